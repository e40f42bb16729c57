"""READ FIRST: a camera view and an opened map go in, a `Fix` or a `NoFix` comes out.

`Localizer.locate(view)` is the whole path. The default path, in the order in which it runs:

1. `checks.check_view` refuses what cannot be placed: missing telemetry, extreme tilt, a blank
   picture. Everything wrong with a view becomes a `NoFix` with a reason; nothing is raised but
   `CameraError`, for a camera of another size.
2. `registration.RegistrationLocalizer` places the view. It rectifies the view with its own heading
   up (`rectify`), and asks `plan.SearchPlan` which searches to try, the cheapest first.
3. A search gives candidates: a correlation by FFT with the map (`orthonav.core.register.search`),
or the
   tiles whose embeddings are most similar (`propose`).
4. Candidates are refined from coarse to fine, the best is compared with its strongest rival
   (`orthonav.core.register.registrar`); the search ends as soon as the best stands out. On a map
   with a terrain the best are orthorectified on it first (`relief`, `orthorectify`).
5. Position, height, heading, pitch and roll are fitted to the blocks of the view there, with the
   reported ones as a prior (`camera`, `resection`). That gives their covariance too.
6. The evidence becomes a confidence (`orthonav.core.localize`): that the place is right, times that
   the error of the camera is small.

Where a map has no registration layer, or with `registration=False`, `tiles.TileLocalizer` takes the
place of steps 2 to 6: the view is embedded under a few headings and put on the most similar tile.

`orthonav.core.track.tracker` places the views of a flight one after another: `registration` gives
it candidate places, `camera` their pitch and roll, `orthonav.core.track.odometry` the displacement
between views, and
`orthonav.core.track` joins all of it to one track.
"""

from orthonav.core.localize.localizer import Localizer
from orthonav.core.localize.rectify import RectifiedView, downsampled, rectify
from orthonav.core.localize.tiles import Match, TileMatcher

__all__ = [
    "Localizer",
    "Match",
    "RectifiedView",
    "TileMatcher",
    "downsampled",
    "rectify",
]
