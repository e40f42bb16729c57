"""One method on one trajectory: build the map, locate the views, write the results.

Everything the tables and plots need is in the file that a run leaves; a run that has its file is
not run again.
"""

import hashlib
import json
import re
import statistics
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.record import provenance
from numpy.typing import NDArray

from experiments.paper import published, views
from experiments.paper.methods import Method
from experiments.paper.results import ACCURACY_M, compact
from experiments.paper.rules import compared
from experiments.paper.scenes import Scene
from experiments.paper.trajectories import TILE_PX, Setting
from orthonav.core.files import write_text
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import MapFile, open_map
from orthonav.core.records import Fix, View
from orthonav.ground.build import BuildRequest, build_map

SWEPT_ON = "B"
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
        """Folder of the result files."""
        return self.out / self.setting.folder

    def result(self, scene: Scene, key: str) -> Path:
        """The file that a run leaves."""
        return self.results / f"{scene.name}-{key}.json"

    def work(self, scene: Scene, key: str) -> Path:
        """Folder of checkpoints, and of the map."""
        return self.out / "work" / self.setting.folder / f"{scene.name}-{key}"


def run(place: Workplace, scene: Scene, method: Method) -> dict[str, Any]:
    """Result of a run, after building, locating and writing; one of the same recipe is reused."""
    out = place.result(scene, method.key)
    if out.is_file():
        found: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
        if found["method"]["recipe"] == method.recipe:
            return found
    start, cpu_s, before = time.perf_counter(), time.process_time(), provenance("paper")
    work = place.work(scene, method.key)
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
    made |= _placed(scene, localizer, place.setting, method.registration)
    made["rules"] = {} if method.registration else _rules(scene, opened, place.setting)
    made["cpu_minutes"] = round((time.process_time() - cpu_s) / 60, 2)
    written = save(out, made, start)
    if not place.keep_checkpoints:
        (work / "checkpoint.pt").unlink(missing_ok=True)
    return written


def head(place: Workplace, scene: Scene, started: dict[str, Any]) -> dict[str, Any]:
    """Header of a result file: method, imagery and settings of the run."""
    return {
        "scene": scene.name,
        "trajectory": asdict(scene.trajectory),
        "setting": asdict(place.setting),
        "command": place.command,
        "seeds": {"views": views.SEED, "build": 0},
        "inputs": {path.name: _digest(path) for path in _imagery(scene)},
        "provenance": started,
    }


def _imagery(scene: Scene) -> tuple[Path, ...]:
    return scene.past, scene.present, *scene.others


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
    scene: Scene, localizer: Localizer, setting: Setting, registration: bool
) -> dict[str, Any]:
    """Errors and evidence of the views of both placements, the sweep, chance, and times."""
    grid, frame = localizer.grid, localizer.sheet.frame
    agl_m, gsd_m = scene.trajectory.agl_m, grid.gsd_m
    camera = views.camera_of(agl_m, gsd_m)
    telemetry = views.telemetry_at(agl_m, exact=not registration)
    times_ms: list[float] = []

    def locate(ground: views.Ground, **wrong: float) -> list[float]:
        grey = views.view_of(ground, camera, agl_m, gsd_m, **wrong)
        start = time.perf_counter()
        found = localizer.locate(View(grey, camera, telemetry))
        times_ms.append(1e3 * (time.perf_counter() - start))
        if not isinstance(found, Fix):
            return [float("nan")] * (2 + len(EVIDENCE))
        error = frame.en_from_latlon(found.lat_deg, found.lon_deg) - ground.truth_en_m
        evidence = [float(found.evidence.get(name, float("nan"))) for name in EVIDENCE]
        return [float(np.hypot(*error)), *evidence, found.confidence]

    result: dict[str, Any] = {"views": {}, "chance": {}, "sweep": {}}
    seen = dict(placements(scene, localizer, setting.views))
    for name, grounds in seen.items():
        result["views"][name] = [locate(ground) for ground in grounds]
        result["chance"][name] = _chance(grounds, localizer.tiles.centres_en_m)
    if not times_ms:
        raise ValueError(f"no view of {scene.name} lies wholly on the imagery of the later date")
    result["view_ms"] = statistics.median(times_ms)
    if scene.name == SWEPT_ON and seen["grid"]:
        count = min(setting.swept, len(seen["grid"]))
        few = [seen["grid"][at] for at in np.linspace(0, len(seen["grid"]) - 1, count, dtype=int)]
        turned = {v: _hits(locate(each, turned_deg=v)[0] for each in few) for v in HEADINGS_DEG}
        lower = {v: _hits(locate(each, drop_m=v)[0] for each in few) for v in DROPS_M}
        result["sweep"] = {"heading_deg": turned, "drop_m": lower}
    return result


def placements(
    scene: Scene, localizer: Localizer, count: int
) -> Iterator[tuple[str, list[views.Ground]]]:
    """Views along the route, on the grid and anywhere.

    The last two are at the same places but for where they are snapped to.
    """
    centres = localizer.tiles.centres_en_m
    anywhere = views.places_en_m(centres, count)
    places = {
        "route": views.along_route(centres, published.views(scene.name)),
        "grid": views.on_grid(anywhere, centres),
        "anywhere": anywhere,
    }
    for name in views.PLACEMENTS:
        yield name, views.grounds(scene, localizer.sheet.frame, localizer.grid, places[name])


def _chance(grounds: list[views.Ground], centres_en_m: NDArray[np.float32]) -> float:
    """Share of tiles within the radius of a view, the mean over views: what a guess gets."""
    if not grounds:
        return float("nan")
    shares = [
        (np.hypot(*(centres_en_m - ground.truth_en_m).T) <= ACCURACY_M).mean() for ground in grounds
    ]
    return float(np.mean(shares))


def _rules(scene: Scene, opened: MapFile, setting: Setting) -> dict[str, Any]:
    """Positions by each rule, with scalar product and cosine, on the same embeddings."""
    localizer = Localizer(opened, registration=False, flying=False)
    agl_m, gsd_m = scene.trajectory.agl_m, localizer.grid.gsd_m
    camera, telemetry = views.camera_of(agl_m, gsd_m), views.telemetry_at(agl_m)
    made: dict[str, Any] = {}
    for name, grounds in placements(scene, localizer, setting.views):
        if name == "route":
            continue
        seen = [
            View(views.view_of(ground, camera, agl_m, gsd_m), camera, telemetry)
            for ground in grounds
        ]
        truths = [ground.truth_en_m for ground in grounds]
        errors = compared(localizer, opened, seen, truths)
        made[name] = {rule: _hits(errors_m) for rule, errors_m in errors.items()}
    return made


def _hits(errors_m: Iterable[float]) -> list[int]:
    """Number of errors within 15 m, and of all."""
    within = [error <= ACCURACY_M for error in errors_m]
    return [sum(within), len(within)]


def _digest(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
