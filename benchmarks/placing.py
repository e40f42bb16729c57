"""A process that locates the views of a flight by one method and prints errors, times and memory.

It imports nothing but what it measures. `python -m benchmarks.placing JSON` prints JSON.
"""

import importlib
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from orthonav.core.geo.frames import LocalFrame
    from orthonav.core.records import View

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
BOTH, TILES, REGISTRATION = OWN = "both", "tiles", "registration"
TEMPLATE, CANNY, PHASE, MUTUAL, SIFT = "template", "canny", "phase", "mutual", "sift"


@dataclass(frozen=True)
class Task:
    """Views and method of one run.

    - `method`: name of the method.
    - `map_path`, `flight`: map file and flight folder.
    - `heading_known`: whether the heading is reported.
    - `use_prior`: whether the prior is used.
    - `pixels`: orthophoto in the map's raster, for methods other than orthonav's.
    - `factor`: map pixels averaged to one, for methods other than orthonav's.
    - `telemetry_only`: try the reported pose only.
    - `views`: largest number of views; None: all.
    - `track`: follow the views as one flight instead of placing them one by one.
    - `threads`: threads that share the search of a view, for orthonav's methods.
    """

    method: str
    map_path: str
    flight: str
    heading_known: bool = True
    use_prior: bool = False
    pixels: str = ""
    factor: int = 1
    telemetry_only: bool = False
    views: int | None = None
    track: bool = False
    threads: int = 1


def placed(task: Task) -> dict[str, Any]:
    """Run a task in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.placing", json.dumps(asdict(task))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def run(task: Task) -> dict[str, Any]:
    """Place every view, the first one twice: cold, and again when warm; once, where it is tracked.

    `rows` hold east and north error in m, confidence, radius in m, the covariance's three numbers
    and the processor time in ms; NaN where there is none. `wall_ms` are times on the clock.
    """
    import cv2

    from benchmarks.child import memory_mb
    from benchmarks.flights import read_views
    from orthonav.core.mapfile import open_map

    if task.method in OWN:
        importlib.import_module(
            "orthonav.core.localize"
        )  # opening a map is timed, importing is not

    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
    _, views = read_views(Path(task.flight))
    start = time.perf_counter()
    place = _method(task)
    opened_ms = 1e3 * (time.perf_counter() - start)
    frame = open_map(Path(task.map_path)).manifest.sheets[0].frame
    cold_ms, rows, wall_ms = math.nan, [], []
    for number, flown in enumerate(views):
        if number == task.views:
            break
        if number == 0 and not task.track:
            cold_ms = _timed(place, flown.view)[1]
        start = time.perf_counter()
        found, took_ms = _timed(place, flown.view)
        wall_ms.append(1e3 * (time.perf_counter() - start))
        rows.append([*row_of(found, frame, flown.truth_latlon_deg), took_ms])
    return {
        "rows": rows,
        "wall_ms": wall_ms,
        "opened_ms": opened_ms,
        "cold_ms": rows[0][-1] if task.track else cold_ms,
        "peak_mb": memory_mb("VmHWM"),
        "mapped_mb": memory_mb("RssFile"),
    }


Placer = Callable[["View"], Any]


def _timed(place: Placer, view: "View") -> tuple[Any, float]:
    start = time.process_time()
    found = place(view)
    return found, 1e3 * (time.process_time() - start)


def row_of(found: Any, frame: "LocalFrame", truth_latlon_deg: tuple[float, float]) -> list[float]:
    """East and north error, confidence, radius, three numbers of the covariance."""
    from orthonav.core.records import Fix, NoFix

    nothing = [math.nan] * 7
    truth = frame.en_from_latlon(*truth_latlon_deg)
    if found is None or isinstance(found, NoFix):
        return nothing
    if not isinstance(found, Fix):
        return [*(float(v) for v in found - truth), *nothing[2:]]
    error = frame.en_from_latlon(found.lat_deg, found.lon_deg) - truth
    cov = found.cov_en_m2
    spread = [cov[0, 0], cov[0, 1], cov[1, 1]]
    return [float(v) for v in (*error, found.confidence, found.radius_m, *spread)]


def _method(task: Task) -> Placer:
    return _orthonav(task) if task.method in OWN else _other(task)


def _orthonav(task: Task) -> Placer:
    from orthonav.core.localize import Localizer
    from orthonav.core.localize.policy import DEFAULT_PLAN
    from orthonav.core.mapfile import open_map
    from orthonav.core.track.tracker import Tracker

    localizer = Localizer(
        open_map(Path(task.map_path)),
        registration=task.method != TILES,
        plan=replace(DEFAULT_PLAN, threads=task.threads),
    )
    if task.method == REGISTRATION:
        without_tiles(localizer)
    if task.track:
        return Tracker(localizer, heading_known=task.heading_known, use_prior=task.use_prior).locate

    def place(view: "View") -> Any:
        return localizer.locate(
            view,
            prior=view.telemetry.prior if task.use_prior else None,
            heading_known=task.heading_known,
        )

    return place


def without_tiles(localizer: Any) -> None:
    """Registration that searches the whole sheet by FFT and never asks for tiles."""
    if hasattr(localizer.registration, "propose"):
        localizer.registration.propose = None


def _other(task: Task) -> Placer:
    from benchmarks import posed

    picture = posed.Picture.read(Path(task.map_path), Path(task.pixels), task.factor)
    method: Any
    if task.method == SIFT:
        method = posed.Keypoints(picture)
    else:
        surfaces: dict[str, Callable[[], Any]] = {
            TEMPLATE: lambda: posed.TemplateSurface(picture, False),
            CANNY: lambda: posed.TemplateSurface(picture, True),
            PHASE: lambda: posed.PhaseSurface(picture),
            MUTUAL: lambda: posed.MutualSurface(picture),
        }
        method = posed.BestOfPoses(picture, surfaces[task.method](), task.telemetry_only)

    def place(view: "View") -> Any:
        return method.locate(view, task.heading_known)

    return place


if __name__ == "__main__":
    for name in THREADS:
        os.environ[name] = "1"
    print(json.dumps(run(Task(**json.loads(sys.argv[1])))))
