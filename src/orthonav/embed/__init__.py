"""Embeddings: a picture as a short vector whose scalar product says how alike two places look."""

from orthonav.variants import Variant

TABLE = {"gradient": Variant("orthonav.embed.whitened:WhitenedRecipe")}
"""Methods by the name that `orthonav build --method` takes."""
