"""What building an atlas came to: sheet by sheet, while it goes on, and at the end."""

import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

from orthonav.atlas.cluster import Failure


@dataclass(frozen=True)
class SheetDone:
    """What came of a sheet and what it cost.

    `peak_bytes` is the most memory that the process which built it ever had.
    """

    sheet: str
    status: Literal["built", "kept", "empty"]
    cpu_s: float = 0.0
    wall_s: float = 0.0
    size_bytes: int = 0
    area_km2: float = 0.0
    tiles: int = 0
    peak_bytes: int = 0


@dataclass(frozen=True)
class AtlasBuilt:
    """What a build came to. `failed` are sheets with what they failed of; `untried` were not begun.

    `core_s` is how long workers were at sheets, which is what machines are paid for; `cpu_s` how
    long they calculated; `finish_error` what kept snapshot or index from being written.
    """

    url: str
    built: tuple[str, ...]
    kept: tuple[str, ...]
    empty: tuple[str, ...]
    failed: tuple[tuple[str, str], ...]
    untried: int
    area_km2: float
    tiles: int
    size_bytes: int
    wall_s: float
    core_s: float
    cpu_s: float
    peak_bytes: int
    finish_error: str | None = None

    @property
    def is_complete(self) -> bool:
        """Whether all that was asked for is there."""
        return not self.failed and not self.untried and self.finish_error is None

    def to_plain(self, cpu_hour_price: float | None = None) -> dict[str, Any]:
        """Plain values, rates included; `cpu_hour_price` is that of an hour of a core."""
        plain: dict[str, Any] = {
            "atlas": self.url,
            "built": len(self.built),
            "kept": len(self.kept),
            "empty": len(self.empty),
            "failed": [{"sheet": sheet, "error": error} for sheet, error in self.failed],
            "untried": self.untried,
            "area_km2": round(self.area_km2, 4),
            "tiles": self.tiles,
            "size_mb": round(self.size_bytes / 1e6, 4),
            "wall_s": round(self.wall_s, 3),
            "core_s": round(self.core_s, 3),
            "cpu_s": round(self.cpu_s, 3),
            "peak_mb": round(self.peak_bytes / 1e6, 1),
            "finish_error": self.finish_error,
        }
        for name, value in {
            "sheets_per_hour": _over(3600 * len(self.built), self.wall_s),
            "km2_per_hour": _over(3600 * self.area_km2, self.wall_s),
            "cpu_s_per_km2": _over(self.cpu_s, self.area_km2),
            "mb_per_km2": _over(self.size_bytes / 1e6, self.area_km2),
        }.items():
            plain[name] = None if value is None else round(value, 4)
        if cpu_hour_price is not None:
            cost = self.core_s / 3600 * cpu_hour_price
            each = _over(cost, self.area_km2)
            plain["cost"] = round(cost, 4)
            plain["cost_per_km2"] = None if each is None else round(each, 6)
        return plain


class Tally:
    """Sheets of a build as they are finished."""

    def __init__(self, total: int, started_s: float) -> None:
        self._total, self._started_s = total, started_s
        self._worked_s = time.monotonic()
        self._done: list[SheetDone] = []
        self.failed: list[tuple[str, str]] = []
        self.finish_error: str | None = None

    @property
    def done(self) -> int:
        """Sheets of which it is known what came of them."""
        return len(self._done) + len(self.failed)

    @property
    def share(self) -> float:
        """Share of the sheets that is done."""
        return self.done / max(1, self._total)

    def take(self, made: SheetDone) -> None:
        """A sheet is finished."""
        self._done.append(made)

    def fail(self, sheet: str, failure: Failure) -> None:
        """A sheet is not to be had."""
        self.failed.append((sheet, f"{failure.kind}: {failure.text}"))

    def line(self) -> str:
        """How far it is, in a line."""
        built = self._of("built")
        km2 = sum(each.area_km2 for each in built)
        spent_s = time.monotonic() - self._worked_s
        text = f"{self.done:,} of {self._total:,} sheets"
        if km2:
            text += (
                f", {3600 * km2 / spent_s:,.0f} km2/h, "
                f"{sum(each.cpu_s for each in built) / km2:.2f} CPU s/km2, "
                f"{sum(each.size_bytes for each in built) / 1e6 / km2:.2f} MB/km2"
            )
        tried = self.done - len(self._of("kept"))
        if tried:
            left_s = spent_s / tried * (self._total - self.done)
            text += f", {duration(left_s)} left"
        return text + (f", {len(self.failed)} failed" if self.failed else "")

    def result(self, url: str) -> AtlasBuilt:
        """What it came to."""
        built = self._of("built")
        tried = [each for each in self._done if each.status != "kept"]
        return AtlasBuilt(
            url=url,
            built=_names(built),
            kept=_names(self._of("kept")),
            empty=_names(self._of("empty")),
            failed=tuple(sorted(self.failed)),
            untried=self._total - self.done,
            area_km2=sum(each.area_km2 for each in built),
            tiles=sum(each.tiles for each in built),
            size_bytes=sum(each.size_bytes for each in built),
            wall_s=time.monotonic() - self._started_s,
            core_s=sum(each.wall_s for each in tried),
            cpu_s=sum(each.cpu_s for each in tried),
            peak_bytes=max((each.peak_bytes for each in tried), default=0),
            finish_error=self.finish_error,
        )

    def _of(self, status: str) -> list[SheetDone]:
        return [each for each in self._done if each.status == status]


def duration(seconds: float) -> str:
    """A time as people say it: `2 h 05 min`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"


def _names(sheets: Iterable[SheetDone]) -> tuple[str, ...]:
    return tuple(sorted(each.sheet for each in sheets))


def _over(value: float, by: float) -> float | None:
    return value / by if by > 0 else None
