"""Learning the embeddings of the paper: auto-encoder, triplet network, bag of visual words."""

import importlib
import logging
import os
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MissingExtraError, VariantError
from orthonav.core.extras import needed, pip_line
from orthonav.core.files import Progress
from orthonav.core.tiles import embed, represent
from orthonav.core.tiles.network import AutoEncoderRecipe, NetworkEmbedder, TripletRecipe
from orthonav.core.tiles.represent import Gray
from orthonav.core.tiles.whitened import WhitenedRecipe
from orthonav.core.tiles.words import WordsEmbedder, WordsRecipe
from orthonav.core.variants import make_variant, variant_recipe
from orthonav.ground.build.calibrate import changed
from orthonav.ground.build.sheet import SheetPictures
from orthonav.research.caevl_recipe import CaevlRecipe
from orthonav.research.tiles import SheetTiles
from orthonav.research.words import SheetWords, learn_words

if TYPE_CHECKING:
    from orthonav.ground.build.build import BuildRequest

log = logging.getLogger(__name__)

EncoderRecipe = AutoEncoderRecipe | TripletRecipe | WordsRecipe
Encoder = NetworkEmbedder | WordsEmbedder


def usual_edges(method: str) -> str:
    edges = {"autoencoder": "canny", "caevl": "canny", "triplet": "gray", "bovw": "gray"}
    return edges.get(method.partition(":")[0], "gradient")


def method_recipe(method: str, representation: Any) -> WhitenedRecipe | EncoderRecipe:
    """One-channel images are whitened on finer cells by default."""
    name, _, parameters = method.partition(":")
    network = ("torch", "onnx", "onnxruntime")
    learnt_with = {"autoencoder": network, "caevl": network, "triplet": network, "bovw": ("faiss",)}
    absent = [each for each in learnt_with.get(name, ()) if find_spec(each) is None]
    if absent:
        gone = ", ".join(absent)
        raise MissingExtraError(f"--method {name} needs {gone}: {pip_line('train')}")
    if name == "gradient" and representation.channels == 1 and "cells=" not in parameters:
        method = f"{name}:{parameters},cells=16"
    recipe = make_variant(embed.TABLE, method)
    assert isinstance(recipe, WhitenedRecipe | AutoEncoderRecipe | TripletRecipe | WordsRecipe)
    if isinstance(recipe, WordsRecipe) and not isinstance(representation, Gray):
        raise VariantError("bovw needs grey levels; give --edges gray, or omit --edges")
    if isinstance(recipe, WhitenedRecipe) and getattr(representation, "per", "sheet") == "tile":
        raise VariantError(
            "edges per tile need a network; give --method autoencoder, caevl or triplet"
        )
    name = stored_representation(representation)["name"]
    if not represent.TABLE[name].flies:
        log.warning("%s is too slow for flight: this map is for experiments", name)
    return recipe


def check_device(name: str) -> None:
    if name not in ("auto", "cpu", "cuda"):
        raise VariantError(f"device must be auto, cpu or cuda, got '{name}'")
    if name == "cuda" and not needed("torch", "train", "a GPU").cuda.is_available():
        raise VariantError("PyTorch sees no GPU; use device auto or cpu")


def stored_representation(representation: Any) -> dict[str, Any]:
    """For a manifest: without local paths and devices."""
    recipe = variant_recipe(represent.TABLE, representation)
    local = ("weights", "cache")
    return {name: "" if name in local else value for name, value in recipe.items()}


MAX_WORD_TILES = 2000


def learn_encoder(
    recipe: EncoderRecipe,
    pictures: SheetPictures,
    other_dates: Sequence[SheetPictures],
    tiles_px: NDArray[np.intp],
    representation: Any,
    request: "BuildRequest",
    progress: Progress,
) -> tuple[Encoder, NDArray[np.float16]]:
    """The embedder, and embeddings (N, D) of the reference tiles. CAEVL learns from one date.

    Positives of a triplet network are the same tiles of `other_dates`, or tiles with simulated
    ageing.
    """
    tiles = pictures.tiles(tiles_px, progress)
    if isinstance(recipe, WordsRecipe):
        step = -(-len(tiles) // MAX_WORD_TILES)
        chosen = ((tiles.grey_tile(i), tiles.valid_tile(i)) for i in range(0, len(tiles), step))
        encoder = learn_words(
            recipe, chosen, request.seed, lambda share: progress("learn words", share)
        )
        if encoder.detector is None:
            found = SheetWords.find(
                encoder, tiles.pixels[0], tiles.valid, lambda share: progress("find words", share)
            )
            at, side = tiles.tiles_px, tiles.tile_px
            return encoder, _embedded(lambda of: found.views(at[of], side), tiles, progress)

        def words(indices: NDArray[np.intp]) -> NDArray[np.float32]:
            valid = np.stack([tiles.valid_tile(int(index)) for index in indices])
            return encoder.views(tiles.batch(indices), valid)

        return encoder, _embedded(words, tiles, progress)
    needed("torch", "train", "learning a network")
    if os.environ.get("WORLD_SIZE", "1") != "1":
        raise VariantError("a network is trained by one process: run the command without torchrun")
    training = importlib.import_module("orthonav.research.training")
    device = None if request.device == "auto" else request.device

    def report(text: str, share: float) -> None:
        log.info("%s", text, extra={"share": share})
        progress("learn", share)

    how: dict[str, Any] = {
        "binary": not pictures.is_grey,
        "seed": request.seed,
        "work": request.work,
        "report": report,
        "means": training.Means(device=device, workers=request.workers),
    }
    if isinstance(recipe, CaevlRecipe):
        caevl = importlib.import_module("orthonav.research.caevl")
        trained = caevl.learn_caevl(recipe, tiles, representation, **how)
    else:
        positive: Any = [each.tiles(tiles_px, progress) for each in other_dates]
        positive = positive or _changed_tiles(tiles, representation)
        trained = training.learn_network(recipe, tiles, positive=positive, **how)
    embedded = _embedded(lambda of: trained.views(tiles.batch(of)), tiles, progress)
    _require_as_in_flight(trained.embedder, tiles, embedded)
    return trained.embedder, embedded


def _require_as_in_flight(
    embedder: NetworkEmbedder, tiles: SheetTiles, embedded: NDArray[np.float16]
) -> None:
    """On 32 tiles, up to four times the precision of float16."""
    some = np.unique(np.linspace(0, len(tiles) - 1, 32).astype(np.intp))
    flown, found = embedder.views(tiles.batch(some)), embedded[some].astype(np.float32)
    away = float(np.abs(flown - found).max())
    if away > 4e-3 * max(float(np.abs(flown).max()), 1e-6):
        raise VariantError(
            f"the device embeds tiles otherwise than the encoder in flight, by {away:.2g}; "
            "hide the GPU (CUDA_VISIBLE_DEVICES=)"
        )


def _changed_tiles(
    tiles: SheetTiles, representation: Any
) -> Callable[[np.random.Generator, NDArray[np.uint8]], NDArray[np.float32]]:
    """Generates a positive (1, S, S) from the grey levels (S, S) of a tile."""

    def positive(rng: np.random.Generator, grey: NDArray[np.uint8]) -> NDArray[np.float32]:
        # Mirrored, so that it does not occur on the map.
        negative = tiles.grey_tile(int(rng.integers(len(tiles))))[:, ::-1]
        # Weaker than in calibration: with the stronger change a network learned a third as much
        # in its first 300 batches.
        made = changed(rng, grey, negative, most_replaced=0.35, most_mixed=0.4)
        return np.asarray(representation(made, np.ones(made.shape, np.bool_)), np.float32)

    return positive


def _embedded(
    embed: Callable[[NDArray[np.intp]], NDArray[np.float32]], tiles: SheetTiles, progress: Progress
) -> NDArray[np.float16]:
    """Embeddings (N, D) of all tiles; `embed` takes indices of some."""
    parts = []
    for start in range(0, len(tiles), 64):
        indices = np.arange(start, min(start + 64, len(tiles)))
        parts.append(embed(indices).astype(np.float16))
        progress("embed", (int(indices[-1]) + 1) / len(tiles))
    out = np.concatenate(parts)
    if not np.isfinite(out).all():
        raise VariantError(
            "embeddings are too large to be stored; learn with similarity=cosine, a smaller "
            "learning_rate or fewer epochs"
        )
    return out
