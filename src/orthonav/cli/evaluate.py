"""`orthonav evaluate`: compare fixes with the truth."""

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthonav.cli.common import print_json
from orthonav.cli.needs import require_extras

if TYPE_CHECKING:
    from orthonav.evaluate.contact_sheet import Row
    from orthonav.evaluate.flights import FlightReport
    from orthonav.evaluate.metrics import Comparison
    from orthonav.flight import FlightFolder
    from orthonav.mapfile.layer import GreyLayer
    from orthonav.mapfile.reader import MapFile
    from orthonav.records import ViewResult
    from orthonav.report import Background


def add(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("fixes", type=Path, nargs="+", metavar="fixes.jsonl")
    parser.add_argument(
        "--truth",
        type=Path,
        required=True,
        action="append",
        metavar="truth.csv",
        help="true positions; one for each file of fixes, in the same order",
    )
    parser.add_argument(
        "--radius-m", type=float, default=15.0, help="an error below it is right (default 15)"
    )
    parser.add_argument(
        "--json",
        nargs="?",
        const="-",
        metavar="metrics.json",
        help="write metrics as JSON, to stdout where no file is named",
    )
    parser.add_argument(
        "--report",
        type=Path,
        metavar="REPORT/",
        help="write an HTML report, and its figures beside it as SVG and PNG",
    )
    parser.add_argument("--map", type=Path, metavar="MAP.onav", help="background of the report")
    parser.add_argument(
        "--flight",
        type=Path,
        action="append",
        metavar="FLIGHT_DIR",
        help="show the worst views beside the map in the report (with --map and --report); one for "
        "each file of fixes, in the same order",
    )


def run(options: argparse.Namespace) -> None:
    """Measure, print the table, write what was asked for."""
    from orthonav.errors import FlightError
    from orthonav.evaluate.flights import flights_to_json, summary, table
    from orthonav.files import write_text
    from orthonav.mapfile import open_map

    if len(options.fixes) != len(options.truth):
        raise FlightError(
            f"{len(options.fixes)} files of fixes need as many --truth, got {len(options.truth)}"
        )
    if not 0 < options.radius_m < 1e7:
        raise FlightError(f"radius must be above 0 m, got {options.radius_m}")
    if options.report:
        require_extras("evaluate --report")
    _check_flights(options)
    opened = open_map(options.map) if options.map else None
    flights = _measured(options, opened)
    if options.report:
        _write_report(options.report, flights, opened)
    plain = flights_to_json(flights)
    if options.json == "-":
        print_json(plain)
        return
    if options.json:
        write_text(Path(options.json), json.dumps(plain, indent=1, allow_nan=False) + "\n")
    print(f"{table(flights)}\n\n{summary(flights)}")
    if options.report:
        print(f"report: {options.report / 'index.html'}")


def _check_flights(options: argparse.Namespace) -> None:
    """Raises `FlightError` where `--flight` lacks what it needs."""
    from orthonav.errors import FlightError

    flights = options.flight or []
    if flights and not (options.map and options.report):
        raise FlightError(
            "--flight shows views beside the map in a report: give --map and --report"
        )
    if flights and len(flights) != len(options.fixes):
        raise FlightError(
            f"{len(options.fixes)} files of fixes need as many --flight, got {len(flights)}"
        )


def _measured(options: argparse.Namespace, opened: "MapFile | None") -> "list[FlightReport]":
    """Every flight beside its truth, and its worst views where their pictures were given."""
    from orthonav.evaluate.flights import FlightReport
    from orthonav.evaluate.metrics import compare, measure
    from orthonav.evaluate.track import measure_track
    from orthonav.flight import open_flight, read_truth
    from orthonav.flight.fixes import read_results

    local = opened.manifest.sheets[0].frame if opened else None
    background = map_background(opened) if opened else None
    layer = _grey_layer(opened) if opened and options.flight else None
    folders = [open_flight(path) for path in options.flight or []]
    names = _names(options.fixes)
    flights = []
    for i, (fixes, truth) in enumerate(zip(options.fixes, options.truth, strict=True)):
        results = read_results(fixes)
        comparison = compare(read_truth(truth), results, local)
        worst: tuple[Row, ...] = ()
        if opened and layer:
            worst = _worst(comparison, results, folders[i], opened, layer)
        metrics = measure(comparison, options.radius_m)
        track = measure_track(comparison, results, options.radius_m)
        flights.append(FlightReport(names[i], comparison, metrics, background, track, worst))
    return flights


def _grey_layer(opened: "MapFile") -> "GreyLayer":
    """The grey pyramid of a map; raises `MapFileError` where it has none."""
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
    """A name for each file: its stem, with its folder where stems are alike."""
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        names = [f"{path.resolve().parent.name}/{path.stem}" for path in paths]
    if len(set(names)) < len(names):
        names = [str(path) for path in paths]
    return names


def _write_report(out: Path, flights: list[Any], opened: "MapFile | None") -> None:
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
    write_report(out, flights, made_from)


def map_background(opened: "MapFile") -> "Background":
    """The small picture of the area that a map carries; raises `MapFileError` where it is none."""
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
