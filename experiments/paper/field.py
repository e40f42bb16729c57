"""The field today: local features, learnt embeddings and orthonav on the same views.

Every method gets the same views of the later date, the same reported pose with its errors, and the
same prior. Each view is placed twice, as it is and mirrored: a mirrored view is nowhere on the map,
so every answer to it is wrong. Each method runs in a process of its own, on one core.
"""

import gc
import json
import math
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from benchmarks.placing import memory_mb
from benchmarks.posed import Picture
from benchmarks.record import provenance
from benchmarks.scenes import store
from numpy.typing import NDArray

from experiments.paper import matchers
from experiments.paper import scenes as views
from experiments.paper.methods import Method, flown, methods
from experiments.paper.results import FIELD
from experiments.paper.runs import MB, Workplace, head, save
from experiments.paper.scenes import Scene
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import Fix, Prior, Telemetry, View

VIEWS = 20
YAW_STD_DEG, AGL_STD, PRIOR_STD_PX = 5.0, 0.03, 40.0
"""Errors of the reported heading, height (share) and position (pixels of the map), all reported."""
CLIPPED = 2.5
"""Errors are drawn up to so many standard deviations."""
SEED = 24


@dataclass(frozen=True, eq=False)
class Seen:
    """A view with its telemetry, its prior in the sheet (2,) and where it was taken (2,)."""

    grey: NDArray[np.uint8]
    telemetry: Telemetry
    prior_en_m: NDArray[np.float64]
    truth_en_m: NDArray[np.float64]


Locate = Callable[[View, Prior, NDArray[np.float64]], matchers.Found | None]


def maps_of(place: Workplace, scene: Scene) -> list[Method]:
    """Rows whose maps are flown, those whose map has been built."""
    rows = flown(methods(place.setting, scene.name, scene.trajectory.tiles))
    return [each for each in rows if (place.work(scene, each.key) / "map.onav").is_file()]


def run(place: Workplace, scene: Scene) -> bool:
    """Place the views by every method; false where no map is, or all results are there.

    Methods whose map has been built since are added to a result.
    """
    out, maps = place.result(scene, FIELD), maps_of(place, scene)
    if not maps:
        return False
    start, made = time.perf_counter(), head(place, scene, provenance("paper"))
    before: dict[str, Any] = json.loads(out.read_text(encoding="utf-8")) if out.is_file() else {}
    names = [*matchers.LOCAL, *(each.key for each in maps)]
    found = before.get("field", {})
    missing = [name for name in names if name not in found]
    if not missing:
        return False
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
        for name in missing:
            found[name] = pool.submit(_measured, place, scene, maps[0].key, name).result()
    made["field"] = {name: found[name] for name in names}
    made["methods"] = [asdict(each) | {"edges": each.edges.partition(":")[0]} for each in maps]
    made["errors"] = {"yaw_std_deg": YAW_STD_DEG, "agl_std": AGL_STD, "prior_std_px": PRIOR_STD_PX}
    save(out, made, start)
    return True


def seen(scene: Scene, localizer: Localizer, count: int) -> Iterator[Seen]:
    """Views anywhere, each with errors of heading, height and prior."""
    rng = np.random.default_rng([SEED, count])
    agl_m, gsd_m = scene.trajectory.agl_m, localizer.grid.gsd_m
    camera = views.camera_of(agl_m, gsd_m)
    places = views.places_en_m(localizer.tiles.centres_en_m, count)
    telemetry = Telemetry(
        0,
        0.0,
        0.0,
        0.0,
        agl_m,
        yaw_std_deg=YAW_STD_DEG,
        agl_std_m=AGL_STD * agl_m,
        tilt_std_deg=0.0,
    )
    for ground in views.grounds(scene, localizer.sheet.frame, localizer.grid, places):
        turned, lower, *off = np.clip(rng.normal(size=4), -CLIPPED, CLIPPED)
        grey = views.view_of(
            ground,
            camera,
            agl_m,
            gsd_m,
            turned_deg=float(turned) * YAW_STD_DEG,
            drop_m=float(lower) * AGL_STD * agl_m,
        )
        prior = ground.truth_en_m + np.array(off) * PRIOR_STD_PX * gsd_m
        yield Seen(grey, telemetry, prior, ground.truth_en_m)


def _measured(place: Workplace, scene: Scene, any_map: str, name: str) -> dict[str, Any]:
    """Errors and evidence of views as they are, evidence of mirrored ones, and what it took."""
    cv2.setNumThreads(1)
    if name in matchers.LOCAL:
        matchers.one_thread()
    localizer = Localizer(open_map(place.work(scene, any_map) / "map.onav"), registration=False)
    began = time.process_time()
    locate, carried = _method(place, scene, localizer, name)
    prepared_s = time.process_time() - began
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")  # the peak is counted from here
    frame, gsd_m = localizer.sheet.frame, localizer.grid.gsd_m
    camera = views.camera_of(scene.trajectory.agl_m, gsd_m)
    straight, mirrored, times_s = [], [], []
    for each in seen(scene, localizer, min(VIEWS, place.setting.views)):
        lat, lon = frame.latlon_from_en(each.prior_en_m)
        prior = Prior(float(lat), float(lon), PRIOR_STD_PX * gsd_m)
        for grey in (each.grey, np.ascontiguousarray(each.grey[:, ::-1])):
            start = time.process_time()
            answer = locate(View(grey, camera, each.telemetry), prior, each.prior_en_m)
            times_s.append(time.process_time() - start)
            evidence = math.nan if answer is None else answer.evidence
            if grey is not each.grey:
                mirrored.append(evidence)
                continue
            away = math.nan if answer is None else np.hypot(*(answer.place_en_m - each.truth_en_m))
            straight.append([float(away), evidence])
    return {
        "views": straight,
        "mirrored": mirrored,
        "prior_m": [
            float(np.hypot(*(each.prior_en_m - each.truth_en_m)))
            for each in seen(scene, localizer, min(VIEWS, place.setting.views))
        ],
        "cpu_s": float(np.median(times_s[2:] or times_s)),  # the first view loads what is needed
        "prepare_cpu_s": prepared_s,
        "peak_mb": memory_mb(),
        "carried_mb": carried / MB,
    }


def _method(
    place: Workplace, scene: Scene, localizer: Localizer, name: str
) -> tuple[Locate, float]:
    """Function that places a view, and bytes that an aircraft would carry."""
    if name in matchers.LOCAL:
        any_map, pixels = localizer.opened.path, place.work(scene, FIELD).with_suffix(".npz")
        picture = Picture.read(any_map, store(scene.past, localizer, pixels), 1)
        features = matchers.FeatureMap(matchers.LOCAL[name](), picture)
        std_m = PRIOR_STD_PX * localizer.grid.gsd_m

        def match(view: View, _: Prior, prior_en_m: NDArray[np.float64]) -> matchers.Found | None:
            return features.locate(view, prior_en_m, std_m)

        return match, features.features.nbytes
    (method,) = (each for each in maps_of(place, scene) if each.key == name)
    path = place.work(scene, name) / "map.onav"
    flying = Localizer(
        open_map(path),
        registration=method.registration,
        position="peak" if method.registration else "best",
        flying=False,
    )
    criterion = "confidence" if method.registration else "lowe_ratio"

    def place_by_map(view: View, prior: Prior, _: NDArray[np.float64]) -> matchers.Found | None:
        fix = flying.locate(view, prior=prior)
        if not isinstance(fix, Fix):
            return None
        known = {**fix.evidence, "confidence": fix.confidence}
        found = flying.sheet.frame.en_from_latlon(fix.lat_deg, fix.lon_deg)
        return matchers.Found(np.asarray(found), float(known.get(criterion, math.nan)))

    return place_by_map, path.stat().st_size
