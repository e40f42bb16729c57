"""`python -m experiments.paper.exceptions`: views that the default places wrongly on trajectory B.

Each view along the route that is beyond 15 m, beside the map at its true place and where it was
put. Nothing but generated imagery is shown.
"""

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib.figure
import numpy as np
from numpy.typing import NDArray

from experiments.paper import scenes, views
from experiments.paper.methods import DEFAULT
from experiments.paper.results import ACCURACY_M
from experiments.paper.runs import SWEPT_ON, placements
from experiments.paper.trajectories import REDUCED, TILE_PX
from orthonav.core.files import replacing
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import Fix, View
from orthonav.ground.build import BuildRequest, build_map

ROWS = ("view, October 2021", "map of July 2016, true place", "map, where it was put")
Pictures = list[NDArray[np.uint8]]


def localizer_of(scene: scenes.Scene, folder: Path) -> Localizer:
    """The default on a new map of a scene."""
    flown = scene.trajectory
    request = BuildRequest(
        [scene.past],
        folder / "map.onav",
        **scene.area(),
        gsd_m=flown.gsd_m,
        tile_px=TILE_PX,
        overlap=flown.overlap,
        method=DEFAULT,
        edges=DEFAULT,
        registration=True,
    )
    build_map(request)
    return Localizer(open_map(request.out), registration=True, position="peak", flying=False)


def wrong(scene: scenes.Scene, localizer: Localizer, count: int) -> Iterator[tuple[str, Pictures]]:
    """Error and confidence, and pictures of `ROWS`, of each view along the route beyond 15 m."""
    frame, gsd_m, agl_m = localizer.sheet.frame, localizer.grid.gsd_m, scene.trajectory.agl_m
    camera, telemetry = views.camera_of(agl_m, gsd_m), views.telemetry_at(agl_m, exact=False)
    for ground in dict(placements(scene, localizer, count))["route"]:
        grey = views.view_of(ground, camera, agl_m, gsd_m)
        found = localizer.locate(View(grey, camera, telemetry))
        if not isinstance(found, Fix):
            continue
        place = frame.en_from_latlon(found.lat_deg, found.lon_deg)
        error_m = float(np.hypot(*(place - ground.truth_en_m)))
        if error_m > ACCURACY_M:
            before = replace(scene, present=scene.past)
            both = np.stack([ground.truth_en_m, place])
            maps = views.grounds(before, frame, localizer.grid, both)
            pictures = [grey, *(views.view_of(each, camera, agl_m, gsd_m) for each in maps)]
            yield f"{error_m:.0f} m off, confidence {found.confidence:.2f}", pictures


def draw(found: Sequence[tuple[str, Pictures]]) -> matplotlib.figure.Figure:
    """A column for each view."""
    size_in = (2.6 * max(1, len(found)) + 0.4, 2.6 * len(ROWS) + 0.4)
    figure = matplotlib.figure.Figure(size_in, layout="constrained")
    for column, axes in enumerate(figure.subplots(len(ROWS), max(1, len(found)), squeeze=False).T):
        title, pictures = found[column] if found else ("no view is beyond 15 m", [])
        axes[0].set_title(title, fontsize=9)
        for number, each in enumerate(axes):
            each.set_xticks([])
            each.set_yticks([])
            if column == 0:
                each.set_ylabel(ROWS[number], fontsize=9)
            if number < len(pictures):
                each.imshow(pictures[number], cmap="gray", vmin=0, vmax=255)
    return figure


def main() -> None:
    """Generate B, build its map, locate the views, draw."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.paper.exceptions", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--out", type=Path, default=Path("exceptions.jpg"), metavar="FILE")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="orthonav-exceptions-") as name:
        scene = scenes.generated(REDUCED, SWEPT_ON, Path(name))
        scenes.render(scene)
        found = list(wrong(scene, localizer_of(scene, Path(name)), REDUCED.views))
        with replacing(options.out) as temporary:
            draw(found).savefig(temporary, format=options.out.suffix[1:], dpi=110)
    print(f"{len(found)} views along the route of {SWEPT_ON} are beyond {ACCURACY_M:g} m")


if __name__ == "__main__":
    main()
