"""What reports of all commands share: the look of the page, drawings, figures as files.

A report is one page that needs nothing else (`document` and the pieces that go into it). What is
drawn becomes a `Drawing`, with a name and what is said of it a `Figure`, which `figure_html` puts
into the page and `write_page` beside it. Importing this does not import matplotlib.
"""

from orthonav.report.canvas import Drawing, draw_axes, draw_figure
from orthonav.report.figures import Figure, file_names, write_figures, write_page
from orthonav.report.ground import Background, draw_background, draw_map, map_size_in
from orthonav.report.numbers import measure_text, percent_text, plain_text
from orthonav.report.page import (
    cards,
    definitions,
    document,
    figure_html,
    html_table,
    notes,
    pictures,
)
from orthonav.report.style import SAID_STYLE, STYLE

__all__ = [
    "SAID_STYLE",
    "STYLE",
    "Background",
    "Drawing",
    "Figure",
    "cards",
    "definitions",
    "document",
    "draw_axes",
    "draw_background",
    "draw_figure",
    "draw_map",
    "figure_html",
    "file_names",
    "html_table",
    "map_size_in",
    "measure_text",
    "notes",
    "percent_text",
    "pictures",
    "plain_text",
    "write_figures",
    "write_page",
]
