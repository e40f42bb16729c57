"""Makes `golden_v1.onav` and `golden_view.png`, and prints what `test_golden.py` expects of them.

    python tests/data/make_golden.py

A map file of version 1 must stay readable for good: make it again only for another version.
"""

import tempfile
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray

from orthonav.core.geo.camera import Camera
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import GreyLayer, open_map
from orthonav.core.records import Fix, Telemetry, View
from orthonav.ground.build import BuildRequest, build_map

HERE = Path(__file__).parent
MAP, VIEW = HERE / "golden_v1.onav", HERE / "golden_view.png"
SIZE_PX = 288
"""The ground is this many metres across, at 1 m a pixel."""
CENTRE_PX, YAW_DEG, VIEW_GSD_M = (131.0, 160.0), 20.0, 0.8
CAMERA = Camera(160, 160, 200.0, 200.0, 80.0, 80.0)
TELEMETRY = Telemetry(0, YAW_DEG, 0.0, 0.0, VIEW_GSD_M * 200.0, tilt_std_deg=0.0)


def ground() -> NDArray[np.uint8]:
    """Random grey levels (S, S) with structure from 2 to 16 m."""
    rng = np.random.default_rng(20211)
    grey = np.zeros((SIZE_PX, SIZE_PX), dtype=np.float32)
    for sigma in (2, 5, 16):
        layer = cv2.GaussianBlur(rng.normal(size=grey.shape).astype(np.float32), (0, 0), sigma)
        grey += layer / layer.std()
    return np.clip(128 + 30 * grey, 0, 255).astype(np.uint8)


def view_of(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The ground seen straight down around `CENTRE_PX`, turned, a little darker and noisy."""
    turn = np.radians(YAW_DEG)
    axes = VIEW_GSD_M * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    half = np.array([CAMERA.width_px, CAMERA.height_px]) / 2
    # Both count from the pixel's outer corner; OpenCV from its centre.
    shift = np.array(CENTRE_PX) - 0.5 - axes @ (half - 0.5)
    matrix = np.column_stack([axes, shift])
    size = (CAMERA.width_px, CAMERA.height_px)
    seen = cv2.warpAffine(grey, matrix, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    noise = np.random.default_rng(7).normal(0, 2, seen.shape)
    return np.asarray(np.clip(seen * 0.8 + noise, 0, 255), dtype=np.uint8)


def write_ortho(path: Path, grey: NDArray[np.uint8]) -> None:
    """The ground as an orthophoto, on the central meridian of Lambert-93 (grid north is true)."""
    x, y = 700_000.0, 6_600_000.0
    transform = rasterio.transform.from_origin(x - SIZE_PX / 2, y + SIZE_PX / 2, 1.0, 1.0)
    profile = {"driver": "GTiff", "dtype": "uint8", "count": 1, "crs": "EPSG:2154"}
    size = {"width": SIZE_PX, "height": SIZE_PX, "transform": transform}
    with rasterio.open(path, "w", **profile, **size) as data:
        data.write(grey, 1)
        data.update_tags(TIFFTAG_DATETIME="2021:06:17 10:00:00")


def main() -> None:
    """Write both files and print the expected values."""
    grey = ground()
    with tempfile.TemporaryDirectory() as folder:
        ortho = Path(folder) / "golden.tif"
        write_ortho(ortho, grey)
        request = BuildRequest([ortho], MAP, gsd_m=1.0, tile_px=96, method="gradient:dims=16")
        build_map(request)
    done, encoded = cv2.imencode(".png", view_of(grey))
    assert done
    VIEW.write_bytes(encoded.tobytes())
    opened = open_map(MAP)
    fix = Localizer(opened).locate(View(view_of(grey), CAMERA, TELEMETRY))
    assert isinstance(fix, Fix)
    sheet = opened.manifest.sheets[0]
    found = sheet.frame.en_from_latlon(fix.lat_deg, fix.lon_deg)
    off = found - [CENTRE_PX[0] - SIZE_PX / 2, SIZE_PX / 2 - CENTRE_PX[1]]
    print("SHEET =", sheet)
    print("FIRST_EMBEDDING =", opened.arrays["sheet0/embeddings"][0, :5].tolist())
    print("LAST_CENTRE_EN_M =", opened.arrays["sheet0/centres_en_m"][-1].tolist())
    layer = GreyLayer.of(opened)
    assert layer is not None
    print("GREY_ROW =", layer.read(1, 96, 60, 1, 8)[0][0].tolist())
    print("FIX_DEG =", (round(fix.lat_deg, 9), round(fix.lon_deg, 9)))
    print("RADIUS_M =", fix.radius_m)
    print("CONFIDENCE =", round(fix.confidence, 4))
    print(f"# the fix is {np.hypot(*off):.2f} m off")


if __name__ == "__main__":
    main()
