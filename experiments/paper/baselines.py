"""The paper's related work on one trajectory: methods that carry the reference images on board.

Mutual information (Patel et al.), edges matched as such (Conte and Doherty: Sobel; and Canny), and
local features with RANSAC. All are those of `benchmarks`, restricted to the reported pose and given
the whole map.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from benchmarks.posed import BestOfPoses, Keypoints, MutualSurface, Picture, TemplateSurface
from benchmarks.record import provenance
from numpy.typing import NDArray

from experiments.paper import views
from experiments.paper.results import ACCURACY_M
from experiments.paper.runs import Workplace, head, placements, save
from experiments.paper.scenes import Scene
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import View
from orthonav.ground.imagery.mosaic import Mosaic

MAP_OF = "gradient-gradient"
"""The baselines get the plane and pixels of this run's map."""
TRIED_ON = "B"
COARSER = 2
"""Mutual information is taken on pixels of so many of the map's, averaged: it is slow."""
VIEWS = 50
KEY = "baselines"


@dataclass(frozen=True)
class Baseline:
    """A method on the map's picture; `sobel` gives it edges instead of grey levels."""

    name: str
    make: Callable[[Picture], Any]
    factor: int = 1
    sobel: bool = False


def _reported_pose(surface: Callable[[Picture], Any]) -> Callable[[Picture], Any]:
    return lambda picture: BestOfPoses(picture, surface(picture), telemetry_only=True)


BASELINES = (
    Baseline("mutual information (Patel et al.)", _reported_pose(MutualSurface), COARSER),
    Baseline(
        "Sobel edges matched (Conte and Doherty)",
        _reported_pose(lambda picture: TemplateSurface(picture, False)),
        sobel=True,
    ),
    Baseline("Canny edges matched", _reported_pose(lambda picture: TemplateSurface(picture, True))),
    Baseline(
        "grey levels matched", _reported_pose(lambda picture: TemplateSurface(picture, False))
    ),
    Baseline("SIFT, ratio test, RANSAC", Keypoints),
)


def run(place: Workplace, scene: Scene) -> bool:
    """Place views by every baseline; false where an earlier run has its file or there is no map."""
    out, map_path = place.result(scene, KEY), place.work(scene, MAP_OF) / "map.onav"
    if out.is_file() or not map_path.is_file():
        return False
    start, made = time.perf_counter(), head(place, scene, provenance("paper"))
    localizer = Localizer(open_map(map_path), registration=False)
    pixels_path = place.work(scene, KEY).with_suffix(".npz")
    _store(scene, localizer, pixels_path)
    count = min(VIEWS, place.setting.views)
    grounds = dict(placements(scene, localizer, count))
    del grounds["route"]
    made["baselines"] = {
        each.name: _placed(each, scene, localizer, map_path, pixels_path, grounds)
        for each in BASELINES
    }
    save(out, made, start)
    return True


def _placed(
    baseline: Baseline,
    scene: Scene,
    localizer: Localizer,
    map_path: Path,
    pixels_path: Path,
    grounds: dict[str, list[views.Ground]],
) -> dict[str, Any]:
    picture = Picture.read(map_path, pixels_path, baseline.factor)
    if baseline.sobel:
        picture = replace(picture, grey=sobel(picture.grey))
    method = baseline.make(picture)
    agl_m, gsd_m = scene.trajectory.agl_m, localizer.grid.gsd_m
    camera, telemetry = views.camera_of(agl_m, gsd_m), views.telemetry_at(agl_m)
    hits: dict[str, list[int]] = {}
    times_ms = []
    for name, seen in grounds.items():
        hits[name] = [0, len(seen)]
        for ground in seen:
            grey = views.view_of(ground, camera, agl_m, gsd_m)
            start = time.perf_counter()
            grey = sobel(grey) if baseline.sobel else grey
            view = View(grey, camera, telemetry)
            found = method.locate(view, True)
            times_ms.append(1e3 * (time.perf_counter() - start))
            right = found is not None and np.hypot(*(found - ground.truth_en_m)) <= ACCURACY_M
            hits[name][0] += bool(right)
    return {"views": hits, "view_ms": float(np.median(times_ms))}


def sobel(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Magnitude of the Sobel gradient (H, W), a quarter of it: it fits into bytes."""
    east = cv2.Sobel(grey, cv2.CV_32F, 1, 0)
    south = cv2.Sobel(grey, cv2.CV_32F, 0, 1)
    return np.asarray(np.clip(cv2.magnitude(east, south) / 4, 0, 255), dtype=np.uint8)


def _store(scene: Scene, localizer: Localizer, out: Path) -> None:
    """The older orthophoto in the map's own raster, as `benchmarks.posed` reads it."""
    grid = localizer.grid
    with Mosaic.open([scene.past]).grid_sheet(localizer.sheet.frame, grid) as raster:
        pixels = raster.read(0, 0, grid.width_px, grid.height_px)
    mean = round(float(pixels.grey[pixels.valid].mean()))
    grey = np.where(pixels.valid, pixels.grey, mean).astype(np.uint8)
    out.parent.mkdir(parents=True, exist_ok=True)
    np.savez(out, grey=grey, valid=pixels.valid)
