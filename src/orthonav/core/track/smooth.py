"""Smoothing: hypotheses followed back through their parents (Rauch, Tung and Striebel 1965); where
a track was born again, smoothing begins again."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from orthonav.core.track.hypothesis import Hypothesis
from orthonav.core.track.mixture import Mixture
from orthonav.core.track.model import STATE, Array
from orthonav.core.track.motion import Expected

SIZES = [STATE, STATE**2] * 3 + [STATE**2]
"""Of a state, its prediction, the state before, and their covariance."""
STARTS = np.cumsum(SIZES)[:-1]
ROWS_OF_BLOCK = 256


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A state (16,), (16, 16), and the `belief` in its track."""

    mean: Array
    covariance: Array
    belief: float


class _Kept(NamedTuple):
    parent: int
    share: float
    row: int
    is_predicted: bool


class _Rows:
    """Rows of numbers in large blocks: single arrays would hold on to four times the memory."""

    def __init__(self) -> None:
        self._blocks: list[Array] = []
        self._free: list[int] = []

    def add(self, parts: Sequence[Array]) -> int:
        if not self._free:
            first = ROWS_OF_BLOCK * len(self._blocks)
            self._blocks.append(np.empty((ROWS_OF_BLOCK, sum(SIZES))))
            self._free = list(range(first + ROWS_OF_BLOCK - 1, first - 1, -1))
        number = self._free.pop()
        made = np.concatenate([part.ravel() for part in parts])
        self._row(number)[: len(made)] = made
        return number

    def remove(self, number: int) -> None:
        self._free.append(number)

    def state(self, number: int) -> tuple[Array, Array]:
        mean, covariance, *_ = np.split(self._row(number), STARTS)
        return mean.copy(), covariance.reshape(STATE, STATE).copy()

    def expected(self, number: int) -> Expected:
        _, _, mean, covariance, mean_before, covariance_before, cross = (
            part if part.size == STATE else part.reshape(STATE, STATE)
            for part in np.split(self._row(number), STARTS)
        )
        return Expected(mean, covariance, mean_before, covariance_before, cross)

    def _row(self, number: int) -> Array:
        block, row = divmod(number, ROWS_OF_BLOCK)
        return np.asarray(self._blocks[block][row])


class History:
    """The hypotheses after each view, as far as the smoother still needs them. Mutable."""

    def __init__(self) -> None:
        self._views: list[dict[int, _Kept]] = []
        self._rows = _Rows()

    def record(self, mixture: Mixture) -> None:
        self._views.append({each.number: self._kept(each) for each in mixture.hypotheses})
        self._forget()

    def _kept(self, each: Hypothesis) -> _Kept:
        parts, expected = [each.mean, each.covariance], each.expected
        if expected is not None:
            parts += [expected.mean, expected.covariance]
            parts += [expected.mean_before, expected.covariance_before, expected.cross]
        return _Kept(each.parent, each.share, self._rows.add(parts), expected is not None)

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
                self._rows.remove(view.pop(number).row)

    def smoothed(self, last: int | None = None) -> list[Smoothed | None]:
        """Of all views, or the `last` ones; None where none exists even then."""
        out: list[Smoothed | None] = []
        after: _Kept | None = None
        later: Smoothed | None = None
        for view in reversed(self._views if last is None else self._views[-last:]):
            before = None if after is None else view.get(after.parent)
            if after is None or before is None or not after.is_predicted or later is None:
                after = view[_likeliest(view)] if view else None
                later = (
                    None if after is None else Smoothed(*self._rows.state(after.row), after.share)
                )
            else:
                later = _one_back(self._rows.expected(after.row), later)
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
