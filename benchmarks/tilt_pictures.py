"""Pictures of views with unreported tilt: orthorectified with the camera found, beside the map, and
how blocks of them are displaced there, with the reported, the found and the true attitude.

They show imagery that has no licence to be published: they stay in the folder of work.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import (
    axis_on_ground_en_m,
    camera_from_en,
    counted_from_centres,
    footprint_en_m,
)
from orthonav.core.localize import Localizer
from orthonav.core.records import Fix, Telemetry, View

BLOCK_PX, STEP_PX, REACH_PX = 48, 32, 12
"""Blocks of the view, their distance, and how far aside they are looked for, map pixels."""
LEAST_SCORE = 0.3
"""Blocks that correlate less have no arrow."""
ZOOM, ARROW = 3, 4
"""Picture pixels per map pixel, and how many times their length arrows are drawn."""
LINE_PX = 28
Array = NDArray[np.float64]
Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Exterior:
    """Place and attitude of a camera over level ground."""

    position_en_m: Array
    attitude_deg: tuple[float, float, float]
    agl_m: float


def attitude_of(fix: Fix, reported: Telemetry) -> tuple[float, float, float]:
    """Heading, pitch and roll of the camera that a fix states, as reported where it states none."""
    pitch_deg, roll_deg = (fix.evidence.get(f"{axis}_bias_deg", 0.0) for axis in ("pitch", "roll"))
    return fix.heading_deg, reported.pitch_deg + pitch_deg, reported.roll_deg + roll_deg


def write_picture(
    path: Path, view: View, fix: Fix, true: Exterior, localizer: Localizer, title: str
) -> None:
    """Write the view orthorectified with the found and the true camera, the map, and a row of
    displacements."""
    assert localizer.registration is not None
    grid, pyramid = localizer.registration.grid, localizer.registration.pyramid
    position = localizer.sheet.frame.en_from_latlon(fix.lat_deg, fix.lon_deg)
    found = Exterior(position, attitude_of(fix, view.telemetry), fix.agl_m)
    level = _as_reported(found, view.telemetry)
    corners = position + footprint_en_m(view.camera, *found.attitude_deg, found.agl_m)
    west_m, south_m = corners.min(axis=0)
    east_m, north_m = corners.max(axis=0)
    col, row = int((west_m - grid.west_m) / grid.gsd_m), int((grid.north_m - north_m) / grid.gsd_m)
    width, height = int((east_m - west_m) / grid.gsd_m), int((north_m - south_m) / grid.gsd_m)
    ground, _ = pyramid.read(0, row, col, height, width)
    corner_en_m = np.array([grid.west_m + col * grid.gsd_m, grid.north_m - row * grid.gsd_m])
    shown, _ = orthorectified(view, found, corner_en_m, grid.gsd_m, (height, width))
    best, _ = orthorectified(view, true, corner_en_m, grid.gsd_m, (height, width))
    panels = [_panel(ground, "map"), _panel(shown, title), _panel(best, "view, true camera")]
    for camera, name in ((level, "reported"), (found, "found"), (true, "true")):
        seen, valid = orthorectified(view, camera, corner_en_m, grid.gsd_m, (height, width))
        at, moved = displacements(seen, valid, ground)
        length = np.hypot(*moved.T)
        median = float(np.median(length)) if len(length) else np.nan
        _, pitch_deg, roll_deg = camera.attitude_deg
        tilt = f"{name} attitude {pitch_deg:.1f}, {roll_deg:.1f} deg"
        text = f"{tilt}: {len(at)} blocks, median {median:.2f} px"
        panels.append(_arrows(_panel(ground // 2, text), at, moved))
    rows = [np.concatenate(panels[i : i + 3], axis=1) for i in (0, 3)]
    cv2.imwrite(str(path), np.concatenate(rows))


def _as_reported(found: Exterior, telemetry: Telemetry) -> Exterior:
    """The camera with the reported pitch and roll that shows the same ground in the middle."""
    attitude_deg = found.attitude_deg[0], telemetry.pitch_deg, telemetry.roll_deg
    middle = found.position_en_m + axis_on_ground_en_m(*found.attitude_deg, found.agl_m)
    position = middle - np.array(axis_on_ground_en_m(*attitude_deg, found.agl_m))
    return Exterior(position, attitude_deg, found.agl_m)


def orthorectified(
    view: View, camera: Exterior, corner_en_m: Array, gsd_m: float, shape: tuple[int, int]
) -> tuple[Picture, NDArray[np.bool_]]:
    """Grey and valid (H, W) of a view of a pinhole camera on the ground; `corner_en_m`: its north
    west corner."""
    ratio = gsd_m / view.camera.gsd_m(camera.agl_m)
    size = [max(1, round(side / max(ratio, 1.0))) for side in view.grey.shape[::-1]]
    lens = view.camera.resized(size[0], size[1])
    grey = cv2.resize(view.grey, (size[0], size[1]), interpolation=cv2.INTER_AREA)
    east, north = corner_en_m - camera.position_en_m
    en_from_map = np.array([[gsd_m, 0, east], [0, -gsd_m, north], [0, 0, 1]])
    ground = camera_from_en(*camera.attitude_deg, camera.agl_m)
    matrix = counted_from_centres(lens.matrix @ ground @ en_from_map)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    seen = cv2.warpPerspective(grey, matrix, shape[::-1], flags=flags)
    whole = np.full(grey.shape, 255, np.uint8)
    valid = cv2.warpPerspective(whole, matrix, shape[::-1], flags=flags) == 255
    return np.asarray(seen, np.uint8), np.asarray(valid)


def displacements(seen: Picture, valid: NDArray[np.bool_], ground: Picture) -> tuple[Array, Array]:
    """Middles (N, 2) of blocks of the view, and how far aside (N, 2) the map agrees best, in map
    pixels (x, y), by normalized correlation of gradient magnitudes."""
    ours, theirs = _gradient(seen), _gradient(ground)
    at, moved = [], []
    side = BLOCK_PX + 2 * REACH_PX
    for top in range(0, ground.shape[0] - side + 1, STEP_PX):
        for left in range(0, ground.shape[1] - side + 1, STEP_PX):
            inside = (
                slice(top + REACH_PX, top + REACH_PX + BLOCK_PX),
                slice(left + REACH_PX, left + REACH_PX + BLOCK_PX),
            )
            if not valid[inside].all():
                continue
            around = theirs[top : top + side, left : left + side]
            scores = cv2.matchTemplate(around, ours[inside], cv2.TM_CCOEFF_NORMED)
            peak = _peak(np.asarray(scores, np.float32))
            if peak is not None:
                at.append((left + side / 2, top + side / 2))
                moved.append(peak - REACH_PX)
    return np.array(at).reshape(-1, 2), np.array(moved).reshape(-1, 2)


def _gradient(grey: Picture) -> NDArray[np.float32]:
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
    across, down = (cv2.Sobel(smooth, cv2.CV_32F, *order) for order in ((1, 0), (0, 1)))
    return np.asarray(np.hypot(across, down))


def _peak(scores: NDArray[np.float32]) -> Array | None:
    """Column and row (2,) of the highest score, between pixels; None at the border or where low."""
    row, col = np.unravel_index(np.argmax(scores), scores.shape)
    last = scores.shape[0] - 1
    if scores[row, col] < LEAST_SCORE or not (0 < row < last and 0 < col < last):
        return None
    found = []
    for at, line in ((col, scores[row]), (row, scores[:, col])):
        before, here, after = line[at - 1 : at + 2].tolist()
        bend = before - 2 * here + after
        found.append(float(at) + (0.5 * (before - after) / bend if bend < 0 else 0.0))
    return np.array(found)


def _panel(grey: Picture, text: str) -> Picture:
    """A picture enlarged, in colour, under a line of text."""
    large = cv2.resize(grey, None, fx=ZOOM, fy=ZOOM, interpolation=cv2.INTER_CUBIC)
    label = np.zeros((LINE_PX, large.shape[1]), np.uint8)
    cv2.putText(label, text, (6, LINE_PX - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 255, 1, cv2.LINE_AA)
    return np.asarray(cv2.cvtColor(np.concatenate([label, large]), cv2.COLOR_GRAY2BGR), np.uint8)


def _arrows(panel: Picture, at: Array, moved: Array) -> Picture:
    for middle, step in zip(at, moved, strict=True):
        ends = np.array([middle, middle + ARROW * step]) * ZOOM + [0, LINE_PX]
        start, end = ends.round().astype(int).tolist()
        cv2.arrowedLine(panel, start, end, (60, 200, 255), 2, cv2.LINE_AA, tipLength=0.25)
    return panel
