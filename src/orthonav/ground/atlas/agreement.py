"""Agreement of views: one view alone never decides where in a country an aircraft is.

A chain is a sequence of places, one per view, that an aircraft can have flown through. A view found
where a chain expects it supports the chain by its odds against the best other place in the whole
atlas, and by how unlikely it is that a wrong place lies there by chance. A view counts by the share
of it that is new ground, because views of the same ground are not independent."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.frames import LocalFrame, distances_m

# Values without another source were chosen with `benchmarks.atlas_lost` at d63ac91.
MAX_SPEED_MPS = 120.0  # faster than the aircraft that this program is for
SLACK_M = 60.0  # errors of two registered positions, seven pixels of 8 m
TURN_RATE_RAD_S = math.radians(12.0)  # four times a standard-rate turn (3 deg/s)
TURN_SLACK_RAD = math.radians(12.0)  # errors of two registered headings
SCALE_SLACK = 0.12  # greatest difference of log scale between two views, besides climbing
CLIMB_PER_S = 0.02  # change of log scale per second: 20 m/s at 1000 m
MIN_NEW = 0.15  # fraction of a view that must be new ground (docs/decisions/tracking.md)
ANCHORS = 30  # places that counted and are remembered: circling over them proves nothing more
MAX_REACH_M = 5_000.0  # a chain whose aircraft may be farther away is dropped
MIN_VELOCITY_S = 0.5  # views closer in time do not give a velocity
AGILE_MPS = 10.0  # the velocity may change by so much, and by half, between two views
MISSED = 1.6  # nats that a view without support costs a chain: exp(-1.6) is 0.2, `1 - FOUND`
CHANCE = 0.05  # least probability that a wrong place lies by chance where a chain expects the view
FOUND = 0.8  # probability that the right place is found where a chain expects the view
MAX_LOG_ODDS = 5.0  # no single view counts more than this: odds of 150
MAX_CHAINS = 12
HOPELESS = 9.0  # chains less likely than the best by more nats are dropped
MIN_VIEWS = 1.7  # views of new ground that must agree: two that overlap by 30 %
MAX_CHAIN_LOG_ODDS = 14.0  # so that a chain that became wrong is given up after some views


@dataclass(frozen=True)
class Placement:
    """How a view may have been taken, and from which place."""

    lat_deg: float
    lon_deg: float
    turn_rad: float  # heading of the top of the view
    log_scale: float  # logarithm of true over reported height

    @property
    def latlon_deg(self) -> tuple[float, float]:
        return self.lat_deg, self.lon_deg


@dataclass(frozen=True)
class PlaceEvidence(Placement):
    log_odds: float  # of this place against all others of the atlas, from this view alone (nats)
    key: int  # number by which the caller recognizes the view


@dataclass(frozen=True, eq=False)
class Chain:
    last: PlaceEvidence  # the latest place
    time_ns: int  # when it was seen
    log_odds: float  # of the chain (nats)
    views: float  # how many agree, in views of new ground
    latest_log_odds: float  # what the latest view alone says of its place (nats)
    anchors: tuple[PlaceEvidence, ...]  # the places of the views that counted
    velocity_en_mps: NDArray[np.float64] | None = None  # east and north, None where unknown
    missed: int = 0  # views since the latest place that did not support the chain

    def latest(self, count: int) -> tuple[PlaceEvidence, ...]:
        places = self.anchors if self.anchors[-1] is self.last else (*self.anchors, self.last)
        return places[-count:]

    def _seconds(self, time_ns: int) -> float:
        return max(0.0, (time_ns - self.time_ns) / 1e9)

    def reach_m(self, time_ns: int) -> float:
        speed = MAX_SPEED_MPS
        if self.velocity_en_mps is not None:
            latest = float(np.hypot(*self.velocity_en_mps))
            speed = min(speed, (0.5 + self.missed) * latest + AGILE_MPS)
        return SLACK_M + speed * self._seconds(time_ns)

    def expected(self, time_ns: int) -> tuple[float, float]:
        if self.velocity_en_mps is None:
            return self.last.latlon_deg
        frame = LocalFrame(*self.last.latlon_deg)
        lat, lon = frame.latlon_from_en(self.velocity_en_mps * self._seconds(time_ns))
        return float(lat), float(lon)

    def turn_std_rad(self, time_ns: int) -> float:
        turned = TURN_SLACK_RAD + TURN_RATE_RAD_S * self._seconds(time_ns)
        return min(math.pi / 2, turned / 3)

    def reaches(self, place: PlaceEvidence, time_ns: int) -> bool:
        dt_s = self._seconds(time_ns)
        away = distances_m([self.expected(time_ns)], [place.latlon_deg])[0]
        turned = abs(math.remainder(place.turn_rad - self.last.turn_rad, 2 * math.pi))
        scaled = abs(place.log_scale - self.last.log_scale)
        return bool(
            away <= self.reach_m(time_ns)
            and turned <= TURN_SLACK_RAD + TURN_RATE_RAD_S * dt_s
            and scaled <= SCALE_SLACK + CLIMB_PER_S * dt_s
        )


class Agreement:
    """The chains of one flight. Mutable; not to be shared between threads."""

    def __init__(self) -> None:
        self.chains: list[Chain] = []

    def add_view(
        self, places: Sequence[PlaceEvidence], time_ns: int, side_m: float, chance: float
    ) -> None:
        """`side_m`: width of the view. `chance`: probability that the best of the wrong places lies
        where a chain expects it, the fraction of the searched area that was searched there."""
        gain = math.log(FOUND / min(max(chance, CHANCE), FOUND))
        made: list[Chain] = []
        supporting = [each for each in places if _support(each, gain) > 0]
        for chain in self.chains:
            if time_ns < chain.time_ns or chain.reach_m(time_ns) > MAX_REACH_M:
                continue
            made += [
                _extended(chain, each, time_ns, side_m, gain)
                for each in supporting
                if chain.reaches(each, time_ns)
            ]
            made.append(replace(chain, log_odds=chain.log_odds - MISSED, missed=chain.missed + 1))
        # New chains come last: of two equal chains the older one comes first.
        for each in places:
            odds = min(each.log_odds, MAX_LOG_ODDS)
            made.append(Chain(each, time_ns, odds, 1.0, odds, (each,)))
        chains = _distinct(made, side_m)
        # Subtracted from all alike: the limit must not make them equal.
        excess = max(0.0, chains[0].log_odds - MAX_CHAIN_LOG_ODDS) if chains else 0.0
        self.chains = [replace(each, log_odds=each.log_odds - excess) for each in chains]

    @property
    def best(self) -> Chain | None:
        return self.chains[0] if self.chains else None

    @property
    def probability(self) -> float:
        if not self.chains:
            return 0.0
        odds = np.array([0.0, *(each.log_odds for each in self.chains)])
        return float(np.exp(odds[1] - np.logaddexp.reduce(odds)))

    @property
    def confidence(self) -> float:
        """Probability that the latest view is where the likeliest chain has it: at most what the
        view itself says of the expected place."""
        best = self.best
        if best is None:
            return 0.0
        return min(self.probability, 1 / (1 + math.exp(-best.latest_log_odds)))

    @property
    def agreed(self) -> bool:
        best = self.best
        return best is not None and best.views >= MIN_VIEWS and best.missed == 0


def _support(place: PlaceEvidence, gain: float) -> float:
    return min(place.log_odds, MAX_LOG_ODDS) + gain


def _extended(
    chain: Chain, place: PlaceEvidence, time_ns: int, side_m: float, gain: float
) -> Chain:
    there = [each.latlon_deg for each in chain.anchors]
    new = min(1.0, nearest_m(place.latlon_deg, there) / max(side_m, 1.0))
    anchors = (*chain.anchors, place)[-ANCHORS:]
    if new < MIN_NEW:
        new, anchors = 0.0, chain.anchors
    support = _support(place, gain)
    return Chain(
        last=place,
        time_ns=time_ns,
        log_odds=max(chain.log_odds + new * support, min(place.log_odds, MAX_LOG_ODDS)),
        views=chain.views + new,
        latest_log_odds=support,
        anchors=anchors,
        velocity_en_mps=_velocity(chain, place, (time_ns - chain.time_ns) / 1e9),
    )


def _velocity(chain: Chain, place: PlaceEvidence, dt_s: float) -> NDArray[np.float64] | None:
    if dt_s < MIN_VELOCITY_S:
        return chain.velocity_en_mps
    frame = LocalFrame(*chain.last.latlon_deg)
    velocity = frame.en_from_latlon(place.lat_deg, place.lon_deg) / dt_s
    speed = float(np.hypot(*velocity))
    return np.asarray(velocity * min(1.0, MAX_SPEED_MPS / max(speed, 1e-9)))


def _distinct(made: Sequence[Chain], side_m: float) -> list[Chain]:
    chains: list[Chain] = []
    for each in sorted(made, key=lambda one: (-one.log_odds, -one.views)):
        if chains and each.log_odds < chains[0].log_odds - HOPELESS:
            break
        if nearest_m(each.last.latlon_deg, [one.last.latlon_deg for one in chains]) >= side_m / 4:
            chains.append(each)
        if len(chains) == MAX_CHAINS:
            break
    return chains


def nearest_m(place: tuple[float, float], others: Sequence[tuple[float, float]]) -> float:
    return float(distances_m([place] * len(others), others).min(initial=math.inf))
