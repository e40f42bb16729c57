"""A generated landscape, imaged at several dates.

Everything is a function of seed, position and date, so any window can be rendered on its own. The
steps: `network` (roads, settlements, rivers), `parcels` and `plan` (content of each macro-cell,
with the years of changes), `crops` (appearance at a date), `surface` and `relief` (colour, height,
shadow), and `scene` and `area`, which combine them.
"""

from lab.landscape.area import generate_area, generate_heights
from lab.landscape.epoch import DEFAULT_DATES, OTHER_LIGHT, Epoch, Season
from lab.landscape.looks import Look
from lab.landscape.scene import GSD_RANGE_M, ORIGIN_M, Landscape

__all__ = [
    "DEFAULT_DATES",
    "GSD_RANGE_M",
    "ORIGIN_M",
    "OTHER_LIGHT",
    "Epoch",
    "Landscape",
    "Look",
    "Season",
    "generate_area",
    "generate_heights",
]
