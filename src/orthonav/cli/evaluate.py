"""`orthonav evaluate`: accuracy of fixes against the truth."""

import argparse
import json
import logging
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from orthonav.cli.changed import (
    add_report_changes,
    changes_text,
    changes_to_plain,
    report_changes,
)
from orthonav.cli.common import print_json, progress
from orthonav.cli.needs import require_extras

if TYPE_CHECKING:
    from orthonav.changes.record import ChangedGround
    from orthonav.evaluate.contact_sheet import Row
    from orthonav.evaluate.flights import FlightReport
    from orthonav.evaluate.metrics import Comparison, Metrics
    from orthonav.flight import FlightFolder
    from orthonav.mapfile.layer import GreyLayer
    from orthonav.mapfile.reader import MapFile
    from orthonav.records import ViewResult
    from orthonav.report import Background

_FAR_M = 50_000.0
"""A larger median error is none of the method: maps of one sheet are smaller."""
log = logging.getLogger(__name__)


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "fixes",
        type=Path,
        nargs="+",
        metavar="fixes.jsonl",
        help="fixes of a flight, as written by localize or fly --jsonl; several files are compared",
    )
    parser.add_argument(
        "--truth",
        type=Path,
        required=True,
        action="append",
        metavar="truth.csv",
        help="true positions; one per file of fixes, in the same order",
    )
    parser.add_argument(
        "--radius-m", type=float, default=15.0, help="largest error of a correct fix (default 15)"
    )
    parser.add_argument(
        "--rpe-distance-m",
        type=float,
        default=100.0,
        help="distance of the relative pose error (default 100)",
    )
    parser.add_argument(
        "--metrics", type=Path, metavar="metrics.json", help="write the metrics to a file"
    )
    parser.add_argument(
        "--json", action="store_true", help="print the metrics as JSON instead of the table"
    )
    parser.add_argument(
        "--report",
        type=Path,
        metavar="REPORT/",
        help="write an HTML report with its figures as SVG and PNG",
    )
    parser.add_argument(
        "--map", type=Path, metavar="MAP.onav", help="map of the flight: background of the report"
    )
    parser.add_argument(
        "--flight",
        type=Path,
        action="append",
        metavar="FLIGHT_DIR",
        help="flight folder with the images, for the worst views in the report (with --map and "
        "--report) and for --report-changes; one per file of fixes, in the same order",
    )
    add_report_changes(parser)


def run(options: argparse.Namespace) -> None:
    """Measure, print the table, write JSON and report."""
    from orthonav.errors import FlightError
    from orthonav.evaluate.flights import flights_to_json, summary, table, total, verdict
    from orthonav.files import write_text
    from orthonav.mapfile import open_map

    if len(options.fixes) != len(options.truth):
        raise FlightError(
            f"give --truth once per file of fixes: {len(options.fixes)} expected, got "
            f"{len(options.truth)}"
        )
    if not 0 < options.radius_m < 1e7:
        raise FlightError(f"--radius-m must be above 0, got {options.radius_m}")
    if not 0 < options.rpe_distance_m < 1e7:
        raise FlightError(f"--rpe-distance-m must be above 0, got {options.rpe_distance_m}")
    if options.report:
        require_extras("evaluate --report")
    _check_flights(options)
    opened = open_map(options.map) if options.map else None
    flights = _measured(options, opened)
    whole = total(flights)
    if options.report:
        _write_report(options.report, flights, whole, opened)
    plain = flights_to_json(flights, whole)
    changed = _changed(options, opened)
    plain |= changes_to_plain(options, changed)
    if options.metrics:
        write_text(options.metrics, json.dumps(plain, indent=1, allow_nan=False) + "\n")
    if options.json:
        print_json(plain)
        return
    print(f"{verdict(whole)}\n\n{table(flights, whole)}\n\n{summary(flights, whole)}")
    for line in changes_text(options, changed):
        print(line)
    if options.report:
        print(f"report: {options.report / 'index.html'}")


def _changed(options: argparse.Namespace, opened: "MapFile | None") -> "ChangedGround | None":
    """Write `--report-changes` by the views of all flights; None where it was not asked for."""
    from orthonav.flight import open_flight
    from orthonav.flight.fixes import read_results

    if options.report_changes is None or opened is None:
        return None
    flights = [
        (open_flight(folder, images_needed=False), read_results(fixes))
        for folder, fixes in zip(options.flight, options.fixes, strict=True)
    ]
    with progress(options) as shown:
        return report_changes(options, opened, flights, shown)


def _check_flights(options: argparse.Namespace) -> None:
    """Raise `FlightError` where `--flight` or `--report-changes` lack other options."""
    from orthonav.errors import FlightError

    flights = options.flight or []
    if options.report_changes and not (options.map and flights):
        raise FlightError(
            "--report-changes compares views with the map; give --map and --flight too"
        )
    if flights and not (options.map and (options.report or options.report_changes)):
        raise FlightError(
            "--flight shows views beside the map in a report; give --map and --report too, or "
            "--report-changes"
        )
    if flights and len(flights) != len(options.fixes):
        raise FlightError(
            f"give --flight once per file of fixes: {len(options.fixes)} expected, got "
            f"{len(flights)}"
        )


def _measured(options: argparse.Namespace, opened: "MapFile | None") -> "list[FlightReport]":
    """Metrics of every flight, with its worst views if their images are given."""
    from orthonav.evaluate.flights import FlightReport
    from orthonav.evaluate.gnss import measure_gnss
    from orthonav.evaluate.metrics import compare, measure
    from orthonav.evaluate.track import measure_track
    from orthonav.flight import open_flight, read_truth
    from orthonav.flight.fixes import read_results

    local = opened.manifest.sheets[0].frame if opened else None
    background = map_background(opened) if opened else None
    layer = _grey_layer(opened) if opened and options.flight else None
    folders = [open_flight(path, images_needed=False) for path in options.flight or []]
    names = _names(options.fixes)
    flights = []
    for i, (fixes, truth) in enumerate(zip(options.fixes, options.truth, strict=True)):
        results = read_results(fixes)
        known = read_truth(truth)
        comparison = compare(known, results, local)
        _warn_if_far(known, results, truth)
        worst: tuple[Row, ...] = ()
        if opened and layer:
            worst = _worst(comparison, results, folders[i], opened, layer)
        metrics = measure(comparison, options.radius_m, rpe_distance_m=options.rpe_distance_m)
        track = measure_track(comparison, results, options.radius_m)
        gnss = measure_gnss(comparison, results)
        flights.append(FlightReport(names[i], comparison, metrics, background, track, worst, gnss))
    return flights


def _warn_if_far(
    truth: "Mapping[str, tuple[float, float]]", results: "list[ViewResult]", path: Path
) -> None:
    """Log a warning where true positions are so far from the fixes that one of both is misread."""
    import numpy as np

    from orthonav.geo.frames import distances_m
    from orthonav.geo.swapped import HINT
    from orthonav.records import Fix

    both = [
        (truth[result.frame], (result.outcome.lat_deg, result.outcome.lon_deg))
        for result in results
        if isinstance(result.outcome, Fix) and result.frame in truth
    ]
    if not both:
        return
    true, found = np.array(both).transpose(1, 0, 2)
    far_m, swapped_m = (
        float(np.nanmedian(distances_m(places, found))) for places in (true, true[:, ::-1])
    )
    if far_m > _FAR_M:
        hint = HINT if swapped_m < _FAR_M else "are these of the same flight?"
        log.warning(
            "true positions are %s km from the fixes (median); %s: %s",
            f"{far_m / 1000:,.0f}",
            hint,
            path,
        )


def _grey_layer(opened: "MapFile") -> "GreyLayer":
    """The grey pyramid of a map; raises `MapFileError` without one."""
    from orthonav.errors import MapFileError
    from orthonav.mapfile.layer import GreyLayer

    layer = GreyLayer.of(opened)
    if layer is None:
        raise MapFileError(f"--flight needs a map with a registration layer: {opened.path}")
    return layer


def _worst(
    comparison: "Comparison",
    results: "list[ViewResult]",
    folder: "FlightFolder",
    opened: "MapFile",
    layer: "GreyLayer",
) -> "tuple[Row, ...]":
    """Rows of the contact sheet of one flight."""
    from orthonav.evaluate.contact_sheet import worst_rows

    grid = opened.manifest.sheets[0].grid
    return tuple(worst_rows(comparison, results, folder, layer, grid))


def _names(paths: list[Path]) -> list[str]:
    """A name for each file: its stem, with its folder where stems are equal."""
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        names = [f"{path.resolve().parent.name}/{path.stem}" for path in paths]
    if len(set(names)) < len(names):
        names = [str(path) for path in paths]
    return names


def _write_report(
    out: Path, flights: list["FlightReport"], whole: "Metrics", opened: "MapFile | None"
) -> None:
    from orthonav import __version__
    from orthonav.cli.info import imagery_text, recipe_text
    from orthonav.evaluate.report import MadeFrom, write_report

    made_from = MadeFrom(
        map_name=opened.path.name if opened else "",
        recipe=recipe_text(opened.manifest.recipe) if opened else "",
        imagery=imagery_text(opened.manifest.imagery) if opened else "",
        flight=", ".join(flight.name for flight in flights),
        command=" ".join(["orthonav", *sys.argv[1:]]),
        version=__version__,
    )
    write_report(out, flights, made_from, whole=whole)


def map_background(opened: "MapFile") -> "Background":
    """The preview of a map as background; raises `MapFileError` where it is damaged."""
    from orthonav.mapfile.layer import preview
    from orthonav.report import Background

    grid = opened.manifest.sheets[0].grid
    return Background(
        preview(opened),
        west_m=grid.west_m,
        south_m=grid.north_m - grid.height_px * grid.gsd_m,
        east_m=grid.west_m + grid.width_px * grid.gsd_m,
        north_m=grid.north_m,
    )
