"""Smoothing: the state at each view of a flight, given all views before and after it.

The surviving hypotheses are followed back through their parents, with the fixed-interval smoother
of Rauch, Tung and Striebel (1965). Where a track was born again, smoothing begins again.
"""

from dataclasses import dataclass

import numpy as np

from orthonav.track.hypotheses import Hypothesis
from orthonav.track.mixture import Mixture
from orthonav.track.model import Array


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A smoothed state: `mean` (8,), `covariance` (8, 8), and `belief` in its track."""

    mean: Array
    covariance: Array
    belief: float


class History:
    """The hypotheses after each view, as far as the smoother still needs them. Mutable."""

    def __init__(self) -> None:
        self._views: list[dict[int, Hypothesis]] = []

    def record(self, mixture: Mixture) -> None:
        """Record the hypotheses after a view."""
        self._views.append({each.number: each for each in mixture.hypotheses})
        self._forget()

    def _forget(self) -> None:
        """Drop hypotheses without successors, except the most likely one of each view."""
        for at in range(len(self._views) - 1, 0, -1):
            parents = {each.parent for each in self._views[at].values()}
            view = self._views[at - 1]
            best = max(view.values(), key=lambda each: each.share).number if view else -1
            needed = {number: view[number] for number in view if number in parents | {best}}
            if len(needed) == len(view):
                return
            self._views[at - 1] = needed

    def smoothed(self, last: int | None = None) -> list[Smoothed | None]:
        """Smoothed states of all views, or of the `last` ones; None where none exists even then."""
        out: list[Smoothed | None] = []
        after: Hypothesis | None = None
        later: Smoothed | None = None
        for view in reversed(self._views if last is None else self._views[-last:]):
            before = None if after is None else view.get(after.parent)
            if after is None or before is None or after.expected is None or later is None:
                after = max(view.values(), key=lambda each: each.share) if view else None
                later = (
                    None if after is None else Smoothed(after.mean, after.covariance, after.share)
                )
            else:
                later = _one_back(after, later)
                after = before
            out.append(later)
        return out[::-1]


def _one_back(after: Hypothesis, later: Smoothed) -> Smoothed:
    """One step of the Rauch-Tung-Striebel smoother (AIAA Journal, 1965)."""
    expected = after.expected
    assert expected is not None
    gain = expected.cross @ np.linalg.pinv(expected.covariance)
    mean = expected.mean_before + gain @ (later.mean - expected.mean)
    covariance = expected.covariance_before
    covariance = covariance + gain @ (later.covariance - expected.covariance) @ gain.T
    return Smoothed(mean, np.asarray((covariance + covariance.T) / 2), later.belief)
