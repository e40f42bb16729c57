"""Other configurations, tried on views that are not confident, to find the wrong value.

A wrong heading, height or focal length lowers the confidence of every view, and so does a map of
another area. A few of the views of low confidence are localized again with one value changed at a
time. The change that makes them confident names the value to check.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from orthonav.core.errors import FlightError
from orthonav.core.flight.recording import RecordedView
from orthonav.core.geo.camera import Camera
from orthonav.core.localize.localizer import Localizer
from orthonav.core.localize.view import LIMITS
from orthonav.core.records import Fix, NoFix, Telemetry, View, ViewResult

FEW = 0.5
"""Below this fraction of confident views the configuration may be wrong; a change that reaches it
explains it."""
SAMPLE = 8  # at most so many views are localized again


@dataclass(frozen=True)
class Setup:
    """One change of the configuration: `factor` is that of the height, 1 where it stays."""

    name: str
    any_heading: bool = False
    factor: float = 1.0
    without_prior: bool = False

    def changed(self, view: View) -> View:
        if self.factor == 1.0:
            return view
        agl_m = self.factor * view.telemetry.agl_m
        telemetry = replace(view.telemetry, agl_m=agl_m, agl_std_m=LIMITS.max_agl_std * agl_m)
        return replace(view, telemetry=telemetry)


_SETUPS = (
    Setup("as reported"),
    Setup("any heading", any_heading=True),
    Setup("twice the height", factor=2.0),
    Setup("half the height", factor=0.5),
    Setup("four times the height", factor=4.0),
    Setup("a quarter of the height", factor=0.25),
    Setup("without the prior", without_prior=True),
)
"""In the order of the trials. What is tried for a wrong heading is the same where it is unknown."""


@dataclass(frozen=True)
class Tried:
    """What a change did: `views` were localized again, `confident` of them are.

    `heading_off_deg`, `height_ratio`: mean of the heading found less the reported one, and median
    of the height found over the reported one, of the confident views; NaN without any.
    """

    setup: Setup
    views: int
    confident: int
    heading_off_deg: float
    height_ratio: float

    @property
    def explains(self) -> bool:
        return self.confident >= FEW * self.views and self.confident > 0


class LowConfidenceViews:
    """Some of the views of a flight that are not confident, spread evenly over them."""

    def __init__(self, camera: Camera, corrected: Callable[[Telemetry], Telemetry]) -> None:
        """`corrected`: what is known to be wrong with the telemetry is corrected by it."""
        self._camera, self._corrected = camera, corrected
        self._count, self._every = 0, 1
        self.views: list[View] = []

    def take(self, view: RecordedView, result: ViewResult) -> None:
        """Keep a view if the confidence of its result is low, and its turn."""
        outcome = result.outcome
        placeable = ("too_small", "too_coarse", "no_match", "outside_map", "low_confidence")
        if result.is_confident or (isinstance(outcome, NoFix) and outcome.reason not in placeable):
            return
        self._count += 1
        if (self._count - 1) % self._every:
            return
        telemetry = self._corrected(view.telemetry)
        if math.isfinite(telemetry.agl_m):
            with suppress(FlightError):  # a track has a position without the image
                self.views.append(View(view.grey(), self._camera, telemetry))
        if len(self.views) > SAMPLE:
            self.views = self.views[::2]
            self._every *= 2


def try_setups(
    localizer: Localizer,
    views: Sequence[View],
    accepts: Callable[[Fix | NoFix], bool],
    *,
    use_prior: bool,
    heading_known: bool,
    tracked: bool = False,
    stop: Callable[[], bool] = lambda: False,
) -> list[Tried]:
    """What each change of the configuration does to the views, in the order of the trials.

    `stop` is asked before each view and ends the search: the last change may then have been tried
    on fewer views, and may be missing. `accepts` says whether an outcome is confident. The first
    change that explains it ends the search; each is tried on at most `SAMPLE` views. `tracked`: the
    views were judged as a track, so they are first placed one by one as reported.
    """
    with_prior = use_prior and any(view.telemetry.prior for view in views)
    found: list[Tried] = []
    for setup in _SETUPS if tracked else _SETUPS[1:]:
        if (setup.any_heading and not heading_known) or (setup.without_prior and not with_prior):
            continue
        fixes: list[tuple[View, Fix]] = []
        placed = 0
        for view in views:
            if stop() or (placed == 4 and not fixes):
                break
            placed += 1
            outcome = localizer.locate(
                setup.changed(view),
                prior=view.telemetry.prior if use_prior and not setup.without_prior else None,
                heading_known=heading_known and not setup.any_heading,
            )
            if isinstance(outcome, Fix) and accepts(outcome):
                fixes.append((view, outcome))
        if placed:
            found.append(_tried(setup, placed if stop() else len(views), fixes))
        if stop() or found[-1].explains:
            break
    return found


def _tried(setup: Setup, views: int, fixes: list[tuple[View, Fix]]) -> Tried:
    if not fixes:
        return Tried(setup, views, 0, math.nan, math.nan)
    off_rad = [math.radians(fix.heading_deg - view.telemetry.yaw_deg) for view, fix in fixes]
    ratios = [fix.agl_m / view.telemetry.agl_m for view, fix in fixes]
    mean = math.degrees(math.atan2(np.sin(off_rad).mean(), np.cos(off_rad).mean()))
    return Tried(setup, views, len(fixes), mean, float(np.median(ratios)))


@dataclass(frozen=True)
class Counts:
    views: int
    confident: int
    low: int
    none: int
    reasons: tuple[tuple[str, int], ...] = ()
    """Reasons of views without a position and their numbers, the most frequent first."""

    @classmethod
    def of(cls, results: Sequence[ViewResult]) -> "Counts":
        none = [each.outcome.reason for each in results if isinstance(each.outcome, NoFix)]
        confident = sum(result.is_confident for result in results)
        low, reasons = len(results) - len(none) - confident, Counter(none).most_common()
        return cls(len(results), confident, low, len(none), tuple(reasons))

    @property
    def few(self) -> bool:
        return self.confident < FEW * self.views


def setup_text(tried: Sequence[Tried], *, on_map: bool) -> list[str]:
    """Sentences: which change makes the views confident and what to check, and what else was tried.

    `on_map`: the flight recorded positions, and some of them lie on the map.
    """
    *failed, last = tried
    if not last.explains:
        names = ", ".join(each.setup.name for each in tried)
        most = max(each.confident for each in tried)
        where = (
            "the recorded positions lie on the map, so check the camera, and whether the ground "
            "changed or has no structure"
            if on_map
            else "no position was recorded, so check first that the map shows the area, then the "
            "camera and the ground"
        )
        tested = f"{names}: at most {most} of {last.views} views of low confidence become confident"
        return [f"no other configuration explains it ({tested}); {where}"]
    of = f"{last.confident} of {last.views} views of low confidence become confident"
    also = ", ".join(f"{each.setup.name} ({each.confident} of {each.views})" for each in failed)
    return [f"{of} {_cause(last)}", *([f"also tried: {also}"] if failed else [])]


def _cause(last: Tried) -> str:
    off, ratio = last.heading_off_deg, last.height_ratio
    if last.setup.without_prior:
        return "without the prior; check the prior positions"
    if last.setup.any_heading:
        apart = "" if math.isnan(off) else f", {off:+.0f} deg from the reported one"
        return f"with any heading{apart}; check the heading column and the mounting of the camera"
    if last.setup.factor == 1.0:
        return "one by one: the configuration is right, but the views do not form a track"
    return (
        f"at {ratio:.2f} times the reported height (or {1 / ratio:.2f} times the focal length); "
        "check the height column (above ground?) and the camera"
    )
