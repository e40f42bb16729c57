"""A generated area: an invented countryside photographed at several dates.

Everything is a function of seed, place and date, so any window can be drawn on its own. From the
plan to the picture: `network` (roads, settlements, rivers), `parcels` and `plan` (what each
macro-cell holds, and in which years), `crops` (how it looks at a date), `ground` and `relief`
(colour, height, shadow), `sensor`, and `scene` and `area`, which put them together.
"""

from orthonav.simulate.landscape.area import generate_area
from orthonav.simulate.landscape.epoch import DEFAULT_DATES, Epoch, Season
from orthonav.simulate.landscape.scene import GSD_RANGE_M, ORIGIN_M, Landscape, render

__all__ = [
    "DEFAULT_DATES",
    "GSD_RANGE_M",
    "ORIGIN_M",
    "Epoch",
    "Landscape",
    "Season",
    "generate_area",
    "render",
]
