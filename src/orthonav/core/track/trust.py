"""Whether a track is believed: by what views showed, where, and on how much new ground.

The mixture filters; its best place is judged here after every view. States and transitions:
docs/tracking.md, with the evidence for the values."""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from orthonav.core.records import CONFIDENT
from orthonav.core.track.model import POSITION

if TYPE_CHECKING:
    from orthonav.core.track.hypothesis import Hypothesis

RECOGNIZED = 0.2  # probability from which on a view shows the map
SURE = (0.1, 0.5)  # probability by a view alone up to which it does not count, from which fully
MOST_OF_ONE = 0.75  # of a single view: less than `CONFIRMED`
CONFIRMED = 1.25
"""New ground, in views, on which a place must have been shown: no single view confirms, nor further
views of its ground, nor those that fit only because they were searched there."""
MOST_LATELY = 3.0  # largest count of it
UNRECOGNIZED, UNCERTAIN = 0.5, 0.5
"""Factors on the count for new ground that does not show the map, and for every view at which the
position is less certain than `Model.wide_m`."""
LIKELY = 0.5  # confidence that a track keeps
UNCONFIRMED = 0.8  # most that is stated except while tracking
REPORTED, MOST_BELIEVED = 8.0, 24.0
"""New ground, in views, that a reported position is worth against other places, and the most that a
track is worth."""
HALVED_S = 10.0  # without odometry, in which it is halved: a reported velocity is wrong for long
EXACT_M = 7.5  # deviation per axis of a dead reckoning that is as good as tracking
REACHED = 6.0  # squared error over its covariance, exceeded with a probability of 0.05
BLIND = 0.5
"""Factor on the evidence against a followed track of a view that does not show the map, for each
such view before: clouds, water and a covered lens last."""


class State(Enum):
    SEARCHING = "searching"  # no place has been believed
    TRACKING = "tracking"  # believed, and this view shows the map there
    COASTING = "coasting"
    """Believed before; this view does not show the map, the position is dead reckoning."""
    LOST = "lost"
    """Believed before; the position is no longer likely, or that of another place."""

    @property
    def is_followed(self) -> bool:
        return self in (State.TRACKING, State.COASTING)


@dataclass(frozen=True)
class Shown:
    """What views showed at one place.

    `ground`: new ground recognized there lately, in views; `waiting`: new since the last view that
    counted; `now`: probability that the last view shows the map there. `followed`: from a believed
    track or a reported position."""

    ground: float = 0.0
    waiting: float = 0.0
    now: float = 0.0
    followed: bool = False

    @property
    def is_now(self) -> bool:
        return self.now >= RECOGNIZED

    @property
    def is_confirmed(self) -> bool:
        return self.ground >= CONFIRMED

    def confirmed(self) -> "Shown":
        """By other means than views."""
        return replace(self, ground=max(self.ground, CONFIRMED), followed=True)

    def missed(self, new: float) -> "Shown":
        """After a view that does not show the map, `new` of which the last one did not show."""
        ground = self.ground * float(UNRECOGNIZED**new)
        return replace(self, ground=ground, waiting=min(self.waiting + new, 1.0), now=0.0)

    def seen(self, now: float, alone: float, new: float, *, competed: bool) -> "Shown":
        """After a view that shows the map here with probability `now`, by itself `alone`.

        `competed`: with all other places where the aircraft may be; others do not count."""
        if now < RECOGNIZED:
            return replace(self.missed(new), now=now)
        low, high = SURE
        waiting = min(self.waiting + new, 1.0)
        # Only of a followed track all that waits: chance has many views to agree with a new one.
        counted = (waiting if self.followed else new) * min(max((alone - low) / (high - low), 0), 1)
        if not competed or not counted:
            return replace(self, waiting=waiting, now=now)
        ground = min(self.ground + min(counted, MOST_OF_ONE), MOST_LATELY)
        return replace(self, ground=ground, waiting=0.0, now=now)


class Claim(NamedTuple):
    """A place that was shown, dead-reckoned since, and the new ground, in views, that showed it."""

    place: "Hypothesis"
    ground: float


class Trust:
    """The state of a track, the place that is believed, and the one that contradicts it.

    A place to which dead reckoning does not lead is not believed before more new ground showed it
    than the track: a camera that consistently shows another place looks the same. Mutable."""

    def __init__(self) -> None:
        self.state = State.SEARCHING
        self.track: Claim | None = None
        self.rival: Claim | None = None
        self.unseen = 0.0  # new evidence of views in a row that did not show the map

    @property
    def most(self) -> float:
        """Largest probability of the place that may be stated."""
        return 1.0 if self.state is State.TRACKING else UNCONFIRMED

    def reported(self, place: "Hypothesis | None") -> None:
        """A position by other means, None: one that does not contradict other places."""
        self.track = None if place is None else Claim(place, REPORTED)
        self.rival = None

    def moved(self, step: "Callable[[Hypothesis], Hypothesis]", blind_s: float = 0.0) -> "Trust":
        """One dead-reckoned, or to another plane. `blind_s`: time that no odometry covers."""
        track, rival = (
            None if each is None else each._replace(place=step(each.place))
            for each in (self.track, self.rival)
        )
        if track is not None:
            track = track._replace(ground=track.ground * 0.5 ** (blind_s / HALVED_S))
        made = copy(self)
        made.track, made.rival = track, rival
        return made

    def viewed(self, newness: float, *, shown: bool) -> None:
        """After a view; `newness`: share that counts as new evidence."""
        blind = self.state is not State.SEARCHING and not shown
        self.unseen = self.unseen + newness if blind else 0.0

    def judge(self, here: "Hypothesis", confidence: float, new: float, missed: float) -> None:
        """Judge the best place after a view, `new` of which the last one did not show.

        `missed`: what counts against the place that contradicts the track, unless shown here."""
        shown, was_followed = here.shown, self.state.is_followed
        stays = was_followed and shown.followed and confidence >= LIKELY
        is_shown = (stays or confidence >= CONFIDENT) and shown.is_confirmed and shown.is_now
        ground = self._ground_of(here, new) if is_shown else None
        if ground is not None:
            followed = replace(here, shown=replace(shown, followed=True))
            self.track, self.rival = Claim(followed, min(ground, MOST_BELIEVED)), None
            self.state = State.TRACKING
            return
        if not is_shown and self.rival is not None:
            left = self.rival.ground - missed
            self.rival = self.rival._replace(ground=left) if left > 0 else None
        if stays and not is_shown:
            self.state = State.COASTING
        elif self.state is not State.SEARCHING:
            self.state = State.LOST

    def _ground_of(self, here: "Hypothesis", new: float) -> float | None:
        """New ground that showed a place in total; None where it is not believed."""
        if self.track is None:
            return here.shown.ground
        if _is_reached(here, self.track.place):
            return self.track.ground + new
        again = self.rival is not None and _is_reached(here, self.rival.place)
        ground = self.rival.ground + new if self.rival is not None and again else CONFIRMED
        self.rival = Claim(here, ground)
        return ground if ground > self.track.ground else None


def _is_reached(here: "Hypothesis", last: "Hypothesis") -> bool:
    """Whether the aircraft can have come here by dead reckoning."""
    off, spread = (here.mean - last.mean)[POSITION], (last.covariance + here.covariance)[:2, :2]
    return bool(off @ np.linalg.solve(spread, off) < REACHED)
