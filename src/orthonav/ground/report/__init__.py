"""What the reports of all commands share: pages, drawings, and figures as files.

A page is made from a Jinja2 template and needs no other file (`render`, `write_page`). A drawing by
matplotlib becomes a `Drawing`, and with name, caption and description a `Figure`. Importing this
package imports neither matplotlib nor Jinja2.
"""

from orthonav.ground.report.canvas import Drawing, draw_axes, draw_figure
from orthonav.ground.report.figures import Figure, file_names, write_figures, write_page
from orthonav.ground.report.maps import Background, draw_background, draw_map, map_size_in
from orthonav.ground.report.numbers import measure_text, metres_text, percent_text, plain_text
from orthonav.ground.report.page import render

__all__ = [
    "Background",
    "Drawing",
    "Figure",
    "draw_axes",
    "draw_background",
    "draw_figure",
    "draw_map",
    "file_names",
    "map_size_in",
    "measure_text",
    "metres_text",
    "percent_text",
    "plain_text",
    "render",
    "write_figures",
    "write_page",
]
