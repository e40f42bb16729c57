"""Agreement of views: one view alone never says where in a country it was taken.

Every hypothesis is a chain of places, one for each view that was seen there, which an aircraft can
have flown. Views that are found where the ones before let expect them speak for it, by the odds
that each has on its own against the best place elsewhere in the whole atlas, and by how unlikely it
is that a wrong place lies there by chance. A view counts by the share of it that is new ground:
what is seen again says the same again.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.geo.frames import LocalFrame, distances_m

MAX_SPEED_MPS = 120.0
"""Faster than what flies with a camera like this; nothing slower is ruled out."""
SLACK_M = 60.0
TURN_RATE_RAD_S = math.radians(12.0)
TURN_SLACK_RAD = math.radians(12.0)
SCALE_SLACK = 0.12
"""How far heading and scale of two views of one hypothesis may be from each other."""
CLIMB_PER_S = 0.02
MIN_NEW = 0.15
"""Share of a view that must be new ground for it to count at all: hovering proves nothing."""
ANCHORS = 30
"""Places that counted and are remembered: circling over them proves nothing more."""
MAX_REACH_M = 5_000.0
"""A hypothesis that may be farther from where it was is forgotten: no gap is bridged blindly."""
MIN_VELOCITY_S = 0.5
AGILE_MPS = 10.0
"""Views closer in time say nothing of the velocity; it may change by so much and by half."""
MISSED = 1.6
"""Nats that a view of new ground costs a hypothesis of which it does not speak."""
CHANCE = 0.05
"""Least probability that a wrong place lies by chance where a hypothesis expects the view."""
FOUND = 0.8
"""Probability that a right one is found there."""
MAX_LOG_ODDS = 5.0
"""No single view is believed more than this."""
KEPT = 12
HOPELESS = 9.0
MIN_VIEWS = 1.7
"""Views' worth of ground that must agree before anything is called a fix."""
FORGOTTEN_NATS = 14.0
"""More is not remembered, so that a hypothesis that became wrong is given up."""


@dataclass(frozen=True, eq=False)
class Seen:
    """One place where a view may have been taken, as agreement needs it.

    `log_odds` are those of the view on its own, against all other places of the atlas; `key` tells
    the caller which it is.
    """

    lat_deg: float
    lon_deg: float
    turn_rad: float
    log_scale: float
    log_odds: float
    key: int


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A chain of places; `last` is the latest, seen at `time_ns`.

    `views` is what agrees, in views of new ground; `worth` the log odds that the latest view alone
    gave it; `anchors` latitudes and longitudes of views that counted; `missed` views since.
    """

    last: Seen
    time_ns: int
    log_odds: float
    views: float
    worth: float
    anchors: tuple[tuple[float, float], ...]
    velocity_en_mps: NDArray[np.float64] | None = None
    missed: int = 0

    def reach_m(self, time_ns: int) -> float:
        """How far from where it is expected the aircraft may be."""
        dt_s = max(0.0, (time_ns - self.time_ns) / 1e9)
        speed = MAX_SPEED_MPS
        if self.velocity_en_mps is not None:
            told = float(np.hypot(*self.velocity_en_mps))
            speed = min(speed, (0.5 + self.missed) * told + AGILE_MPS)
        return SLACK_M + speed * dt_s

    def expected(self, time_ns: int) -> tuple[float, float]:
        """Latitude and longitude where the aircraft should be."""
        if self.velocity_en_mps is None:
            return self.last.lat_deg, self.last.lon_deg
        dt_s = max(0.0, (time_ns - self.time_ns) / 1e9)
        frame = LocalFrame(self.last.lat_deg, self.last.lon_deg)
        lat, lon = frame.latlon_from_en(self.velocity_en_mps * dt_s)
        return float(lat), float(lon)

    def turn_std_rad(self, time_ns: int) -> float:
        """How far the heading may have turned, as a standard deviation."""
        dt_s = max(0.0, (time_ns - self.time_ns) / 1e9)
        return min(math.pi / 2, (TURN_SLACK_RAD + TURN_RATE_RAD_S * dt_s) / 3)

    def fits(self, seen: Seen, time_ns: int) -> bool:
        """Whether the aircraft can have come there."""
        dt_s = max(0.0, (time_ns - self.time_ns) / 1e9)
        away = distances_m([self.expected(time_ns)], [(seen.lat_deg, seen.lon_deg)])[0]
        turned = abs(math.remainder(seen.turn_rad - self.last.turn_rad, 2 * math.pi))
        scaled = abs(seen.log_scale - self.last.log_scale)
        return bool(
            away <= self.reach_m(time_ns)
            and turned <= TURN_SLACK_RAD + TURN_RATE_RAD_S * dt_s
            and scaled <= SCALE_SLACK + CLIMB_PER_S * dt_s
        )


class Agreement:
    """The hypotheses of one flight. Mutable; not to be shared between threads."""

    def __init__(self) -> None:
        self.hypotheses: list[Hypothesis] = []

    def see(self, seen: Sequence[Seen], time_ns: int, side_m: float, chance: float) -> None:
        """Take in where a view `side_m` wide may have been taken.

        `chance` is the probability that the best of wrong places lies by chance where a hypothesis
        expects the view: the share that was looked at there of all that was looked at.
        """
        gain = math.log(FOUND / min(max(chance, CHANCE), FOUND))
        made: list[Hypothesis] = []
        speaking = [each for each in seen if _worth(each, gain) > 0]
        for old in self.hypotheses:
            if time_ns < old.time_ns or old.reach_m(time_ns) > MAX_REACH_M:
                continue
            made += [
                _followed(old, each, time_ns, side_m, gain)
                for each in speaking
                if old.fits(each, time_ns)
            ]
            made.append(replace(old, log_odds=old.log_odds - MISSED, missed=old.missed + 1))
        # Last, for of two that say the same the one that is older comes first.
        made += [_begun(each, time_ns) for each in seen]
        kept = _distinct(made, side_m)
        # Taken from all alike: what is not remembered must not make them equal.
        beyond = max(0.0, kept[0].log_odds - FORGOTTEN_NATS) if kept else 0.0
        self.hypotheses = [replace(each, log_odds=each.log_odds - beyond) for each in kept]

    @property
    def best(self) -> Hypothesis | None:
        """The likeliest hypothesis, None where there is none."""
        return self.hypotheses[0] if self.hypotheses else None

    @property
    def probability(self) -> float:
        """That of the likeliest, against all others and against none of them."""
        if not self.hypotheses:
            return 0.0
        odds = np.array([0.0, *(each.log_odds for each in self.hypotheses)])
        return float(np.exp(odds[1] - np.logaddexp.reduce(odds)))

    @property
    def confidence(self) -> float:
        """Probability that the latest view is where the likeliest hypothesis has it: no more than
        the view itself says where it was expected."""
        best = self.best
        if best is None:
            return 0.0
        return min(self.probability, 1 / (1 + math.exp(-best.worth)))

    @property
    def agreed(self) -> bool:
        """Whether enough views speak for the likeliest, the latest among them."""
        best = self.best
        return best is not None and best.views >= MIN_VIEWS and best.missed == 0


def _worth(seen: Seen, gain: float) -> float:
    """What a view found where it was expected says, in nats."""
    return min(seen.log_odds, MAX_LOG_ODDS) + gain


def _begun(seen: Seen, time_ns: int) -> Hypothesis:
    odds = min(seen.log_odds, MAX_LOG_ODDS)
    return Hypothesis(seen, time_ns, odds, 1.0, odds, ((seen.lat_deg, seen.lon_deg),))


def _followed(old: Hypothesis, seen: Seen, time_ns: int, side_m: float, gain: float) -> Hypothesis:
    place = seen.lat_deg, seen.lon_deg
    nearest_m = float(distances_m([place] * len(old.anchors), old.anchors).min())
    new = min(1.0, nearest_m / max(side_m, 1.0))
    anchors = (*old.anchors, place)[-ANCHORS:]
    if new < MIN_NEW:
        new, anchors = 0.0, old.anchors
    worth = _worth(seen, gain)
    return Hypothesis(
        last=seen,
        time_ns=time_ns,
        log_odds=max(old.log_odds + new * worth, min(seen.log_odds, MAX_LOG_ODDS)),
        views=old.views + new,
        worth=worth,
        anchors=anchors,
        velocity_en_mps=_velocity(old, seen, (time_ns - old.time_ns) / 1e9),
    )


def _velocity(old: Hypothesis, seen: Seen, dt_s: float) -> NDArray[np.float64] | None:
    """Metres per second east and north from the last place to this one."""
    if dt_s < MIN_VELOCITY_S:
        return old.velocity_en_mps
    frame = LocalFrame(old.last.lat_deg, old.last.lon_deg)
    velocity = frame.en_from_latlon(seen.lat_deg, seen.lon_deg) / dt_s
    speed = float(np.hypot(*velocity))
    return np.asarray(velocity * min(1.0, MAX_SPEED_MPS / max(speed, 1e-9)))


def _distinct(made: Sequence[Hypothesis], side_m: float) -> list[Hypothesis]:
    """The likeliest of those that say the same, best first, without those that are hopeless."""
    kept: list[Hypothesis] = []
    for each in sorted(made, key=lambda one: (-one.log_odds, -one.views)):
        if kept and each.log_odds < kept[0].log_odds - HOPELESS:
            break
        place = (each.last.lat_deg, each.last.lon_deg)
        others = [(one.last.lat_deg, one.last.lon_deg) for one in kept]
        near = others and distances_m([place] * len(others), others).min() < side_m / 4
        if not near:
            kept.append(each)
        if len(kept) == KEPT:
            break
    return kept
