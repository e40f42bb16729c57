"""Smoothing: hypotheses followed back through their parents (Rauch, Tung and Striebel 1965); where
a track was born again, smoothing begins again."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from orthonav.core.track.hypothesis import Hypothesis
from orthonav.core.track.mixture import Mixture
from orthonav.core.track.model import STATE, Array
from orthonav.core.track.motion import Expected

SIZES = [STATE, STATE**2] * 3 + [STATE**2]
"""Of a state, its prediction, the state before, and their covariance."""
STARTS = np.cumsum(SIZES)[:-1]


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A state (16,), (16, 16), and the `belief` in its track."""

    mean: Array
    covariance: Array
    belief: float


class _Kept(NamedTuple):
    """`numbers`: state, prediction, state before and their covariance, in one array: many small
    ones would hold on to more memory."""

    parent: int
    share: float
    numbers: Array
    is_predicted: bool

    def state(self) -> tuple[Array, Array]:
        mean, covariance = np.split(self.numbers, STARTS[:2])[:2]
        return mean, covariance.reshape(STATE, STATE)

    def expected(self) -> Expected:
        parts = np.split(self.numbers, STARTS)[2:]
        return Expected(
            *(each if each.size == STATE else each.reshape(STATE, STATE) for each in parts)
        )


class History:
    """The hypotheses after each view, as far as the smoother still needs them. Mutable."""

    def __init__(self) -> None:
        self._views: list[dict[int, _Kept]] = []
        self._most: list[float] = []  # largest belief that each view allows

    def record(self, mixture: Mixture, number: int) -> None:
        """The view with this number, from 0, in place of what an error left of it."""
        del self._views[number:], self._most[number:]
        self._views.append({each.number: self._kept(each) for each in mixture.hypotheses})
        self._most.append(mixture.trust.most)
        self._forget()

    @staticmethod
    def _kept(each: Hypothesis) -> _Kept:
        parts, expected = [each.mean, each.covariance], each.expected
        if expected is not None:
            parts += [expected.mean, expected.covariance]
            parts += [expected.mean_before, expected.covariance_before, expected.cross]
        numbers = np.concatenate([part.ravel() for part in parts])
        return _Kept(each.parent, each.share, numbers, expected is not None)

    def _forget(self) -> None:
        """Without successors, except the most likely one of each view."""
        for at in range(len(self._views) - 1, 0, -1):
            parents = {each.parent for each in self._views[at].values()}
            view = self._views[at - 1]
            needed = parents | ({_likeliest(view)} if view else set())
            left = [number for number in view if number not in needed]
            if not left:
                return
            for number in left:
                del view[number]

    def smoothed(self, last: int | None = None) -> list[Smoothed | None]:
        """Of all views, or the `last` ones; None where none exists even then."""
        out: list[Smoothed | None] = []
        after: _Kept | None = None
        later: Smoothed | None = None
        first = 0 if last is None else -last
        views = zip(self._views[first:], self._most[first:], strict=True)
        for view, most in reversed(list(views)):
            before = None if after is None else view.get(after.parent)
            if after is None or before is None or not after.is_predicted or later is None:
                after = view[_likeliest(view)] if view else None
                share = 0.0 if after is None else min(after.share, most)
                later = None if after is None else Smoothed(*after.state(), share)
            else:
                belief = max(later.belief, min(before.share, most))
                later = replace(_one_back(after.expected(), later), belief=belief)
                after = before
            out.append(later)
        return out[::-1]


def _likeliest(view: dict[int, _Kept]) -> int:
    return max(view, key=lambda number: view[number].share)


def _one_back(expected: Expected, later: Smoothed) -> Smoothed:
    gain = expected.cross @ np.linalg.pinv(expected.covariance)
    mean = expected.mean_before + gain @ (later.mean - expected.mean)
    covariance = expected.covariance_before
    covariance = covariance + gain @ (later.covariance - expected.covariance) @ gain.T
    return Smoothed(mean, np.asarray((covariance + covariance.T) / 2), later.belief)
