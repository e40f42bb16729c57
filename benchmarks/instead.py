"""Alternatives to the track: other methods, view by view on the same core.

`python -m benchmarks.instead JSON` places the views of a flight by one method, in a process that
loads nothing else, and prints JSON.
"""

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from benchmarks.flights import FlownView
    from benchmarks.inputs import Workplace
    from benchmarks.record import Section, Table
    from orthonav.core.geo.frames import LocalFrame

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
TRACK, SIFT, ORB, ENCODER = "track", "sift", "orb", "encoder"
NEAR_M = 300.0
TILE_PX, DIMS, WARM_UP = 256, 1024, 3
OPENCV = ("opencv-python-headless", "numpy")
Placer = Callable[["FlownView"], Any]


@dataclass(frozen=True)
class Task:
    """Views and method of one run.

    - `name`: name in the table.
    - `method`: name of the method.
    - `needs`: packages that the method needs, with their requirements.
    - `near_m`: search radius around the true place, m; None: the whole map.
    - `map_path`, `flight`: map file and flight folder.
    - `pixels`: orthophoto in the map's raster.
    - `views`: largest number of views.
    - `every`: step between views of the lap.
    """

    name: str
    method: str
    needs: tuple[str, ...]
    near_m: float | None = None
    map_path: str = ""
    pixels: str = ""
    flight: str = ""
    views: int = 0
    every: int = 1


TASKS = (
    Task("orthonav, tracked", TRACK, ("orthonav[autopilot]",)),
    Task(f"SIFT, {NEAR_M:.0f} m around the true place", SIFT, OPENCV, NEAR_M),
    Task("SIFT, whole map", SIFT, OPENCV),
    Task(f"ORB, {NEAR_M:.0f} m around the true place", ORB, OPENCV, NEAR_M),
    Task("ORB, whole map", ORB, OPENCV),
    Task("auto-encoder of the paper, PyTorch", ENCODER, ("torch", *OPENCV)),
)


def beside(
    section: "Section", place: "Workplace", past: Path, map_path: Path, lap: Path, core: int
) -> "Table":
    """All methods on views of the same lap, each in a process of its own on one core."""
    import numpy as np

    from benchmarks.inputs import FLIGHT_SEED
    from benchmarks.install import installed_mb
    from benchmarks.pair import on_core
    from benchmarks.record import Table, number
    from benchmarks.side_by_side import stored
    from benchmarks.verdicts import percent

    pixels = stored(past, map_path, place.scratch)
    views = 30 if place.quick else 300
    rows, tiles = [], 0
    for each in TASKS:
        task = replace(each, map_path=str(map_path), pixels=str(pixels), flight=str(lap))
        count = views if task.method == TRACK else max(views // 3, 20)
        with on_core(core):
            result = _placed(replace(task, views=count, every=2 if task.method == TRACK else 6))
        errors_m = np.array([math.nan if e is None else e for e in result["errors_m"]])
        time = section.add(f"{task.name}: a view", "ms", result["ms"], data="lap", seed=FLIGHT_SEED)
        section.add(f"{task.name}: peak memory", "MB", [result["peak_mb"]], data="lap")
        size_mb = installed_mb(task.needs)
        section.add(f"{task.name}: installed", "MB", [size_mb], data="site-packages")
        places = ["-", "-", "-"]
        if task.method != ENCODER:
            shares = [(errors_m <= radius_m).mean() for radius_m in (15.0, 35.0)]
            places = [percent(float(share)) for share in (*shares, np.isnan(errors_m).mean())]
        tail = number(float(np.percentile(result["ms"], 99)))
        memory = [number(result["peak_mb"]), number(size_mb)]
        rows.append([task.name, str(len(errors_m)), number(time.median), tail, *places, *memory])
        tiles = result["tiles"] or tiles
        print(f"        {task.name} done", file=sys.stderr, flush=True)
    header: tuple[str, ...] = ("method", "views", "ms", "p99 ms", "15 m", "35 m", "no answer")
    header += ("peak MB", "installed MB")
    return Table("Alternatives to the track", header, rows, _notes(tiles))


def _notes(tiles: int) -> tuple[str, ...]:
    return (
        "ms: from the decoded picture to a place, one core, warm; tracked: `Tracker` on views "
        "that follow each other at 5 Hz, shares once it is tracking; the others: each view for "
        "itself, rectified by orthonav's code under the reported heading, height and tilt",
        "SIFT, ORB: keypoints of the map (1 m) made once; whole map: FLANN; around the true place "
        "(as if it were known): one by one; ratio 0.75, RANSAC similarity, fewer than 8 inliers "
        "are no answer",
        f"auto-encoder: Canny edges of a {TILE_PX} px tile, the encoder of 1024 numbers, scalar "
        f"products with {tiles:,} tiles, one heading; weights are random, for its time does not "
        "hang on them, so it has no places",
        "peak MB: resident memory of the process while it places views, not while it prepares; "
        "installed: what pip puts into site-packages, with all it needs, here (PyTorch: the CPU "
        "build where that is installed)",
    )


def _placed(task: Task) -> dict[str, Any]:
    command = [sys.executable, "-m", "benchmarks.instead", json.dumps(asdict(task))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def run(task: Task) -> dict[str, Any]:
    """Milliseconds and errors (m, None without an answer) of the views, and the peak memory."""
    import time
    from itertools import islice

    import cv2

    from benchmarks.child import peak_memory_mb
    from benchmarks.flights import FlownView
    from orthonav.core.flight import open_flight, read_truth
    from orthonav.core.mapfile import open_map
    from orthonav.core.records import View

    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
    flight, truth = open_flight(Path(task.flight)), read_truth(Path(task.flight) / "truth.csv")
    frame = open_map(Path(task.map_path)).manifest.sheets[0].frame
    place, tiles = _method(task, frame)
    Path("/proc/self/clear_refs").write_text("5")  # the peak is counted from here
    errors_m: list[float | None] = []
    times_ms: list[float] = []
    for number, one in enumerate(islice(flight.views, 0, task.views * task.every, task.every)):
        flown = FlownView(
            one.path, View(one.grey(), flight.camera, one.telemetry), truth[one.frame]
        )
        start = time.perf_counter()
        found = place(flown)
        took_ms = 1e3 * (time.perf_counter() - start)
        if number < WARM_UP or found is SEARCHING:
            continue
        there = frame.en_from_latlon(*flown.truth_latlon_deg)
        errors_m.append(None if found is None else math.hypot(*(found - there).tolist()))
        times_ms.append(took_ms)
    return {"ms": times_ms, "errors_m": errors_m, "peak_mb": peak_memory_mb(), "tiles": tiles}


SEARCHING = object()
"""What a track answers before it has found a place."""


def _method(task: Task, frame: "LocalFrame") -> tuple[Placer, int]:
    """What places a view, and the number of tiles where it compares tiles."""
    if task.method == TRACK:
        return _track(task, frame), 0
    if task.method == ENCODER:
        return _encoder(task)
    from benchmarks import posed

    picture = posed.Picture.read(Path(task.map_path), Path(task.pixels), 1)
    keypoints = posed.Keypoints(picture, orb=task.method == ORB, near_m=task.near_m)

    def place(flown: "FlownView") -> Any:
        near = frame.en_from_latlon(*flown.truth_latlon_deg) if task.near_m else None
        return keypoints.locate(flown.view, True, near)

    return place, 0


def _track(task: Task, frame: "LocalFrame") -> Placer:
    from orthonav.core.localize import Localizer
    from orthonav.core.mapfile import open_map
    from orthonav.core.records import Fix
    from orthonav.core.track.tracker import Tracker

    tracker = Tracker(Localizer(open_map(Path(task.map_path))))

    def place(flown: "FlownView") -> Any:
        found = tracker.locate(flown.view)
        if tracker.state_name != "tracking":
            return SEARCHING
        return (
            frame.en_from_latlon(found.lat_deg, found.lon_deg) if isinstance(found, Fix) else None
        )

    return place


def _encoder(task: Task) -> tuple[Placer, int]:
    import numpy as np
    import torch

    from orthonav.core.localize.rectify import downsampled, rectify
    from orthonav.core.mapfile import open_map
    from orthonav.core.tiles.represent import Canny
    from orthonav.research.autoencoder import AutoEncoder

    torch.set_num_threads(1)
    torch.manual_seed(0)
    encoder = AutoEncoder(tile_px=TILE_PX, dims=DIMS).encoder.eval()
    sheet = open_map(Path(task.map_path)).manifest.sheets[0]
    gsd_m = sheet.grid.gsd_m
    rng = np.random.default_rng(0)
    embeddings = rng.standard_normal((sheet.tiles, DIMS), dtype=np.float32)
    edges_of = Canny()

    def place(flown: "FlownView") -> Any:
        seen = rectify(downsampled(flown.view, gsd_m), gsd_m=gsd_m, size_px=TILE_PX)
        edges = edges_of(seen.grey, seen.valid)[:1].astype(np.float32)
        with torch.inference_mode():
            made = encoder(torch.from_numpy(edges[None])).numpy()[0]
        int((embeddings @ made).argmax())

    return place, sheet.tiles


if __name__ == "__main__":
    for name in THREADS:
        os.environ[name] = "1"
    values = json.loads(sys.argv[1])
    print(json.dumps(run(Task(**{**values, "needs": tuple(values["needs"])}))))
