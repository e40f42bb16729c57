"""Smoothing: hypotheses followed back through their parents (Rauch, Tung and Striebel 1965); where
a track was born again, smoothing begins again."""

from dataclasses import dataclass, replace

import numpy as np

from orthonav.core.track.filter import Array, Expected
from orthonav.core.track.hypothesis import Hypothesis
from orthonav.core.track.mixture import Mixture


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A state (16,), (16, 16), and the `belief` in its track."""

    mean: Array
    covariance: Array
    belief: float


class History:
    """The hypotheses after each view, as far as the smoother still needs them. Mutable."""

    def __init__(self) -> None:
        self._views: list[dict[int, Hypothesis]] = []
        self._most: list[float] = []  # largest belief that each view allows

    def record(self, mixture: Mixture, number: int) -> None:
        """The view with this number, from 0, in place of what an error left of it."""
        del self._views[number:], self._most[number:]
        self._views.append({each.number: each for each in mixture.hypotheses})
        self._most.append(mixture.trust.most)
        self._forget()

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

    def smoothed(self) -> list[Smoothed | None]:
        """Of all views; None where none exists even then."""
        out: list[Smoothed | None] = []
        after: Hypothesis | None = None
        later: Smoothed | None = None
        for view, most in reversed(list(zip(self._views, self._most, strict=True))):
            before = None if after is None else view.get(after.parent)
            if after is None or before is None or after.expected is None or later is None:
                after = view[_likeliest(view)] if view else None
                later = None
                if after is not None:
                    later = Smoothed(after.mean, after.covariance, min(after.share, most))
            else:
                belief = max(later.belief, min(before.share, most))
                later = replace(_one_back(after.expected, later), belief=belief)
                after = before
            out.append(later)
        return out[::-1]


def _likeliest(view: dict[int, Hypothesis]) -> int:
    return max(view, key=lambda number: view[number].share)


def _one_back(expected: Expected, later: Smoothed) -> Smoothed:
    gain = expected.cross @ np.linalg.pinv(expected.covariance)
    mean = expected.mean_before + gain @ (later.mean - expected.mean)
    covariance = expected.covariance_before
    covariance = covariance + gain @ (later.covariance - expected.covariance) @ gain.T
    return Smoothed(mean, np.asarray((covariance + covariance.T) / 2), later.belief)
