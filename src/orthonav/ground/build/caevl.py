"""Learning the embedding of CAEVL: an auto-encoder, fine-tuned on augmented reference tiles."""

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.extras import needed
from orthonav.core.files import Progress
from orthonav.core.tiles.network import NetworkEmbedder
from orthonav.ground.build.encoders import (
    EncoderRecipe,
    Learning,
    _embedded,
    _log_progress,
    _require_as_in_flight,
)
from orthonav.ground.build.pictures import SheetPictures
from orthonav.research.caevl_recipe import CaevlRecipe


def learn_caevl(
    recipe: EncoderRecipe,
    pictures: SheetPictures,
    other_dates: Sequence[SheetPictures],
    tiles_px: NDArray[np.intp],
    representation: Any,
    learning: Learning,
    progress: Progress,
) -> tuple[NetworkEmbedder, NDArray[np.float16]]:
    """As `learn_encoder`, for CAEVL: it learns from one date, so `other_dates` are not used."""
    assert isinstance(recipe, CaevlRecipe) and not other_dates
    needed("torch", "train", "learning a network")
    neural = importlib.import_module("orthonav.research.caevl")
    device = None if learning.device == "auto" else learning.device
    tiles = pictures.tiles(tiles_px, progress)
    trained = neural.learn_caevl(
        recipe,
        tiles,
        representation,
        binary=not pictures.is_grey,
        seed=learning.seed,
        work=learning.work,
        report=lambda text, share: _log_progress(progress, text, share),
        means=neural.Means(device=device, workers=learning.workers),
    )
    embedded = _embedded(lambda of: trained.views(tiles.batch(of)), tiles, progress)
    _require_as_in_flight(trained.embedder, tiles, embedded)
    return trained.embedder, embedded
