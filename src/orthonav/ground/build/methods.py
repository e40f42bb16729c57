"""Methods and their default representations, as named on the command line."""

import logging
from importlib.util import find_spec
from typing import Any

from orthonav.core.errors import MissingExtraError, VariantError
from orthonav.core.extras import needed, pip_line
from orthonav.core.tiles import embed, represent
from orthonav.core.tiles.gray import Gray
from orthonav.core.tiles.network import AutoEncoderRecipe, TripletRecipe
from orthonav.core.tiles.whitened import WhitenedRecipe
from orthonav.core.tiles.words import WordsRecipe
from orthonav.core.variants import make_variant, variant_recipe
from orthonav.ground.build.encoders import EncoderRecipe

log = logging.getLogger(__name__)

LEARNT_WITH = {
    "autoencoder": ("torch", "onnx", "onnxruntime"),
    "caevl": ("torch", "onnx", "onnxruntime"),
    "triplet": ("torch", "onnx", "onnxruntime"),
    "bovw": ("faiss",),
}
"""Modules of the extra "train" that learning a method needs."""
USUAL_EDGES = {"autoencoder": "canny", "caevl": "canny", "triplet": "gray", "bovw": "gray"}
DEVICES = ("auto", "cpu", "cuda")
LOCAL_FIELDS = ("weights", "cache")


def usual_edges(method: str) -> str:
    """The default representation of a method; for methods of the paper, its choice."""
    name = method.partition(":")[0]
    return USUAL_EDGES.get(name, "gradient")


def method_recipe(method: str, representation: Any) -> WhitenedRecipe | EncoderRecipe:
    """The recipe of a method; one-channel images are whitened on finer cells by default.

    Raises `VariantError`, and `MissingExtraError` naming all that learning it needs and lacks.
    """
    name, _, parameters = method.partition(":")
    absent = [each for each in LEARNT_WITH.get(name, ()) if find_spec(each) is None]
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
    if not represent.TABLE[_name_of(representation)].flies:
        log.warning(
            "%s is too slow for flight: this map is for experiments", _name_of(representation)
        )
    return recipe


def check_device(name: str) -> None:
    """Raise `VariantError` for an unknown device, and for a GPU that PyTorch does not see."""
    if name not in DEVICES:
        raise VariantError(f"device must be {', '.join(DEVICES)}, got '{name}'")
    if name == "cuda" and not needed("torch", "train", "a GPU").cuda.is_available():
        raise VariantError("PyTorch sees no GPU; use --device auto or cpu")


def check_positives(recipe: WhitenedRecipe | EncoderRecipe, representation: Any) -> None:
    """Raise `VariantError` if a triplet network without other dates would need days.

    Its positives would be segmented anew at every step: seconds to minutes each.
    """
    if isinstance(recipe, TripletRecipe) and not represent.TABLE[_name_of(representation)].flies:
        raise VariantError(
            f"a triplet network on {_name_of(representation)} edges needs orthophotos of other "
            "dates; give --other-date"
        )


def stored_representation(representation: Any) -> dict[str, Any]:
    """Recipe of a representation for a manifest, without local paths and devices."""
    recipe = variant_recipe(represent.TABLE, representation)
    return {name: "" if name in LOCAL_FIELDS else value for name, value in recipe.items()}


def _name_of(representation: Any) -> str:
    return str(variant_recipe(represent.TABLE, representation)["name"])
