"""Embeddings: pictures as short vectors whose scalar product is the similarity of two places.

Auto-encoder, triplet network and bag of words are those of Di Piazza et al. 2024, section
Methodology; gradients are orthonav's default, CAEVL is a later work."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from orthonav.core.variants import Part, Variant, variant_from_recipe

TABLE = {
    "gradient": Variant("orthonav.core.tiles.whitened:WhitenedRecipe"),
    "autoencoder": Variant("orthonav.core.tiles.network:AutoEncoderRecipe", extra="neural"),
    "caevl": Variant("orthonav.research.caevl_recipe:CaevlRecipe", extra="neural"),
    "triplet": Variant("orthonav.core.tiles.network:TripletRecipe", extra="neural"),
    "bovw": Variant("orthonav.core.tiles.words:WordsRecipe"),
}


class ViewEmbedder(Protocol):
    """A learnt embedding: a view's representation becomes a vector for scalar products.

    Its recipe opens it from the parts of a map: `embedder(part, channels)`."""

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
    made: ViewEmbedder = variant_from_recipe(TABLE, plain).embedder(part, channels)
    return made
