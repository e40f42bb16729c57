"""READ FIRST: a camera view and an opened map go in, a `Fix` or a `NoFix` comes out.

`Localizer.locate(view)` is the whole path. A file is a step, each can be read alone:

1. `view` refuses what cannot be placed (missing telemetry, extreme tilt, a blank picture) and
   rectifies the rest with its own heading up. Everything wrong with a view becomes a
   `NoFix` with a reason; nothing is raised but `CameraError`, for a camera of another size.
2. `search.Search` runs stages that find candidates, the cheapest first: a correlation with the map
   by FFT, or the tiles whose embeddings are most similar (`tiles`). `prepared` is the map as all
   searches share it; what is tried, what it costs and when it ends are the numbers of `plan`.
3. `place.CandidateRefiner` refines candidates from coarse to fine and compares the best place with
   its strongest rival; the search ends as soon as it stands out. On a map with a terrain the best
   are orthorectified on it first (`ground`). Where none is recognized, gradients alone decide.
4. `camera` fits position, height, heading, pitch and roll to the blocks of the view there, with the
   reported ones as a prior. That gives their covariance too.
5. `fix` states what was found; `confidence` is the probability that the place is right, from its
   scores, and the error within a radius.

Below them, `orthonav.core.register` compares a view with the map. Where a map has no registration
layer, or with `registration=False`, `tiles.TileLocalizer` takes the place of steps 2 to 5: the view
is embedded under a few headings and put on the most similar tile.

`orthonav.core.track.tracker` places the views of a flight one after another: `sighting` gives it
the places of a view with their odds, `odometry` the displacement between views, and
`orthonav.core.track.mixture` joins all of it to one track."""

from orthonav.core.localize.localizer import Localizer
from orthonav.core.localize.tiles import Match, TileMatcher
from orthonav.core.localize.view import RectifiedView, downsampled, rectify

__all__ = ["Localizer", "Match", "RectifiedView", "TileMatcher", "downsampled", "rectify"]
