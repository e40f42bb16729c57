"""How often the 95 % ellipse of a pixel holds the ground that it shows.

`python -m benchmarks.pixel_ellipses [--views 40] [--seed 1] [--area 3] [--work DIR]` places the
views of `benchmarks.over_terrain` with pitch and roll reported off by 1 deg, on maps with a terrain
and on level ground without one, and follows the true rays of some of their pixels to the ground.
"""

import argparse
import math
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.over_terrain import Array, Bench, Row, Seen, home_m, layer_of
from orthonav.cli.heights import map_heights
from orthonav.core.errors import FlightError
from orthonav.core.geo.camera import Camera
from orthonav.core.localize import Localizer
from orthonav.core.localize.ground import Relief
from orthonav.core.records import CONFIDENT, Fix
from orthonav.ground.recordings.pixel import locate_pixel
from orthonav.ground.simulate.perspective import Raster, met, rays_enu
from orthonav.onboard.messages.estimate import ELLIPSE_95

TILT_STD_DEG = 1.0
AT = ((0.5, 0.5), (0.15, 0.8), (0.85, 0.8), (0.3, 0.4), (0.7, 0.4))
"""Pixels, as shares of the picture's sides."""
CHI2_95 = ELLIPSE_95**2
HEADER = (
    "| off nadir | slope | map | fixes | of the camera | of pixels | median pixel error | ellipse |"
)


def shown(each: Seen, hills: Raster, px: tuple[float, float]) -> Array:
    """The ground (3,) that a pixel shows."""
    camera = each.view.camera
    alone = Camera(
        1, 1, camera.fx_px, camera.fy_px, camera.cx_px - px[0] + 0.5, camera.cy_px - px[1] + 0.5
    )
    return np.asarray(met(hills, rays_enu(alone, each.attitude_deg, 1), each.position_m)[0, 0])


def measured(bench: Bench, row: Row, with_terrain: bool) -> str:
    """A row of the table."""
    ground = bench.ground(row.imagery)
    seen, hills = bench.seen(row)
    sheet = ground.opened.manifest.sheets[0]
    terrain, frame = layer_of(row, ground, hills) if with_terrain else None, sheet.frame
    localizer = Localizer(ground.opened)
    if terrain is not None:
        assert localizer.registration is not None
        # It gives heights as a terrain layer does.
        localizer.registration.relief = Relief(terrain, localizer.grid)
    rng = np.random.default_rng(11)
    cameras, pixels, errors, axes = [], [], [], []
    for each in seen:
        off = rng.normal(0, TILT_STD_DEG, 2)
        reported = each.view.telemetry
        reported = replace(
            reported,
            pitch_deg=reported.pitch_deg + float(off[0]),
            roll_deg=reported.roll_deg + float(off[1]),
            tilt_std_deg=TILT_STD_DEG,
            home_m=float(each.position_m[2] - home_m(hills)),
        )
        if terrain is None:
            reported = replace(reported, agl_m=float(each.position_m[2] - home_m(hills)))
        else:
            heights = map_heights(ground.opened, terrain)
            assert heights is not None
            reported = heights.corrected(reported)
        fix = localizer.locate(replace(each.view, telemetry=reported))
        if not isinstance(fix, Fix) or fix.confidence < CONFIDENT:
            continue
        miss = frame.en_from_latlon(fix.lat_deg, fix.lon_deg) - each.position_m[:2]
        cameras.append(float(miss @ np.linalg.solve(fix.cov_en_m2, miss)))
        for share in AT:
            px = share[0] * each.view.camera.width_px, share[1] * each.view.camera.height_px
            there = shown(each, hills, px)
            try:
                found = locate_pixel(each.view.camera, reported, fix, px, terrain)
            except FlightError:
                continue
            if not np.isfinite(there).all():
                continue
            miss = frame.en_from_latlon(found.lat_deg, found.lon_deg) - there[:2]
            pixels.append(float(miss @ np.linalg.solve(found.cov_en_m2, miss)))
            errors.append(float(np.hypot(*miss)))
            axes.append(math.sqrt(CHI2_95 * float(np.linalg.eigvalsh(found.cov_en_m2)[-1])))
    inside = [f"{np.mean(np.array(each) <= CHI2_95):.0%}" for each in (cameras, pixels)]
    return (
        f"| {row.tilt_deg:.0f} deg | {row.slope:g} | {'terrain' if with_terrain else 'level'} |"
        f" {len(cameras)} | {inside[0]} | {inside[1]} |"
        f" {np.median(errors):.1f} m | {np.median(axes):.1f} m |"
    )


def main() -> None:
    """Place, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, help="folder that is kept (default: a temporary one)")
    parser.add_argument("--views", type=int, default=40, help="views of a row")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--area", type=int, default=3, help="seed of the generated imagery")
    parser.add_argument("--tilt-deg", type=float, nargs="+", default=[0.0, 30.0, 60.0])
    options = parser.parse_args()
    cv2.setNumThreads(1)
    print(HEADER + "\n|--:|--:|---|--:|--:|--:|--:|--:|")
    with tempfile.TemporaryDirectory() as temporary:
        work = options.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        bench = Bench(work, options.views, options.seed, options.area)
        for tilt_deg in options.tilt_deg:
            for slope, terrain in ((0.0, False), (0.05, True), (0.15, True)):
                row = Row("oblique", "generated", 480, slope, 300.0, tilt_deg=tilt_deg, agl_m=250.0)
                print(measured(bench, row, terrain), flush=True)


if __name__ == "__main__":
    main()
