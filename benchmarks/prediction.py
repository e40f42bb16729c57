"""Predictions of `orthonav check`, from one date alone, compared with measured results.

`python -m benchmarks.prediction [--views 240] [--only NAME ..] [--workers N] [--out FOLDER]` checks
maps as the command does, without the second date, then flies over that date with the program's own
simulator, or replays a recorded flight, places every view once with the same prior, and compares
cell by cell (stretch by stretch of flights) the predicted with the measured share of correct,
confident fixes. Real imagery is looked for in `../shared/data` beside the checkout or in the folder
that ORTHONAV_DATA names; absent imagery is left out with a line that says so. The generated areas
have seeds that `experiments.persistence` does not learn from.
"""

import argparse
import json
import math
import os
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from lab.landscape import DEFAULT_DATES
from numpy.typing import NDArray

from benchmarks.inputs import DATA, file_of
from benchmarks.record import Table, provenance
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import CONFIDENT, Fix, Prior
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.check.outcome import Cells
from orthonav.ground.check.request import CheckRequest
from orthonav.ground.check.run import check_map
from orthonav.ground.simulate.flight import DEFAULT_CAMERA, Errors, SimulateRequest, simulate_flight
from orthonav.onboard.run import SingleViews, localize_flight

YAW_STD_DEG, AGL_STD = 5.0, 0.05
WIDTHS_PX = (112, 160, 256)
"""Pixels of the map across a view, for orthophotos: views from three heights."""
VIEWS_PER_CELL = 15
LEAST_PER_CELL = 8
PRIOR_PX = 60.0
BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0001)
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """A map, and the other date: an orthophoto seen `width_px` across, or a recorded flight.

    Files are below `DATA`; those of generated areas are `generated:SEED:DATE`.
    """

    group: str
    map: str
    views: str
    width_px: int = 0
    relief_m: float = 0.0

    @property
    def name(self) -> str:
        """For tables."""
        across = f", {self.width_px} px" if self.width_px else ""
        return f"{Path(self.map).stem} / {Path(self.views).stem}{across}"


def scenes() -> list[Scene]:
    """All of them."""
    past, present, other = (date.name for date in DEFAULT_DATES)
    pairs = [
        ("naip", "naip_nd/20090818.tif", "naip_nd/20180716.tif"),
        ("naip", "naip_nd/20180716.tif", "naip_nd/20120731.tif"),
        *(("airchange", f"airchange/szada_{n}_a.tif", f"airchange/szada_{n}_b.tif") for n in "157"),
        ("airchange", "airchange/szada_mosaic_a.tif", "airchange/szada_mosaic_b.tif"),
        ("generated", f"generated:21:{past}", f"generated:21:{present}"),
        ("generated", f"generated:22:{other}", f"generated:22:{past}"),
    ]
    made = [Scene(*pair, width_px) for pair in pairs for width_px in WIDTHS_PX]
    flown = [
        Scene("arroio", f"arroio_maps/{month}.tif", "arroio_drone_1", relief_m=3.0)
        for month in ("2014-01", "2014-03")
    ]
    return made + flown


@dataclass(frozen=True)
class Outcome:
    """Predictions and measurements of one scene.

    - `scene`, `group`: names of the scene and of its group.
    - `predicted`, `measured`: share of correct, confident views for each cell, 0 to 1.
    - `views`: number of views in each cell.
    - `wrong`: number of views that are confident and wrong.
    - `error_predicted_m`, `error_measured_m`: error of correct views, m.
    """

    scene: str
    group: str
    predicted: list[float]
    measured: list[float]
    views: list[int]
    wrong: int
    error_predicted_m: float
    error_measured_m: float


def main() -> None:
    """Check, fly, compare, print; write JSON and a picture where a folder is named."""
    options = _parser().parse_args()
    chosen = [each for each in scenes() if _there(each) and each.group in (options.only or GROUPS)]
    about = provenance("prediction of fixes")
    with tempfile.TemporaryDirectory(prefix="orthonav-prediction-") as folder:
        files = {
            name: file_of(name, Path(folder)) for each in chosen for name in (each.map, each.views)
        }
        maps = {each.map: _map(files[each.map], Path(folder)) for each in chosen}
        jobs = [
            (each, maps[each.map], files[each.views], Path(folder) / f"flight{i}", options)
            for i, each in enumerate(chosen)
        ]
        found = []
        with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
            for each in pool.map(_compared, jobs):
                found.append(each)
                print("  ".join(_row(each)), flush=True)
    tables = [_scenes_table(found, options), _bins_table(found)]
    head = f"commit {about['commit'][:10]}, sources {about['sources']}, {about['cpu']}"
    text = "\n".join([head, "", *(table.markdown() for table in tables)])
    print("\n" + text)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        plain = {**about, "scenes": [asdict(each) for each in found], "totals": totals(found)}
        (options.out / "prediction.json").write_text(json.dumps(plain, indent=1) + "\n")
        (options.out / "prediction.md").write_text(text + "\n")
        _picture(found, options.out / "prediction.png")


GROUPS = ("naip", "airchange", "generated", "arroio")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.prediction", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--views", type=int, default=240, help="views per scene (default 240)")
    parser.add_argument("--effort", type=float, default=1.0, help="of the checks (default 1)")
    parser.add_argument("--only", nargs="+", choices=GROUPS, help="only these")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="scenes at a time")
    parser.add_argument("--out", type=Path, help="folder for JSON, Markdown and a picture")
    return parser


def _there(scene: Scene) -> bool:
    missing = [
        name
        for name in (scene.map, scene.views)
        if not name.startswith("generated:") and not (DATA / name).exists()
    ]
    for name in missing:
        print(f"not there, left out: {DATA / name}")
    return not missing


def _map(ortho: Path, folder: Path) -> Path:
    path = folder / f"{ortho.parent.name}-{ortho.stem}.onav"
    if not path.is_file():
        build_map(BuildRequest([ortho], path))
    return path


def _compared(job: tuple[Scene, Path, Path, Path, argparse.Namespace]) -> Outcome:
    """Prediction and outcome of one scene."""
    cv2.setNumThreads(1)
    scene, map_path, views, folder, options = job
    opened = open_map(map_path)
    gsd_m = opened.manifest.sheets[0].grid.gsd_m
    prior_m = PRIOR_PX * gsd_m
    camera, agl_m = DEFAULT_CAMERA, scene.width_px * gsd_m * 1000.0 / 1280.0
    if scene.width_px:
        errors = Errors(yaw_std_deg=YAW_STD_DEG, agl_std=AGL_STD)
        simulate_flight(
            SimulateRequest(
                [views], folder, random=options.views, agl_m=agl_m, errors=errors, seed=7
            )
        )
    else:
        folder, prior_m = views, 100.0
        flight = open_flight(folder)
        camera = flight.camera
        agl_m = float(np.median([view.telemetry.agl_m for view in flight.views]))
    request = CheckRequest(
        map_path,
        camera=camera,
        agl_m=agl_m,
        yaw_std_deg=YAW_STD_DEG,
        agl_std=AGL_STD,
        prior_std_m=prior_m,
        accept=CONFIDENT,
        relief_m=scene.relief_m,
        extras=False,
        effort=options.effort,
        workers=1,
    )
    cells = check_map(request)[0].cells
    en_m, right, wrong, errors_m = _flown(Localizer(opened), folder, prior_m)
    predicted, expected_m = _at(cells.probability, cells, en_m), _at(cells.error_m, cells, en_m)
    groups = _cells_of(en_m) if scene.width_px else np.arange(len(en_m)) // VIEWS_PER_CELL
    members = [groups == each for each in np.unique(groups)]
    members = [each for each in members if each.sum() >= LEAST_PER_CELL]
    return Outcome(
        scene.name,
        scene.group,
        [round(float(np.nanmean(predicted[each])), 4) for each in members],
        [round(float(right[each].mean()), 4) for each in members],
        [int(each.sum()) for each in members],
        int(wrong.sum()),
        float(np.nanmean(expected_m)),
        float(np.sqrt(np.mean(errors_m[right] ** 2))) if right.any() else math.nan,
    )


def _flown(
    localizer: Localizer, folder: Path, prior_m: float
) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_], Array]:
    """True places (N, 2) of views, which of them were placed surely and right, surely and wrong,
    and the errors; the prior is drawn around the truth."""
    rng = np.random.default_rng(11)
    frame, flight = localizer.sheet.frame, open_flight(folder)
    truth = read_truth(folder / "truth.csv")
    views = []
    for view in flight.views:
        if view.frame not in truth:
            continue
        east, north = frame.en_from_latlon(*truth[view.frame]) + rng.normal(0, prior_m, 2)
        lat, lon = frame.latlon_from_en(np.array([east, north]))
        telemetry = replace(view.telemetry, prior=Prior(float(lat), float(lon), prior_m))
        views.append(replace(view, telemetry=telemetry))
    places, right, wrong, errors = [], [], [], []
    for result in localize_flight(SingleViews(localizer, use_prior=True), flight, views=views):
        true = frame.en_from_latlon(*truth[result.frame])
        error, confident = math.inf, False
        if isinstance(result.outcome, Fix):
            found = frame.en_from_latlon(result.outcome.lat_deg, result.outcome.lon_deg)
            error = float(np.hypot(*(found - true)))
            confident = result.outcome.confidence >= CONFIDENT
        near = error <= (result.outcome.radius_m if isinstance(result.outcome, Fix) else 0.0)
        places.append(true)
        right.append(confident and near)
        wrong.append(confident and not near)
        errors.append(error)
    return np.array(places), np.array(right), np.array(wrong), np.array(errors)


def _at(values: Array, cells: Cells, en_m: Array) -> Array:
    """Values (rows, cols) of cells at places (N, 2)."""
    rows, cols = values.shape
    col = ((en_m[:, 0] - cells.west_m) / cells.side_m).astype(int).clip(0, cols - 1)
    row = ((cells.north_m - en_m[:, 1]) / cells.side_m).astype(int).clip(0, rows - 1)
    return np.asarray(values[row, col])


def _cells_of(en_m: Array) -> NDArray[np.intp]:
    """Numbers (N,) of square cells that hold `VIEWS_PER_CELL` views on average."""
    across = max(1, int(math.sqrt(len(en_m) / VIEWS_PER_CELL)))
    low, high = en_m.min(axis=0), en_m.max(axis=0) + 1e-6
    index = ((en_m - low) / (high - low) * across).astype(np.intp)
    return np.asarray(index[:, 0] * across + index[:, 1])


def totals(found: Sequence[Outcome]) -> dict[str, Any]:
    """Correlation, calibration and the worst of the confident cells, over all cells."""
    predicted, measured, views = _pooled(found)
    error = 0.0
    for low, high in pairwise(BINS):
        inside = (predicted >= low) & (predicted < high)
        if inside.any():
            off = np.average(predicted[inside] - measured[inside], weights=views[inside])
            error += abs(float(off)) * float(views[inside].sum() / views.sum())
    confident = predicted > CONFIDENT
    return {
        "cells": len(predicted),
        "correlation": round(float(np.corrcoef(predicted, measured)[0, 1]), 3),
        "bias": round(float(np.average(predicted - measured, weights=views)), 3),
        "calibration_error": round(error, 3),
        "confident_cells": int(confident.sum()),
        "confident_cells_least_measured": float(measured[confident].min())
        if confident.any()
        else None,
        "wrong": sum(each.wrong for each in found),
        "views": int(views.sum()),
    }


def _pooled(found: Sequence[Outcome]) -> tuple[Array, Array, Array]:
    predicted = np.array([value for each in found for value in each.predicted])
    measured = np.array([value for each in found for value in each.measured])
    views = np.array([value for each in found for value in each.views], np.float64)
    return predicted, measured, views


def _row(found: Outcome) -> list[str]:
    predicted, measured, views = _pooled([found])
    varied = len(predicted) > 2 and predicted.std() > 0 and measured.std() > 0
    return [
        found.scene,
        str(len(predicted)),
        str(int(views.sum())),
        f"{np.average(predicted, weights=views):.2f}",
        f"{np.average(measured, weights=views):.2f}",
        f"{np.corrcoef(predicted, measured)[0, 1]:.2f}" if varied else "-",
        f"{found.error_predicted_m:.1f}",
        f"{found.error_measured_m:.1f}",
        str(found.wrong),
    ]


def _scenes_table(found: Sequence[Outcome], options: argparse.Namespace) -> Table:
    header = (
        *("map / other date", "cells", "views", "predicted", "measured", "correlation of cells"),
        *("error m predicted", "measured", "confident and wrong"),
    )
    whole = totals(found)
    worst = whole["confident_cells_least_measured"]
    notes = (
        f"share of views with a correct fix of confidence {CONFIDENT:g} or more; predicted from "
        "the map's date alone",
        f"checks of effort {options.effort:g}; {options.views} views per orthophoto, heading off "
        f"by {YAW_STD_DEG:g} deg, height by "
        f"{AGL_STD:.0%}, prior off by {PRIOR_PX:g} px of the map (flights: 100 m), standard "
        f"deviations; cells of {VIEWS_PER_CELL} views on average, stretches of as many",
        f"all cells: correlation {whole['correlation']}, predicted less measured "
        f"{whole['bias']:+}, calibration error {whole['calibration_error']} over fifths; "
        f"{whole['confident_cells']} cells predicted above {CONFIDENT:g}, lowest measured "
        f"{'-' if worst is None else worst}",
    )
    return Table("Predicted and measured fixes", header, [_row(each) for each in found], notes)


def _bins_table(found: Sequence[Outcome]) -> Table:
    predicted, measured, views = _pooled(found)
    rows = []
    for low, high in pairwise(BINS):
        inside = (predicted >= low) & (predicted < high)
        if inside.any():
            rows.append(
                [
                    f"{low:.1f} to {min(high, 1.0):.1f}",
                    str(int(inside.sum())),
                    f"{np.average(predicted[inside], weights=views[inside]):.2f}",
                    f"{np.average(measured[inside], weights=views[inside]):.2f}",
                    f"{measured[inside].min():.2f} to {measured[inside].max():.2f}",
                ]
            )
    return Table("By prediction", ("predicted", "cells", "mean", "measured", "from, to"), rows, ())


def _picture(found: Sequence[Outcome], path: Path) -> None:
    """Predicted against measured, a point per cell."""
    from orthonav.ground.report.drawing import draw_axes

    def draw(axes: Any) -> None:
        for group in GROUPS:
            predicted, measured, views = _pooled([each for each in found if each.group == group])
            if len(predicted):
                axes.scatter(predicted, measured, s=2 * views, alpha=0.6, label=group)
        axes.plot([0, 1], [0, 1], color="0.5", linewidth=1)
        axes.set(xlabel="predicted", ylabel="measured", xlim=(0, 1), ylim=(-0.02, 1.02))
        axes.legend()

    path.write_bytes(draw_axes((6, 6), draw).png)


if __name__ == "__main__":
    main()
