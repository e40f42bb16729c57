"""Embeddings: pictures as short vectors whose scalar product is the similarity of two places."""

from orthonav.core.variants import Variant

TABLE = {
    "gradient": Variant("orthonav.core.tiles.whitened:WhitenedRecipe"),
    "autoencoder": Variant("orthonav.core.tiles.network:AutoEncoderRecipe", extra="neural"),
    "caevl": Variant("orthonav.research.caevl_recipe:CaevlRecipe", extra="neural"),
    "triplet": Variant("orthonav.core.tiles.network:TripletRecipe", extra="neural"),
    "bovw": Variant("orthonav.core.tiles.words:WordsRecipe"),
}
"""Methods by the name that `orthonav build --method` takes."""
