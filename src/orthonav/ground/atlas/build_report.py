"""The result of building an atlas, sheet by sheet and in all."""

import time
from dataclasses import dataclass, field
from typing import Any, Literal

Status = Literal["built", "unchanged", "empty", "failed"]


@dataclass(frozen=True)
class SheetResult:
    """The result of one sheet and its cost.

    `sheet`: name.
    `status`: `built`; `unchanged`, it was there already; `empty`, there is no imagery; `failed`.
    `error`: why it failed.
    `cpu_s`: processor time.
    `wall_s`: time that the worker spent on it.
    `size_bytes`, `area_km2`, `tiles`: of the sheet.
    `peak_bytes`: greatest memory that the worker process ever had.
    """

    sheet: str
    status: Status
    error: str = ""
    cpu_s: float = 0.0
    wall_s: float = 0.0
    size_bytes: int = 0
    area_km2: float = 0.0
    tiles: int = 0
    peak_bytes: int = 0


@dataclass
class BuildReport:
    """The results of a build of `total` sheets; grows while sheets are finished.

    `url`: the atlas.
    `total`: sheets asked for.
    `started_s`: monotonic clock at the start.
    `results`: sheets that are finished or failed.
    `finish_error`: why snapshot or index could not be written.
    """

    url: str
    total: int
    started_s: float = field(default_factory=time.monotonic)
    results: list[SheetResult] = field(default_factory=list)
    finish_error: str | None = None
    wall_s: float = 0.0

    def names(self, status: Status) -> list[str]:
        """Names of the sheets with that status, sorted."""
        return sorted(each.sheet for each in self.results if each.status == status)

    @property
    def untried(self) -> int:
        """Number of sheets that were not begun."""
        return self.total - len(self.results)

    @property
    def share(self) -> float:
        """Share of the sheets that is done."""
        return len(self.results) / max(1, self.total)

    @property
    def is_complete(self) -> bool:
        """Whether all that was asked for is there."""
        return not self.names("failed") and not self.untried and self.finish_error is None

    def line(self) -> str:
        """Progress in one line."""
        plain = self.to_plain()
        text = f"{len(self.results):,} of {self.total:,} sheets"
        if plain["area_km2"]:
            text += (
                f", {plain['km2_per_hour']:,.0f} km2/h, {plain['cpu_s_per_km2']:.2f} CPU s/km2, "
                f"{plain['mb_per_km2']:.2f} MB/km2"
            )
        tried = len(self.results) - plain["unchanged"]
        if tried:
            left_s = plain["wall_s"] / tried * self.untried
            text += f", {duration(left_s)} left"
        return text + (f", {len(plain['failed'])} failed" if plain["failed"] else "")

    def to_plain(self, cpu_hour_price: float | None = None) -> dict[str, Any]:
        """Sums and rates as plain values; `cpu_hour_price` is the price of an hour of a core.

        `core_s` is how long workers were busy with sheets, which is what machines are paid for.
        """
        built = [each for each in self.results if each.status == "built"]
        tried = [each for each in self.results if each.status != "unchanged"]
        wall_s = self.wall_s or time.monotonic() - self.started_s
        area_km2 = sum(each.area_km2 for each in built)
        size_mb = sum(each.size_bytes for each in built) / 1e6
        core_s, cpu_s = sum(each.wall_s for each in tried), sum(each.cpu_s for each in tried)
        plain: dict[str, Any] = {
            "atlas": self.url,
            "built": len(built),
            "unchanged": len(self.names("unchanged")),
            "empty": len(self.names("empty")),
            "failed": [
                {"sheet": each.sheet, "error": each.error}
                for each in sorted(self.results, key=lambda each: each.sheet)
                if each.status == "failed"
            ],
            "untried": self.untried,
            "area_km2": round(area_km2, 4),
            "tiles": sum(each.tiles for each in built),
            "size_mb": round(size_mb, 4),
            "wall_s": round(wall_s, 3),
            "core_s": round(core_s, 3),
            "cpu_s": round(cpu_s, 3),
            "peak_mb": round(max((each.peak_bytes for each in tried), default=0) / 1e6, 1),
            "finish_error": self.finish_error,
            "sheets_per_hour": _rate(3600 * len(built), wall_s),
            "km2_per_hour": _rate(3600 * area_km2, wall_s),
            "cpu_s_per_km2": _rate(cpu_s, area_km2),
            "mb_per_km2": _rate(size_mb, area_km2),
        }
        if cpu_hour_price is not None:
            cost = core_s / 3600 * cpu_hour_price
            plain["cost"] = round(cost, 4)
            plain["cost_per_km2"] = _rate(cost, area_km2, 6)
        return plain


def duration(seconds: float) -> str:
    """A time for people: `2 h 05 min`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"


def _rate(value: float, by: float, digits: int = 4) -> float | None:
    return round(value / by, digits) if by > 0 else None
