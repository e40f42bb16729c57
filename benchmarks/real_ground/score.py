"""What a row says: errors of confident fixes, and whether what they state is true."""

import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.record import number
from benchmarks.scenes import FAR_M
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize import Localizer
from orthonav.core.records import RADIUS_SHARE, Fix, NoFix, View, protection_level_m
from orthonav.onboard.run import Locator, locate_view

RISK = 0.001
HEADER = (
    *("row", "views", "confident %", "of right %", "median m", "95 % m", "stated sd m"),
    *("NEES", "NEES median", "PL exceeded", "false", "ms"),
)
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Seen:
    """A view and the truth.

    - `latlon_deg`: of the camera; of the ground in the middle of the picture if `of_ground`.
    - `height_m`: of the camera above ground.
    - `judged`: whether it counts; others only lead a track to those that do.
    """

    view: View
    latlon_deg: tuple[float, float]
    height_m: float
    judged: bool = True
    of_ground: bool = False


class Source:
    """Where the views of a row come from. `std_m`: error of the truth per axis."""

    std_m: float = 0.0

    def imagery(self) -> str:
        """Name of what must be there, as `maps.found` takes it or below `DATA`."""
        raise NotImplementedError

    def pictures(self) -> str:
        """Name of pictures that several rows share, and that are made first; empty: none."""
        return ""

    def seen(self, work: Path, base: Localizer, views: int, tracked: bool) -> Iterator[Seen]:
        """So many views on the map of `base`; more for a track."""
        raise NotImplementedError


@dataclass(frozen=True)
class Placed:
    """A fix against the truth.

    - `time_s`: of the view, by the clock of the flight.
    - `state`: of the track at the view; None for a single view.
    - `variance_m2`: stated, mean of both axes. `nees` and `level_m`, the protection level at
      `RISK`, add the error of the truth to it.
    """

    time_s: float
    state: str | None
    confident: bool
    error_m: float
    wrong: bool
    variance_m2: float
    nees: float
    level_m: float


def placed(locator: Locator, seen: Iterable[Seen], frame: LocalFrame, std_m: float) -> "Row":
    """Places views in order. `std_m`: error of the truth per axis."""
    found: list[Placed] = []
    times_ms: list[float] = []
    for each in seen:
        if not times_ms and locator.state_name is None:
            locate_view(locator, each.view)  # the first view prepares the map
        start = time.process_time()
        outcome, _ = locate_view(locator, each.view)
        took_ms = 1e3 * (time.process_time() - start)
        if each.judged:
            times_ms.append(took_ms)
            found += compared(outcome, each, frame, std_m, locator.state_name)
    return Row(found, times_ms)


def compared(
    outcome: Fix | NoFix, each: Seen, frame: LocalFrame, std_m: float, state: str | None = None
) -> list[Placed]:
    """The fix against the truth; nothing where there is none."""
    if not isinstance(outcome, Fix):
        return []
    place, cov = (outcome.lat_deg, outcome.lon_deg), outcome.cov_en_m2
    if each.of_ground:
        if outcome.ground_latlon_deg is None or outcome.ground_cov_en_m2 is None:
            return []
        place, cov = outcome.ground_latlon_deg, outcome.ground_cov_en_m2
    off = frame.en_from_latlon(*place) - frame.en_from_latlon(*each.latlon_deg)
    total, error_m = cov + std_m**2 * np.eye(2), float(np.hypot(*off))
    return [
        Placed(
            time_s=each.view.telemetry.time_ns / 1e9,
            state=state,
            confident=outcome.is_confident,
            error_m=error_m,
            wrong=error_m > max(FAR_M, RADIUS_SHARE * each.height_m),
            variance_m2=float(np.trace(cov)) / 2,
            nees=float(off @ np.linalg.solve(total, off)),
            level_m=protection_level_m(outcome.right_probability, total, RISK),
        )
    ]


@dataclass(frozen=True)
class Row:
    """Fixes of one row, and the processor's time of all its views."""

    found: list[Placed]
    times_ms: list[float]

    def __add__(self, other: "Row") -> "Row":
        return Row(self.found + other.found, self.times_ms + other.times_ms)

    def values(self) -> dict[str, Any]:
        """The numbers of the row and its fixes, as JSON; None where nothing is confident."""
        accepted = [each for each in self.found if each.confident]
        right = [each for each in self.found if not each.wrong]
        views = len(self.times_ms)

        def of(name: str) -> Array:
            return np.array([getattr(each, name) for each in accepted], np.float64)

        found: dict[str, Any] = {
            "fixes": [asdict(each) for each in self.found],
            "views": views,
            "confident": len(accepted) / max(views, 1),
            "of_right": sum(each.confident for each in right) / max(len(right), 1),
            "exceeded": sum(each.error_m > each.level_m for each in accepted),
            "bounded": sum(math.isfinite(each.level_m) for each in accepted),
            "false": sum(each.wrong for each in accepted),
            "ms": float(np.median(self.times_ms)) if views else None,
        }
        if not accepted:
            return found | dict.fromkeys(("median_m", "p95_m", "std_m", "nees", "nees_median"))
        return found | {
            "median_m": float(np.median(of("error_m"))),
            "p95_m": float(np.percentile(of("error_m"), 95)),
            "std_m": math.sqrt(float(of("variance_m2").mean())),
            "nees": float(of("nees").mean()),
            "nees_median": float(np.median(of("nees"))),
        }


def cells(name: str, values: dict[str, Any]) -> list[str]:
    """Values of a row as cells under `HEADER`."""

    def text(key: str) -> str:
        return "-" if values[key] is None else number(values[key])

    return [
        *(name, str(values["views"])),
        *(f"{100 * values['confident']:.0f}", f"{100 * values['of_right']:.0f}"),
        *(text(key) for key in ("median_m", "p95_m", "std_m", "nees", "nees_median")),
        f"{values['exceeded']} of {values['bounded']}",
        str(values["false"]),
        text("ms"),
    ]
