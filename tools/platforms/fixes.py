"""Compares the fixes of this machine with stored ones, made on another.

    python tools/platforms/fixes.py                          # of the stored map and flight
    python tools/platforms/fixes.py --rebuild                # builds the map here (extra geo)

The stored map and flight lie in `tests/data/golden_flight` beside `fixes.json`; `--make` makes
them from a generated area. The same bytes go to every machine: imagery and maps made on two
machines may differ in the last digits. Exit code 1 where a place is farther off than `LIMITS_M`.

Without AVX-512, and without AVX2:

    NPY_DISABLE_CPU_FEATURES="X86_V4 AVX512_ICL" OPENBLAS_CORETYPE=Haswell OPENCV_IPP=avx2
    OPENCV_CPU_DISABLE=AVX512-SKX GLIBC_TUNABLES=glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX512BW
    ATEN_CPU_CAPABILITY=avx2 ONEDNN_MAX_CPU_ISA=AVX2

    NPY_DISABLE_CPU_FEATURES="X86_V3 X86_V4 AVX512_ICL" OPENBLAS_CORETYPE=Nehalem
    ORTHONAV_NO_AVX2=1 OPENCV_CPU_DISABLE=AVX512-SKX,AVX2,FP16,AVX OPENCV_IPP=sse42
"""

import argparse
import json
import platform
import sys
import tempfile
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from orthonav.core.files import write_text
from orthonav.core.flight import Flight, open_flight
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import Fix, ViewResult
from orthonav.core.track.tracker import Tracker
from orthonav.ground.recordings.localize import localize_flight, smoothed_track
from orthonav.onboard.run import SingleViews

STORED = Path(__file__).resolve().parents[2] / "tests" / "data" / "golden_flight"
LIMITS_M = {"views": 0.2, "any_heading": 0.2, "track": 0.3, "smoothed": 0.3}
"""By run. Rounding, which differs between AVX2 and AVX-512, decides whether the camera of a view is
fitted once more. That moves it by a tenth of its standard deviation, and a track carries it on."""
RUNS = tuple(LIMITS_M)
PACKAGES = ("numpy", "opencv-python-headless")
Places = dict[str, list[float] | str]
"""By frame: metres east and north of the map's centre, to 0.1 mm, or why there is no fix."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Localize, print, compare; returns the exit code."""
    options = _parser().parse_args(arguments)
    if options.make:
        make(STORED)
    made = {"machine": machine(), "runs": _localized(options)}
    if options.make:
        write_text(STORED / "fixes.json", json.dumps(made, indent=1) + "\n")
    print("this machine:", made["machine"])
    stored = json.loads((STORED / "fixes.json").read_text(encoding="utf-8"))
    print("compared with:", stored["machine"])
    return int(not all([_compared(name, made, stored) for name in made["runs"]]))


def machine() -> str:
    """Processor, versions, and the instructions that OpenCV uses (those after a ? are off)."""
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in PACKAGES)
    python = f"{platform.machine()}, Python {platform.python_version()}, {versions}"
    return f"{python}, OpenCV uses {cv2.getCPUFeaturesLine()}"


def places(map_path: Path, flight: Flight, run: str) -> Places:
    """Where the views of a flight are placed by one of `RUNS`."""
    localizer = Localizer(open_map(map_path))
    if run in ("views", "any_heading"):
        single = SingleViews(localizer, heading_known=run == "views")
        results = list(localize_flight(single, flight))
    else:
        tracker = Tracker(localizer, smooth=run == "smoothed")
        results = list(localize_flight(tracker, flight))
        if run == "smoothed":
            results = smoothed_track(tracker, results, None)
    return {result.frame: _place(result, localizer) for result in results}


def farthest_m(here: Places, there: Places) -> float:
    """The largest distance (m) of two places of one frame; infinite where only one has a fix."""
    if here.keys() != there.keys():
        return float("inf")
    distances_m = [0.0]
    for name, place in here.items():
        other = there[name]
        if isinstance(place, str) or isinstance(other, str):
            distances_m.append(0.0 if place == other else float("inf"))
        else:
            distances_m.append(float(np.hypot(*np.subtract(place, other))))
    return max(distances_m)


def make(folder: Path) -> None:
    """Generate an area at two dates, a map of the first and a flight over the second."""
    from orthonav.core.files import replacing_folder
    from orthonav.core.geo.camera import Camera
    from orthonav.ground.planning.route import Route
    from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight

    with replacing_folder(folder, lambda _: True) as made, tempfile.TemporaryDirectory() as area:
        past, present = _imagery(Path(area))
        build(past, made / "area.onav")
        frame = open_map(made / "area.onav").manifest.sheets[0].frame
        turns_en_m = np.array([[-170.0, -150.0], [-150.0, 120.0], [140.0, 100.0]])
        latlon = (degrees.tolist() for degrees in frame.latlon_from_en(turns_en_m))
        request = SimulateRequest(
            [present],
            made / "flight",
            route=Route(tuple(zip(*latlon, strict=True))),
            spacing_m=30.0,
            agl_m=150.0,
            camera=Camera(256, 192, 200.0, 200.0, 128.0, 96.0),
            errors=Errors(yaw_std_deg=4.0, agl_std=0.03, attitude_std_deg=2.0, velocity_drift=0.03),
            seed=1,
        )
        simulate_flight(request)


def build(ortho: Path, out: Path) -> None:
    """Build the map whose fixes are compared."""
    from orthonav.ground.build import BuildRequest, build_map

    build_map(BuildRequest([ortho], out, gsd_m=1.0, tile_px=128, method="gradient:dims=32"))


def _imagery(folder: Path) -> list[Path]:
    """Orthophotos of the generated area at two dates."""
    sys.path.append(str(STORED.parents[2]))
    from lab.landscape import DEFAULT_DATES, generate_area

    return generate_area(folder, size_m=(600.0, 600.0), dates=DEFAULT_DATES[:2], seed=4)


def _localized(options: argparse.Namespace) -> dict[str, Places]:
    flight = open_flight(STORED / "flight")
    if not options.rebuild:
        return {run: places(STORED / "area.onav", flight, run) for run in options.run}
    with tempfile.TemporaryDirectory() as folder:
        rebuilt = Path(folder) / "area.onav"
        build(_imagery(Path(folder))[0], rebuilt)
        _compare_maps(rebuilt, STORED / "area.onav")
        return {run: places(rebuilt, flight, run) for run in options.run}


def _place(result: ViewResult, localizer: Localizer) -> list[float] | str:
    outcome = result.outcome
    if not isinstance(outcome, Fix):
        return outcome.reason
    east_north_m = localizer.sheet.frame.en_from_latlon(outcome.lat_deg, outcome.lon_deg)
    return [round(float(metres), 4) for metres in east_north_m]


def _compared(name: str, made: Mapping[str, Any], stored: Mapping[str, Any]) -> bool:
    """Whether one run gives the stored fixes; prints the largest distance."""
    here, there = made["runs"][name], stored["runs"][name]
    found = sum(not isinstance(place, str) for place in here.values())
    off_m = farthest_m(here, there)
    print(
        f"{name:12s} {found:3d} of {len(here)} views placed, "
        f"at most {1000 * off_m:.1f} mm apart: {'ok' if off_m <= LIMITS_M[name] else 'DIFFERENT'}"
    )
    return off_m <= LIMITS_M[name]


def _compare_maps(here: Path, there: Path) -> None:
    """Print how the arrays of two maps differ."""
    if here.read_bytes() == there.read_bytes():
        print("map built here: the same bytes")
        return
    mine, theirs = open_map(here).arrays, open_map(there).arrays
    for name in sorted(mine.keys() | theirs.keys()):
        if name not in mine or name not in theirs or mine[name].shape != theirs[name].shape:
            print(f"map built here: {name} has another size")
            continue
        off = np.abs(mine[name].astype(float) - theirs[name].astype(float))
        print(f"map built here: {name} differs by {off.max(initial=0.0):.2g} at most")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--run", nargs="+", choices=RUNS, default=RUNS, help="default: all")
    parser.add_argument(
        "--rebuild", action="store_true", help="build the stored map again on this machine"
    )
    parser.add_argument("--make", action="store_true", help="replace the stored files")
    return parser


if __name__ == "__main__":
    sys.exit(main())
