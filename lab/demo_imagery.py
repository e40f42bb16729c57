"""Make the imagery that `orthonav demo` ships: `python -m lab.demo_imagery [FOLDER]`.

Two dates of one generated area of 2 x 2 km at 1 m per pixel, seed 1, as GeoTIFF compressed with
JPEG. On one machine with the same NumPy, OpenCV and GDAL the files are the same to the bit. Other
processors round single pixels of the generated landscape differently. The golden views are views
of this imagery: renew them too (`make golden`).
"""

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import rasterio

from lab.landscape import DEFAULT_DATES, generate_area

FOLDER = Path(__file__).parents[1] / "src" / "orthonav" / "ground" / "demo_data"
SEED = 1
JPEG_QUALITY = 90
"""About 2 MB for both dates; grey levels differ from the generated ones by 1.7 on average."""


def main(arguments: Sequence[str]) -> None:
    """Write the imagery to a folder, by default that of the package."""
    folder = Path(arguments[0]) if arguments else FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        for path in generate_area(Path(scratch), dates=DEFAULT_DATES[:2], seed=SEED):
            compress(path, folder / path.name)
            print(folder / path.name)


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


if __name__ == "__main__":
    main(sys.argv[1:])
