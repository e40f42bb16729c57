"""The cells of a check as a GeoTIFF in the plane of the map's sheet, for GIS programs."""

import math
from typing import Any

import numpy as np

from orthonav.check.outcome import CheckResult
from orthonav.extras import missing_extra

BANDS = {
    "probability": "probability of a correct, confident fix of one view",
    "low": "lower end of its 80 % interval",
    "high": "upper end of its 80 % interval",
    "error_m": "expected error of such a fix, root mean square, metres",
    "wrong": "share of trials that were confident and wrong",
    "trials": "how many views were tried",
    "texture": "how much of what the ground shows is expected to last, 0 to 1",
}
"""Bands in order: name, which is their description in the file, and what it says."""


def tif_bytes(result: CheckResult) -> bytes:
    """The file: float32, NaN where nothing is known, north up, conditions as tags.

    Made in memory, where GDAL has no disk to find full; a cell takes 28 bytes before compression.
    Raises `MissingExtraError` without rasterio.
    """
    try:
        from rasterio import Affine
        from rasterio.io import MemoryFile
    except ImportError as error:
        raise missing_extra("writing a check", "geo", "rasterio", error) from error
    cells = result.cells
    rows, cols = cells.probability.shape
    side = cells.side_m
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": cols,
        "height": rows,
        "count": len(BANDS),
        "dtype": "float32",
        "nodata": math.nan,
        "crs": result.frame.proj4,
        "transform": Affine(side, 0.0, cells.west_m, 0.0, -side, cells.north_m),
        "compress": "deflate",
        "predictor": 3,
        "interleave": "band",
    }
    with MemoryFile() as memory:
        with memory.open(**profile) as target:
            for number, (name, said) in enumerate(BANDS.items(), start=1):
                target.write(np.asarray(getattr(cells, name), dtype=np.float32), number)
                target.set_band_description(number, name)
                target.update_tags(number, said=said)
            target.update_tags(**_tags(result))
        return bytes(memory.read())


def _tags(result: CheckResult) -> dict[str, str]:
    """What was checked and for what; what is not known is left out."""
    tags = {"TIFFTAG_SOFTWARE": f"orthonav {result.about.version}".strip()}
    said = {
        "map": result.about.map_name,
        "imagery": result.about.imagery,
        "route": result.about.route_name,
        "verdict": result.verdict.word.value,
        **vars(result.conditions),
    }
    for name, value in said.items():
        if value not in (None, ""):
            said_as = value if isinstance(value, str) else f"{value:.9g}"
            tags[f"ORTHONAV_{name.upper()}"] = said_as.encode("utf-8", "replace").decode("utf-8")
    return tags
