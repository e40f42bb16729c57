"""`orthonav evaluate`: accuracy of fixes against the ground truth."""

import argparse
import json
import shlex
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from orthonav.cli.changed import add_report_changes, changes_text, changes_to_plain, report_changes
from orthonav.cli.common import beside, print_json, progress
from orthonav.cli.needs import require_extras

if TYPE_CHECKING:
    from orthonav.core.flight import FlightFolder
    from orthonav.core.mapfile.reader import MapFile
    from orthonav.ground.changes.record import ChangedGround
    from orthonav.ground.evaluate.metrics import Metrics
    from orthonav.ground.evaluate.tables import FlightReport


def add(parser: argparse.ArgumentParser) -> None:
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
        action="append",
        default=[],
        metavar="truth.csv",
        help="ground truth: the true positions (default: truth.csv of --flight); one for all files "
        "of fixes, or one for each in the same order",
    )
    parser.add_argument(
        "--radius-m", type=float, default=15.0, help="largest error of a correct fix (default 15)"
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
        default=[],
        metavar="FLIGHT_DIR",
        help="flight folder with the true positions, and with the images for --report-changes; one "
        "for all files of fixes, or one for each in the same order",
    )
    add_report_changes(parser)
    parser.set_defaults(wrong_usage=parser.error)


def run(options: argparse.Namespace) -> None:
    from orthonav.core.files import write_text
    from orthonav.core.mapfile import open_map
    from orthonav.ground.evaluate.tables import (
        covariance_verdict,
        flights_to_json,
        summary,
        table,
        total,
        verdict,
    )

    _check_options(options)
    opened = open_map(options.map) if options.map else None
    flights = _measured(options, opened)
    whole = total(flights)
    if options.report:
        _write_report(options.report, flights, whole, opened)
    changed = _changed(options, opened)
    plain = flights_to_json(flights, whole) | changes_to_plain(options, changed)
    if options.metrics:
        write_text(options.metrics, json.dumps(plain, indent=1, allow_nan=False) + "\n")
    with beside(options.metrics, options.report_changes):
        if options.json:
            print_json(plain)
        else:
            print(f"{verdict(whole)}\n{covariance_verdict(whole.consistency)}\n")
            print(f"{table(flights, whole)}\n\n{summary(flights, whole)}")
            report = [f"report: {options.report / 'index.html'}"] if options.report else []
            for line in (*changes_text(options, changed), *report):
                print(line)


def _check_options(options: argparse.Namespace) -> None:
    from orthonav.core.errors import FlightError

    options.flight = _one_each(options.flight, options.fixes, "--flight")
    options.truth = _one_each(options.truth, options.fixes, "--truth")
    options.truth = options.truth or [folder / "truth.csv" for folder in options.flight]
    if not options.truth:
        options.wrong_usage(
            "give --flight FLIGHT_DIR, whose truth.csv is used, or --truth truth.csv"
        )
    if not 0 < options.radius_m < 1e7:
        raise FlightError(f"--radius-m must be above 0, got {options.radius_m}")
    if options.report:
        require_extras("evaluate --report")
    if options.report_changes and not (options.map and options.flight):
        raise FlightError(
            "--report-changes compares views with the map; give --map and --flight too"
        )


def _one_each(given: list[Path], fixes: list[Path], option: str) -> list[Path]:
    from orthonav.core.errors import FlightError

    if len(given) == 1:
        return given * len(fixes)
    if given and len(given) != len(fixes):
        raise FlightError(
            f"give {option} once per file of fixes, or one for all: {len(fixes)} expected, got "
            f"{len(given)}"
        )
    return given


def _changed(options: argparse.Namespace, opened: "MapFile | None") -> "ChangedGround | None":
    from orthonav.core.flight import open_flight
    from orthonav.core.flight.fixes import read_results

    if options.report_changes is None or opened is None:
        return None
    flights = [
        (open_flight(folder, images_needed=False), read_results(fixes))
        for folder, fixes in zip(options.flight, options.fixes, strict=True)
    ]
    with progress(options) as shown:
        return report_changes(options, opened, flights, shown)


def _measured(options: argparse.Namespace, opened: "MapFile | None") -> "list[FlightReport]":
    from orthonav.core.flight import open_flight, read_truth
    from orthonav.core.flight.fixes import read_results
    from orthonav.core.mapfile.layer import preview
    from orthonav.ground.evaluate.metrics import check_truth, compare, measure, warn_of_another_run
    from orthonav.ground.evaluate.tables import FlightReport
    from orthonav.ground.evaluate.track import measure_gnss, measure_track
    from orthonav.ground.report.drawing import Background

    local, background = None, None
    if opened:
        sheet = opened.manifest.sheets[0]
        local, background = sheet.frame, Background(preview(opened), sheet.grid.extent_en_m)
    folders = [open_flight(path, images_needed=False) for path in options.flight]
    flights = []
    for i, (fixes, truth) in enumerate(zip(options.fixes, options.truth, strict=True)):
        results = read_results(fixes)
        known = read_truth(truth)
        comparison = compare(known, results, local)
        check_truth(known, results, (local.lat_deg, local.lon_deg) if local else None, truth)
        warn_of_another_run(fixes, opened, folders[i] if folders else _flight_of(truth))
        metrics = measure(comparison, options.radius_m)
        flights.append(
            FlightReport(
                _names(options.fixes)[i],
                comparison,
                metrics,
                background,
                measure_track(comparison, results, options.radius_m),
                measure_gnss(comparison, results),
                _view_command(options, i),
            )
        )
    return flights


def _flight_of(truth: Path) -> "FlightFolder | None":
    """The flight folder that holds the ground truth, if any."""
    from orthonav.core.errors import OrthonavError
    from orthonav.core.flight import open_flight

    with suppress(OrthonavError):
        if (truth.parent / "telemetry.csv").is_file():
            return open_flight(truth.parent, images_needed=False)
    return None


def _names(paths: list[Path]) -> list[str]:
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
    from orthonav.ground.evaluate.report import MadeFrom, write_report

    made_from = MadeFrom(
        map_name=opened.path.name if opened else "",
        recipe=recipe_text(opened.manifest.recipe) if opened else "",
        imagery=imagery_text(opened.manifest.imagery) if opened else "",
        flight=", ".join(flight.name for flight in flights),
        command=" ".join(["orthonav", *sys.argv[1:]]),
        version=__version__,
    )
    write_report(out, flights, made_from, whole=whole)


def _view_command(options: argparse.Namespace, i: int) -> str:
    if options.map is None:
        return ""
    words = ["orthonav", "view", str(options.fixes[i]), "--map", str(options.map)]
    if options.flight:
        words += ["--flight", str(options.flight[i])]
    if not options.flight or options.truth[i] != options.flight[i] / "truth.csv":
        words += ["--truth", str(options.truth[i])]
    if options.radius_m != 15.0:
        words += ["--radius-m", f"{options.radius_m:g}"]
    return shlex.join(words)
