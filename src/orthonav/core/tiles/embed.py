"""Embeddings: pictures as short vectors whose scalar product is the similarity of two places.

Auto-encoder, triplet network and bag of words are those of Di Piazza et al. 2024, section
Methodology; gradients are orthonav's default, CAEVL is a later work."""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MapFileError, VariantError
from orthonav.core.tiles.network import AutoEncoderRecipe, NetworkEmbedder, TripletRecipe
from orthonav.core.tiles.whitened import WhitenedEmbedder, WhitenedRecipe
from orthonav.core.tiles.words import WordsEmbedder, WordsRecipe
from orthonav.core.variants import Variant, variant_from_recipe

TABLE = {
    "gradient": Variant("orthonav.core.tiles.whitened:WhitenedRecipe"),
    "autoencoder": Variant("orthonav.core.tiles.network:AutoEncoderRecipe", extra="neural"),
    "caevl": Variant("orthonav.research.caevl_recipe:CaevlRecipe", extra="neural"),
    "triplet": Variant("orthonav.core.tiles.network:TripletRecipe", extra="neural"),
    "bovw": Variant("orthonav.core.tiles.words:WordsRecipe"),
}
Part = Callable[[str, Any, int], NDArray[Any]]


class ViewEmbedder(Protocol):
    """A learnt embedding: a view's representation becomes a vector for scalar products."""

    @property
    def recipe(self) -> Any:
        pass

    @property
    def dims(self) -> int:
        pass

    def view(self, maps: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
        """(D,) of a representation (C, S, S); `valid` (S, S) is what was seen."""

    def parts(self) -> dict[str, NDArray[Any]]:
        pass


def embedder_of(plain: Any, part: Part, channels: int) -> ViewEmbedder:
    """Raises `VariantError` for an unknown recipe, `MapFileError` for parts that do not fit."""
    recipe: Any = variant_from_recipe(TABLE, plain)
    if isinstance(recipe, WhitenedRecipe):
        return _whitened(recipe, part, channels)
    if isinstance(recipe, AutoEncoderRecipe | TripletRecipe):
        return _network(recipe, part, channels)
    if isinstance(recipe, WordsRecipe):
        return _words(recipe, part)
    raise MapFileError(f"map's embedding '{plain}' cannot be flown with this program")


def _whitened(recipe: WhitenedRecipe, part: Part, channels: int) -> WhitenedEmbedder:
    mean, basis = part("mean", np.float16, 1), part("basis", np.float16, 2)
    if not basis.shape[0] == mean.shape[0] == recipe.cells**2 * channels:
        raise MapFileError("map's embedding parts do not fit together")
    if not (np.isfinite(mean).all() and np.isfinite(basis).all()):
        raise MapFileError("map's embedding is not finite")
    return WhitenedEmbedder(recipe, mean, basis)


def _network(
    recipe: AutoEncoderRecipe | TripletRecipe, part: Part, channels: int
) -> NetworkEmbedder:
    made = NetworkEmbedder(recipe, part("onnx", np.uint8, 1))
    # Fails here, not at the first view, where onnxruntime is absent.
    if made.shape[0] != channels:
        raise MapFileError(
            f"map's encoder takes {made.shape[0]} channels, its representation has {channels}"
        )
    return made


def _words(recipe: WordsRecipe, part: Part) -> WordsEmbedder:
    if recipe.features != "sift":
        # Its recipe names a file of weights; a map must not choose which files are read.
        raise MapFileError(f"words of {recipe.features} do not fly")
    try:
        return WordsEmbedder(recipe, part("vocabulary", np.uint8, 2), part("idf", np.float32, 1))
    except VariantError as error:
        raise MapFileError(f"map's words do not fit: {error}") from error
