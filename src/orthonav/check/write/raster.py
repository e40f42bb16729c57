"""The cells of a check as a GeoTIFF in the plane of the map's sheet."""

import math
from typing import Any

import numpy as np

from orthonav.check.outcome import CELL_VALUES, CheckResult


def tif_bytes(result: CheckResult) -> bytes:
    """The file: float32, NaN where unknown, north up, conditions as tags.

    Made in memory (28 bytes per cell before compression), because GDAL does not report a full disk.
    """
    from rasterio import Affine
    from rasterio.io import MemoryFile

    cells = result.cells
    rows, cols = cells.probability.shape
    side = cells.side_m
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": cols,
        "height": rows,
        "count": len(CELL_VALUES),
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
            for number, (name, meaning) in enumerate(CELL_VALUES.items(), start=1):
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
