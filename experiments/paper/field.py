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
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from benchmarks.record import Table, memory_mb, number, provenance
from benchmarks.scenes import far_m
from numpy.typing import NDArray

from experiments.paper import matchers
from experiments.paper import scenes as views
from experiments.paper.methods import Method, flown, methods
from experiments.paper.posed import Picture, store
from experiments.paper.results import ACCURACY_M, FIELD, Result, numbers, percent
from experiments.paper.runs import MB, Workplace, head, save
from experiments.paper.scenes import Scene
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import CONFIDENT, Fix, Prior, Telemetry, View

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
    found = before.get(FIELD, {})
    missing = [name for name in names if name not in found]
    if not missing:
        return False
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
        for name in missing:
            found[name] = pool.submit(_measured, place, scene, maps[0].key, name).result()
    made[FIELD] = {name: found[name] for name in names}
    made["methods"] = [asdict(each) | {"edges": each.input} for each in maps]
    made["errors"] = {"yaw_std_deg": YAW_STD_DEG, "agl_std": AGL_STD, "prior_std_px": PRIOR_STD_PX}
    save(out, made, start)
    return True


def seen(scene: Scene, localizer: Localizer, count: int) -> Iterator[Seen]:
    """Views anywhere, each with errors of heading, height and prior."""
    rng = np.random.default_rng([SEED, count])
    agl_m, gsd_m = scene.trajectory.agl_m, localizer.grid.gsd_m
    places = views.places_en_m(localizer.tiles.centres_en_m, count)
    telemetry = replace(
        views.telemetry_at(agl_m), yaw_std_deg=YAW_STD_DEG, agl_std_m=AGL_STD * agl_m
    )
    for ground in views.grounds(scene, localizer, places):
        turned, lower, *off = np.clip(rng.normal(size=4), -CLIPPED, CLIPPED)
        grey = views.view_of(
            ground,
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
    straight, mirrored, prior_m, times_s = [], [], [], []
    for each in seen(scene, localizer, min(VIEWS, place.setting.views)):
        prior_m.append(float(np.hypot(*(each.prior_en_m - each.truth_en_m))))
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
        "prior_m": prior_m,
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


@dataclass(frozen=True, eq=False)
class Placed:
    """What a method made of the views of one or several scenes.

    - `error_m` (N,): infinite without an answer. `far_m` (N,): error above which it is wrong.
    - `evidence` (N,): -inf without an answer. `mirrored` (M,): that of mirrored views.
    """

    error_m: NDArray[np.float64]
    far_m: NDArray[np.float64]
    evidence: NDArray[np.float64]
    mirrored: NDArray[np.float64]

    @classmethod
    def of(cls, rows: Sequence[Result], name: str) -> "Placed":
        parts = [
            (each.plain[FIELD][name], far_m(each.trajectory.gsd_m))
            for each in rows
            if name in each.plain[FIELD]
        ]
        seen = [(*view, far) for part, far in parts for view in part["views"]]
        return cls(
            numbers([error for error, _, _ in seen], math.inf),
            np.array([far for _, _, far in seen]),
            numbers([evidence for _, evidence, _ in seen], -math.inf),
            numbers([each for part, _ in parts for each in part["mirrored"]], -math.inf),
        )

    @property
    def right(self) -> NDArray[np.bool_]:
        """Mask (N,) of the views that are not wrong."""
        return self.error_m <= self.far_m

    def within(self, radius_m: float = ACCURACY_M) -> float:
        return float((self.error_m <= radius_m).mean())

    def trusted(self) -> float:
        """Largest share of the right views that a threshold accepts with no wrong one."""
        wrong = np.concatenate([self.evidence[~self.right], self.mirrored, [-math.inf]])
        right = self.evidence[self.right]
        return float((right > wrong.max()).mean()) if right.size else math.nan

    def accepted(self, threshold: float) -> tuple[float, int]:
        """Share of the right views that a threshold accepts, and how many wrong ones."""
        accepted = self.evidence >= threshold
        right = float(accepted[self.right].mean()) if self.right.any() else math.nan
        return right, int((accepted & ~self.right).sum() + (self.mirrored >= threshold).sum())

    def median_m(self) -> float:
        """Median error of the right views."""
        return float(np.median(self.error_m[self.right])) if self.right.any() else math.nan


def tables(results: Sequence[Result]) -> list[Table]:
    """Each method over all scenes, and within 15 m and not wrong on each."""
    rows = [each for each in results if FIELD in each.plain]
    if not rows:
        return []
    first = rows[0].plain[FIELD]
    names = list(dict.fromkeys(name for each in rows for name in each.plain[FIELD]))
    flying = [Method(**plain) for each in rows for plain in each.plain["methods"]]
    labels = dict(zip(names, names, strict=True)) | {each.key: each.label for each in flying}
    lines = [_line(rows, *each) for each in labels.items()]
    guess = ["the prior itself", *"-" * 7]
    for each in rows:
        away = np.array(next(iter(each.plain[FIELD].values()))["prior_m"])
        radii = ACCURACY_M, far_m(each.trajectory.gsd_m)
        guess.append("/".join(percent(float((away <= radius).mean())) for radius in radii))
    confident = [
        f"{labels[name]}, at a confidence of {CONFIDENT:g}: {percent(right)} % of the correct ones "
        f"accepted, {wrong} wrong"
        for name in labels
        if name.endswith("registration")
        for right, wrong in [Placed.of(rows, name).accepted(CONFIDENT)]
    ]
    errors, counts = rows[0].plain["errors"], Placed.of(rows, next(iter(first)))
    header = (
        *("method", "15 m", "35 m or 10 px", "accepted at no wrong", "median m"),
        *("CPU s per view", "peak MB", "carried MB"),
        *(each.scene for each in rows),
    )
    notes = (
        f"{len(counts.error_m)} views anywhere, of the later date, and {len(counts.mirrored)} "
        "mirrored; "
        f"standard deviations of the reported heading, {errors['yaw_std_deg']:g} deg, the height, "
        f"{errors['agl_std']:.0%}, and the prior, {errors['prior_std_px']:g} px",
        "views in %; accepted at no wrong: of those correct within 35 m or 10 px, the "
        "largest fraction that one threshold over all scenes accepts without a wrong one; every "
        "answer to a mirrored view is wrong; evidence: inliers, Lowe's ratio, or the confidence",
        *confident,
        "CPU s, peak MB: the largest of the scenes' medians and peaks, one core; carried: "
        "keypoints (descriptors in 16 bits) or maps with their encoders, all scenes",
        "by scene: within 15 m / within 35 m or 10 px",
    )
    return [Table("The field today", header, [*lines, guess], notes)]


def _line(rows: Sequence[Result], name: str, label: str) -> list[str]:
    placed = Placed.of(rows, name)
    parts = [each.plain[FIELD][name] for each in rows if name in each.plain[FIELD]]
    cells = [
        label,
        percent(placed.within()),
        percent(float(placed.right.mean())),
        percent(placed.trusted()),
        number(placed.median_m()),
        number(max(part["cpu_s"] for part in parts)),
        number(max(part["peak_mb"] for part in parts)),
        number(sum(part["carried_mb"] for part in parts)),
    ]
    for each in (Placed.of([row], name) for row in rows):
        shares = (each.within(), float(each.right.mean())) if each.error_m.size else ()
        cells.append("/".join(map(percent, shares)) or "-")
    return cells
