"""`orthonav evaluate`: compare fixes with the truth."""

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthonav.cli.common import print_json

if TYPE_CHECKING:
    from orthonav.evaluate.plots import Background
    from orthonav.mapfile.reader import MapFile


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
    parser.add_argument("--report", type=Path, metavar="REPORT/", help="write an HTML report")
    parser.add_argument("--map", type=Path, metavar="MAP.onav", help="background of the report")


def run(options: argparse.Namespace) -> None:
    """Measure, print the table, write what was asked for."""
    from orthonav.errors import FlightError
    from orthonav.evaluate.metrics import compare, measure
    from orthonav.evaluate.report import FlightReport, metrics_to_json, summary, table, total
    from orthonav.files import write_text
    from orthonav.flight import read_truth
    from orthonav.mapfile import open_map
    from orthonav.publish.jsonl import read_results

    if len(options.fixes) != len(options.truth):
        raise FlightError(
            f"{len(options.fixes)} files of fixes need as many --truth, got {len(options.truth)}"
        )
    if not 0 < options.radius_m < 1e7:
        raise FlightError(f"radius must be above 0 m, got {options.radius_m}")
    opened = open_map(options.map) if options.map else None
    local = opened.manifest.sheets[0].frame if opened else None
    background = map_background(opened) if opened else None
    names = _names(options.fixes)
    flights: list[FlightReport] = []
    for fixes, truth in zip(options.fixes, options.truth, strict=True):
        comparison = compare(read_truth(truth), read_results(fixes), local)
        metrics = measure(comparison, options.radius_m)
        flights.append(FlightReport(names[len(flights)], comparison, metrics, background))
    if options.report:
        _write_report(options.report, flights, opened)
    plain: dict[str, Any] = metrics_to_json(flights[0].metrics)
    if len(flights) > 1:
        plain = metrics_to_json(total(flights))
        plain["flights"] = {flight.name: metrics_to_json(flight.metrics) for flight in flights}
    if options.json == "-":
        print_json(plain)
        return
    if options.json:
        write_text(Path(options.json), json.dumps(plain, indent=1, allow_nan=False) + "\n")
    print(f"{table(flights)}\n\n{summary(flights)}")
    if options.report:
        print(f"report: {options.report / 'index.html'}")


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
    from orthonav.cli.info import recipe_text
    from orthonav.evaluate.report import MadeFrom, write_report

    made_from = MadeFrom(
        map_name=opened.path.name if opened else "",
        recipe=recipe_text(opened.manifest.recipe) if opened else "",
        flight=", ".join(flight.name for flight in flights),
        command=" ".join(["orthonav", *sys.argv[1:]]),
        version=__version__,
    )
    write_report(out, flights, made_from)


def map_background(opened: "MapFile") -> "Background":
    """The small picture of the area that a map carries."""
    import cv2
    import numpy as np

    from orthonav.errors import MapFileError
    from orthonav.evaluate.plots import Background

    data = opened.array("sheet0/preview_jpeg", np.uint8, 1)
    grey = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
    if grey is None:
        raise MapFileError(f"map's preview cannot be decoded: {opened.path}")
    grid = opened.manifest.sheets[0].grid
    return Background(
        np.asarray(grey, dtype=np.uint8),
        west_m=grid.west_m,
        south_m=grid.north_m - grid.height_px * grid.gsd_m,
        east_m=grid.west_m + grid.width_px * grid.gsd_m,
        north_m=grid.north_m,
    )
