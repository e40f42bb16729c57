"""How views of another date are placed, and negatives refused, on optional real imagery.

`python -m benchmarks.real_imagery [--views 200] [--negatives 2000] [--seed 1] [--only NAME ..]
[--out FILE.md]` builds maps as `orthonav build` does, flies over other dates at random places, or
replays recorded flights, and prints Markdown tables. Looked for in `../shared/data` beside the
checkout or in the folder that ORTHONAV_DATA names; absent imagery is left out with a line that
says so. Maps and flights go into a temporary folder.
"""

import argparse
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np

from benchmarks.inputs import DATA
from benchmarks.negatives import SHARES, Sources, negatives
from benchmarks.placing import row_of
from benchmarks.record import Table, number, provenance
from benchmarks.verdicts import FAR_M, Verdict, percent
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import CONFIDENT, Fix, Telemetry, View
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.simulate.flight import DEFAULT_CAMERA, Errors, SimulateRequest, simulate_flight
from orthonav.onboard.run import SingleViews, localize_flight, locate_view

NAIP_MAP = "naip_nd/20090818.tif"
NAIP_VIEWS = ("naip_nd/20120731.tif", "naip_nd/20150926.tif", "naip_nd/20180716.tif")
SZADA = ("szada_1", "szada_5", "szada_7", "szada_mosaic")
GROUPS = ("naip", "airchange", "taichung", "arroio", "negatives")
HEADER = (
    *("map", "views", "n", "near", "35 m", "median m", f"correct and accepted at {CONFIDENT:g}"),
    *("wrong accepted", "ECE", "NEES", "ms", "p99 ms"),
)


@dataclass(frozen=True)
class Scene:
    """A map and what flies over it: an orthophoto or a recorded flight, under `DATA`."""

    group: str
    map: str
    views: str
    near_m: float
    heading_known: bool = True


def scenes() -> list[Scene]:
    """All scenes, those of one map together."""
    made = [
        Scene("naip", NAIP_MAP, views, 15, known) for known in (True, False) for views in NAIP_VIEWS
    ]
    made += [
        Scene("airchange", f"airchange/{name}_a.tif", f"airchange/{name}_b.tif", 15)
        for name in SZADA
    ]
    made.append(Scene("taichung", "taichung_drone/map.tif", "taichung_drone", 35))
    made += [
        Scene("arroio", f"arroio_maps/{month}.tif", "arroio_drone_1", 25)
        for month in ("2014-01", "2014-03")
    ]
    return made


@dataclass(frozen=True)
class Bench:
    """Folders of maps and flights of this run, and its options."""

    folder: Path
    options: argparse.Namespace

    def localizer(self, ortho: str) -> Localizer:
        """On a map with the defaults of `orthonav build`, built once."""
        path = self.folder / (ortho.replace("/", "-") + ".onav")
        if not path.is_file():
            build_map(BuildRequest([DATA / ortho], path))
        return Localizer(open_map(path))

    def flight(self, views: str) -> Path:
        """A recorded flight as it is, or one over an orthophoto, flown once."""
        if not views.endswith(".tif"):
            return DATA / views
        folder = self.folder / (views.replace("/", "-") + ".flight")
        if not folder.is_dir():
            errors = Errors(
                yaw_std_deg=self.options.yaw_std_deg,
                agl_std=self.options.agl_std,
                mount_std_deg=1.0,
                horizon_std_deg=1.0,
            )
            simulate_flight(
                SimulateRequest(
                    [DATA / views],
                    folder,
                    random=self.options.views,
                    errors=errors,
                    seed=self.options.seed,
                )
            )
        return folder


def main() -> None:
    """Run the chosen scenes and print their tables."""
    options = _parser().parse_args()
    cv2.setNumThreads(1)
    about = provenance("real imagery")
    tables = []
    with tempfile.TemporaryDirectory(prefix="orthonav-real-") as folder:
        bench = Bench(Path(folder), options)
        rows = [_row(scene, _verdict(bench, scene)) for scene in _wanted(options)]
        if rows:
            tables.append(
                Table("Views of another date, real imagery", HEADER, rows, _notes(options))
            )
        if "negatives" in (options.only or GROUPS) and _there(NAIP_MAP, *_negative_files()):
            tables.append(_refusals(bench))
    load = " ".join(f"{value:.2f}" for value in os.getloadavg())
    head = f"commit {about['commit'][:10]}, sources {about['sources']}, {about['cpu']}, load {load}"
    text = "\n".join([head, "", *(table.markdown() for table in tables)])
    print("\n" + text)
    if options.out:
        options.out.write_text(text + "\n", encoding="utf-8")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.real_imagery", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--views", type=int, default=200, help="views per simulated flight")
    parser.add_argument("--negatives", type=int, default=2000, help="views that must be refused")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=GROUPS, help="only these")
    parser.add_argument("--yaw-std-deg", type=float, default=10.0)
    parser.add_argument("--agl-std", type=float, default=0.1)
    parser.add_argument("--out", type=Path, help="Markdown file to write too")
    return parser


def _wanted(options: argparse.Namespace) -> Iterator[Scene]:
    for scene in scenes():
        if scene.group in (options.only or GROUPS) and _there(scene.map, scene.views):
            yield scene


def _there(*names: str) -> bool:
    missing = [name for name in names if not (DATA / name).exists()]
    for name in missing:
        print(f"not there, left out: {DATA / name}")
    return not missing


def _verdict(bench: Bench, scene: Scene) -> Verdict:
    localizer, folder = bench.localizer(scene.map), bench.flight(scene.views)
    truth, frame = read_truth(folder / "truth.csv"), localizer.sheet.frame
    flight = open_flight(folder)
    warm = flight.views[:1]  # the first view prepares the map: it is placed twice
    placed = localize_flight(
        SingleViews(localizer, use_prior=False, heading_known=scene.heading_known),
        flight,
        views=[*warm, *flight.views],
    )
    rows = [
        [*row_of(each.outcome, frame, truth[each.frame]), each.latency_ms]
        for each in placed
        if each.frame in truth
    ]
    return Verdict.of(rows[1:])


def _row(scene: Scene, verdict: Verdict) -> list[str]:
    heading = "" if scene.heading_known else ", heading unknown"
    row = [
        Path(scene.map).stem if "taichung" not in scene.map else "taichung",
        Path(scene.views).stem + heading,
        str(len(verdict.times_ms)),
        f"{percent(float(verdict.within(scene.near_m).mean()), 1)} ({scene.near_m:g} m)",
        percent(float(verdict.within(FAR_M).mean()), 1),
        number(verdict.median_m),
        percent(verdict.accepted_of_right(FAR_M), 1),
        f"{verdict.wrong_accepted} of {int(verdict.accepted.sum())}",
        f"{verdict.ece:.3f}",
        number(verdict.nees_mean),
        number(float(np.median(verdict.times_ms))),
        number(float(np.percentile(verdict.times_ms, 99))),
    ]
    print("  ".join(row), flush=True)
    return row


def _notes(options: argparse.Namespace) -> tuple[str, ...]:
    return (
        f"whole map, no prior, seed {options.seed}; simulated flights: heading off by "
        f"{options.yaw_std_deg:g} deg and height by {options.agl_std:.0%} (standard deviations), "
        "random places; recorded flights as they are: Taichung's camera tilts up to 9 deg more "
        "than reported and its height is about 12 % off, Arroio's truth is good to 7 to 10 m and "
        "its map's position is nominal",
        "near: share of all views within the radius in brackets; accepted: confidence of "
        f"{CONFIDENT:g} or more, of the views within {FAR_M:g} m; wrong accepted: by more than "
        f"{FAR_M:g} m, of all accepted",
        "ECE: expected calibration error at the map's own radius; NEES: mean normalized error "
        "squared of right fixes, 2 if the covariance is theirs; ms: decoded picture to fix, one "
        "core, warm",
    )


def _negative_files() -> list[str]:
    return [
        *NAIP_VIEWS,
        *(f"airchange/{name}_{date}.tif" for name in SZADA for date in "ab"),
        "arroio_maps/2014-01.tif",
    ]


def _refusals(bench: Bench) -> Table:
    """Views that are not on the NAIP map, at the height and heading of a flight over it."""
    options, localizer = bench.options, bench.localizer(NAIP_MAP)
    flights = [bench.flight(views) for views in NAIP_VIEWS]
    sources = Sources(
        [DATA / f"airchange/{name}_{date}.tif" for name in SZADA[:3] for date in "ab"],
        flights,
        DATA / NAIP_VIEWS[0],
        DATA / "arroio_maps/2014-01.tif",
    )
    agl_m = float(np.median([view.telemetry.agl_m for view in open_flight(flights[0]).views]))
    rng = np.random.default_rng([options.seed, 6])
    size = DEFAULT_CAMERA.height_px, DEFAULT_CAMERA.width_px
    stated: dict[str, list[float]] = {kind: [] for kind in SHARES}
    times_ms = []
    for kind, picture in negatives(sources, options.negatives, size, options.seed):
        telemetry = Telemetry(
            time_ns=0,
            yaw_deg=float(rng.uniform(0, 360)),
            pitch_deg=0.0,
            roll_deg=0.0,
            agl_m=agl_m,
            yaw_std_deg=options.yaw_std_deg,
            agl_std_m=options.agl_std * agl_m,
        )
        alone = SingleViews(localizer, use_prior=False)
        outcome, took_ms = locate_view(alone, View(picture, DEFAULT_CAMERA, telemetry))
        stated[kind].append(outcome.confidence if isinstance(outcome, Fix) else np.nan)
        times_ms.append(took_ms)
    rows = [_refused(kind, np.array(values)) for kind, values in stated.items()]
    rows.append(_refused("**all**", np.concatenate([np.array(v) for v in stated.values()])))
    notes = (
        f"on the map of {Path(NAIP_MAP).stem}, telemetry as of a flight over it, whole map, no "
        f"prior, seed {options.seed}; {number(float(np.median(times_ms)))} ms median, "
        f"{number(float(np.percentile(times_ms, 99)))} ms p99",
        "other places: windows of the Szada orthophotos, stretched to the view; mirrored: views of "
        "2012, 2015 and 2018; forest and water: windows of real imagery, stretched to the view; "
        "refused outright: no fix at all, with a reason",
    )
    header = (
        "negatives",
        "n",
        "refused outright",
        "confidence 0.5 or more",
        f"{CONFIDENT:g} or more",
    )
    return Table("Views that are not on the map", (*header, "highest"), rows, notes)


def _refused(kind: str, confidence: np.ndarray) -> list[str]:
    known = confidence[~np.isnan(confidence)]
    counts = [str(int((known >= limit).sum())) for limit in (0.5, CONFIDENT)]
    highest = number(float(known.max())) if known.size else "-"
    refused = str(len(confidence) - len(known))
    return [kind, str(len(confidence)), refused, *counts, highest]


if __name__ == "__main__":
    main()
