"""A displayed run: its results, truth, health and images."""

import math
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from orthonav import __version__
from orthonav.core.errors import FlightError, OrthonavError
from orthonav.core.flight.fixes import STATES
from orthonav.core.flight.mount import Mount
from orthonav.core.records import Fix, Telemetry, ViewResult
from orthonav.ground.evaluate.contact_sheet import as_fixed
from orthonav.ground.recordings.pixel import ellipse_95, locate_pixel
from orthonav.ground.view.columns import columns_of
from orthonav.ground.view.feed import Batch, Feed
from orthonav.ground.view.images import Shot, ViewImages
from orthonav.ground.view.logs import LogReader
from orthonav.ground.view.sheet import (
    GroundWindow,
    SheetImagery,
    image_px,
    small_jpeg,
    view_png,
    window_of,
)

AT = ("fix", "truth")


@dataclass(frozen=True)
class RunLabels:
    """Names of run, map, images, truth and second run for the page; `live` while the run is in
    progress."""

    name: str
    map_name: str
    images: str
    truth: str
    live: bool
    second: str = ""


@dataclass(frozen=True, eq=False)
class _Placed:
    """A view without the errors of its mount, the telemetry corrected by its fix, and the ground
    that it shows."""

    shot: Shot
    telemetry: Telemetry
    window: GroundWindow


class Run:
    """Everything that the page requests. Safe to share between threads."""

    def __init__(
        self,
        labels: RunLabels,
        feed: Feed,
        images: ViewImages,
        sheet: SheetImagery,
        truth: Mapping[str, tuple[float, float]],
        radius_m: float,
        mount: Mount | None = None,
        second: Mapping[str, ViewResult] | None = None,
    ) -> None:
        """Read what exists. `mount`: None: that of the flight log, where the feed is one. `second`:
        results of another run of the same flight by frame, to compare.

        Raises what the feed raises, and `FlightError` for an empty run.
        """
        self._mount = mount
        self.labels, self.sheet = labels, sheet
        self._feed, self._images = feed, images
        self._truth, self._radius_m, self._second = truth, radius_m, second
        self._lock = threading.Lock()
        self._generation = 1
        self._results: list[ViewResult] = []
        self._health: list[dict[str, Any]] = []
        self._columns: dict[str, list[Any]] = {}
        self._problems: list[str] = []
        self._trouble = ""
        self._take(feed.poll())
        if not self._results and not labels.live:
            reason = f": {self._problems[0]}" if self._problems else ""
            raise FlightError(f"run has no views{reason}: {labels.name}")

    @property
    def count(self) -> int:
        """Number of views so far."""
        return len(self._results)

    @property
    def problems(self) -> tuple[str, ...]:
        """Messages about what was read."""
        return tuple(self._problems)

    def any_known(self, column: str) -> bool:
        """Whether any view has a value in a column."""
        return any(value is not None for value in self._columns.get(column, ()))

    def any_on_map(self) -> bool:
        """Whether any fix lies on the sheet."""
        grid = self.sheet.grid
        places = zip(self._columns.get("x", ()), self._columns.get("y", ()), strict=True)
        return any(
            x is not None and 0 <= x <= grid.width_px and 0 <= y <= grid.height_px
            for x, y in places
        )

    def summary(self) -> dict[str, Any]:
        """What does not change while the page is open."""
        return {
            **asdict(self.labels),
            "version": __version__,
            "radius_m": self._radius_m,
            "states": list(STATES),
            "sheet": self.sheet.plain(),
        }

    def news(self, generation: int, views: int, health: int) -> dict[str, Any]:
        """What is new after so many views and lines of health; all for another `generation`."""
        with self._lock:
            self._refresh()
            if generation != self._generation:
                views, health = 0, 0
            views, health = max(views, 0), max(health, 0)
            return {
                "generation": self._generation,
                "first": views,
                "count": len(self._results),
                "columns": {name: each[views:] for name, each in self._columns.items()},
                "health": self._health[health:],
                "problems": [*self._problems, *([self._trouble] if self._trouble else [])],
            }

    def detail(self, index: int) -> dict[str, Any]:
        """Everything known about one view. Raises `IndexError`."""
        result = self._result(index)
        outcome = result.outcome
        plain: dict[str, Any] = {
            "index": index,
            "frame": result.frame,
            "time_s": _seconds(result.time_ns),
            "state": result.state,
            "evidence": {str(name): _known(value) for name, value in outcome.evidence.items()},
        }
        if isinstance(outcome, Fix):
            plain |= {"lat_deg": outcome.lat_deg, "lon_deg": outcome.lon_deg}
        else:
            plain |= {"reason": outcome.reason, "detail": outcome.detail}
        other = (self._second or {}).get(result.frame)
        if other is not None and isinstance(other.outcome, Fix):
            plain |= {"second_lat_deg": other.outcome.lat_deg}
            plain |= {"second_lon_deg": other.outcome.lon_deg}
        truth = self._truth.get(result.frame)
        if truth is not None:
            plain |= {"true_lat_deg": truth[0], "true_lon_deg": truth[1]}
        try:
            shot = self._images.shot(result.frame)
            plain["telemetry"] = _plain(shot.telemetry)
            placed = self._placed(result, shot)
            plain["window"] = asdict(placed.window)
        except FlightError as error:
            plain["why_no_window"] = str(error)
        return plain

    def view_png(self, index: int) -> bytes:
        """The view rectified to nadir. Raises `IndexError` or `FlightError`."""
        result = self._result(index)
        placed = self._placed(result, self._images.shot(result.frame))
        return view_png(placed.shot.load(), placed.telemetry, placed.shot.camera, placed.window)

    def raw_jpeg(self, index: int) -> bytes:
        """The view as recorded, reduced. Raises `IndexError` or `FlightError`."""
        return small_jpeg(self._images.shot(self._result(index).frame).load())

    def map_png(self, index: int, at: str) -> bytes:
        """The map at the fix or the true position. Raises `IndexError` or `FlightError`."""
        result = self._result(index)
        place = self._truth.get(result.frame) if at == "truth" else None
        if at == "fix" and isinstance(result.outcome, Fix):
            place = result.outcome.lat_deg, result.outcome.lon_deg
        if place is None:
            raise FlightError(f"view {result.frame} has no such position: {at}")
        window = self._placed(result, self._images.shot(result.frame)).window
        east, north = np.asarray(self.sheet.frame.en_from_latlon(*place)) + window.offset_en_m
        return self.sheet.crop_png((float(east), float(north)), window)

    def ground(self, index: int, x: float, y: float) -> dict[str, Any]:
        """The ground at a point of the rectified view, shares of its window from the left and the
        top, with its 95 % ellipse. Raises `IndexError` or `FlightError`."""
        result = self._result(index)
        fix = result.outcome
        if not isinstance(fix, Fix):
            raise FlightError(f"view {result.frame} has no position")
        placed = self._placed(result, self._images.shot(result.frame))
        camera = placed.shot.camera
        px = image_px(placed.telemetry, camera, placed.window, (x, y))
        found = locate_pixel(camera, placed.shot.telemetry, fix, px, self.sheet.terrain)
        return {
            "lat_deg": found.lat_deg,
            "lon_deg": found.lon_deg,
            "height_m": _known(found.height_m),
            "ellipse_95": ellipse_95(found.cov_en_m2),
            "confident": result.is_confident,
        }

    def _result(self, index: int) -> ViewResult:
        with self._lock:
            if not 0 <= index < len(self._results):
                raise IndexError(f"no view {index}")
            return self._results[index]

    def _placed(self, result: ViewResult, shot: Shot) -> _Placed:
        mount = self._mount
        if mount is None and isinstance(self._feed, LogReader):
            mount = self._feed.mount
        if mount is not None:
            shot = replace(shot, telemetry=mount.corrected(shot.telemetry))
        telemetry = as_fixed(shot.telemetry, result)
        return _Placed(shot, telemetry, window_of(telemetry, shot.camera, self.sheet.grid.gsd_m))

    def _refresh(self) -> None:
        """Read what is new; a file that cannot be read now is reported and tried again."""
        if not self.labels.live:
            return
        try:
            if isinstance(self._images, LogReader) and self._images is not self._feed:
                self._images.poll()
            self._take(self._feed.poll())
            self._trouble = ""
        except (OrthonavError, OSError) as error:
            self._trouble = " ".join(str(error).split())

    def _take(self, batch: Batch) -> None:
        if batch.restarted:
            self._generation += 1
            self._results, self._health, self._columns = [], [], {}
        self._problems += batch.problems
        self._health += [{"view": before, **plain} for before, plain in batch.health]
        if not batch.results:
            return
        self._results += batch.results
        began_ns = self._results[0].time_ns
        made = columns_of(
            batch.results, began_ns, self._truth, self.sheet, self._radius_m, self._second
        )
        for name, values in made.items():
            self._columns.setdefault(name, []).extend(values)


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _seconds(time_ns: int) -> str:
    """Decimal seconds with all nanoseconds, as text: JavaScript's numbers cannot hold them."""
    whole, rest = divmod(abs(time_ns), 10**9)
    return f"{'-' if time_ns < 0 else ''}{whole}.{rest:09d}"


def _plain(telemetry: Telemetry) -> dict[str, float | None]:
    names = ("yaw_deg", "pitch_deg", "roll_deg", "agl_m")
    return {name: _known(getattr(telemetry, name)) for name in names}
