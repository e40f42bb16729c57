"""A process that locates the views of a flight by one method and prints errors, times and memory.

It imports nothing but what it measures. `python -m benchmarks.placing JSON` prints JSON.
"""

import importlib
import json
import math
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from orthonav.core.geo.frames import LocalFrame
    from orthonav.core.records import View

    Placer = Callable[[View], Any]

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
    """

    method: str
    map_path: str
    flight: str
    heading_known: bool = True
    use_prior: bool = False
    pixels: str = ""
    factor: int = 1
    telemetry_only: bool = False


@dataclass(frozen=True, eq=False)
class FlownView:
    """A view, the name of its image, and where it was taken."""

    frame: str
    view: "View"
    truth_latlon_deg: tuple[float, float]


def views_in(folder: Path) -> Iterator[FlownView]:
    """Views of a flight folder, each read on demand."""
    from orthonav.core.flight import open_flight, read_truth
    from orthonav.core.records import View

    recorded, truth = open_flight(folder), read_truth(folder / "truth.csv")
    for each in recorded.views:
        if each.frame in truth:
            view = View(each.grey(), recorded.camera, each.telemetry)
            yield FlownView(each.frame, view, truth[each.frame])


def placed(task: Task) -> dict[str, Any]:
    """Run a task in a process of its own."""
    result: dict[str, Any] = child("placing", json.dumps(asdict(task)))
    return result


def child(module: str, *arguments: str) -> Any:
    """The JSON in the last line that a module of the benchmarks prints, in a process of its own."""
    command = [sys.executable, "-m", f"benchmarks.{module}", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def memory_mb(kind: str = "VmHWM") -> float:
    """Resident memory of this process in MB: the largest (`VmHWM`), or now (`VmRSS`).

    Linux's own count: `ru_maxrss` of a started process also remembers its parent's memory.
    """
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{kind}:"):
            return int(line.split()[1]) * 1024 / 1e6
    raise RuntimeError(f"this system does not report {kind} of a process")


def run(task: Task) -> dict[str, Any]:
    """Place every view, the first one twice: cold, and again when warm.

    `rows` hold east and north error in m, confidence, radius in m, the covariance's three numbers
    and the processor time in ms; NaN where there is none.
    """
    import cv2

    from orthonav.core.mapfile import open_map

    if task.method in OWN:
        importlib.import_module("orthonav.core.localize")  # opening a map is timed, importing not
    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
    start = time.perf_counter()
    place = _method(task)
    opened_ms = 1e3 * (time.perf_counter() - start)
    frame = open_map(Path(task.map_path)).manifest.sheets[0].frame
    cold_ms: float = math.nan
    rows: list[list[float]] = []
    for flown in views_in(Path(task.flight)):
        if not rows:
            cold_ms = _timed(place, flown.view)[1]
        found, took_ms = _timed(place, flown.view)
        rows.append([*row_of(found, frame, flown.truth_latlon_deg), took_ms])
    return {"rows": rows, "opened_ms": opened_ms, "cold_ms": cold_ms, "peak_mb": memory_mb()}


def _timed(place: "Placer", view: "View") -> tuple[Any, float]:
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


def _method(task: Task) -> "Placer":
    if task.method not in OWN:
        return _other(task)
    from orthonav.core.localize import Localizer
    from orthonav.core.mapfile import open_map

    localizer = Localizer(open_map(Path(task.map_path)), registration=task.method != TILES)
    if task.method == REGISTRATION:  # the whole sheet is searched by FFT, never asking for tiles
        setattr(localizer.registration, "propose", None)  # noqa: B010

    def place(view: "View") -> Any:
        prior = view.telemetry.prior if task.use_prior else None
        return localizer.locate(view, prior=prior, heading_known=task.heading_known)

    return place


def _other(task: Task) -> "Placer":
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
    return lambda view: method.locate(view, task.heading_known)


if __name__ == "__main__":
    print(json.dumps(run(Task(**json.loads(sys.argv[1])))))
