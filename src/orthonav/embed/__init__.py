"""Embeddings: pictures as short vectors whose scalar product is the similarity of two places."""

from orthonav.variants import Variant

TABLE = {
    "gradient": Variant("orthonav.embed.whitened:WhitenedRecipe"),
    "autoencoder": Variant("orthonav.embed.network:AutoEncoderRecipe", extra="neural"),
    "caevl": Variant("orthonav.embed.caevl:CaevlRecipe", extra="neural"),
    "triplet": Variant("orthonav.embed.network:TripletRecipe", extra="neural"),
    "bovw": Variant("orthonav.embed.words:WordsRecipe"),
}
"""Methods by the name that `orthonav build --method` takes."""
