"""Drawings by matplotlib as PNG and SVG, in one style.

The canvases are used without pyplot: no global state changes and no display is needed. Colours are
those of Okabe and Ito (https://jfly.uni-koeln.de/color/), safe for colour-blind readers.
"""

import io
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
LOW_CONFIDENCE = "#E69F00"
"""Of best guesses, as confident fixes have the colour `RIGHT`."""
DPI = 220
"""Resolution of the PNG: twice that of a screen, and enough for a paper."""
MOST_POINTS = 20_000
"""Lines of more points are rasterized in the SVG, which would be too large to open."""
OFFSET: dict[str, Any] = {"textcoords": "offset points", "fontsize": 9}
"""Arguments of an annotation whose position is an offset in points."""
BACKING: dict[str, Any] = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.5}
"""Box (`bbox`) that keeps text readable on any background."""
_STYLE: dict[Any, Any] = {
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
_NOT_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_NO_METADATA = {"Date": None, "Creator": None}


@dataclass(frozen=True)
class Drawing:
    """One drawing as PNG and SVG; the same drawing gives the same bytes.

    `png`: image of `DPI` with a palette.
    `svg`: document with text as text.
    `size_in`: width and height in inches.
    """

    png: bytes
    svg: str
    size_in: tuple[float, float]


def draw_axes(size_in: tuple[float, float], draw: "Callable[[Axes], None]") -> Drawing:
    """A drawing of `size_in` inches by a function of one pair of axes; see `draw_figure`."""
    return draw_figure(size_in, lambda figure: draw(figure.add_subplot()))


def draw_figure(size_in: tuple[float, float], draw: "Callable[[Figure], None]") -> Drawing:
    """A drawing of `size_in` inches by a function of a matplotlib figure.

    Raises `MissingExtraError` without matplotlib.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.backends.backend_svg import FigureCanvasSVG
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_extra("drawing figures", "report", "matplotlib", error) from error
    svg = io.StringIO()
    with _own_style():
        figure = Figure(figsize=size_in, dpi=DPI, layout="constrained")
        canvas: Any = FigureCanvasAgg(figure)
        draw(figure)
        canvas.draw()
        png = _png(np.asarray(canvas.buffer_rgba()))
        figure.set_layout_engine("none")  # PNG and SVG share one layout
        _limit_points(figure)
        # As `savefig`, which draws once more before, for a layout.
        page: Any = FigureCanvasSVG(figure)
        page.print_svg(svg, metadata=_NO_METADATA)
    return Drawing(png, _NOT_XML.sub("\ufffd", svg.getvalue()), size_in)


def _png(rgba: NDArray[np.uint8]) -> bytes:
    """An opaque image (H, W, 4) as PNG with a palette."""
    from PIL import Image

    out = io.BytesIO()
    image = Image.fromarray(rgba).convert("RGB").quantize(colors=256)
    image.save(out, format="PNG", compress_level=6, dpi=(DPI, DPI))
    return out.getvalue()


def _limit_points(figure: "Figure") -> None:
    """Rasterize lines of many points."""
    for line in (line for axes in figure.axes for line in axes.lines):
        if np.size(line.get_xdata()) > MOST_POINTS:
            line.set_rasterized(True)


@contextmanager
def _own_style() -> Iterator[None]:
    """matplotlib's defaults and our style, whatever the settings of the user."""
    import matplotlib

    with matplotlib.rc_context(), warnings.catch_warnings():
        # Characters that the font of the PNG lacks are shown as boxes.
        warnings.filterwarnings("ignore", "Glyph .* missing from")
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        yield
