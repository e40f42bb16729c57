"""What a check finds: predictions of places, along a route, and the verdict.

Nothing here computes; `orthonav.check.run` fills these in and `orthonav.check.write` writes them.
Probabilities are of one single view; NaN where nothing is known (no imagery, outside the band).
"""

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from orthonav.geo.frames import LocalFrame

Array = NDArray[np.float64]


class Word(Enum):
    """The verdict; its value is what is printed and written."""

    GO = "go"
    MARGINAL = "marginal"
    NO_GO = "no-go"

    @property
    def exit_code(self) -> int:
        """Of the command, for scripts: 0 go, 3 marginal, 4 no-go (1 and 2 are errors)."""
        return {Word.GO: 0, Word.MARGINAL: 3, Word.NO_GO: 4}[self]


@dataclass(frozen=True)
class Conditions:
    """What was checked for: views of `width_m` x `height_m` on the ground, and what is told.

    Standard deviations: `yaw_std_deg` of the told heading (None: unknown), `agl_std` of the told
    height as a share of it, `prior_std_m` of the told position per axis (None: the whole map is
    searched). A fix is confident from `accept` on and correct within `radius_m`. `speed_mps` over
    ground and `drift` (metres of error per metre flown without a fix) are for stretches.
    """

    width_m: float
    height_m: float
    agl_m: float | None
    yaw_std_deg: float | None
    agl_std: float
    prior_std_m: float | None
    accept: float
    radius_m: float
    speed_mps: float
    drift: float


@dataclass(frozen=True, eq=False)
class Cells:
    """Predictions of square cells, row 0 in the north; arrays are (rows, cols).

    `probability` of a correct, confident fix of one view anywhere in the cell, `low` and `high` an
    80 % interval of it; `error_m` expected error (root mean square, metres) of such a fix;
    `wrong` share of trials that were confident and wrong; `trials` how many views were tried;
    `texture` 0..1, how much of what the ground shows is expected to last in another year.
    """

    west_m: float
    north_m: float
    side_m: float
    probability: Array
    low: Array
    high: Array
    error_m: Array
    wrong: Array
    trials: NDArray[np.int32]
    texture: Array


@dataclass(frozen=True, eq=False)
class Along:
    """Predictions at points (N,) along the route, `distance_m` from its start.

    `across_low` is the lowest probability over the width of the band there; `points_en_m` (N, 2).
    `drift_m` is the position error expected there (one standard deviation) when each fix comes with
    its probability and dead reckoning drifts in between. `low` and `high` are an 80 % interval of
    `probability`; where they are not told, those of the cells below are shown.
    """

    distance_m: Array
    points_en_m: Array
    probability: Array
    across_low: Array
    error_m: Array
    drift_m: Array
    low: Array | None = None
    high: Array | None = None


@dataclass(frozen=True)
class Stretch:
    """Part of the route where a view is unlikely to be placed: metres and seconds from its start.

    `drift_m` is what dead reckoning may be off by at its end, `allowed_m` how far it may be off
    there and the next view still be searched in the right place. `ends_lost` where the route ends
    in it.
    """

    start_m: float
    end_m: float
    start_s: float
    end_s: float
    probability: float
    drift_m: float
    allowed_m: float
    ends_lost: bool = False

    @property
    def length_m(self) -> float:
        """How long it is along the route."""
        return self.end_m - self.start_m

    @property
    def bearable(self) -> bool:
        """Whether the aircraft is found again after it."""
        return not self.ends_lost and self.drift_m <= self.allowed_m


@dataclass(frozen=True)
class Lookalike:
    """Two places that views of one may be put at the other; `likeness` 0..1, `trials` behind it.

    Positions are (latitude, longitude) in degrees. `within_prior` is whether the other lies where a
    view of the one would be searched.
    """

    place_latlon_deg: tuple[float, float]
    other_latlon_deg: tuple[float, float]
    apart_m: float
    likeness: float
    trials: int
    within_prior: bool


@dataclass(frozen=True, eq=False)
class Envelope:
    """Share (A, B) of correct, confident fixes over errors of heading (A,) and height (B,).

    Errors are those of one view, beyond what is told; `agl_off` is a share of the height. `fine` is
    the largest of each alone at which the share stays at 85 % or more of that without error.
    """

    yaw_off_deg: Array
    agl_off: Array
    share: Array
    fine_yaw_deg: float
    fine_agl_low: float
    fine_agl_high: float


@dataclass(frozen=True)
class Alternative:
    """What would be if something else were chosen: `what` ("agl_m", "band_m"), its value, and the
    mean probability along the route or over the map with it."""

    what: str
    value: float
    probability: float
    chosen: bool = False


@dataclass(frozen=True)
class Reason:
    """Why the verdict is what it is: a short word for programs, a sentence for people."""

    code: str
    text: str
    word: Word


@dataclass(frozen=True)
class Verdict:
    """The worst of its reasons, which come worst first."""

    word: Word
    reasons: tuple[Reason, ...]


@dataclass(frozen=True)
class About:
    """What was checked, as text to show."""

    map_name: str
    imagery: str
    recipe: str
    other_date: str = ""
    route_name: str = ""
    command: str = ""
    version: str = ""
    terms: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class CheckResult:
    """All that a check found. `along` is None without a route, `envelope` where none was asked for.

    `route_en_m` (M, 2) are its waypoints, `band_m` the width of its widest band. `second_date` is
    whether views of another date were tried too. `area_km2` is what was checked, `mean` the mean
    probability over it.
    """

    about: About
    conditions: Conditions
    frame: LocalFrame
    cells: Cells
    verdict: Verdict
    area_km2: float
    mean: float
    second_date: bool
    along: Along | None = None
    route_en_m: Array | None = None
    band_m: float | None = None
    stretches: tuple[Stretch, ...] = ()
    lookalikes: tuple[Lookalike, ...] = ()
    envelope: Envelope | None = None
    alternatives: tuple[Alternative, ...] = field(default=())
