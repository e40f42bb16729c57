"""Learning the embeddings of the paper: auto-encoder, triplet network, bag of visual words."""

import importlib
import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.embed.network import AutoEncoderRecipe, NetworkEmbedder, TripletRecipe
from orthonav.embed.words import WordsEmbedder, WordsRecipe
from orthonav.errors import VariantError
from orthonav.extras import needed
from orthonav.files import Progress
from orthonav.neural.tiles import SheetTiles
from orthonav.neural.words import learn_words
from orthonav.prepare.change import changed
from orthonav.prepare.pictures import SheetPictures

log = logging.getLogger(__name__)

BATCH_TILES = 64
MAX_WORD_TILES = 2000
MOST_REPLACED, MOST_MIXED = 0.35, 0.4
"""Change of the positives of a triplet, weaker than in calibration: with the stronger change a
network learned a third as much in its first 300 batches."""

EncoderRecipe = AutoEncoderRecipe | TripletRecipe | WordsRecipe
Encoder = NetworkEmbedder | WordsEmbedder


def learn_encoder(
    recipe: EncoderRecipe,
    pictures: SheetPictures,
    other_dates: Sequence[SheetPictures],
    tiles_px: NDArray[np.intp],
    representation: Any,
    seed: int,
    work: Path | None,
    progress: Progress,
) -> tuple[Encoder, NDArray[np.float16]]:
    """Learn from the reference tiles and embed them: the embedder and embeddings (N, D).

    A triplet network's positives are the same tiles of `other_dates`; without any, the tiles
    themselves with simulated ageing. `work`: folder for checkpoints and images of networks.
    Raises `MissingExtraError` if PyTorch or faiss is needed and missing.
    """
    tiles = pictures.tiles(tiles_px)
    encoder: Encoder
    if isinstance(recipe, WordsRecipe):
        chosen = _word_tiles(tiles)
        encoder = learn_words(recipe, chosen, seed, lambda share: progress("learn words", share))
    else:
        positive: Any = [each.tiles(tiles_px) for each in other_dates]
        learn_network = _training().learn_network
        encoder = learn_network(
            recipe,
            tiles,
            binary=not pictures.is_grey,
            seed=seed,
            work=work,
            positive=positive or _changed_tiles(tiles, representation),
            report=lambda text, share: _log_progress(progress, text, share),
        )
    return encoder, _embedded(encoder, tiles, progress)


def _log_progress(progress: Progress, text: str, share: float) -> None:
    log.info("%s", text)
    progress("learn", share)


def _word_tiles(tiles: SheetTiles) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.bool_]]]:
    step = -(-len(tiles) // MAX_WORD_TILES)
    for index in range(0, len(tiles), step):
        yield tiles.grey_tile(index), tiles.valid_tile(index)


def _changed_tiles(
    tiles: SheetTiles, representation: Any
) -> Callable[[np.random.Generator, NDArray[np.uint8]], NDArray[np.float32]]:
    """Function that generates a positive (1, S, S) from the grey levels (S, S) of a tile."""

    def positive(rng: np.random.Generator, grey: NDArray[np.uint8]) -> NDArray[np.float32]:
        # Mirrored, so that it does not occur on the map.
        negative = tiles.grey_tile(int(rng.integers(len(tiles))))[:, ::-1]
        made = changed(rng, grey, negative, most_replaced=MOST_REPLACED, most_mixed=MOST_MIXED)
        return np.asarray(representation(made, np.ones(made.shape, np.bool_)), np.float32)

    return positive


def _embedded(encoder: Encoder, tiles: SheetTiles, progress: Progress) -> NDArray[np.float16]:
    out = np.empty((len(tiles), encoder.dims), np.float16)
    for start in range(0, len(tiles), BATCH_TILES):
        indices = np.arange(start, min(start + BATCH_TILES, len(tiles)))
        maps = tiles.batch(indices)
        if isinstance(encoder, WordsEmbedder):
            valid = np.stack([tiles.valid_tile(int(index)) for index in indices])
            out[indices] = encoder.views(maps, valid)
        else:
            out[indices] = encoder.views(maps)
        progress("embed", (int(indices[-1]) + 1) / len(tiles))
    if not np.isfinite(out).all():
        raise VariantError(
            "embeddings are too large to be stored; learn with similarity=cosine, a smaller "
            "learning_rate or fewer epochs"
        )
    return out


def _training() -> Any:
    needed("torch", "train", "learning a network")
    return importlib.import_module("orthonav.neural.training")
