"""What all pictures share: colours, style, and the way from a drawing to PNG bytes.

Drawn on matplotlib's Agg canvas without pyplot, so nothing global is kept and no display needed.
Colours are those of Okabe and Ito, told apart by everyone.
"""

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from orthonav.errors import MissingExtraError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patheffects import AbstractPathEffect

RIGHT, WRONG, TRUTH, GREY, INK = "#0072B2", "#D55E00", "#1A1A1A", "#8C8C8C", "#222222"
SOFT = "#555555"
DPI = 110
OFFSET: dict[str, Any] = {"textcoords": "offset points", "fontsize": 9}
"""Of a note beside a point: its place is in points from there."""
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
}


def png(size_in: tuple[float, float], draw: "Callable[[Axes], None]") -> bytes:
    """What `draw` puts on one pair of axes, as PNG with a palette; `size_in` in inches."""
    return figure_png(size_in, lambda figure: draw(figure.add_subplot()))


def figure_png(size_in: tuple[float, float], draw: "Callable[[Figure], None]") -> bytes:
    """What `draw` puts on a figure of `size_in` inches, as PNG with a palette.

    Raises `MissingExtraError` without matplotlib.
    """
    try:
        from matplotlib.figure import Figure
        from PIL import Image
    except ImportError as error:
        raise MissingExtraError(
            "pictures need matplotlib, which is not installed: pip install 'orthonav[report]'"
        ) from error
    raw, out = io.BytesIO(), io.BytesIO()
    with _own_style():
        figure = Figure(figsize=size_in, dpi=DPI, layout="constrained")
        draw(figure)
        figure.savefig(raw, format="png")
    image = Image.open(raw).convert("RGB").quantize(colors=128)
    image.save(out, format="PNG", optimize=True)
    return out.getvalue()


def halo() -> "list[AbstractPathEffect]":
    """A white rim that keeps a text readable on a line."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=3, foreground="white")]


@contextmanager
def _own_style() -> Iterator[None]:
    """matplotlib's defaults and our style, whatever the user's own settings are."""
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        yield
