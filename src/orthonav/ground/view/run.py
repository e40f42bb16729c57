"""A displayed run: its results as columns of short numbers, truth, health and images.

Columns let many thousand views fit into one response: lengths and positions are rounded to what a
screen can show; unknown values are None.
"""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav import __version__
from orthonav.core.errors import FlightError, MissingFileError, UsageError
from orthonav.core.files import with_paths
from orthonav.core.flight import read_truth
from orthonav.core.flight.fixes import STATES, evidence_of_fields, flight_digest
from orthonav.core.flight.gnss import fault_of, gnss_of
from orthonav.core.flight.mount import read_mount
from orthonav.core.mapfile import open_map
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.records import Fix, NoFix, Telemetry, ViewResult, error_ellipse
from orthonav.ground.evaluate.metrics import (
    FAR_M,
    LatLon,
    check_truth,
    place_of,
    places_en_m,
    protection_levels_m,
    reason_of,
    warn_of_another_run,
)
from orthonav.ground.recordings import SourceOptions, open_source
from orthonav.ground.recordings.flightlog import is_flight_log
from orthonav.ground.recordings.opening import source_kind
from orthonav.ground.report import to_plain
from orthonav.ground.report.imagery import (
    GroundWindow,
    SheetImagery,
    as_fixed,
    jpeg,
    png,
    rectified,
    shrunk,
    shrunk_px,
    window_of,
)
from orthonav.ground.view.perspective import map_in_view
from orthonav.ground.view.recorded import LoggedRun, Recorded, RecordedImages, Shot, read_lines

Array = NDArray[np.float64]
Images = LoggedRun | RecordedImages
RAW_PX = 640
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ViewRequest:
    run: Path
    map_path: Path
    second: Path | None = None
    flight: Path | None = None
    truth: Path | None = None
    mount: Path | None = None
    radius_m: float = 15.0
    source: SourceOptions = field(default_factory=partial(SourceOptions, skip_bad_images=True))
    """How `flight` is read, where it is no flight log."""

    def __post_init__(self) -> None:
        with_paths(self, "run", "map_path", "second", "flight", "truth", "mount")


class Run:
    """Everything that the page requests. Safe to share between threads.

    Methods that take the index of a view raise `IndexError` for others, and `FlightError` where
    there is no image or position.
    """

    def __init__(self, request: ViewRequest) -> None:
        """Reads the run and logs its problems.

        Raises an `OrthonavError` where a given file is missing or damaged, or the run is empty.
        """
        if not 0 < request.radius_m < 1e7:
            raise UsageError(f"radius_m must be above 0, got {request.radius_m}")
        opened = open_map(request.map_path)
        self.request, self.sheet = request, SheetImagery(opened)
        self.recorded = _read(request.run)
        second = None if request.second is None else _read(request.second).results
        self._second = None if second is None else {result.frame: result for result in second}
        self._images = _images(request, self.recorded)
        self._mount = self.recorded.mount if request.mount is None else read_mount(request.mount)
        self._truth, self.truth_name = _truth(request, self._images)
        if self._truth:
            centre = self.sheet.frame.lat_deg, self.sheet.frame.lon_deg
            check_truth(self._truth, (), centre, Path(self.truth_name))
        self._columns = columns_of(
            self.recorded.results, self._truth, self.sheet, request.radius_m, self._second
        )
        self._warn(opened)

    def _warn(self, opened: MapFile) -> None:
        request, images, sha256 = self.request, self._images, None
        if isinstance(images, RecordedImages):
            sha256 = flight_digest(images.views.values())
        flown = self.recorded.session.get("map")
        if isinstance(flown, dict) and flown.get("manifest_sha256") != opened.manifest.sha256:
            name = flown.get("name")
            log.warning("the flight used another map (%.80s): %s", name, request.map_path)
        for path in filter(None, (request.run, request.second)):
            if path.is_file() and not is_log(path):
                warn_of_another_run(path, opened, request.flight, sha256)
        if self.truth_name and not self.any_known("tx"):
            log.warning("no view of the run has a true position in %s", self.truth_name)
        if request.second is not None and not self.any_known("x2"):
            log.warning("no view has a position in the second run: %s", request.second)

    def any_known(self, column: str) -> bool:
        return any(value is not None for value in self._columns[column])

    def summary(self) -> dict[str, Any]:
        request, images = self.request, self._images
        return {
            "name": request.run.name or str(request.run),
            "map_name": request.map_path.name,
            "images": "" if images is None else (request.flight or request.run).name,
            "truth": self.truth_name,
            "second": request.second.name if request.second else "",
            "version": __version__,
            "radius_m": request.radius_m,
            "states": list(STATES),
            "sheet": self.sheet.plain(),
        }

    def views(self) -> dict[str, Any]:
        """All views as columns, and what else was recorded."""
        health, problems = self.recorded.health, self.recorded.problems
        return {"columns": self._columns, "health": health, "problems": problems}

    def detail(self, index: int) -> dict[str, Any]:
        result = self._result(index)
        outcome = result.outcome
        found: dict[str, Any] = {
            "index": index,
            "frame": result.frame,
            "time_s": str(Decimal(result.time_ns).scaleb(-9)),  # JavaScript rounds numbers
            "state": result.state,
            "evidence": {str(name): value for name, value in outcome.evidence.items()},
        }
        if isinstance(outcome, Fix):
            found["evidence"] |= evidence_of_fields(outcome)
        if isinstance(outcome, NoFix):
            found |= {"reason": outcome.reason, "detail": outcome.detail}
        other = (self._second or {}).get(result.frame)
        places = {
            "": place_of(outcome),
            "second_": None if other is None else place_of(other.outcome),
            "true_": self._truth.get(result.frame),
        }
        for name, place in places.items():
            if place is not None:
                found |= {f"{name}lat_deg": place[0], f"{name}lon_deg": place[1]}
        try:
            telemetry = self._shot(result).telemetry
            names = ("yaw_deg", "pitch_deg", "roll_deg", "agl_m")
            found["telemetry"] = {name: getattr(telemetry, name) for name in names}
            found["window"] = self._placed(result)[2]
        except FlightError as error:
            found["why_no_window"] = str(error)
        plain: dict[str, Any] = to_plain(found)
        return plain

    def view_png(self, index: int) -> bytes:
        shot, telemetry, window = self._placed(self._result(index))
        return png(*rectified(shot.load(), telemetry, shot.camera, window))

    def raw_jpeg(self, index: int) -> bytes:
        return jpeg(shrunk(self._shot(self._result(index)).load(), RAW_PX))

    def map_png(self, index: int, at: str) -> bytes:
        result = self._result(index)
        place = self._truth.get(result.frame) if at == "truth" else place_of(result.outcome)
        if place is None:
            raise FlightError(f"view {result.frame} has no such position: {at}")
        window = self._placed(result)[2]
        box = window.box_at(np.asarray(self.sheet.frame.en_from_latlon(*place)))
        return png(*self.sheet.crop(box, (window.size_px, window.size_px)))

    def map_in_view_png(self, index: int) -> bytes:
        """The map from the fix, in the picture of the camera, as large as `raw_jpeg`."""
        result = self._result(index)
        place = place_of(result.outcome)
        if place is None:
            raise FlightError(f"view {result.frame} has no fix")
        shot, telemetry, _ = self._placed(result)
        size_px = shrunk_px((shot.camera.width_px, shot.camera.height_px), RAW_PX)
        at_en_m = np.asarray(self.sheet.frame.en_from_latlon(*place))
        return png(*map_in_view(self.sheet, shot.camera.resized(*size_px), telemetry, at_en_m))

    def _result(self, index: int) -> ViewResult:
        if not 0 <= index < len(self.recorded.results):
            raise IndexError(f"no view {index}")
        return self.recorded.results[index]

    def _shot(self, result: ViewResult) -> Shot:
        if self._images is None:
            raise FlightError("there are no images; name the flight with --flight")
        return self._images.shot(result.frame)

    def _placed(self, result: ViewResult) -> tuple[Shot, Telemetry, GroundWindow]:
        """A view without the errors of its mount, the telemetry corrected by its fix, and the
        ground that it shows."""
        shot = self._shot(result)
        if self._mount is not None:
            shot = replace(shot, telemetry=self._mount.corrected(shot.telemetry))
        telemetry = as_fixed(shot.telemetry, result)
        return shot, telemetry, window_of(telemetry, shot.camera, self.sheet.grid.gsd_m)


def columns_of(
    results: Sequence[ViewResult],
    truth: Mapping[str, LatLon],
    sheet: SheetImagery,
    radius_m: float,
    second: Mapping[str, ViewResult] | None = None,
) -> dict[str, list[Any]]:
    """The columns of `results`, in order; `second`: of another run, by frame."""
    fix_en_m = places_en_m(sheet.frame, [place_of(r.outcome) for r in results])
    truth_en_m = places_en_m(sheet.frame, [truth.get(r.frame) for r in results])
    gnss_en_m = places_en_m(sheet.frame, [gnss_of(r.outcome.evidence) for r in results])
    error_m = np.hypot(*(fix_en_m - truth_en_m).T)
    major_m, minor_m, direction_deg = _ellipses(results).T

    def stated(name: str) -> Array:
        """(N,), NaN without a fix."""
        return np.array([getattr(r.outcome, name, math.nan) for r in results], np.float64)

    trusted = np.array([r.is_confident or r.state == "tracking" for r in results], np.bool_)
    wrong = trusted & (error_m > np.fmax(max(FAR_M, radius_m), stated("radius_m")))
    columns: dict[str, list[Any]] = {
        "frame": [r.frame for r in results],
        "t": to_plain([(r.time_ns - results[0].time_ns) / 1e9 for r in results], 3),
        "ms": to_plain([float(r.latency_ms) for r in results], 1),  # processing time
        # Fix, true position and GNSS in pixels of the sheet.
        **_drawn(("x", "y"), fix_en_m, sheet),
        **_drawn(("tx", "ty"), truth_en_m, sheet),
        **_drawn(("gx", "gy"), gnss_en_m, sheet),
        # Errors of fix and GNSS, and their distance, metres; reason of the GNSS monitor.
        "err": to_plain(error_m, 4),
        "gerr": to_plain(np.hypot(*(gnss_en_m - truth_en_m).T), 2),
        "gdiff": to_plain(np.hypot(*(gnss_en_m - fix_en_m).T), 2),
        "gfault": [fault_of(r.outcome.evidence) for r in results],
        # As the fix states it: confidence, its radius (m), protection level (m) at a risk.
        "conf": to_plain(stated("confidence"), 4),
        "radius": to_plain(stated("radius_m"), 1),
        "level": to_plain(protection_levels_m(results), 1),
        "risk": [r.risk for r in results],
        # Axes of one standard deviation (m); angle of the longer one, counter-clockwise from east.
        "a": to_plain(major_m, 2),
        "b": to_plain(minor_m, 2),
        "turn": to_plain((90.0 - direction_deg) % 180.0, 1),
        "head": to_plain(stated("heading_deg"), 1),
        "agl": to_plain(stated("agl_m"), 1),
        "state": [-1 if r.state is None else STATES.index(r.state) for r in results],
        "reason": [reason_of(r.outcome) for r in results],  # "" for a fix
        "confident": [int(r.is_confident) for r in results],
        # Tracking or confident, with an error above 35 m, `radius_m` and its own radius.
        "wrong": wrong.astype(int).tolist(),
    }
    if second is not None:
        found = [second.get(r.frame) for r in results]
        second_en_m = places_en_m(
            sheet.frame, [None if r is None else place_of(r.outcome) for r in found]
        )
        columns |= {
            **_drawn(("x2", "y2"), second_en_m, sheet),
            "err2": to_plain(np.hypot(*(second_en_m - truth_en_m).T), 4),
            "confident2": [int(r is not None and r.is_confident) for r in found],
        }
    return columns


def _drawn(names: tuple[str, str], en_m: Array, sheet: SheetImagery) -> dict[str, list[Any]]:
    px = sheet.px_from_en(en_m)
    px[~(np.abs(px) < 1e9).all(axis=1)] = math.nan  # no place on a screen
    return {name: to_plain(each, 2) for name, each in zip(names, px.T, strict=True)}


def _ellipses(results: Sequence[ViewResult]) -> Array:
    """Axes of one standard deviation, longer first, and the angle of the longer one (N, 3)."""
    unknown = np.full((2, 2), math.nan)
    found = [error_ellipse(getattr(r.outcome, "cov_en_m2", unknown)) for r in results]
    return np.array(found, np.float64).reshape(-1, 3)


def is_log(path: Path) -> bool:
    """Whether this names a flight log, perhaps by the name given to `--log`."""
    return is_flight_log(path) if path.exists() else path.suffix == ".mcap"


def _read(path: Path) -> Recorded:
    if path.is_dir() and not is_log(path):
        raise FlightError(f"expected fixes.jsonl or a flight log, got a folder without one: {path}")
    found = LoggedRun(path) if is_log(path) else read_lines(path)
    if not found.results:
        reason = f": {found.problems[0]}" if found.problems else ""
        raise FlightError(f"run has no views{reason}: {path}")
    for problem in found.problems:
        log.warning("%s", problem)
    return found


def _images(request: ViewRequest, recorded: Recorded) -> Images | None:
    path = request.flight
    if path is None:
        return recorded if isinstance(recorded, LoggedRun) else None
    if is_log(path):
        return LoggedRun(path)
    if not path.exists():
        raise MissingFileError(f"flight does not exist: {path}")
    if source_kind(path) in ("video", "ros"):
        raise FlightError(
            "images of a video or of ROS messages are decoded one after the other only; convert "
            f"it with `orthonav import` and give that flight folder: {path}"
        )
    return RecordedImages(open_source(path, request.source))


def _truth(request: ViewRequest, images: Images | None) -> tuple[Mapping[str, LatLon], str]:
    if request.truth is not None:
        return read_truth(request.truth), request.truth.name
    if isinstance(images, RecordedImages) and images.truth and request.flight is not None:
        return images.truth, request.flight.name
    return {}, ""
