"""Single views whose pitch and roll are not reported: how far off they are placed.

`python -m benchmarks.unreported_tilt --work DIR [--views 100] [--tilt 0 2 4] [--width 256 128]
[--seed 1] [--only TEXT ..] [--workers 1] [--pictures] [--out FILE.md]` flies over the later date of
each pair of `benchmarks.trust_views` (optional real imagery, and generated ground) at random
places, and places the views on a map of the earlier date as `orthonav build` makes it. True pitch
and roll are drawn with a standard deviation of `--tilt` deg each; the telemetry reports 0 for both
and no standard deviation. `--width` is the root of the area that a view covers, in pixels of the
map. Maps and flights stay in DIR: use another one after the code that makes them has changed.
`--pictures` writes the worst confident view of each row to DIR, see `benchmarks.tilt_pictures`.
"""

import argparse
import math
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.inputs import DATA, file_of, map_of
from benchmarks.record import Table, number, provenance
from benchmarks.tilt_pictures import Exterior, attitude_of, write_picture
from benchmarks.trust_views import Pair, is_covered, pairs, views_in
from benchmarks.verdicts import FAR_M
from orthonav.core.geo.camera import axis_on_ground_en_m
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import CONFIDENT, RADIUS_SHARE, Fix, NoFix, Telemetry, View
from orthonav.ground.simulate.flight import DEFAULT_CAMERA, Errors, SimulateRequest, simulate_flight
from orthonav.onboard.run import SingleViews, locate_view

YAW_STD_DEG, AGL_STD = 10.0, 0.1
"""Errors of heading and height, which are reported."""
HEADER = (
    *("scene", "px", "tilt sd", "views", "confident %", "median m", "95 % m", "% of height"),
    *("stated sd m", "NEES", "middle m", "wrong", "ms"),
)
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """Views of one pair, width and tilt.

    - `width_px`: root of the area of a view, pixels of the map.
    - `tilt_std_deg`: standard deviation of true pitch and of roll.
    """

    pair: Pair
    width_px: int
    tilt_std_deg: float


@dataclass(frozen=True)
class Flown:
    """A view with unreported tilt, and the truth.

    - `view`: with telemetry that reports it level; `true`: the telemetry without errors.
    - `camera_en_m`, `middle_en_m`: true position of the camera, and of the ground in the middle of
      the picture.
    """

    frame: str
    view: View
    true: Telemetry
    camera_en_m: Array
    middle_en_m: Array


@dataclass(frozen=True)
class Placed:
    """A fix against the truth; `error_m` of the camera, `middle_m` of the middle of the picture."""

    frame: str
    confidence: float
    error_m: float
    middle_m: float
    share_of_height: float
    variance_m2: float
    nees: float

    @property
    def is_wrong(self) -> bool:
        """Whether the camera is farther off than tilt explains."""
        return self.error_m > FAR_M and self.share_of_height > RADIUS_SHARE


@dataclass(frozen=True)
class Result:
    """What a case gave: `placed` are its fixes, `times_ms` (N,) of all views."""

    case: Case
    placed: tuple[Placed, ...]
    times_ms: Array

    @property
    def confident(self) -> list[Placed]:
        """Fixes to rely on."""
        return [each for each in self.placed if each.confidence >= CONFIDENT]


def name_of(pair: Pair) -> str:
    """A short name, such as `naip_nd 20090818 > 20180716`."""
    if pair.map.startswith("generated:"):
        _, seed, past = pair.map.split(":")
        return f"generated {seed} {past} > {pair.views.rsplit(':', 1)[1]}"
    past_path, present_path = Path(pair.map), Path(pair.views)
    return f"{past_path.parent.name} {past_path.stem} > {present_path.stem}"


def stem_of(case: Case) -> str:
    """Beginning of the names of files of a case."""
    plain = name_of(case.pair).replace(" > ", "-").replace(" ", "-")
    return f"{plain}-{case.width_px}-{case.tilt_std_deg:g}"


def height_m(width_px: float, gsd_m: float) -> float:
    """Height from which the root of the area of a level view is so many pixels of the map."""
    return width_px * gsd_m / math.sqrt(math.prod(DEFAULT_CAMERA.extent))


def tilted_views(
    case: Case, localizer: Localizer, views: int, seed: int, work: Path
) -> Iterator[Flown]:
    """Views of the later date that the map covers; the flight stays in `work`."""
    assert localizer.registration is not None
    grid, frame = localizer.registration.grid, localizer.sheet.frame
    agl_m = height_m(case.width_px, grid.gsd_m)
    folder = work / f"{stem_of(case)}-{views}-{seed}.flight"
    if not folder.is_dir():
        errors = Errors(attitude_std_deg=case.tilt_std_deg)
        ortho = file_of(case.pair.views, work)
        request = SimulateRequest(
            [ortho], folder, random=views, agl_m=agl_m, errors=errors, seed=seed
        )
        simulate_flight(request)
    for count, (name, view, truth) in enumerate(views_in(folder)):
        if is_covered(localizer.registration, truth, case.width_px):
            rng = np.random.default_rng([seed, count])
            level = replace(view, telemetry=level_telemetry(view.telemetry, rng))
            position = frame.en_from_latlon(*truth)
            true = view.telemetry
            axis = axis_on_ground_en_m(true.yaw_deg, true.pitch_deg, true.roll_deg, true.agl_m)
            yield Flown(name, level, true, position, position + axis)


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
    """A fix against the truth."""
    position = frame.en_from_latlon(fix.lat_deg, fix.lon_deg)
    off = position - each.camera_en_m
    if fix.ground_latlon_deg is None:
        axis = axis_on_ground_en_m(*attitude_of(fix, each.view.telemetry), fix.agl_m)
        middle = position + axis
    else:
        middle = frame.en_from_latlon(*fix.ground_latlon_deg)
    error_m = float(np.hypot(*off))
    return Placed(
        frame=each.frame,
        confidence=fix.confidence,
        error_m=error_m,
        middle_m=float(np.hypot(*(middle - each.middle_en_m))),
        share_of_height=error_m / each.true.agl_m,
        variance_m2=float(np.trace(fix.cov_en_m2)) / 2,
        nees=float(off @ np.linalg.solve(fix.cov_en_m2, off)),
    )


def measured(task: tuple[Case, argparse.Namespace]) -> Result:
    """Place the views of a case."""
    case, options = task
    cv2.setNumThreads(1)
    localizer = Localizer(open_map(map_of(file_of(case.pair.map, options.work), options.work)))
    alone = SingleViews(localizer, use_prior=False)
    placed: list[Placed] = []
    times_ms: list[float] = []
    for each in tilted_views(case, localizer, options.views, options.seed, options.work):
        if not times_ms:
            locate_view(alone, each.view)  # the first view prepares the map
        outcome, took_ms = locate_view(alone, each.view)
        times_ms.append(took_ms)
        if not isinstance(outcome, NoFix):
            placed.append(compared(outcome, each, localizer.sheet.frame))
    result = Result(case, tuple(placed), np.array(times_ms))
    if options.pictures and result.confident:
        _write_worst(result, alone, options)
    return result


def _write_worst(result: Result, alone: SingleViews, options: argparse.Namespace) -> None:
    """The picture of the confident view with the largest error."""
    case, localizer = result.case, alone.localizer
    worst = max(result.confident, key=lambda each: each.error_m)
    flown = tilted_views(case, localizer, options.views, options.seed, options.work)
    each = next(each for each in flown if each.frame == worst.frame)
    fix, true = alone.locate(each.view), each.true
    assert isinstance(fix, Fix)
    attitude_deg = true.yaw_deg, true.pitch_deg, true.roll_deg
    camera = Exterior(each.camera_en_m, attitude_deg, true.agl_m)
    title = f"{worst.frame}, camera {worst.error_m:.1f} m off, middle {worst.middle_m:.1f} m"
    path = options.work / f"{stem_of(case)}-worst.png"
    write_picture(path, each.view, fix, camera, localizer, title)


def row_of(result: Result) -> list[str]:
    """A row of the table."""
    case, fixes, views = result.case, result.confident, len(result.times_ms)
    cells = [name_of(case.pair), str(case.width_px), f"{case.tilt_std_deg:g}", str(views)]
    ms = number(float(np.median(result.times_ms))) if views else "-"
    if not fixes:
        return [*cells, "0", *["-"] * 6, "0", ms]
    error_m, share, middle_m, variance_m2, nees = np.array(
        [(p.error_m, p.share_of_height, p.middle_m, p.variance_m2, p.nees) for p in fixes]
    ).T
    values = (
        *(float(np.median(error_m)), float(np.percentile(error_m, 95))),
        100 * float(np.median(share)),
        *(math.sqrt(variance_m2.mean()), float(nees.mean()), float(np.median(middle_m))),
    )
    wrong = sum(each.is_wrong for each in fixes)
    confident = f"{100 * len(fixes) / views:.0f}"
    return [*cells, confident, *(number(value) for value in values), str(wrong), ms]


def notes(options: argparse.Namespace) -> tuple[str, ...]:
    """What the columns mean."""
    camera = DEFAULT_CAMERA
    return (
        f"camera of {camera.width_px} x {camera.height_px} px, 65 deg wide (4:3); heading off by "
        f"{YAW_STD_DEG:g} deg and height by {AGL_STD:.0%} (standard deviations, reported); pitch "
        f"and roll reported 0 without a deviation; whole map, no prior, seed {options.seed}; views "
        "beside the map are left out",
        "px: root of the area of a view; tilt sd: of true pitch and roll per axis, cut at 2.5 sd; "
        f"confident: {CONFIDENT:g} or more, and all further columns but ms are of those",
        "median m, 95 % m, % of height: error of the camera; stated sd: root of the mean "
        "eigenvalue of the covariance; NEES: mean, 2 if the covariance is right; middle: median "
        "error of the ground in the middle of the picture",
        f"wrong: camera off by more than {FAR_M:g} m and {RADIUS_SHARE:.1%} of the height; "
        "ms: median of all views, one core, warm",
    )


def main() -> None:
    """Measure the chosen pairs and print the table."""
    options = _parser().parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    chosen = [pair for pair in pairs() if _is_wanted(pair, options.only)]
    there = [pair for pair in chosen if pair.is_there]
    for pair in chosen:
        if pair not in there:
            print(f"not there, left out: {DATA / pair.map}, {DATA / pair.views}")
    cases = [
        Case(pair, width_px, tilt_std_deg)
        for pair in there
        for width_px in options.width
        for tilt_std_deg in options.tilt
    ]
    about = provenance("unreported tilt")
    maps = dict.fromkeys(pair.map for pair in there)
    for name in maps:  # builds use all cores themselves
        map_of(file_of(name, options.work), options.work)
    for pair in there:
        file_of(pair.views, options.work)
    rows = []
    for result in _each(measured, [(case, options) for case in cases], options.workers):
        rows.append(row_of(result))
        print("  ".join(rows[-1]), flush=True)
    head = f"commit {about['commit'][:10]}, sources {about['sources']}, {about['cpu']}"
    table = Table("Views with unreported tilt", HEADER, rows, notes(options))
    text = f"{head}\n\n{table.markdown()}"
    print("\n" + text)
    if options.out:
        options.out.write_text(text + "\n", encoding="utf-8")


Task = tuple[Case, argparse.Namespace]


def _each(
    function: Callable[[Task], Result], tasks: Sequence[Task], workers: int
) -> Iterable[Result]:
    """Results in the order of the tasks, by so many processes."""
    if workers == 1:
        yield from map(function, tasks)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        yield from pool.map(function, tasks)


def _is_wanted(pair: Pair, only: Sequence[str] | None) -> bool:
    return only is None or any(text in name_of(pair) for text in only)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.unreported_tilt", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--work", type=Path, required=True, help="folder of maps and flights")
    parser.add_argument("--views", type=int, default=100, help="views per row")
    parser.add_argument("--tilt", type=float, nargs="+", default=[0.0, 2.0, 4.0], metavar="DEG")
    parser.add_argument("--width", type=int, nargs="+", default=[256, 128], metavar="PX")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--only", nargs="+", metavar="TEXT", help="pairs whose name contains one of these"
    )
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument(
        "--pictures", action="store_true", help="write the worst confident view of each row"
    )
    parser.add_argument("--out", type=Path, help="Markdown file to write too")
    return parser


if __name__ == "__main__":
    main()
