"""Ground that changed for good: how well one flight over a later date finds it.

`python -m benchmarks.changes --work DIR [--views 60] [--width 256] [--only SCENE ..] [--out FILE]`
builds a map of an early date, simulates views of a later one at random places, localizes them
without a prior, and compares the cells that `orthonav.ground.changes` scores with a reference made
of the orthophotos of all dates. Real imagery is looked for in `../shared/data` beside the checkout
or in the folder that ORTHONAV_DATA names. DIR keeps maps and flights.

The reference takes colour only (a* and b* of CIELAB, means of cells), which views do not have: they
are grey. A cell changed where no date up to the map's looks like any date from the views' on
(`CHANGED` units apart), and these differences are no smaller than those among the dates of either
side, which hold seasons. It is unchanged below half of that; cells between are left out. Where one
side has one date only, nothing separates a season there from a change.
"""

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from benchmarks.inputs import DATA, map_of
from benchmarks.record import Table, provenance
from benchmarks.verdicts import percent
from orthonav.core.files import write_text
from orthonav.core.flight import open_flight
from orthonav.core.localize import Localizer
from orthonav.core.localize.confidence import Acceptance
from orthonav.core.mapfile import open_map
from orthonav.core.mapfile.manifest import SheetInfo
from orthonav.ground.changes.ground import cell_side_m, changed_ground, views_beside_map
from orthonav.ground.changes.record import ChangedGround, ChangeGrid
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.simulate.flight import DEFAULT_CAMERA, Errors, SimulateRequest, simulate_flight
from orthonav.onboard.run import SingleViews, localize_flight

YAW_STD_DEG, AGL_STD = 10.0, 0.1
CHANGED = 3.0
"""Difference of colour, a* and b*, of ground that changed."""
LEAST_CHANGED = 10
"""With fewer cells that changed there is no area under the curve."""
GAINS = (0.6, 1.6)
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Record:
    """Dates of one scene, in order, of which `map` and `views` are flown. Files are below DATA."""

    scene: str
    dates: tuple[str, ...]
    map: int
    views: int

    @property
    def early(self) -> tuple[str, ...]:
        """Dates up to that of the map."""
        return self.dates[: self.map + 1]

    @property
    def late(self) -> tuple[str, ...]:
        """Dates from that of the views on."""
        return self.dates[self.views :]

    @property
    def is_target(self) -> bool:
        """Whether much of the ground changed for good, and two dates of each side show it."""
        return self.scene in ("solar_farm", "aral")


def records() -> list[Record]:
    """All pairs of dates with a record."""
    dates = {
        "solar_farm": ("2009_12", "2012_12", "2015_12", "2017_12", "2020_12"),
        "aral": ("1985_12", "1995_12", "2000_12", "2006_12", "2012_12", "2015_12", "2020_12"),
        "garching": ("2001_09", "2009_04", "2015_04", "2018_04", "2020_03"),
        "schiphol": ("2004_05", "2008_05", "2015_09", "2018_04", "2021_06"),
        "atlanta": ("2012_11", "2016_12", "2021_08", "2024_02"),
    }
    named = {
        scene: tuple(f"scenes/{scene}/{each}.tif" for each in each_date)
        for scene, each_date in dates.items()
    }
    naip = ("20090818", "20120731", "20150926", "20180716")
    named["naip"] = tuple(f"naip_nd/{each}.tif" for each in naip)
    chosen = [
        *(("solar_farm", 1, 2), ("solar_farm", 1, 3), ("solar_farm", 0, 3)),
        *(("aral", 1, 5), ("aral", 2, 4), ("aral", 0, 4)),
        *(("garching", 1, 3), ("schiphol", 1, 3), ("atlanta", 1, 2), ("naip", 1, 2)),
    ]
    return [Record(scene, named[scene], first, last) for scene, first, last in chosen]


@dataclass(frozen=True, eq=False)
class Outcome:
    """A flight and its reference: scores (N,) of the cells that both know, and whether changed."""

    record: Record
    views: int
    confident: int
    scores: Array
    named: NDArray[np.bool_]
    changed: NDArray[np.bool_]
    unseen: int

    @property
    def auc(self) -> float:
        """Area under the curve of the scores; NaN where too few cells changed."""
        return area_under_curve(self.scores, self.changed)


def area_under_curve(scores: Array, changed: NDArray[np.bool_]) -> float:
    """Chance that a changed cell scores above an unchanged one (Mann and Whitney)."""
    ones, zeros = int(changed.sum()), int((~changed).sum())
    if ones < LEAST_CHANGED or not zeros:
        return float("nan")
    return float((rankdata(scores)[changed].sum() - ones * (ones + 1) / 2) / (ones * zeros))


def main() -> None:
    """Fly, compare, print; write Markdown where a file is named."""
    options = _parser().parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(1)
    about = provenance("changes")
    found = []
    for each in records():
        if options.only and each.scene not in options.only:
            continue
        if not all((DATA / name).is_file() for name in each.dates):
            print(f"not there, left out: {each.scene}")
            continue
        found.append(_flown(each, options))
        print("  ".join(_row(found[-1])), flush=True)
    head = f"commit {about['commit'][:10]}, sources {about['sources']}, {about['cpu']}"
    text = "\n".join([head, "", _table(found, options).markdown()])
    print("\n" + text)
    if options.out:
        write_text(options.out, text + "\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.changes", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--work", type=Path, required=True, help="folder for maps and flights")
    parser.add_argument("--views", type=int, default=60, help="views per flight (default 60)")
    parser.add_argument("--width", type=int, default=256, help="their width, px of the map")
    parser.add_argument("--only", nargs="+", help="only these scenes")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="Markdown file to write too")
    return parser


def _flown(record: Record, options: argparse.Namespace) -> Outcome:
    ground, confident = _changes(record, options)
    sheet = open_map(map_of(DATA / record.dates[record.map], options.work)).manifest.sheets[0]
    changed, unchanged = reference(record, sheet, ground.grid)
    known = (changed | unchanged) & (ground.views > 0)
    return Outcome(
        record,
        options.views,
        confident,
        ground.score[known],
        ground.changed[known],
        changed[known],
        int((changed & (ground.views == 0)).sum()),
    )


def _changes(record: Record, options: argparse.Namespace) -> tuple[ChangedGround, int]:
    """What a flight over the later date finds, as `localize --report-changes` does."""
    localizer = Localizer(open_map(map_of(DATA / record.dates[record.map], options.work)))
    registration = localizer.registration
    assert registration is not None
    grid, over = registration.grid, DATA / record.dates[record.views]
    name = f"{over.parent.name}-{over.stem}-{options.width}-{options.views}-{options.seed}"
    folder = options.work / name
    if not folder.is_dir():
        agl_m = options.width * grid.gsd_m / min(DEFAULT_CAMERA.extent)
        errors = Errors(yaw_std_deg=YAW_STD_DEG, agl_std=AGL_STD)
        request = SimulateRequest(
            [over], folder, random=options.views, agl_m=agl_m, errors=errors, seed=options.seed
        )
        simulate_flight(request)
    flight = open_flight(folder)
    accept = Acceptance.parse("confidence:0.9")
    results = list(localize_flight(SingleViews(localizer), flight, accept=accept))
    side_m = cell_side_m([(flight.camera, results)])
    assert side_m is not None
    cells = ChangeGrid.of_sheet(localizer.sheet, side_m)
    seen = list(views_beside_map(registration, cells, flight, results))
    return changed_ground(seen, cells), sum(result.is_confident for result in results)


def reference(
    record: Record, sheet: SheetInfo, grid: ChangeGrid
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which cells (rows, cols) changed for good, and which did not, by the colours of all dates."""
    used = record.early + record.late
    means, known = {}, np.ones((grid.rows, grid.cols), np.bool_)
    for name in used:
        means[name], whole = _colours(DATA / name, sheet, grid)
        known &= whole
    base = means[record.early[-1]]
    means = {name: _alike(each, base, known) for name, each in means.items()}

    def apart(pair: tuple[str, str]) -> Array:
        return np.asarray(np.hypot(*np.moveaxis(means[pair[0]] - means[pair[1]], -1, 0)))

    between = np.min([apart(each) for each in product(record.early, record.late)], axis=0)
    inside = [*combinations(record.early, 2), *combinations(record.late, 2)]
    within = np.max([apart(each) for each in inside], axis=0)
    changed = known & (between > CHANGED) & (within <= between)
    return changed, known & (between < CHANGED / 2)


def _colours(path: Path, sheet: SheetInfo, grid: ChangeGrid) -> tuple[Array, NDArray[np.bool_]]:
    """Mean a* and b* (rows, cols, 2) of the cells of an orthophoto, and which it covers."""
    pixels = sheet.grid
    raster = Mosaic.open([path]).sheet(
        sheet.frame,
        west_m=pixels.west_m,
        north_m=pixels.north_m,
        width_px=pixels.width_px,
        height_px=pixels.height_px,
        gsd_m=pixels.gsd_m,
        threads=1,
    )
    with raster as opened:
        read = opened.read(0, 0, pixels.width_px, pixels.height_px)
    lab = cv2.cvtColor(read.rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    x = pixels.west_m + (np.arange(pixels.width_px) + 0.5) * pixels.gsd_m
    y = pixels.north_m - (np.arange(pixels.height_px) + 0.5) * pixels.gsd_m
    numbers = grid.numbers(np.stack(np.meshgrid(x, y), axis=-1))
    inside = read.valid & (numbers >= 0)
    count = grid.rows * grid.cols
    pixel_count = np.bincount(numbers[inside], minlength=count)
    sums = [np.bincount(numbers[inside], lab[..., i][inside], count) for i in (1, 2)]
    means = np.stack(sums, axis=-1) / np.maximum(pixel_count, 1)[:, None]
    whole = pixel_count > 0.9 * (grid.side_m / pixels.gsd_m) ** 2
    shape = grid.rows, grid.cols
    return means.reshape(*shape, 2), whole.reshape(shape)


def _alike(means: Array, base: Array, known: NDArray[np.bool_]) -> Array:
    """Colours with the cast of another date, by a robust affine relation of each channel."""
    out = np.empty_like(means)
    for i in range(means.shape[-1]):
        x, y = means[..., i][known], base[..., i][known]
        weights = np.ones_like(x)
        for _ in range(20):
            design = np.stack([x, np.ones_like(x)], axis=1) * weights[:, None]
            gain = float(np.clip(np.linalg.lstsq(design, y * weights)[0][0], *GAINS))
            offset = float(np.median(y - gain * x))
            weights = np.sqrt(1 / np.maximum(np.abs(y - gain * x - offset), 0.5))
        out[..., i] = gain * means[..., i] + offset
    return out


def _row(found: Outcome) -> list[str]:
    record = found.record
    stems = [Path(record.dates[i]).stem for i in (record.map, record.views)]
    changed = found.changed
    return [
        f"{record.scene}, {' / '.join(stems)}",
        f"{len(record.early)} + {len(record.late)}",
        f"{found.confident} of {found.views}",
        f"{int(changed.sum())} + {int((~changed).sum())}",
        str(found.unseen),
        f"{found.auc:.3f}" if np.isfinite(found.auc) else "-",
        percent(float(found.named[changed].mean()), 1) if changed.any() else "-",
        percent(float(found.named[~changed].mean()), 1),
    ]


def _table(found: Sequence[Outcome], options: argparse.Namespace) -> Table:
    rows = [_row(each) for each in found]
    chosen = [each for each in found if each.record.is_target]
    if chosen:
        scores = np.concatenate([each.scores for each in chosen])
        changed = np.concatenate([each.changed for each in chosen])
        named = np.concatenate([each.named for each in chosen])
        rows.append(
            [
                "**solar farm and Aral together**",
                *("", "", f"{int(changed.sum())} + {int((~changed).sum())}"),
                str(sum(each.unseen for each in chosen)),
                f"{area_under_curve(scores, changed):.3f}",
                percent(float(named[changed].mean()), 1),
                percent(float(named[~changed].mean()), 1),
            ]
        )
    header = (
        *("scene, map / views", "dates up to + from", "confident views"),
        *("cells changed + unchanged", "changed, not seen", "AUC", "changed and reported"),
        "unchanged and reported",
    )
    notes = (
        f"{options.views} views {options.width} px of the map wide at random places of the later "
        f"date, heading sd {YAW_STD_DEG:g} deg, height sd {AGL_STD:.0%}, no prior, seed "
        f"{options.seed}; cells of an eighth of a view",
        f"reference: colour only, {CHANGED:g} units of a* and b* between every early and every "
        "late date, no less than among them",
        f"no AUC with fewer than {LEAST_CHANGED} changed cells",
    )
    return Table("Ground that changed", header, rows, notes)


if __name__ == "__main__":
    main()
