"""Pictures of the worst views of every scene of `benchmarks.trust`: the view beside the map there.

They show imagery that has no licence to be published: they stay in the folder of work.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.inputs import file_of, map_of
from orthonav.core.flight import open_flight
from orthonav.core.flight.folder import read_image
from orthonav.core.mapfile import open_map
from orthonav.core.mapfile.layer import GreyLayer
from orthonav.core.register.pose import Pose

WORST = 3
"""Views of each kind and scene: right ones with the least confidence, wrong ones with the most."""
SIDE_PX, LINE_PX = 280, 20
Picture = NDArray[np.uint8]


def write_worst(
    rows: Sequence[dict[str, Any]],
    right: NDArray[np.bool_],
    confidence: NDArray[np.float64],
    work: Path,
) -> list[Path]:
    """A picture per scene in `work/worst`, by rows of `views_of` and what was said of them (N,)."""
    folder = work / "worst"
    folder.mkdir(exist_ok=True)
    scenes = np.array([each["scene"] for each in rows])
    written = []
    for scene in np.unique(scenes):
        inside = np.flatnonzero(scenes == scene)
        refused = [i for i in inside[np.argsort(confidence[inside])] if right[i]][:WORST]
        believed = [i for i in inside[np.argsort(-confidence[inside])] if not right[i]][:WORST]
        parts = [_pair(rows[i], float(confidence[i]), work) for i in (*refused, *believed)]
        path = folder / f"{scene}.png"
        cv2.imwrite(str(path), np.concatenate(parts))
        written.append(path)
    return written


def _pair(row: dict[str, Any], confidence: float, work: Path) -> Picture:
    """The view of a row, and the map where it was placed, with what was said of it."""
    name, frame = row["frame"].split("/", 1)
    flight = open_flight(work / name)
    seen = next(each for each in flight.views if each.frame == frame)
    view = read_image(seen.path)
    if row["kind"] == "mirrored":
        view = np.ascontiguousarray(view[:, ::-1])
    scale = SIDE_PX / max(view.shape)
    view = np.asarray(cv2.resize(view, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    left = np.zeros((SIDE_PX, SIDE_PX), np.uint8)
    left[: view.shape[0], : view.shape[1]] = view
    text = (
        f"{row['kind']} {row['width_px']} px{', prior' * (row['prior_px'] is not None)}: "
        f"confidence {confidence:.2f}, {row['error_px']:.0f} px off"
    )
    label = np.zeros((LINE_PX, 2 * SIDE_PX), np.uint8)
    cv2.putText(label, text, (4, LINE_PX - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.42, 255)
    both = np.concatenate([left, _map_at(row, work)], axis=1)
    return np.concatenate([label, both])


def _map_at(row: dict[str, Any], work: Path) -> Picture:
    """The map (S, S) around the place of a row, turned and scaled like the view."""
    bounds = row["bounds_deg"]
    opened = open_map(map_of(file_of(row["map"], work), work, bounds and tuple(bounds)))
    layer = GreyLayer.of(opened)
    assert layer is not None
    pose = Pose(*row["pose"])
    unit = row["side_px"] * math.sqrt(4 / 3) / SIDE_PX  # views are four by three
    reach = math.ceil(unit * SIDE_PX * math.exp(pose.log_scale))
    col, row_px = int(pose.x_px) - reach, int(pose.y_px) - reach
    grey, _ = layer.read(0, row_px, col, 2 * reach, 2 * reach)
    linear = pose.linear * unit
    middle = np.array([pose.x_px - col, pose.y_px - row_px])
    matrix = np.column_stack([linear, middle - linear @ [SIDE_PX / 2, SIDE_PX / 2]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(grey, matrix, (SIDE_PX, SIDE_PX), flags=flags), np.uint8)
