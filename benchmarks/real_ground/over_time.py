"""Errors of a track and of the single views of the same flight over time, as pictures."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.real_ground.pairs import Pair
from benchmarks.real_ground.score import RISK, Placed
from benchmarks.record import say
from orthonav.ground.report.drawing import (
    GREY,
    LEGEND_ABOVE,
    LOW_CONFIDENCE,
    RIGHT,
    WRONG,
    Drawing,
    draw_axes,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE_IN = 10.0, 4.4
MIN_M = 0.1
"""Smaller errors are drawn here: the axis is logarithmic."""
SINGLE, TRACK = "single view", "track"
COASTING = "coasting"
MARKS = {
    SINGLE: ("o", WRONG),
    f"{SINGLE}, not confident": ("x", WRONG),
    f"{TRACK}, {COASTING}": ("s", RIGHT),
    f"{TRACK}, not confident": ("^", LOW_CONFIDENCE),
}
"""Of fixes beside the line of the track."""


def write(pairs: dict[str, Pair], work: Path) -> None:
    """A picture of each pair into the folder `over_time`."""
    out = work / "over_time"
    out.mkdir(exist_ok=True)
    for name, pair in pairs.items():
        path = out / f"{name.replace(' ', '_').replace(',', '')}.png"
        path.write_bytes(drawing(name, pair).png)
        say(f"errors over time: {path}")


def drawing(name: str, pair: Pair) -> Drawing:
    """Errors of both rows; of the track the stated deviation, of the distance, and the protection
    level, which has gaps where there is none."""
    fixes, track = pair.single + pair.track, pair.track
    begin_s = min((each.time_s for each in fixes), default=0.0)

    def draw(axes: "Axes") -> None:
        def plot(shown: list[Placed], values_m: list[float], *mark: str, **looks: Any) -> None:
            axes.plot([each.time_s - begin_s for each in shown], values_m, *mark, **looks)

        dots: dict[str, Any] = {"marker": ".", "markersize": 4}
        stated, level = f"stated deviation of the {TRACK}", f"its protection level at {RISK:g}"
        std_m = [math.sqrt(2 * each.variance_m2) for each in track]
        plot(track, std_m, color=RIGHT, linestyle="--", linewidth=1.0, label=stated)
        plot(track, [each.level_m for each in track], color=GREY, label=level, **dots)
        plot(track, _errors_m(track), color=RIGHT, label=TRACK, **dots)
        for label, (mark, colour) in MARKS.items():
            shown = [each for each in fixes if _label(each) == label]
            plot(shown, _errors_m(shown), mark, color=colour, markersize=4.5, label=label)
        axes.set(yscale="log", xlabel="time since the first view (s)", ylabel="error (m)")
        axes.set_ylim(bottom=MIN_M)
        axes.set_xlim(left=0)
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_title(name, pad=42)
        axes.legend(ncols=4, **LEGEND_ABOVE)

    return draw_axes(SIZE_IN, draw)


def _label(fix: Placed) -> str:
    row = SINGLE if fix.state is None else TRACK
    if fix.confident:
        return row
    return f"{row}, {COASTING if fix.state == COASTING else 'not confident'}"


def _errors_m(fixes: list[Placed]) -> list[float]:
    return [max(each.error_m, MIN_M) for each in fixes]
