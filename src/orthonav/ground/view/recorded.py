"""Results, health and images of a flight: from lines of fixes or from a flight log."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError, MissingFileError
from orthonav.core.files import require_file
from orthonav.core.flight.fixes import is_health, result_from_json
from orthonav.core.flight.logged import (
    TOPICS,
    LoggedView,
    camera_of,
    from_json,
)
from orthonav.core.flight.mount import Mount, logged_mount
from orthonav.core.geo.camera import Camera
from orthonav.core.records import Telemetry, ViewResult
from orthonav.ground.recordings import Recording
from orthonav.ground.recordings.flightlog import (
    MAX_VIEWS,
    BrokenLogError,
    LogContent,
    files_of_run,
    is_flight_log,
    logged_result,
    run_of,
)
from orthonav.ground.recordings.mcap_files import McapFile

MAX_LINE_BYTES = 2**20
log = logging.getLogger(__name__)


@dataclass
class Recorded:
    """What a run left behind.

    `health`: lines of health; `view` of each is the number of results before it. `mount`: with
    which it was localized, where a log states it. `session`: of a flight log.
    """

    results: list[ViewResult] = field(default_factory=list)
    health: list[dict[str, Any]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    mount: Mount | None = None
    session: dict[str, Any] = field(default_factory=dict)

    def add_result(self, result: ViewResult) -> None:
        self.results.append(result)
        if len(self.results) > MAX_VIEWS:
            raise BrokenLogError(f"run has more than {MAX_VIEWS} views")

    def add_health(self, plain: dict[str, Any]) -> None:
        if len(self.health) < MAX_VIEWS:
            self.health.append({"view": len(self.results), **checked_health(plain)})


@dataclass(frozen=True, eq=False)
class Shot:
    """One recorded view; `load` returns the image (H, W), or raises `FlightError`."""

    telemetry: Telemetry
    camera: Camera
    load: Callable[[], NDArray[np.uint8]]


def read_lines(path: Path) -> Recorded:
    """The content of `fixes.jsonl`, or of the output of `orthonav fly --jsonl`.

    Other lines are skipped, the first of them is reported: a file that a full disk cut short is
    better than none. Raises `MissingFileError`, and `FlightError` beyond the limits.
    """
    found = Recorded()
    with require_file(path, "file of fixes").open("rb") as stream:
        lines = iter(lambda: stream.readline(MAX_LINE_BYTES + 1), b"")
        for number, line in enumerate(lines, start=1):
            try:
                _take_line(line, found)
            except BrokenLogError:
                raise
            except (FlightError, UnicodeDecodeError) as error:
                if not found.problems:
                    found.problems.append(f"line {number} was skipped ({error}): {path}")
    return found


def _take_line(line: bytes, found: Recorded) -> None:
    if len(line) > MAX_LINE_BYTES:
        raise FlightError(f"more than {MAX_LINE_BYTES} bytes")
    text = line.decode("utf-8").strip()
    if is_health(text):
        found.add_health(from_json(line))
    elif text:
        found.add_result(result_from_json(text))


def checked_health(plain: dict[str, Any]) -> dict[str, Any]:
    level, reasons = plain.get("health"), plain.get("reasons")
    if not isinstance(level, str):
        raise FlightError("health has no level")
    known: dict[str, Any] = {
        "level": level[:20],
        "reasons": [str(each)[:40] for each in reasons[:20]] if isinstance(reasons, list) else [],
    }
    for name in ("utc_s", "age_p50_ms", "age_p95_ms"):
        value = plain.get(name)
        if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e12:
            known[name] = value
    for name in ("counts", "sent", "withheld", "log_lost"):
        value = plain.get(name)
        if isinstance(value, dict):
            known[name] = {str(k)[:40]: v for k, v in value.items() if isinstance(v, int)}
    return known


class LoggedRun(Recorded):
    """The content of one flight log, with its images.

    `path` is a folder, the first file, or the name given to `orthonav fly --log`.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._camera: Camera | None = None
        self._content = LogContent()
        self._views: dict[str, LoggedView] = {}
        for each in _files_of(path):
            file = McapFile(each)
            self._content.read(file, self._take)
            if file.damaged:
                self.problems.append(f"damaged chunks were skipped: {each}")
        if self._content.broken:
            self.problems.append(self._content.problem)

    def shot(self, frame: str) -> Shot:
        view = self._views.get(frame)
        if view is None or self._camera is None:
            raise FlightError("this view is not in the log")
        place = self._content.places.get(view.index)
        if place is None:
            why = {
                "none": "the log has no images",
                "dropped": "this image was dropped for lack of time or space",
                "bad": "the camera delivered no usable image",
            }
            raise FlightError(why.get(view.picture, "the image of this view is missing"))
        where = f"view {frame} of {place.path}"
        load = partial(self._content.grey, place, self._camera, where)
        return Shot(view.telemetry, self._camera, load)

    def _take(self, topic: str, data: bytes) -> None:
        if topic == TOPICS.telemetry.name:
            view = self._content.views[-1]
            self._views.setdefault(view.frame, view)
        elif topic == TOPICS.session.name:
            self.session = self._content.session
            self._camera = camera_of(self.session["camera"])
            options = self.session.get("options")
            self.mount = logged_mount(options if isinstance(options, dict) else {})
        elif topic == TOPICS.result.name:
            self.add_result(logged_result(data))
        elif topic == TOPICS.health.name:
            self.add_health(from_json(data))


class RecordedImages:
    """Images of a flight folder or of photographs, with what is known of their positions."""

    def __init__(self, recording: Recording) -> None:
        self.camera, self.views = recording.camera, {each.frame: each for each in recording.views}
        places = ((name, view.truth_latlon_deg) for name, view in self.views.items())
        self.truth = {name: place for name, place in places if place is not None}
        for said in (*recording.choices, *recording.warnings):
            log.warning("%s", said)

    def shot(self, frame: str) -> Shot:
        view = self.views.get(frame)
        if view is None:
            raise FlightError("this view is not in the flight")
        return Shot(view.telemetry, self.camera, view.grey)


def _files_of(path: Path) -> list[Path]:
    """The files of the flight that `path` names, in order; see `LoggedRun`."""
    if path.exists():
        found = files_of_run(path)
        if not found:
            raise FlightError(f"no complete chunk of a flight log in this folder: {path}")
        return found
    logs = filter(is_flight_log, path.parent.glob(f"{path.stem}_*.mcap"))
    named = sorted(filter(run_of, logs), key=lambda file: (len(file.name), file.name))
    if not named:
        raise MissingFileError(f"flight log does not exist: {path}")
    found = files_of_run(named[0])
    if len(found) < len(named):
        names = ", ".join(file.name for file in named[:5])
        raise FlightError(f"several flights have this name; name a file ({names}): {path}")
    return found
