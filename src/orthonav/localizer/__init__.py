"""READ FIRST: a view, what the autopilot knew, and a map go in; a `Fix` or a `NoFix` comes out.

`localizer.Localizer.locate` is the whole path: check the view, rectify it to the map's ground
resolution with north up (`rectify`), represent and embed it, search the tiles that the prior
allows, and say how sure that is.
"""

from orthonav.localizer.localizer import Localizer
from orthonav.localizer.match import Match, TileMatcher
from orthonav.localizer.rectify import RectifiedView, downsampled, rectify

__all__ = [
    "Localizer",
    "Match",
    "RectifiedView",
    "TileMatcher",
    "downsampled",
    "rectify",
]
