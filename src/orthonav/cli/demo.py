"""`orthonav demo`: build, check, fly, localize and report, over two orthophotos of the package."""

import argparse
import json
import os
import shlex
import shutil
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthonav.cli.common import Progress, print_json, progress
from orthonav.cli.simulate import HORIZON_STD_DEG, MOUNT_STD_DEG

if TYPE_CHECKING:
    from orthonav.ground.evaluate.metrics import Metrics

IMAGERY = Path(__file__).parents[1] / "ground" / "demo_data"
"""Two dates of a generated area of 2 x 2 km; `lab/demo_imagery.py` makes them."""
MARKER = "demo.json"
"""File that marks a folder as an earlier demo, which may be replaced."""
HEIGHT_M = 270.0
"""Views then cover 346 x 259 m, a whole tile of 256 m."""
SPACING_M = 24.0
"""About 220 views along the route."""
RADIUS_M = 15.0
"""Error below which a fix is correct, as in the paper (accuracy at 15 m)."""
CHECKED_BAND_M = 300.0
CHECK_EFFORT = 0.5
"""Half of the trials of a full check, to keep the demo short."""
WAYPOINTS_EN_M = (
    (-720, -720),
    (-720, 650),
    (-300, 730),
    (-150, -650),
    (350, -720),
    (420, 600),
    (740, 740),
)
"""The route in metres east and north of the centre of the area, which is 2 km wide."""


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("orthonav-demo"),
        metavar="DIR",
        help="folder to write (default ./orthonav-demo)",
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the flight (default 1)")
    parser.add_argument("--json", action="store_true", help="print the metrics as JSON")


def run(options: argparse.Namespace) -> None:
    from orthonav.core.files import replacing_folder

    start = time.perf_counter()
    with progress(options) as shown, replacing_folder(options.out, _is_earlier_demo) as folder:
        plain, text = _demo(folder, options, shown)
        plain["made_by"] = "orthonav demo"
        (folder / MARKER).write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")
    if options.json:
        print_json(plain)
        return
    print(f"{text}\n\ndone in {time.perf_counter() - start:.0f} s")
    print(_how_to_view(options.out))


def _how_to_view(out: Path) -> str:
    """A picture, the reports, and the command that shows the flight."""
    files = [f"{out}/fixes.jsonl", "--map", f"{out}/area.onav", "--flight", f"{out}/flight"]
    command = shlex.join([*_this_program(), "view", *files])
    return "\n".join(
        (
            "look at:",
            f"  {out}/report/figures/map.png   picture: fixes and true positions on the map",
            f"  {out}/check/index.html         before the flight: where fixes are expected",
            f"  {out}/report/index.html        after the flight: errors, confidence, worst views",
            f"step through the views in a browser:\n  {command}",
        )
    )


def _this_program() -> list[str]:
    """The words that call this program again: its name, if the shell finds it, else its path."""
    called = Path(sys.argv[0])
    if called.name != "orthonav":
        return [sys.executable, "-m", "orthonav"]
    found = shutil.which("orthonav")
    is_found = found is not None and os.path.realpath(found) == os.path.realpath(called)
    return ["orthonav" if is_found else str(called)]


def _is_earlier_demo(out: Path) -> bool:
    """Whether a folder holds the output of an earlier demo and nothing else."""
    try:
        plain = json.loads((out / MARKER).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    names = {path.name for path in out.iterdir()}
    known = {MARKER, "area.onav", "check", "fixes.jsonl", "flight", "report", "route.geojson"}
    made = isinstance(plain, dict) and plain.get("made_by") == "orthonav demo"
    return made and all(name in known or name.endswith(".tif") for name in names)


def _demo(folder: Path, options: argparse.Namespace, shown: Progress) -> tuple[dict[str, Any], str]:
    from orthonav.cli.evaluate import map_background
    from orthonav.cli.info import recipe_text, summary, summary_text
    from orthonav.core.flight import open_flight, read_truth
    from orthonav.core.flight.fixes import Identity, flight_digest, write_results
    from orthonav.core.localize import Localizer
    from orthonav.core.mapfile import open_map
    from orthonav.ground.build import BuildRequest, build_map
    from orthonav.ground.evaluate.metrics import compare, measure
    from orthonav.ground.evaluate.report import MadeFrom, write_report
    from orthonav.ground.evaluate.tables import FlightReport, metrics_to_json, table, verdict
    from orthonav.ground.planning.route import read_route
    from orthonav.ground.recordings.localize import localize_flight
    from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight
    from orthonav.onboard.run import SingleViews

    past, present = (Path(shutil.copy(path, folder)) for path in sorted(IMAGERY.glob("*.tif")))
    _say(options, f"1/4 building the map from {past.name}")
    map_path = folder / "area.onav"
    built = build_map(BuildRequest([past], map_path), shown)
    opened = open_map(map_path)
    frame = opened.manifest.sheets[0].frame
    route = folder / "route.geojson"
    _write_route(route, frame.latlon_from_en(WAYPOINTS_EN_M))
    _say(options, f"2/4 checking from {past.name} alone where along the route fixes are expected")
    checked = _checked(folder, map_path, route, shown)
    _say(
        options,
        f"3/4 simulating a flight over {present.name}, heading error 5 deg, height error 5 %, "
        "unreported tilt of mount and horizon 1 deg each",
    )
    request = SimulateRequest(
        [present],
        folder / "flight",
        route=read_route(route),
        agl_m=HEIGHT_M,
        spacing_m=SPACING_M,
        errors=Errors(
            yaw_std_deg=5.0,
            agl_std=0.05,
            mount_std_deg=MOUNT_STD_DEG,
            horizon_std_deg=HORIZON_STD_DEG,
        ),
        seed=options.seed,
    )
    simulate_flight(request, lambda share: shown("simulate", share))
    _say(options, "4/4 localizing every view, searching the whole map")
    results = []
    flight = open_flight(request.out)
    for result in localize_flight(SingleViews(Localizer(opened), use_prior=False), flight):
        results.append(result)
        shown("localize", len(results) / len(flight.views))
    identity = Identity(opened.manifest.sha256, flight_digest(flight.views))
    write_results(folder / "fixes.jsonl", results, identity)
    comparison = compare(read_truth(request.out / "truth.csv"), results, frame)
    metrics = measure(comparison, RADIUS_M)
    shown_flight = FlightReport("demo", comparison, metrics, map_background(opened))
    about = summary(built.manifest, built.size_bytes, Path(map_path.name))
    made_from = MadeFrom(
        map_name=map_path.name,
        recipe=recipe_text(about["recipe"]),
        flight=f"{len(results)} views of {present.name}",
        command="orthonav demo",
        version=str(about["created_by"]),
    )
    write_report(folder / "report", [shown_flight], made_from)
    lines = [summary_text(about), "", f"check      {checked}", ""]
    lines += [verdict(metrics), "", table([shown_flight], metrics), "", *_criteria_lines(metrics)]
    return metrics_to_json(metrics), "\n".join(lines)


def _checked(folder: Path, map_path: Path, route: Path, shown: Progress) -> str:
    """The prediction for the route in one line; writes the report of the check to `check`."""
    from orthonav import __version__
    from orthonav.cli.info import imagery_text, recipe_text
    from orthonav.core.mapfile import open_map
    from orthonav.ground.check.outcome import CheckedInputs
    from orthonav.ground.check.request import CheckRequest
    from orthonav.ground.check.run import check_map
    from orthonav.ground.check.write import write_check
    from orthonav.ground.planning.route import read_route

    manifest = open_map(map_path).manifest
    request = CheckRequest(
        map_path,
        route=read_route(route),
        band_m=CHECKED_BAND_M,
        agl_m=HEIGHT_M,
        effort=CHECK_EFFORT,
        extras=False,
        about=CheckedInputs(
            map_path.name,
            imagery_text(manifest.imagery),
            recipe_text(manifest.recipe),
            route_name="demo",
            command="orthonav demo",
            version=__version__,
        ),
    )
    result, opened = check_map(request, shown)
    write_check(result, opened, folder / "check")
    assert result.along is not None
    mean, word = float(result.along.probability.mean()), result.verdict.word.value
    return (
        f"{word}: {mean:.0%} of views along the route are expected to give a correct, confident fix"
    )


def _criteria_lines(metrics: "Metrics") -> list[str]:
    """Accepted share and accuracy at each confidence threshold."""
    return [
        f"confidence >= {row.threshold:g}: {row.share_accepted:.0%} of views accepted, "
        f"{row.accuracy:.1%} of them within {metrics.radius_m:g} m"
        for row in metrics.criteria
        if row.name == "confidence" and row.share_accepted > 0
    ]


def _write_route(path: Path, latlon_deg: Any) -> None:
    line = [[float(lon), float(lat)] for lat, lon in zip(*latlon_deg, strict=True)]
    geometry = {"type": "LineString", "coordinates": line}
    feature = {"type": "Feature", "properties": {"name": "demo"}, "geometry": geometry}
    path.write_text(json.dumps(feature) + "\n", encoding="utf-8")


def _say(options: argparse.Namespace, text: str) -> None:
    if not options.quiet:
        print(text, file=sys.stderr, flush=True)
