"""Single views whose pitch and roll are not reported: how far off they are placed.

`python -m benchmarks.unreported_tilt --work DIR [--views 100] [--tilt 0 2 4] [--width 256 128]
[--only TEXT ..] [--workers 1]` places views of the later date of pairs of dates on maps of the
earlier one. True pitch and roll have a standard deviation of `--tilt` deg each; the telemetry
reports 0 for both and no standard deviation. `--width` is the root of the area that a view covers,
in pixels of the map. Rerun to resume.
"""

import argparse
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.judged_views import is_covered
from benchmarks.placing import views_in
from benchmarks.record import Section, Table, number, quantiles, resumed, rows_path, run, say
from benchmarks.scenes import (
    FAR_M,
    Pair,
    chosen,
    flight,
    leave_one_out_pairs,
    localizer_of,
    map_of,
    ortho,
    root_agl_of,
)
from orthonav.core.geo.camera import axis_on_ground_en_m
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize import Localizer
from orthonav.core.records import CONFIDENT, RADIUS_SHARE, Fix, Telemetry, View
from orthonav.ground.simulate.flight import Errors
from orthonav.onboard.run import SingleViews, locate_view

NAME = "unreported_tilt"
YAW_STD_DEG, AGL_STD = 10.0, 0.1
"""Errors of heading and height, which are reported."""
HEADER = (
    *("scene", "px", "tilt sd", "views", "confident %", "median m", "95 % m", "% of height"),
    *("stated sd m", "NEES", "middle m", "false", "ms"),
)
MEANS, ERRORS = ("variance_m2", "nees"), ("error_m", "share_of_height", "middle_m")
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Flown:
    """A view with unreported tilt, and the truth.

    - `view`: with telemetry that reports it level; `true`: the telemetry without errors.
    - `camera_en_m`, `middle_en_m`: true position of the camera, and of the ground in the middle of
      the picture.
    """

    view: View
    true: Telemetry
    camera_en_m: Array
    middle_en_m: Array


@dataclass(frozen=True)
class Placed:
    """A fix against the truth; `error_m` of the camera, `middle_m` of the middle of the picture."""

    error_m: float
    middle_m: float
    share_of_height: float
    variance_m2: float
    nees: float

    @property
    def is_wrong(self) -> bool:
        """Whether the camera is farther off than tilt explains."""
        return self.error_m > FAR_M and self.share_of_height > RADIUS_SHARE


def tilted_views(
    pair: Pair,
    width_px: int,
    tilt_std_deg: float,
    localizer: Localizer,
    views: int,
    options: argparse.Namespace,
) -> Iterator[Flown]:
    """Views of the later date that the map covers."""
    assert localizer.registration is not None
    frame, path = localizer.sheet.frame, ortho(pair.views, options.work)
    errors = Errors(attitude_std_deg=tilt_std_deg)
    agl_m = root_agl_of(width_px, localizer.grid.gsd_m)
    folder = flight(path, options.work, views=views, errors=errors, seed=options.seed, agl_m=agl_m)
    for count, each in enumerate(views_in(folder)):
        if is_covered(localizer.registration, each.truth_latlon_deg, width_px):
            true = each.view.telemetry
            level = level_telemetry(true, np.random.default_rng([options.seed, count]))
            position = frame.en_from_latlon(*each.truth_latlon_deg)
            axis = axis_on_ground_en_m(true.yaw_deg, true.pitch_deg, true.roll_deg, true.agl_m)
            tilted = replace(each.view, telemetry=level)
            yield Flown(tilted, true, position, position + axis)


def level_telemetry(true: Telemetry, rng: np.random.Generator) -> Telemetry:
    """Telemetry that reports a level camera, with errors of heading and height."""
    turn, log = rng.normal(0, 1, 2)
    return replace(
        true,
        yaw_deg=(true.yaw_deg + float(turn) * YAW_STD_DEG) % 360,
        pitch_deg=0.0,
        roll_deg=0.0,
        agl_m=true.agl_m * max(0.5, 1 + float(log) * AGL_STD),
        yaw_std_deg=YAW_STD_DEG,
        agl_std_m=AGL_STD * true.agl_m,
        tilt_std_deg=None,
    )


def compared(fix: Fix, each: Flown, frame: LocalFrame) -> Placed:
    position = frame.en_from_latlon(fix.lat_deg, fix.lon_deg)
    off = position - each.camera_en_m
    if fix.ground_latlon_deg is None:
        axis = axis_on_ground_en_m(*attitude_of(fix, each.view.telemetry), fix.agl_m)
        middle = position + axis
    else:
        middle = frame.en_from_latlon(*fix.ground_latlon_deg)
    error_m = float(np.hypot(*off))
    return Placed(
        error_m=error_m,
        middle_m=float(np.hypot(*(middle - each.middle_en_m))),
        share_of_height=error_m / each.true.agl_m,
        variance_m2=float(np.trace(fix.cov_en_m2)) / 2,
        nees=float(off @ np.linalg.solve(fix.cov_en_m2, off)),
    )


def attitude_of(fix: Fix, reported: Telemetry) -> tuple[float, float, float]:
    """Heading, pitch and roll of the camera that a fix states, as reported where it states none."""
    pitch_deg, roll_deg = (fix.evidence.get(f"{axis}_bias_deg", 0.0) for axis in ("pitch", "roll"))
    return fix.heading_deg, reported.pitch_deg + pitch_deg, reported.roll_deg + roll_deg


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--views", type=int, default=100, help="views per row")
    parser.add_argument("--tilt", type=float, nargs="+", default=[0.0, 2.0, 4.0], metavar="DEG")
    parser.add_argument("--width", type=int, nargs="+", default=[256, 128], metavar="PX")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="pairs whose name has this")
    parser.add_argument("--workers", type=int, default=1, help="processes")


def measure(options: argparse.Namespace) -> Section:
    """A row for each pair, width and tilt."""
    pairs = chosen(leave_one_out_pairs(), options.only)
    for pair in pairs:  # builds use all cores themselves
        map_of(ortho(pair.map, options.work), options.work)
        ortho(pair.views, options.work)
    views = 4 if options.quick else options.views
    tasks = {
        f"{pair.name} {width_px} px {tilt:g} deg": (pair, width_px, tilt, views, options)
        for pair in pairs
        for width_px in options.width
        for tilt in options.tilt
    }
    stored = rows_path(options.work, f"rows-{views}-{options.seed}")
    rows = []
    for row in resumed(stored, measured, tasks, options.workers):
        rows.append(row)
        say("  ".join(row))
    notes = (
        "heading off by 10 deg and height by 10 % (standard deviations, reported); pitch and roll "
        f"reported 0 without a deviation; whole map, no prior, seed {options.seed}; px: root of "
        f"the area of a view; columns after confident ({CONFIDENT:g} or more) but ms are of those; "
        f"false: camera off by more than {FAR_M:g} m and {RADIUS_SHARE:.1%} of the height",
    )
    title = "Views with unreported tilt"
    return Section(title, [Table(title, HEADER, rows, notes)])


def measured(task: tuple[Pair, int, float, int, argparse.Namespace]) -> list[str]:
    pair, width_px, tilt_std_deg, views, options = task
    cv2.setNumThreads(1)
    localizer = localizer_of(pair.map, options.work)
    alone = SingleViews(localizer, use_prior=False)
    found: list[Placed] = []
    times_ms: list[float] = []
    for each in tilted_views(pair, width_px, tilt_std_deg, localizer, views, options):
        if not times_ms:
            locate_view(alone, each.view)  # the first view prepares the map
        outcome, took_ms = locate_view(alone, each.view)
        times_ms.append(took_ms)
        if isinstance(outcome, Fix) and outcome.confidence >= CONFIDENT:
            found.append(compared(outcome, each, localizer.sheet.frame))
    cells = [pair.name, str(width_px), f"{tilt_std_deg:g}", str(len(times_ms))]
    if not found:
        return [*cells, "0", *["-"] * 6, "0", *quantiles(times_ms, 50)]
    variance_m2, nees = (np.mean([getattr(each, name) for each in found]) for name in MEANS)
    error_m, share, middle_m = (np.array([getattr(p, name) for p in found]) for name in ERRORS)
    return [
        *(*cells, f"{100 * len(found) / len(times_ms):.0f}"),
        *(*quantiles(error_m, 50, 95), *quantiles(100 * share, 50)),
        *(number(math.sqrt(variance_m2)), number(float(nees)), *quantiles(middle_m, 50)),
        *(str(sum(each.is_wrong for each in found)), *quantiles(times_ms, 50)),
    ]


if __name__ == "__main__":
    sys.exit(run(NAME, __doc__, measure, add))
