"""A run that is looked at: its results, their truth, its health and its pictures."""

import math
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from orthonav import __version__
from orthonav.errors import FlightError, OrthonavError
from orthonav.evaluate.contact_sheet import as_fixed
from orthonav.flight.fixes import STATES
from orthonav.records import Fix, Telemetry, ViewResult
from orthonav.web.columns import columns_of
from orthonav.web.feed import Batch, Feed
from orthonav.web.ground import Ground, Window, small_jpeg, view_png, window_of
from orthonav.web.logs import LogReader
from orthonav.web.pictures import Pictures, Shot

AT = ("fix", "truth")


@dataclass(frozen=True)
class Told:
    """What the page says of a run: names as text, and whether more of it is to come."""

    name: str
    map_name: str
    pictures: str
    truth: str
    live: bool


@dataclass(frozen=True, eq=False)
class _Placed:
    """A view with its picture, as its fix has it, and the ground that it shows."""

    shot: Shot
    told: Telemetry
    window: Window


class Run:
    """Everything that the page asks for. Safe to share between threads."""

    def __init__(
        self,
        told: Told,
        feed: Feed,
        pictures: Pictures,
        ground: Ground,
        truth: Mapping[str, tuple[float, float]],
        radius_m: float,
    ) -> None:
        """Reads what is there. Raises what the feed raises, and `FlightError` where it is empty."""
        self.told, self.ground = told, ground
        self._feed, self._pictures = feed, pictures
        self._truth, self._radius_m = truth, radius_m
        self._lock = threading.Lock()
        self._generation = 1
        self._results: list[ViewResult] = []
        self._health: list[dict[str, Any]] = []
        self._columns: dict[str, list[Any]] = {}
        self._problems: list[str] = []
        self._trouble = ""
        self._take(feed.poll())
        if not self._results and not told.live:
            told_why = f": {self._problems[0]}" if self._problems else ""
            raise FlightError(f"run has no views{told_why}: {told.name}")

    @property
    def count(self) -> int:
        """Views so far."""
        return len(self._results)

    @property
    def problems(self) -> tuple[str, ...]:
        """What people should know of what was read."""
        return tuple(self._problems)

    def any_known(self, column: str) -> bool:
        """Whether any view has a value in a column."""
        return any(value is not None for value in self._columns.get(column, ()))

    def any_on_map(self) -> bool:
        """Whether any fix lies on the sheet."""
        grid = self.ground.grid
        places = zip(self._columns.get("x", ()), self._columns.get("y", ()), strict=True)
        return any(
            x is not None and 0 <= x <= grid.width_px and 0 <= y <= grid.height_px
            for x, y in places
        )

    def summary(self) -> dict[str, Any]:
        """What does not change while the page is open."""
        return {
            **asdict(self.told),
            "version": __version__,
            "radius_m": self._radius_m,
            "states": list(STATES),
            "sheet": self.ground.plain(),
        }

    def news(self, generation: int, views: int, health: int) -> dict[str, Any]:
        """What came after so many views and lines of health; all where `generation` is another."""
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
        """All that is known of one view. Raises `IndexError`."""
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
        truth = self._truth.get(result.frame)
        if truth is not None:
            plain |= {"true_lat_deg": truth[0], "true_lon_deg": truth[1]}
        try:
            shot = self._pictures.shot(result.frame)
            plain["told"] = _told(shot.telemetry)
            placed = self._placed(result, shot)
            plain["window"] = asdict(placed.window)
        except FlightError as error:
            plain["why_no_window"] = str(error)
        return plain

    def view_png(self, index: int) -> bytes:
        """The view from straight above. Raises `IndexError` or `FlightError`."""
        result = self._result(index)
        placed = self._placed(result, self._pictures.shot(result.frame))
        return view_png(placed.shot.load(), placed.told, placed.shot.camera, placed.window)

    def raw_jpeg(self, index: int) -> bytes:
        """The view as it was taken, made small. Raises `IndexError` or `FlightError`."""
        return small_jpeg(self._pictures.shot(self._result(index).frame).load())

    def map_png(self, index: int, at: str) -> bytes:
        """The map where a view was put, or was taken. Raises `IndexError` or `FlightError`."""
        result = self._result(index)
        place = self._truth.get(result.frame) if at == "truth" else None
        if at == "fix" and isinstance(result.outcome, Fix):
            place = result.outcome.lat_deg, result.outcome.lon_deg
        if place is None:
            raise FlightError(f"view {result.frame} has no such place: {at}")
        window = self._placed(result, self._pictures.shot(result.frame)).window
        east, north = np.asarray(self.ground.frame.en_from_latlon(*place)) + window.offset_en_m
        return self.ground.crop_png((float(east), float(north)), window)

    def _result(self, index: int) -> ViewResult:
        with self._lock:
            if not 0 <= index < len(self._results):
                raise IndexError(f"no view {index}")
            return self._results[index]

    def _placed(self, result: ViewResult, shot: Shot) -> _Placed:
        told = as_fixed(shot.telemetry, result)
        return _Placed(shot, told, window_of(told, shot.camera, self.ground.grid.gsd_m))

    def _refresh(self) -> None:
        """Read what came; a file that cannot be read right now is told of and tried again."""
        if not self.told.live:
            return
        try:
            if isinstance(self._pictures, LogReader) and self._pictures is not self._feed:
                self._pictures.poll()
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
        made = columns_of(batch.results, began_ns, self._truth, self.ground, self._radius_m)
        for name, values in made.items():
            self._columns.setdefault(name, []).extend(values)


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _seconds(time_ns: int) -> str:
    """Decimal seconds with all nanoseconds, as text: JavaScript's numbers cannot hold them."""
    whole, rest = divmod(abs(time_ns), 10**9)
    return f"{'-' if time_ns < 0 else ''}{whole}.{rest:09d}"


def _told(told: Telemetry) -> dict[str, float | None]:
    names = ("yaw_deg", "pitch_deg", "roll_deg", "agl_m")
    return {name: _known(getattr(told, name)) for name in names}
