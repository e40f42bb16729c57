"""Learning the embeddings of the paper: auto-encoder, triplet network, bag of visual words."""

import importlib
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import VariantError
from orthonav.core.extras import needed
from orthonav.core.files import Progress
from orthonav.core.tiles.network import AutoEncoderRecipe, NetworkEmbedder, TripletRecipe
from orthonav.core.tiles.words import WordsEmbedder, WordsRecipe
from orthonav.ground.build.change import changed
from orthonav.ground.build.pictures import SheetPictures
from orthonav.research.tiles import SheetTiles
from orthonav.research.words import learn_words

log = logging.getLogger(__name__)

BATCH_TILES = 64
MAX_WORD_TILES = 2000
CHECKED_TILES, SAME = 32, 4e-3
"""Tiles on which a device is compared with flight, and the largest difference, relative to the
largest value: four times that of float16."""
MOST_REPLACED, MOST_MIXED = 0.35, 0.4
"""Change of the positives of a triplet, weaker than in calibration: with the stronger change a
network learned a third as much in its first 300 batches."""

EncoderRecipe = AutoEncoderRecipe | TripletRecipe | WordsRecipe
Encoder = NetworkEmbedder | WordsEmbedder


@dataclass(frozen=True)
class Learning:
    """How to learn: seed of all draws, and of networks what `BuildRequest` says of each."""

    seed: int = 0
    work: Path | None = None
    device: str = "auto"
    workers: int | None = None


def learn_encoder(
    recipe: EncoderRecipe,
    pictures: SheetPictures,
    other_dates: Sequence[SheetPictures],
    tiles_px: NDArray[np.intp],
    representation: Any,
    learning: Learning,
    progress: Progress,
) -> tuple[Encoder, NDArray[np.float16]]:
    """Learn from the reference tiles and embed them: the embedder and embeddings (N, D).

    A triplet network's positives are the same tiles of `other_dates`; without any, the tiles
    themselves with simulated ageing.
    Raises `MissingExtraError` if PyTorch or faiss is needed and missing.
    """
    tiles = pictures.tiles(tiles_px, progress)
    if isinstance(recipe, WordsRecipe):
        chosen = _word_tiles(tiles)
        encoder = learn_words(
            recipe, chosen, learning.seed, lambda share: progress("learn words", share)
        )
        return encoder, _embedded(lambda of: _words(encoder, tiles, of), tiles, progress)
    positive: Any = [each.tiles(tiles_px, progress) for each in other_dates]
    training = _training()
    device = None if learning.device == "auto" else learning.device
    trained = training.learn_network(
        recipe,
        tiles,
        binary=not pictures.is_grey,
        seed=learning.seed,
        work=learning.work,
        positive=positive or _changed_tiles(tiles, representation),
        report=lambda text, share: _log_progress(progress, text, share),
        means=training.Means(device=device, workers=learning.workers),
    )
    embedded = _embedded(lambda of: trained.views(tiles.batch(of)), tiles, progress)
    _require_as_in_flight(trained.embedder, tiles, embedded)
    return trained.embedder, embedded


def _require_as_in_flight(
    embedder: NetworkEmbedder, tiles: SheetTiles, embedded: NDArray[np.float16]
) -> None:
    """Raise `VariantError` if a device embeds tiles otherwise than the encoder that flies."""
    some = np.unique(np.linspace(0, len(tiles) - 1, CHECKED_TILES).astype(np.intp))
    flown, found = embedder.views(tiles.batch(some)), embedded[some].astype(np.float32)
    away = float(np.abs(flown - found).max())
    if away > SAME * max(float(np.abs(flown).max()), 1e-6):
        raise VariantError(
            f"the device embeds tiles otherwise than the encoder in flight, by {away:.2g}; "
            "learn with --device cpu"
        )


def _log_progress(progress: Progress, text: str, share: float) -> None:
    log.info("%s", text, extra={"share": share})
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


def _words(
    encoder: WordsEmbedder, tiles: SheetTiles, indices: NDArray[np.intp]
) -> NDArray[np.float32]:
    valid = np.stack([tiles.valid_tile(int(index)) for index in indices])
    return encoder.views(tiles.batch(indices), valid)


def _embedded(
    embed: Callable[[NDArray[np.intp]], NDArray[np.float32]], tiles: SheetTiles, progress: Progress
) -> NDArray[np.float16]:
    """Embeddings (N, D) of all tiles; `embed` takes indices of some."""
    parts = []
    for start in range(0, len(tiles), BATCH_TILES):
        indices = np.arange(start, min(start + BATCH_TILES, len(tiles)))
        parts.append(embed(indices).astype(np.float16))
        progress("embed", (int(indices[-1]) + 1) / len(tiles))
    out = np.concatenate(parts)
    if not np.isfinite(out).all():
        raise VariantError(
            "embeddings are too large to be stored; learn with similarity=cosine, a smaller "
            "learning_rate or fewer epochs"
        )
    return out


def _training() -> Any:
    needed("torch", "train", "learning a network")
    return importlib.import_module("orthonav.research.training")
