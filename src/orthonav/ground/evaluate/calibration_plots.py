"""Figures of calibration: reliability diagram, and errors against covariance."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from orthonav.ground.evaluate.calibration import (
    NEES_LEVELS,
    Bin,
    ConfidenceCalibration,
    CovarianceConsistency,
    nees_bound,
)
from orthonav.ground.report.canvas import (
    BACKING,
    GREY,
    OFFSET,
    RIGHT,
    SOFT,
    WRONG,
    Drawing,
    draw_axes,
    draw_figure,
)

if TYPE_CHECKING:
    from matplotlib import figure as mpl
    from matplotlib.axes import Axes

_SIDE: dict[str, Any] = {"fontsize": 9, "color": "#777777", "style": "italic"}
_NEES_AXIS = (0.01, 1e4)  # its edges at the widest; 1 in 200 of consistent fixes lie below


def reliability_picture(calibration: ConfidenceCalibration) -> Drawing:
    """Share of right fixes over confidence per bin, with 95 % intervals; below, fixes per bin."""

    def draw(figure: "mpl.Figure") -> None:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
        above.plot([0, 1], [0, 1], color=GREY, linestyle=(0, (4, 3)), linewidth=1.2)
        above.text(0.03, 0.96, "under-confident", va="top", **_SIDE)
        above.text(0.97, 0.04, "over-confident", ha="right", **_SIDE)
        filled = [b for b in calibration.bins if b.n_fixes]
        if filled:
            _draw_bins(above, filled)
            _draw_verdict(above, calibration)
        else:
            above.text(0.5, 0.5, "no fix states a confidence", ha="center", bbox=BACKING)
        above.set(xlim=(-0.015, 1.015), ylim=(-0.02, 1.04))
        above.set(ylabel="fraction with an error\nwithin the stated radius")
        _draw_counts(below, calibration)
        below.set(xlabel="stated confidence")
        figure.align_ylabels()

    return draw_figure((6.2, 5.0), draw)


def nees_picture(consistency: CovarianceConsistency) -> Drawing:
    """Cumulative share of right fixes over NEES, compared with chi-square (2 dof)."""

    def draw(axes: "Axes") -> None:
        nees = np.clip(consistency.nees, _NEES_AXIS[0], None)  # a log axis has no zero
        high = float(min(max([50.0, *(1.3 * nees[-1:])]), _NEES_AXIS[1]))
        x = np.geomspace(_NEES_AXIS[0], high, 300)
        expected = 100 * -np.expm1(-x / 2)
        label = "chi-square, 2 degrees of freedom"
        axes.plot(x, expected, color=GREY, linestyle=(0, (4, 3)), linewidth=1.6, label=label)
        if nees.size:
            _draw_band(axes, x, expected, nees.size)
            shares = 100 * np.arange(nees.size + 1) / nees.size
            steps = (np.append(_NEES_AXIS[0], nees), shares)
            label = f"correct fixes ({nees.size})"
            axes.step(*steps, where="post", color=RIGHT, linewidth=2, label=label)
            axes.plot([nees[-1], _NEES_AXIS[1]], [100, 100], color=RIGHT, linewidth=2)
            _draw_levels(axes, consistency)
            _draw_summary(axes, consistency)
        else:
            said = "no correct fix has a usable covariance"
            axes.text(0.5, 0.5, said, ha="center", transform=axes.transAxes, bbox=BACKING)
        axes.text(0.02, 0.955, "under-confident", va="top", transform=axes.transAxes, **_SIDE)
        axes.text(0.98, 0.04, "over-confident", ha="right", transform=axes.transAxes, **_SIDE)
        axes.set(xscale="log", xlim=(_NEES_AXIS[0], high), ylim=(0, 104))
        axes.set(xlabel="normalized error squared, eᵀC⁻¹e (no unit)")
        axes.set(ylabel="percentage of correct fixes below it")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("")
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)

    return draw_axes((6.2, 5.0), draw)


def _draw_bins(axes: "Axes", filled: list[Bin]) -> None:
    x = [b.mean_confidence for b in filled]
    y = np.array([b.share_right for b in filled])
    low = y - [b.right_low for b in filled]
    high = [b.right_high for b in filled] - y
    for b in filled:  # the gap that counts in the ECE
        ends = [b.mean_confidence, b.share_right]
        axes.plot([b.mean_confidence] * 2, ends, color=WRONG, linewidth=5, alpha=0.3, zorder=2)
    yerr = np.maximum([low, high], 0.0)  # rounding may leave -1e-17
    axes.errorbar(x, y, yerr, fmt="none", ecolor=RIGHT, elinewidth=1.3, capsize=3, zorder=3)
    axes.plot(x, y, "-", color=RIGHT, linewidth=1.2, alpha=0.8, zorder=3)
    axes.plot(x, y, "o", color=RIGHT, markersize=7, markeredgecolor="white", zorder=4)


def _draw_verdict(axes: "Axes", calibration: ConfidenceCalibration) -> None:
    text = (
        f"ECE {calibration.ece:.3f} · Brier {calibration.brier:.3f}\n"
        f"mean confidence {calibration.mean_confidence:.2f}, "
        f"fraction correct {calibration.share_right:.2f}"
    )
    axes.set_title(text, fontsize=9, color=SOFT, linespacing=1.4)


def _draw_counts(axes: "Axes", calibration: ConfidenceCalibration) -> None:
    counts = [b.n_fixes for b in calibration.bins]
    middles = [(b.lower + b.upper) / 2 for b in calibration.bins]
    axes.bar(middles, counts, width=0.094, color="#9DB9CC")
    for x, count in zip(middles, counts, strict=True):
        axes.annotate(f"{count}", (x, count), (0, 2), **OFFSET, ha="center", color=SOFT)
    axes.set(ylim=(0, 1.45 * max([1, *counts])), ylabel="fixes")
    axes.set_xticks(np.arange(11) / 10)
    axes.yaxis.set_major_locator(_whole_numbers())


def _whole_numbers() -> Any:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(nbins=2, integer=True)


def _draw_band(
    axes: "Axes", x: "np.ndarray[Any, Any]", expected: "np.ndarray[Any, Any]", n: int
) -> None:
    """The 95 % band of samples of `n` (Dvoretzky, Kiefer, Wolfowitz; Massart 1990)."""
    reach = 100 * math.sqrt(math.log(2 / 0.05) / (2 * n))
    low, high = np.clip(expected - reach, 0, 100), np.clip(expected + reach, 0, 100)
    axes.fill_between(x, low, high, color=GREY, alpha=0.18, linewidth=0)


def _draw_levels(axes: "Axes", consistency: CovarianceConsistency) -> None:
    """Bounds as lines, and the shares found inside them as points."""
    for level in NEES_LEVELS:
        bound, found = nees_bound(level), 100 * consistency.within[level]
        axes.plot([bound] * 2, [0, 104], color=GREY, linewidth=0.9, zorder=1.5)
        name = f"{100 * level:g} % bound"
        looks: dict[str, Any] = {"rotation": 90, "color": SOFT, "bbox": BACKING}
        axes.annotate(name, (bound, 0), (-12, 4), **{**OFFSET, "fontsize": 8}, **looks)
        axes.plot(bound, found, "o", color=WRONG, markersize=6, markeredgecolor="white", zorder=5)


def _draw_summary(axes: "Axes", consistency: CovarianceConsistency) -> None:
    levels = " / ".join(f"{100 * level:g}" for level in NEES_LEVELS)
    found = " / ".join(f"{100 * consistency.within[level]:.1f}" for level in NEES_LEVELS)
    text = (
        f"mean {consistency.nees_mean:.3g} (2 expected), "
        f"median {consistency.nees_median:.3g} ({nees_bound(0.5):.2f} expected)\n"
        f"{found} % within the bounds of {levels} %"
    )
    axes.set_title(text, fontsize=9, color=SOFT, linespacing=1.4, pad=24)
