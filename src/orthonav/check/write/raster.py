"""The cells of a check as a GeoTIFF in the plane of the map's sheet."""

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
    "trials": "number of views tried",
    "persistence": "expected correlation of the ground with another year, 0 to 1",
}
"""Bands in order: name (the band's description in the file) and meaning."""


def tif_bytes(result: CheckResult) -> bytes:
    """The file: float32, NaN where unknown, north up, conditions as tags.

    Made in memory (28 bytes per cell before compression), because GDAL does not report a full disk.
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
            for number, (name, meaning) in enumerate(BANDS.items(), start=1):
                target.write(np.asarray(getattr(cells, name), dtype=np.float32), number)
                target.set_band_description(number, name)
                target.update_tags(number, meaning=meaning)
            target.update_tags(**_tags(result))
        return bytes(memory.read())


def _tags(result: CheckResult) -> dict[str, str]:
    """What was checked under which conditions; unknown values are left out."""
    tags = {"TIFFTAG_SOFTWARE": f"orthonav {result.about.version}".strip()}
    values = {
        "map": result.about.map_name,
        "imagery": result.about.imagery,
        "route": result.about.route_name,
        "verdict": result.verdict.word.value,
        **vars(result.conditions),
    }
    for name, value in values.items():
        if value not in (None, ""):
            text = value if isinstance(value, str) else f"{value:.9g}"
            tags[f"ORTHONAV_{name.upper()}"] = text.encode("utf-8", "replace").decode("utf-8")
    return tags
