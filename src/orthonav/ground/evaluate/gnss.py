"""GNSS beside the map, where `orthonav fly --gnss` recorded it in the evidence of views."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from orthonav.core.flight.gnss import BIASES, biases_of, fault_of, gnss_of
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import ViewResult
from orthonav.ground.evaluate.figures import FloatArray, frozen, or_none, percentile, runs
from orthonav.ground.evaluate.gaps import seconds_since_first
from orthonav.ground.evaluate.metrics import Comparison
from orthonav.ground.report.canvas import GREY, RIGHT, TRUTH, WRONG, Drawing, draw_figure
from orthonav.ground.report.figures import Figure
from orthonav.ground.report.numbers import measure_text

if TYPE_CHECKING:
    from matplotlib import figure as mpl

_EAST, _NORTH, _PITCH, _ROLL, _LATENCY = BIASES
_LEARNT = {
    "learnt displacement of the map": ((_EAST, 1, "m east"), (_NORTH, 1, "m north")),
    "learnt error of the mount": ((_PITCH, 2, "deg pitch"), (_ROLL, 2, "deg roll")),
    "learnt latency": ((_LATENCY, 0, "ms"),),
}
"""Learnt biases as they are shown: keys, digits and units."""


@dataclass(frozen=True, eq=False)
class GnssMetrics:
    """GNSS and map against ground truth, over the compared views (N,).

    `seconds_s`: time since the first view. `errors_m`: of GNSS. `map_errors_m`: of the fixes.
    `differences_m`: distance between both; NaN where one of them is missing, as above.
    `faults`: reason of the monitor, "" without one.
    `learnt`: biases of GNSS minus map at the last view that has them, each with its standard
    deviation, by their keys in evidence; empty where nothing was learnt.
    """

    seconds_s: FloatArray
    errors_m: FloatArray
    map_errors_m: FloatArray
    differences_m: FloatArray
    faults: tuple[str, ...]
    learnt: Mapping[str, float]

    @property
    def alarms(self) -> tuple[tuple[int, int], ...]:
        """First view of each stretch with a fault, and the first one after it."""
        return tuple(runs(np.array([bool(each) for each in self.faults], dtype=bool)))


def measure_gnss(comparison: Comparison, results: Sequence[ViewResult]) -> GnssMetrics | None:
    """Figures of GNSS; None where no result has a GNSS position."""
    by_frame = {result.frame: result.outcome.evidence for result in results}
    evidence = [by_frame[frame] for frame in comparison.frames]
    places = [gnss_of(each) for each in evidence]
    if not any(places):
        return None
    frame = LocalFrame(comparison.lat_deg, comparison.lon_deg)
    en_m = np.full((len(places), 2), np.nan)
    for i, place in enumerate(places):
        if place is not None:
            en_m[i] = frame.en_from_latlon(*place)
    return GnssMetrics(
        seconds_since_first(comparison.time_ns),
        frozen(np.hypot(*(en_m - comparison.truth_en_m).T)),
        comparison.errors_m,
        frozen(np.hypot(*(en_m - comparison.fix_en_m).T)),
        tuple(fault_of(each) for each in evidence),
        next((found for each in reversed(evidence) if (found := biases_of(each))), {}),
    )


def gnss_rows(found: GnssMetrics) -> tuple[tuple[str, str], ...]:
    """The figures as names and texts."""
    named = [found.faults[first] for first, _ in found.alarms]
    return (
        ("error of GNSS", _spread_text(found.errors_m)),
        ("difference of GNSS and map", _spread_text(found.differences_m)),
        ("GNSS alarms", f"{len(named)}{': ' if named else ''}{', '.join(named)}"),
        *_learnt_rows(found.learnt),
    )


def gnss_to_json(found: GnssMetrics) -> dict[str, object]:
    """The figures as values for strict JSON."""
    plain: dict[str, object] = {}
    for name, values in (("error", found.errors_m), ("difference", found.differences_m)):
        plain |= {
            f"{name}_median_m": or_none(percentile(values, 50)),
            f"{name}_p95_m": or_none(percentile(values, 95)),
            f"{name}_max_m": or_none(percentile(values, 100)),
        }
    plain["alarms"] = [
        {
            "fault": found.faults[first],
            "first_s": or_none(float(found.seconds_s[first])),
            "views": end - first,
        }
        for first, end in found.alarms
    ]
    plain["learnt"] = dict(found.learnt)
    return plain


def _learnt_rows(learnt: Mapping[str, float]) -> Iterator[tuple[str, str]]:
    """Names and texts of the learnt biases."""
    if not learnt:
        return
    for name, pairs in _LEARNT.items():
        texts = [
            f"{learnt[key]:.{digits}f} +- {learnt[std_key]:.{digits}f} {unit}"
            for (key, std_key), digits, unit in pairs
        ]
        yield name, ", ".join(texts)


def gnss_figure(found: GnssMetrics) -> Figure:
    """Errors of both and their difference over time; alarms are shaded."""
    return Figure(
        "gnss",
        f"GNSS: {_spread_text(found.errors_m)}; alarms: {len(found.alarms)}",
        "Errors of GNSS and of the map, and the distance between them; shaded while the GNSS "
        "monitor reports a fault.",
        _picture(found),
    )


def _picture(found: GnssMetrics) -> Drawing:
    def draw(figure: "mpl.Figure") -> None:
        above, below = figure.subplots(2, 1, sharex=True)
        known = bool(np.isfinite(found.seconds_s).all())
        x = found.seconds_s if known else np.arange(len(found.errors_m), dtype=np.float64)
        for values, colour, label in (
            (found.errors_m, WRONG, "GNSS"),
            (found.map_errors_m, RIGHT, "map"),
        ):
            above.plot(x, values, ".-", color=colour, linewidth=1.0, markersize=3, label=label)
        below.plot(x, found.differences_m, ".-", color=TRUTH, linewidth=1.0, markersize=3)
        for axes in (above, below):
            for first, end in found.alarms:
                axes.axvspan(x[first], x[min(end, len(x) - 1)], color=GREY, alpha=0.25, linewidth=0)
            axes.set_ylim(bottom=0)
        above.legend(ncols=2, loc="upper left", frameon=False)
        above.set(ylabel="error (m)")
        below.set(ylabel="difference (m)", xlabel="time (s)" if known else "view")
        figure.align_ylabels()

    return draw_figure((6.2, 4.0), draw)


def _spread_text(values: FloatArray) -> str:
    median, p95, most = (measure_text(percentile(values, q), " m") for q in (50, 95, 100))
    return f"median {median}, 95 % {p95}, largest {most}"
