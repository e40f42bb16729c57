"""Smoothing: what a whole flight says of each of its views.

The hypotheses that were right in the end are followed back to where they came from, and every view
learns from those after it (Rauch, Tung and Striebel 1965). Where a track began anew, so does this.
"""

from dataclasses import dataclass

import numpy as np

from orthonav.track.hypotheses import Hypothesis
from orthonav.track.mixture import Mixture
from orthonav.track.model import Array


@dataclass(frozen=True, eq=False)
class Smoothed:
    """Mean (8,) and covariance (8, 8) at one view, and the belief in the track it belongs to."""

    mean: Array
    covariance: Array
    belief: float


class History:
    """What a mixture believed at each view, as far as it still matters. Mutable."""

    def __init__(self) -> None:
        self._views: list[dict[int, Hypothesis]] = []

    def record(self, mixture: Mixture) -> None:
        """Take in the belief after a view."""
        self._views.append({each.number: each for each in mixture.hypotheses})
        self._forget()

    def _forget(self) -> None:
        """Drop what nothing came from, but for the likeliest of each view."""
        for at in range(len(self._views) - 1, 0, -1):
            parents = {each.parent for each in self._views[at].values()}
            view = self._views[at - 1]
            best = max(view.values(), key=lambda each: each.share).number if view else -1
            kept = {number: view[number] for number in view if number in parents | {best}}
            if len(kept) == len(view):
                return
            self._views[at - 1] = kept

    def smoothed(self, last: int | None = None) -> list[Smoothed | None]:
        """One for each view, or for each of the `last` ones; None where nothing was known of it
        even afterwards."""
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
    """The view before, with what is known of the one after it."""
    expected = after.expected
    assert expected is not None
    gain = expected.cross @ np.linalg.pinv(expected.covariance)
    mean = expected.mean_before + gain @ (later.mean - expected.mean)
    covariance = expected.covariance_before
    covariance = covariance + gain @ (later.covariance - expected.covariance) @ gain.T
    return Smoothed(mean, np.asarray((covariance + covariance.T) / 2), later.belief)
