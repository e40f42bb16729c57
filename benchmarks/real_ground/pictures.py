"""Residual displacements of the blocks of a view under the camera that was found.

`python -m benchmarks.real_ground.pictures --work DIR --only TEXT .. [--views 4]` writes a picture
of each view into DIR/residuals: the view orthorectified under its camera, and the displacement at
which each block fits the map best, ten times as long.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.real_ground.rows import questions
from orthonav.core.localize import Localizer
from orthonav.core.records import NoFix, View
from orthonav.core.register.refine import block_scores

REACH_PX, LONGER, ENLARGED = 6, 10, 3
LEAST_CORRELATION = 0.15
"""Blocks that fit worse show nothing."""


def residuals(localizer: Localizer, view: View) -> NDArray[np.uint8] | None:
    """The picture (H, W, 3) of a view; None where it has no camera."""
    registration = localizer.registration
    assert registration is not None
    found = registration.found(view)
    if isinstance(found, NoFix):
        return None
    search, place = found
    camera = search.camera(place)
    if camera is None:
        return None
    level, pose = search.levels.final, place.fit.pose
    made = search.over_ground.templates_at(pose, level, camera.orientation)
    if made is None:
        return None
    template = made.at(level)
    scores = block_scores(template, registration.reference, pose, REACH_PX)
    grey = made.picture(level)[0]
    wide = cv2.resize(grey, None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_CUBIC)
    picture = cv2.cvtColor(np.asarray(wide, np.uint8), cv2.COLOR_GRAY2BGR)
    rows, cols = grey.shape
    for surface, pixels, middle in zip(*scores, strict=True):
        down, right = np.unravel_index(int(surface.argmax()), surface.shape)
        if pixels == 0 or surface.max() < LEAST_CORRELATION:
            continue
        begin = (middle + np.array([cols, rows]) / 2) * ENLARGED
        moved = np.array([right, down]) - REACH_PX
        end = begin + moved * LONGER
        first, last = np.rint(begin).astype(int).tolist(), np.rint(end).astype(int).tolist()
        cv2.arrowedLine(picture, first, last, (0, 200, 255), 2, tipLength=0.3)
        cv2.circle(picture, first, 3, (0, 200, 255), -1)
    return np.asarray(picture, np.uint8)


def main() -> None:
    """Write the pictures of the rows that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--only", nargs="+", required=True, metavar="TEXT")
    parser.add_argument("--views", type=int, default=4, help="of each row")
    options = parser.parse_args()
    out = options.work / "residuals"
    out.mkdir(parents=True, exist_ok=True)
    for row in questions():
        if not any(text in row.name for text in options.only):
            continue
        for built, source in row.legs:
            built.build(options.work)
            localizer = built.localizer(options.work)
            source.prepare(options.work, localizer, options.views)
            for number, seen in enumerate(
                source.seen(options.work, localizer, options.views, False)
            ):
                picture = residuals(localizer, seen.view)
                if picture is not None:
                    path = out / f"{row.name.replace(' ', '_').replace('%', '')}_{number}.png"
                    cv2.imwrite(str(path), picture)
                    print(path)


if __name__ == "__main__":
    main()
