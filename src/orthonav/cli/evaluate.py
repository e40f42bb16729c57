"""`orthonav evaluate`: accuracy of fixes against the ground truth."""

import argparse
import logging
import math
import shlex
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import orthonav
from orthonav.cli.common import add_options, print_result
from orthonav.cli.info import imagery_text, recipe_text
from orthonav.cli.source import add_source, open_source
from orthonav.cli.version import require_extras
from orthonav.core.errors import FlightError, OrthonavError, UsageError

if TYPE_CHECKING:
    from orthonav.ground.evaluate.metrics import Positions
    from orthonav.ground.evaluate.tables import FlightReport

EXAMPLE = "fixes.jsonl --flight flight --map area.onav --report report"
EVERYDAY = (
    *("--flight", "--truth", "--map", "--report", "--radius-m", "--alert-limit-m", "--risk"),
    "--json",
)
log = logging.getLogger(__name__)


def add(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    text = "fixes of a flight, as written by localize or fly --jsonl; several files are compared"
    add("fixes", type=Path, nargs="+", metavar="fixes.jsonl", help=text)
    each: dict[str, Any] = {"type": Path, "action": "append", "default": []}
    text = "what was localized, with the recorded positions: flight folder, photographs, video, "
    text += "ROS; one for all files of fixes, or one for each in the same order"
    add("--flight", **each, metavar="FLIGHT_DIR", help=text)
    text = "ground truth: the true positions (default: those of --flight); one for all files of "
    text += "fixes, or one for each in the same order"
    add("--truth", **each, metavar="truth.csv", help=text)
    text = "map of the flight: background of the report"
    add("--map", type=Path, metavar="MAP.onav", help=text)
    text = "write an HTML report with its figures as SVG and PNG"
    add("--report", type=Path, metavar="REPORT/", help=text)
    text = "largest horizontal error that the mission allows: availability and false fixes at it"
    add_options(parser, "--alert-limit-m", help=text)
    add_options(parser, "--risk", "--radius-m", "--json")
    add_source(parser, dem=False)
    parser.set_defaults(skip_bad_images=True)


def run(options: argparse.Namespace) -> None:
    from orthonav.ground.evaluate.tables import runs_to_json, text

    options.flight = _one_each(options.flight, options.fixes, "--flight")
    options.truth = _one_each(options.truth, options.fixes, "--truth")
    if not (options.truth or options.flight):
        raise UsageError("give --flight with recorded positions, or --truth truth.csv")
    if not 0 < options.radius_m < 1e7:
        raise UsageError(f"--radius-m must be above 0, got {options.radius_m}")
    if options.report:
        require_extras("evaluate --report")
    opened = orthonav.open_map(options.map) if options.map else None
    flights = _measured(options, opened)
    if options.report:
        _write_report(options.report, flights, opened)
    lines = [f"report: {options.report / 'index.html'}"] if options.report else []
    print_result(options, runs_to_json(flights), text(flights), *lines)


def _one_each(given: list[Path], fixes: list[Path], option: str) -> list[Path]:
    if len(given) == 1:
        return given * len(fixes)
    if given and len(given) != len(fixes):
        raise UsageError(
            f"give {option} once per file of fixes, or one for all: {len(fixes)} expected, got "
            f"{len(given)}"
        )
    return given


def _measured(
    options: argparse.Namespace, opened: "orthonav.MapFile | None"
) -> "list[FlightReport]":
    from orthonav.core.mapfile.layer import preview
    from orthonav.ground.evaluate.metrics import check_truth, compare, measure, warn_of_another_run
    from orthonav.ground.evaluate.tables import FlightReport
    from orthonav.ground.evaluate.track import measure_gnss, measure_track
    from orthonav.ground.report.drawing import Background

    local, background, place = None, None, None
    if opened:
        sheet = opened.manifest.sheets[0]
        local, place = sheet.frame, (sheet.frame.lat_deg, sheet.frame.lon_deg)
        background = Background(preview(opened), sheet.grid.extent_en_m)
    sources = dict.fromkeys(options.flight)
    recorded = {path: _recorded(path, options) for path in sources}
    names = [path.stem for path in options.fixes]
    if len(set(names)) < len(names):
        names = [str(path) for path in options.fixes]
    flights = []
    for i, fixes in enumerate(options.fixes):
        truth = options.truth[i] if options.truth else options.flight[i]
        flight = options.flight[i] if options.flight else truth.parent
        known, sha256 = recorded[flight] if options.flight else ({}, _digest_of(flight))
        results = orthonav.read_results(fixes)
        known = orthonav.read_truth(truth) if options.truth else known
        comparison = compare(known, results, local, options.risk)
        on_map = (comparison.lat_deg, comparison.lon_deg) == place
        if opened and not on_map:
            log.warning("the map is of another place than the true positions: %s", options.map)
        check_truth(known, results, place, truth)
        warn_of_another_run(fixes, opened, flight, sha256)
        flights.append(
            FlightReport(
                names[i],
                comparison,
                measure(comparison, options.radius_m, options.alert_limit_m or math.nan),
                background if on_map else None,
                measure_track(comparison, results, options.radius_m),
                measure_gnss(comparison, results),
                _view_command(options, i),
            )
        )
    return flights


def _recorded(path: Path, options: argparse.Namespace) -> "tuple[Positions, str]":
    """Recorded positions of what was localized, by frame, and its digest."""
    from orthonav.core.flight.fixes import FlightDigest

    digest = FlightDigest()
    views = digest.watching(open_source(path, options).views)
    places = {view.frame: view.truth_latlon_deg for view in views}
    known = {name: at for name, at in places.items() if at is not None}
    if not (known or options.truth):
        raise FlightError(f"no positions were recorded; give --truth: {path}")
    return known, digest.sha256


def _digest_of(folder: Path) -> str | None:
    """The digest of the flight folder in which a file with the truth lies, if it is one."""
    from orthonav.core.flight.fixes import flight_digest

    with suppress(OrthonavError):
        if (folder / "telemetry.csv").is_file():
            return flight_digest(orthonav.open_flight(folder, images_needed=False).views)
    return None


def _write_report(
    out: Path, flights: "list[FlightReport]", opened: "orthonav.MapFile | None"
) -> None:
    from orthonav.ground.evaluate.report import write_report

    manifest = opened.manifest if opened else None
    made_from = {
        "map": opened.path.name if opened else "",
        "recipe": recipe_text(manifest.recipe) if manifest else "",
        "imagery": imagery_text(manifest.imagery) if manifest else "",
        "flight": ", ".join(flight.name for flight in flights),
        "command": " ".join(["orthonav", *sys.argv[1:]]),
        "orthonav": orthonav.__version__,
    }
    write_report(out, flights, made_from)


def _view_command(options: argparse.Namespace, i: int) -> str:
    if options.map is None:
        return ""
    words = ["orthonav", "view", str(options.fixes[i]), "--map", str(options.map)]
    words += ["--flight", str(options.flight[i])] if options.flight else []
    words += ["--truth", str(options.truth[i])] if options.truth else []
    words += ["--radius-m", f"{options.radius_m:g}"]
    return shlex.join(words)
