"""Embeddings: a picture as a short vector whose scalar product says how alike two places look."""

from orthonav.variants import Variant

TABLE = {
    "gradient": Variant("orthonav.embed.whitened:WhitenedRecipe"),
    "autoencoder": Variant("orthonav.embed.network:AutoEncoderRecipe", extra="neural"),
    "triplet": Variant("orthonav.embed.network:TripletRecipe", extra="neural"),
    "bovw": Variant("orthonav.embed.words:WordsRecipe"),
}
"""Methods by the name that `orthonav build --method` takes."""
