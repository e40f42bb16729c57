"""One method on one trajectory: build the map, locate the views, write the results.

Everything the tables need is in the file that a run leaves; a run that has its file is not run
again. Baselines are the paper's related work: methods that carry the reference images on board.
"""

import hashlib
import json
import logging
import math
import re
import resource
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from benchmarks.record import provenance
from numpy.typing import NDArray

from experiments.paper import scenes as views
from experiments.paper.methods import DEFAULT, STUDIED, TILE_PX, Method, Setting
from experiments.paper.posed import (
    Highest,
    Keypoints,
    MutualSurface,
    Picture,
    TemplateSurface,
    store,
)
from experiments.paper.results import ACCURACY_M, BASELINES, compact
from experiments.paper.scenes import Scene
from orthonav.core.cores import usable_cores
from orthonav.core.files import write_text
from orthonav.core.localize import Localizer
from orthonav.core.localize.tiles import TileMatcher
from orthonav.core.localize.view import downsampled
from orthonav.core.mapfile import MapFile, open_map
from orthonav.core.records import Fix, View
from orthonav.core.tiles.position import RULES
from orthonav.ground.build import BuildRequest, build_map

HEADINGS_DEG = (0, 1, 2, 3, 5, 7, 10, 15)
DROPS_M = (0, 25, 50, 75, 100, 150, 200)
EVIDENCE = ("score", "lowe_ratio", "peak_ratio")
"""Written of every view behind its error, then its confidence."""
MB = 1e6


@dataclass(frozen=True)
class Workplace:
    """Folders of results, maps and generated areas, and the options of the run.

    `device`, `workers`: as of `BuildRequest`. `keep_checkpoints`: also when a row is done, so that
    epochs can be added.
    """

    out: Path
    setting: Setting
    command: str
    device: str = "auto"
    workers: int | None = None
    keep_checkpoints: bool = False

    @property
    def results(self) -> Path:
        return self.out / self.setting.folder

    def result(self, scene: Scene, key: str) -> Path:
        """The file that a run leaves."""
        return self.results / f"{scene.name}-{key}.json"

    def work(self, scene: Scene, key: str) -> Path:
        """Folder of checkpoints, and of the map."""
        return self.out / "work" / self.setting.folder / f"{scene.name}-{key}"


Task = tuple[Workplace, Scene, Method]
Grounds = dict[str, list[views.Ground]]
"""Ground of the views, by placement."""


def run(place: Workplace, scene: Scene, method: Method) -> dict[str, Any]:
    """Result of a run, after building, locating and writing; one of the same recipe is reused."""
    out = place.result(scene, method.key)
    if out.is_file():
        found: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
        if found["method"]["recipe"] == method.recipe:
            return found
    start, cpu_s, before = time.perf_counter(), time.process_time(), provenance("paper")
    work = place.work(scene, method.training)
    opened, built = _map(place, scene, method, work)
    localizer = Localizer(
        opened,
        registration=method.registration,
        position="peak" if method.registration else "best",
        flying=False,
    )
    made = head(place, scene, before)
    # Where weights lie is no part of a result.
    edges = re.sub("[:,]weights=[^,]*", "", method.edges)
    made |= {"method": asdict(method) | {"edges": edges}, **built, **_sizes(opened)}
    seen = placements(scene, localizer, place.setting.views)
    made |= _placed(scene, localizer, seen, method.registration, place.setting.swept)
    ruled = not (method.registration or method.curve)
    made["rules"] = _rules(scene, localizer, seen) if ruled else {}
    history = work / "history.json"
    if history.is_file():
        made["loss"] = json.loads(history.read_text(encoding="utf-8"))["loss"]
    made["cpu_minutes"] = round((time.process_time() - cpu_s) / 60, 2)
    made["peak_mb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / MB)
    written = save(out, made, start)
    if not place.keep_checkpoints:
        (work / "checkpoint.pt").unlink(missing_ok=True)
    return written


def side_by_side(tasks: Sequence[Task], jobs: int) -> Iterator[tuple[Task, float | Exception]]:
    """Each task with its minutes or what went wrong with it, as they end.

    Raises `BrokenProcessPool` where a process died: memory has run out, or somebody ended it.
    """
    spawn = get_context("spawn")  # a process a task: the peak of its memory is the task's
    with ProcessPoolExecutor(jobs, spawn, _prepare, (jobs,), max_tasks_per_child=1) as pool:
        waiting = {pool.submit(run, *task): task for task in tasks}
        try:
            for done in as_completed(waiting):
                error = done.exception()
                if isinstance(error, BrokenProcessPool) or not isinstance(error, Exception | None):
                    raise error
                yield waiting[done], done.result()["minutes"] if error is None else error
        except BaseException:  # interrupted: hours of work are not waited for, checkpoints stay
            pool.shutdown(wait=False, cancel_futures=True)
            for process in active_children():
                process.terminate()
            raise


def _prepare(jobs: int) -> None:
    """Give a process its part of the cores; training says epoch, loss and time left."""
    logging.basicConfig(level=logging.ERROR, format="%(levelname)s: %(message)s")
    logging.getLogger("orthonav.ground.build.encoders").setLevel(logging.INFO)
    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
    try:
        import torch
    except ImportError:
        return
    torch.set_num_threads(max(1, usable_cores() // jobs))


def head(place: Workplace, scene: Scene, started: dict[str, Any]) -> dict[str, Any]:
    """Header of a result file: imagery and settings of the run."""
    return {
        "scene": scene.name,
        "trajectory": asdict(scene.trajectory),
        "setting": asdict(place.setting),
        "command": place.command,
        "seeds": {"views": views.VIEW_SEED, "build": 0},
        "inputs": {path.name: _digest(path) for path in scene.imagery},
        "provenance": started,
    }


def save(out: Path, made: dict[str, Any], start: float) -> dict[str, Any]:
    """The result as written, whole or not at all, with the minutes since `start`."""
    made["minutes"] = round((time.perf_counter() - start) / 60, 2)
    out.parent.mkdir(parents=True, exist_ok=True)
    text = compact(made)
    write_text(out, text)
    written: dict[str, Any] = json.loads(text)
    return written


def _map(
    place: Workplace, scene: Scene, method: Method, work: Path
) -> tuple[MapFile, dict[str, float]]:
    """The map by `build_map`, and the seconds it took; `learn_s` includes embedding the tiles."""
    work.mkdir(parents=True, exist_ok=True)
    marks: dict[float, float] = {}

    def progress(stage: str, share: float) -> None:
        if stage == "learn" and share in (0.0, 1.0):
            marks[share] = time.perf_counter()

    def request(out: Path) -> BuildRequest:
        return BuildRequest(
            [scene.past],
            out,
            **scene.area(),
            gsd_m=scene.trajectory.gsd_m,
            tile_px=TILE_PX,
            overlap=scene.trajectory.overlap,
            method=method.recipe,
            edges=method.edges,
            registration=method.registration,
            other_dates=scene.others if method.family == "triplet" else (),
            work=work,
            workers=place.workers,
            device=place.device,
        )

    start = time.perf_counter()
    build_map(request(work / "map.onav"), progress)
    build_s = time.perf_counter() - start
    opened = open_map(work / "map.onav")
    return opened, {"build_s": build_s, "learn_s": marks[1.0] - marks[0.0]}


def geometry(place: Workplace, scene: Scene) -> Localizer:
    """Frame, grid and tiles of a scene: its map by gradients, built if it is not there."""
    work = place.work(scene, MAP_OF)
    if not (work / "map.onav").is_file():
        _map(place, scene, Method(DEFAULT, DEFAULT, DEFAULT), work)
    return Localizer(open_map(work / "map.onav"), registration=False)


def _sizes(opened: MapFile) -> dict[str, float]:
    """Megabytes of the map per km2, and of what it holds once: the encoder or vocabulary."""
    sheet = opened.manifest.sheets[0]
    embeddings = opened.array("sheet0/embeddings", np.float16, 2)
    area_km2 = len(embeddings) * sheet.grid.stride_m**2 / 1e6
    once = sum(part.nbytes for name, part in opened.arrays.items() if name.startswith("embed/"))
    whole = opened.path.stat().st_size
    return {
        "tiles": len(embeddings),
        "dims": embeddings.shape[1],
        "area_km2": area_km2,
        "encoder_mb": once / MB,
        "mb_per_km2": (whole - once) / MB / area_km2,
    }


def _placed(
    scene: Scene, localizer: Localizer, seen: Grounds, registration: bool, swept: int
) -> dict[str, Any]:
    """Errors and evidence of the views of all placements, the sweep, chance, and times."""
    grid, frame = localizer.grid, localizer.sheet.frame
    agl_m, gsd_m = scene.trajectory.agl_m, grid.gsd_m
    camera = views.camera_of(agl_m, gsd_m)
    telemetry = views.telemetry_at(agl_m, exact=not registration)
    times_ms: list[float] = []

    def locate(ground: views.Ground, **wrong: float) -> list[float]:
        grey = views.view_of(ground, agl_m, gsd_m, **wrong)
        start = time.perf_counter()
        found = localizer.locate(View(grey, camera, telemetry))
        times_ms.append(1e3 * (time.perf_counter() - start))
        if not isinstance(found, Fix):
            return [math.nan] * (2 + len(EVIDENCE))
        error = frame.en_from_latlon(found.lat_deg, found.lon_deg) - ground.truth_en_m
        evidence = [float(found.evidence.get(name, math.nan)) for name in EVIDENCE]
        return [float(np.hypot(*error)), *evidence, found.confidence]

    result: dict[str, Any] = {"views": {}, "chance": {}, "sweep": {}}
    for name, grounds in seen.items():
        result["views"][name] = [locate(ground) for ground in grounds]
        result["chance"][name] = _chance(grounds, localizer.tiles.centres_en_m)
    if not times_ms:
        raise ValueError(f"no view of {scene.name} lies wholly on the imagery of the later date")
    result["view_ms"] = statistics.median(times_ms)
    if scene.name == STUDIED and swept and seen["grid"]:
        count = min(swept, len(seen["grid"]))
        few = [seen["grid"][at] for at in np.linspace(0, len(seen["grid"]) - 1, count, dtype=int)]
        turned = {v: _hits(locate(each, turned_deg=v)[0] for each in few) for v in HEADINGS_DEG}
        lower = {v: _hits(locate(each, drop_m=v)[0] for each in few) for v in DROPS_M}
        result["sweep"] = {"heading_deg": turned, "drop_m": lower}
    return result


def placements(scene: Scene, localizer: Localizer, count: int) -> Grounds:
    """Views along the route, on the grid and anywhere.

    The last two are at the same places but for where they are snapped to.
    """
    centres = localizer.tiles.centres_en_m
    anywhere = views.places_en_m(centres, count)
    places = {
        "route": views.along_route(centres, views.most_views(scene.name)),
        "grid": views.on_grid(anywhere, centres),
        "anywhere": anywhere,
    }
    return {name: views.grounds(scene, localizer, places[name]) for name in views.PLACEMENTS}


def _chance(grounds: list[views.Ground], centres_en_m: NDArray[np.float32]) -> float:
    """Share of tiles within the radius of a view, the mean over views: what a random tile gets."""
    away_m = (np.hypot(*(centres_en_m - ground.truth_en_m).T) for ground in grounds)
    shares = [(each <= ACCURACY_M).mean() for each in away_m]
    return float(np.mean(shares)) if shares else math.nan


def _rules(scene: Scene, localizer: Localizer, seen: Grounds) -> dict[str, Any]:
    """Views within 15 m by each rule of position, with scalar product and cosine.

    "We use the position of the reference embedding leading to the highest scalar product, as we
    observed that (in our setting) it yields better results than the weighted average" (section
    Methodology).
    """
    placer, gsd_m, agl_m = localizer.tiles, localizer.grid.gsd_m, scene.trajectory.agl_m
    camera, telemetry = views.camera_of(agl_m, gsd_m), views.telemetry_at(agl_m)
    tiles, centres = localizer.opened.array("sheet0/embeddings", np.float16, 2), placer.centres_en_m
    made: dict[str, Any] = {}
    for name in ("grid", "anywhere"):
        queries = []
        for ground in seen[name]:
            view = View(views.view_of(ground, agl_m, gsd_m), camera, telemetry)
            rectified = placer.rectified(downsampled(view, gsd_m), telemetry.yaw_deg)
            queries.append(placer.embedded([rectified]))
        for similarity in ("product", "cosine"):
            cosine = similarity == "cosine"
            scaled = _unit(tiles).astype(np.float16) if cosine else tiles
            for rule in RULES:
                matcher, errors = TileMatcher(localizer.grid, centres, scaled, rule), []
                for query, ground in zip(queries, seen[name], strict=True):
                    match = matcher.match(_unit(query) if cosine else query)
                    found = centres[match.tile].astype(np.float64) + match.shift_en_m
                    errors.append(float(np.hypot(*(found - ground.truth_en_m))))
                made.setdefault(name, {})[f"{similarity} {rule}"] = _hits(errors)
    return made


def _unit(vectors: NDArray[Any]) -> NDArray[np.float32]:
    values = np.asarray(vectors, dtype=np.float32)
    norms = np.linalg.norm(values, axis=1, keepdims=True)
    return np.asarray(values / np.maximum(norms, 1e-12), dtype=np.float32)


def _hits(errors_m: Iterable[float]) -> list[int]:
    """Number of errors within 15 m, and of all."""
    within = [error <= ACCURACY_M for error in errors_m]
    return [sum(within), len(within)]


def _digest(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


MAP_OF = "gradient-gradient"
"""The baselines get the plane and pixels of this run's map."""
COARSER = 2
"""Mutual information is taken on pixels of so many of the map's, averaged: it is slow."""
BASELINE_VIEWS = 50


@dataclass(frozen=True)
class Baseline:
    """A method on the map's picture; `sobel` gives it edges instead of grey levels."""

    name: str
    make: Callable[[Picture], Any]
    factor: int = 1
    sobel: bool = False


def _reported_pose(surface: Callable[[Picture], Any]) -> Callable[[Picture], Any]:
    return lambda picture: Highest(picture, surface(picture))


def _matched(edges: bool) -> Callable[[Picture], Any]:
    return _reported_pose(lambda picture: TemplateSurface(picture, edges))


RELATED_WORK = (
    Baseline("mutual information (Patel et al.)", _reported_pose(MutualSurface), COARSER),
    Baseline("Sobel edges matched (Conte and Doherty)", _matched(edges=False), sobel=True),
    Baseline("Canny edges matched", _matched(edges=True)),
    Baseline("grey levels matched", _matched(edges=False)),
    Baseline("SIFT, ratio test, RANSAC", Keypoints),
)


def run_baselines(place: Workplace, scene: Scene) -> bool:
    """Place views by every baseline; false where an earlier run has its file or there is no map."""
    out, map_path = place.result(scene, BASELINES), place.work(scene, MAP_OF) / "map.onav"
    if out.is_file() or not map_path.is_file():
        return False
    start, made = time.perf_counter(), head(place, scene, provenance("paper"))
    localizer = Localizer(open_map(map_path), registration=False)
    pixels_path = place.work(scene, BASELINES).with_suffix(".npz")
    store(scene.past, localizer, pixels_path)
    seen = placements(scene, localizer, min(BASELINE_VIEWS, place.setting.views))
    made[BASELINES] = {
        each.name: _placed_by(each, Picture.read(map_path, pixels_path, each.factor), scene, seen)
        for each in RELATED_WORK
    }
    save(out, made, start)
    return True


def _placed_by(baseline: Baseline, picture: Picture, scene: Scene, seen: Grounds) -> dict[str, Any]:
    agl_m, gsd_m = scene.trajectory.agl_m, picture.grid.gsd_m
    camera, telemetry = views.camera_of(agl_m, gsd_m), views.telemetry_at(agl_m)
    if baseline.sobel:
        picture = replace(picture, grey=sobel(picture.grey))
    method, times_ms = baseline.make(picture), []

    def error_m(ground: views.Ground) -> float:
        grey = views.view_of(ground, agl_m, gsd_m)
        start = time.perf_counter()
        grey = sobel(grey) if baseline.sobel else grey
        found = method.locate(View(grey, camera, telemetry))
        times_ms.append(1e3 * (time.perf_counter() - start))
        return math.inf if found is None else float(np.hypot(*(found - ground.truth_en_m)))

    hits = {name: _hits(map(error_m, seen[name])) for name in ("grid", "anywhere")}
    return {"views": hits, "view_ms": float(np.median(times_ms))}


def sobel(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Magnitude of the Sobel gradient (H, W), a quarter of it: it fits into bytes."""
    east = cv2.Sobel(grey, cv2.CV_32F, 1, 0)
    south = cv2.Sobel(grey, cv2.CV_32F, 0, 1)
    return np.asarray(np.clip(cv2.magnitude(east, south) / 4, 0, 255), dtype=np.uint8)
