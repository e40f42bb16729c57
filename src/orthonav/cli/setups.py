"""What to check where few views of a run are confident."""

import argparse
import math
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from orthonav.cli.build import reporter
from orthonav.cli.source import FAR_M, far_from_map, far_text

if TYPE_CHECKING:
    from orthonav.core.flight.heights import FlownHeights
    from orthonav.core.flight.mount import Mount
    from orthonav.core.localize import Localizer
    from orthonav.core.localize.confidence import Acceptance
    from orthonav.core.records import Telemetry, ViewResult
    from orthonav.ground.recordings import Recording, SourceView
    from orthonav.ground.recordings.setups import Tried

BUDGET_S = 15.0
"""After so long no further view is localized: the search for the cause takes at most 20 s."""


_SILENT = (
    "no fix states the criterion {criterion}, so none can be confident; build the map from a "
    "larger or more varied area, or give --accept peak_ratio:1.3"
)


class SetupAdvice:
    """Views of low confidence of a run, from which its summary advises what to check."""

    def __init__(
        self,
        options: argparse.Namespace,
        flight: "Recording",
        localizer: "Localizer",
        mount: "Mount | None",
        heights: "FlownHeights | None",
    ) -> None:
        from orthonav.ground.recordings.setups import LowConfidenceViews

        self._options, self._flight, self._localizer = options, flight, localizer

        def corrected(telemetry: "Telemetry") -> "Telemetry":
            made = telemetry if heights is None else heights.corrected(telemetry)
            return mount.corrected(made) if mount else made

        self._low = LowConfidenceViews(flight.camera, corrected)
        self._nearest: tuple[float, str] | None = None
        self._yaw_deg: list[float] = []

    def watching(self) -> "Iterator[SourceView]":
        for view in self._low.watching(self._flight.views):
            found = far_from_map(view, self._localizer)
            if found is not None and (self._nearest is None or found < self._nearest):
                self._nearest = found
            self._yaw_deg.append(view.telemetry.yaw_deg)
            yield view

    def take(self, result: "ViewResult") -> None:
        self._low.take(result)

    def advice(
        self, results: "Sequence[ViewResult]", accept: "Acceptance"
    ) -> "tuple[list[str], list[dict[str, Any]]]":
        """Sentences on what to check, and the configurations that were tried as JSON values.

        Both are empty where enough views are confident.
        """
        from orthonav.core.geo.headings import RADIANS, seem_radians
        from orthonav.ground.recordings.setups import Counts, setup_text

        options, counts = self._options, Counts.of(results)
        known = options.heading == "known"
        lines = [RADIANS] if known and seem_radians(self._yaw_deg) else []
        if not counts.few:
            return lines, []
        if self._nearest is not None and self._nearest[0] > FAR_M:
            return [*lines, far_text("the recorded positions are", *self._nearest)], []
        if counts.low and not any(_states(result, accept) for result in results):
            return [*lines, _SILENT.format(criterion=accept.criterion)], []
        if not self._low.views or not options.diagnosis:
            return lines, []
        try:
            tried, ended = self._tried(accept)
        except KeyboardInterrupt:  # skips the search; the results are written
            return [*lines, "the search for another configuration was interrupted"], []
        if ended:
            lines.append(f"the search for another configuration was ended after {BUDGET_S:.0f} s")
        if tried:
            lines += setup_text(tried, on_map=self._nearest is not None)
        return lines, [
            {"setup": each.setup.name, "views": each.views, "confident": each.confident}
            for each in tried
        ]

    def _tried(self, accept: "Acceptance") -> "tuple[list[Tried], bool]":
        """The configurations that were tried, and whether the time for it ran out."""
        from orthonav.ground.recordings.setups import try_setups

        options, end_s = self._options, time.monotonic() + BUDGET_S
        reporter(options)(
            "few views are confident: trying other configurations on some of them for up to "
            f"{BUDGET_S:.0f} s (Ctrl-C or --no-diagnosis skips this)"
        )
        tried = try_setups(
            self._localizer,
            self._low.views,
            accept.accepts,
            use_prior=options.prior == "telemetry",
            heading_known=options.heading == "known",
            stop=lambda: time.monotonic() > end_s,
        )
        return tried, time.monotonic() > end_s


def _states(result: "ViewResult", accept: "Acceptance") -> bool:
    """Whether the number that the criterion compares is known."""
    from dataclasses import replace

    return replace(accept, threshold=-math.inf).accepts(result.outcome)
