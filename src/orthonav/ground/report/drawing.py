"""Drawings by matplotlib as PNG and SVG, in one style.

The canvases are used without pyplot: no global state changes and no display is needed. Colours are
those of Okabe and Ito (https://jfly.uni-koeln.de/color/), safe for colour-blind readers.
"""

import io
import math
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.extras import missing_extra

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RIGHT, WRONG, TRUTH, GREY, INK = "#0072B2", "#D55E00", "#1A1A1A", "#8C8C8C", "#222222"
SOFT = "#555555"
LOW_CONFIDENCE = "#E69F00"  # of best guesses, as confident fixes have the colour `RIGHT`
DPI = 220
"""Resolution of the PNG: twice that of a screen, and enough for a paper."""
OFFSET: dict[str, Any] = {"textcoords": "offset points", "fontsize": 9}
BACKING: dict[str, Any] = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.5}
"""Box (`bbox`) that keeps text readable on any background."""
LEGEND_ABOVE: dict[str, Any] = {
    "loc": "lower center",
    "bbox_to_anchor": (0.5, 1.0),
    "frameon": False,
}
STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.8,
    "text.color": INK,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "legend.frameon": True,
    "legend.framealpha": 0.9,
    "legend.edgecolor": "#DDDDDD",
    "legend.fontsize": 9,
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "orthonav",  # names inside the file are the same every time
}
NOT_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True)
class Drawing:
    """One drawing as PNG and SVG; the same drawing gives the same bytes."""

    png: bytes
    svg: str
    size_in: tuple[float, float]


def draw_axes(size_in: tuple[float, float], draw: "Callable[[Axes], None]") -> Drawing:
    """A drawing of `size_in` inches by a function of one pair of axes; see `draw_figure`."""
    return draw_figure(size_in, lambda figure: draw(figure.add_subplot()))


def draw_figure(size_in: tuple[float, float], draw: "Callable[[Figure], None]") -> Drawing:
    """A drawing of `size_in` inches; raises `MissingExtraError` without matplotlib."""
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_extra("drawing figures", "report", "matplotlib", error) from error
    png, svg = io.BytesIO(), io.StringIO()
    with matplotlib.rc_context(), warnings.catch_warnings():
        # Characters that the font of the PNG lacks are shown as boxes.
        warnings.filterwarnings("ignore", "Glyph .* missing from")
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)
        figure = Figure(figsize=size_in, dpi=DPI, layout="constrained")
        draw(figure)
        figure.savefig(png, format="png")
        figure.set_layout_engine("none")  # PNG and SVG share one layout
        for line in (line for axes in figure.axes for line in axes.lines):
            if np.size(line.get_xdata()) > 5_000:  # as vectors too large to open
                line.set_rasterized(True)
        figure.savefig(svg, format="svg", metadata={"Date": None, "Creator": None})
    return Drawing(png.getvalue(), NOT_XML.sub("\ufffd", svg.getvalue()), size_in)


@dataclass(frozen=True, eq=False)
class Background:
    """A grey image (rows, columns) behind a map, north up; `box`: west, south, east, north."""

    grey: NDArray[np.uint8]
    box: tuple[float, float, float, float]


def draw_map(axes: "Axes", box: tuple[float, ...], background: Background | None = None) -> None:
    """The base of a map; `box` is the visible part: west, east, south, north in metres."""
    if background is not None:  # pale, in few grey levels that keep files small
        pale = 0.45 + 0.55 * np.round(background.grey / 17) / 15
        looks: dict[str, Any] = {"cmap": "gray", "vmin": 0, "vmax": 1, "interpolation": "none"}
        west, south, east, north = background.box
        axes.imshow(pale, extent=(west, east, south, north), **looks)
        axes.grid(visible=False)
    axes.set(xlim=box[:2], ylim=box[2:], aspect="equal")
    axes.set(xlabel="east (m)", ylabel="north (m)")
    draw_scale_bar(axes, box)
    draw_north(axes)


def map_size_in(box: tuple[float, ...], longest_in: float) -> tuple[float, float]:
    """Width and height in inches of a drawing of `box`, an inch for the axes included."""
    width_m, height_m = box[1] - box[0], box[3] - box[2]
    scale = longest_in / max(width_m, height_m)
    return max(scale * width_m, 3.0) + 1.0, max(scale * height_m, 3.0) + 1.0


def draw_scale_bar(axes: "Axes", box: tuple[float, ...]) -> None:
    width_m, height_m = box[1] - box[0], box[3] - box[2]
    length_m = _round_length(0.25 * min(width_m, height_m))
    x, y = box[0] + 0.04 * width_m, box[2] + 0.04 * height_m
    for width, colour in ((6, "white"), (3, INK)):
        axes.plot([x, x + length_m], [y, y], color=colour, linewidth=width, zorder=8)
    text = f"{length_m / 1000:g} km" if length_m >= 1000 else f"{length_m:g} m"
    axes.annotate(
        text, (x + length_m / 2, y), (0, 6), **OFFSET, ha="center", zorder=8, bbox=BACKING
    )


def draw_north(axes: "Axes") -> None:
    axes.annotate(
        "N",
        xy=(0.965, 0.975),
        xytext=(0.965, 0.89),
        xycoords="axes fraction",
        ha="center",
        weight="bold",
        zorder=8,
        arrowprops={"arrowstyle": "-|>", "color": INK, "linewidth": 1.6, "shrinkA": 1},
        bbox=BACKING,
    )


def _round_length(length_m: float) -> float:
    power = 10.0 ** math.floor(math.log10(length_m))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= length_m * (1 + 1e-9))
