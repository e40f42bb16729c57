"""`orthonav demo`: build, check, fly, localize and report, over two orthophotos of the package."""

import argparse
import contextlib
import json
import shlex
import shutil
import time
from pathlib import Path
from typing import Any

import orthonav
from orthonav.cli.common import add_options, print_json, run_command, say
from orthonav.core.files import replacing_folder, write_text
from orthonav.ground import planning

EXAMPLE = ""
IMAGERY = Path(__file__).parents[1] / "ground" / "demo_data"
"""Two dates of a generated area of 2 x 2 km and its level terrain, from `lab/demo_imagery.py`."""
MARKER = "demo.json"
"""File that marks a folder as an earlier demo, which may be replaced."""
SPACING_M = 24.0
"""About 220 views along the route."""
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
    text = "folder to write (default ./orthonav-demo)"
    parser.add_argument("--out", type=Path, default=Path("orthonav-demo"), metavar="DIR", help=text)
    add_options(parser, "--json")


def run(options: argparse.Namespace) -> None:
    start, out = time.perf_counter(), options.out
    with replacing_folder(out, _is_earlier_demo) as folder:
        plain, text = _demo(folder, options)
        plain["made_by"] = "orthonav demo"
        (folder / MARKER).write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")
    if options.json:
        print_json(plain)
        return
    files = [f"{out}/fixes.jsonl", "--map", f"{out}/area.onav", "--flight", f"{out}/flight"]
    print(f"{text}\ndone in {time.perf_counter() - start:.0f} s")
    print(
        "look at:\n"
        f"  {out}/report/figures/map.png   picture: fixes and true positions on the map\n"
        f"  {out}/check/index.html         before the flight: where fixes are expected\n"
        f"  {out}/report/index.html        after the flight: errors, confidence, worst views\n"
        f"step through the views in a browser:\n  {shlex.join(['orthonav', 'view', *files])}"
    )


def _is_earlier_demo(out: Path) -> bool:
    """Whether a folder holds the output of an earlier demo and nothing else."""
    try:
        plain = json.loads((out / MARKER).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    names = {path.name for path in out.iterdir()}
    known = {MARKER, "area.onav", "check", "fixes.jsonl", "flight", "report", "route.geojson"}
    made = isinstance(plain, dict) and plain.get("made_by") == "orthonav demo"
    return made and all(name in known or name.endswith((".tif", ".tif.aux.xml")) for name in names)


def _demo(folder: Path, options: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Run the commands in the folder; the metrics, and what the commands printed about them."""
    past, present, dem = (shutil.copy(path, folder) for path in sorted(IMAGERY.glob("*.tif")))
    with contextlib.chdir(folder):
        past, present, dem = (Path(each).name for each in (past, present, dem))
        say(options, f"1/4 building the map from {past}")
        built = run_command(options, "build", "--ortho", past, "--dem", dem, "--out", "area.onav")
        frame = orthonav.open_map("area.onav").manifest.sheets[0].frame
        places = zip(*frame.latlon_from_en(WAYPOINTS_EN_M), strict=True)
        route = planning.Route(tuple((float(lat), float(lon)) for lat, lon in places), name="demo")
        write_text(Path("route.geojson"), planning.to_geojson([route]))
        # Views then cover 346 x 259 m, a whole tile of 256 m.
        flown = ("--route", "route.geojson", "--agl-m", 270)
        say(options, f"2/4 checking from {past} alone where along the route fixes are expected")
        trials = ("--band-m", 300, "--effort", CHECK_EFFORT)
        checked = run_command(options, "check", "area.onav", *flown, *trials, "--out", "check")
        say(
            options,
            f"3/4 simulating a flight over {present}, heading error 5 deg, height error 5 %, "
            "unreported tilt of mount and horizon 1 deg each",
        )
        errors = ("--yaw-std-deg", 5, "--agl-std", 0.05, "--seed", 1)
        spaced = ("--spacing-m", SPACING_M, "--out", "flight")
        run_command(options, "simulate", "--ortho", present, *flown, *errors, *spaced)
        say(options, "4/4 localizing every view, searching the whole map")
        searched = ("--prior", "none", "--out", "fixes.jsonl")
        run_command(options, "localize", "area.onav", "flight", *searched)
        scored = ("evaluate", "fixes.jsonl", "--flight", "flight")
        plain = json.loads(run_command(options, *scored, "--json"))
        reported = ("--map", "area.onav", "--report", "report")
        measured = run_command(options, *scored, *reported)
    verdict = checked.partition("\n")[0]
    return plain, f"{built}\ncheck      {verdict}\n\n{measured.rpartition('report: ')[0]}"
