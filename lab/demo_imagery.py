"""Make the imagery that `orthonav demo` ships: `python -m lab.demo_imagery [FOLDER]`.

Two dates of one generated area of 2 x 2 km at 1 m per pixel, seed 1, as GeoTIFF compressed with
JPEG, and the terrain under it and around it, which is level. On one machine with the same NumPy,
OpenCV and GDAL the files are the same to the bit. Other processors round single pixels of the
generated landscape differently. The golden views are views of this imagery: renew them too
(`make golden`).
"""

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import Affine

from lab.landscape import DEFAULT_DATES, generate_area
from orthonav.ground.imagery.terrain import DATUM_TAG

FOLDER = Path(__file__).parents[1] / "src" / "orthonav" / "ground" / "demo_data"
SEED = 1
JPEG_QUALITY = 90
"""About 2 MB for both dates; grey levels differ from the generated ones by 1.7 on average."""
GROUND_M = 40.0
"""Height of the ground above the sea, also where the recorded flights of `benchmarks.closed_loop`
were flown."""
POSTING_M, REACH_M = 25.0, 1000.0
"""Of the terrain, and how far it reaches beyond the imagery."""


def main(arguments: Sequence[str]) -> None:
    """Write the imagery to a folder, by default that of the package."""
    folder = Path(arguments[0]) if arguments else FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        dates = generate_area(Path(scratch), dates=DEFAULT_DATES[:2], seed=SEED)
        for path in dates:
            compress(path, folder / path.name)
            print(folder / path.name)
        write_terrain(dates[0], folder / "dem.tif")
        print(folder / "dem.tif")


def compress(source: Path, target: Path) -> None:
    """Write an orthophoto as a tiled GeoTIFF compressed with JPEG, with its date."""
    with rasterio.open(source) as data:
        rgb, tags = data.read(), data.tags()
        place = {"crs": data.crs, "transform": data.transform}
        size = {"width": data.width, "height": data.height, "count": 3, "dtype": "uint8"}
    layout = {"tiled": True, "blockxsize": 512, "blockysize": 512, "interleave": "pixel"}
    jpeg = {"compress": "jpeg", "photometric": "YCBCR", "JPEG_QUALITY": JPEG_QUALITY}
    with rasterio.open(target, "w", driver="GTiff", **place, **size, **layout, **jpeg) as data:
        data.write(rgb)
        data.update_tags(
            TIFFTAG_DATETIME=tags["TIFFTAG_DATETIME"], TIFFTAG_SOFTWARE=tags["TIFFTAG_SOFTWARE"]
        )


def write_terrain(ortho: Path, target: Path) -> None:
    """Write level ground under an orthophoto and around it."""
    with rasterio.open(ortho) as data:
        west, south, east, north = data.bounds
        crs = data.crs
    shape = [round((each + 2 * REACH_M) / POSTING_M) for each in (north - south, east - west)]
    place = Affine(POSTING_M, 0, west - REACH_M, 0, -POSTING_M, north + REACH_M)
    size = {"width": shape[1], "height": shape[0], "count": 1, "dtype": "float32"}
    layout = {"driver": "GTiff", "compress": "deflate", "tiled": True}
    with rasterio.open(target, "w", crs=crs, transform=place, **size, **layout) as data:
        data.write(np.full((1, *shape), GROUND_M, np.float32))
        data.update_tags(**{DATUM_TAG: "msl"})


if __name__ == "__main__":
    main(sys.argv[1:])
