"""`orthonav run`: from a recording and an orthophoto to positions and a page."""

import argparse
import csv
import io
import math
import shlex
import statistics
from itertools import pairwise
from pathlib import Path

from orthonav.cli.common import add_options, progress, run_command, say, watched
from orthonav.cli.source import add_source, dem_of, source_options
from orthonav.core.errors import MissingFileError, OutputError
from orthonav.core.files import write_text

EXAMPLE = "DCIM --map ortho.tif --dem dem.tif"
EVERYDAY = ("--out", "--dem", "--camera", "--fov-deg", "--telemetry", "--agl-m", "--heading")


def add(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    text = "flight folder, photographs, video or ROS recording, as for `orthonav localize`"
    add("flight", type=Path, nargs="+", metavar="SOURCE", help=text)
    text = "map, or an orthophoto (or a folder of them): a map of it is built around the recorded "
    add("--map", type=Path, required=True, metavar="MAP.onav", help=f"{text}positions")
    text = "folder to write (default ./orthonav-run)"
    add("--out", type=Path, default=Path("orthonav-run"), metavar="DIR", help=text)
    add_source(parser)
    add_options(parser, "--heading")
    parser.set_defaults(skip_bad_images=True)


def run(options: argparse.Namespace) -> None:
    out, area, source = options.out, options.map, vars(source_options(options))
    fixes, positions, report = out / "fixes.jsonl", out / "truth.csv", out / "report"
    ours = {"area.onav", fixes.name, positions.name, report.name}
    if foreign := {each.name for each in out.glob("[!.]*")} - ours:
        raise OutputError(f"output folder holds what no run wrote ({min(foreign)}): {out}")
    if not area.exists():
        raise MissingFileError(f"orthophoto or map does not exist: {area}")
    dem_of(options)
    truth, band_m, tracked, kind = _recorded(options)
    write_text(positions, truth)
    terrain = {name: getattr(options, name) for name in ("dem", "dem_datum")}
    if area.suffix.lower() != ".onav":
        area = out / "area.onav"
        around = ("--route", positions, "--band-m", band_m) if band_m else ()
        say(options, f"building the map; after an interrupt --map {area} uses it, once it is there")
        run_command(options, "build", "--ortho", options.map, "--out", area, *around, **terrain)
        terrain = dict.fromkeys(terrain)
    say(options, f"localizing the views on {area}")
    placed = (*["--track"] * tracked, "--heading", options.heading, "--out", fixes)
    print(run_command(options, "localize", area, *options.flight, *placed, **source | terrain))
    if band_m:
        compared = ("--truth", positions, "--map", area, "--report", report)
        print(run_command(options, "evaluate", fixes, *compared), end="")
        print(f"open it: {(report / 'index.html').resolve().as_uri()}")
    else:
        print("no positions were recorded to compare with: there is no report")
    if kind in ("flight", "photos") and len(options.flight) == 1:
        words = ["orthonav", "view", fixes, "--map", area, "--flight", options.flight[0]]
        print(f"step through the views: {shlex.join(map(str, words))}")


def _recorded(options: argparse.Namespace) -> tuple[str, float, bool, str]:
    """Recorded positions as `truth.csv`; the width of the band around them that views show, 0
    without any; whether views follow each other closely enough for a track; kind of recording."""
    from orthonav.ground.recordings import open_source

    text, most_m, count, times_ns = io.StringIO(newline=""), 0.0, 0, []
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("frame", "lat_deg", "lon_deg"))
    over_terrain = options.dem is not None or options.map.suffix.lower() == ".onav"
    found = open_source(options.flight, source_options(options, over_terrain=over_terrain))
    with progress(options) as shown:
        for view in watched(found.views, found.expected, "positions", shown):
            agl_m = view.telemetry.agl_m
            most_m = max(most_m, agl_m if math.isfinite(agl_m) else 1000.0)  # only altitudes
            times_ns.append(view.telemetry.time_ns)
            if view.truth_latlon_deg is not None:
                writer.writerow((view.frame, *(f"{each:.8f}" for each in view.truth_latlon_deg)))
                count += 1
    steps_s = [(after - before) / 1e9 for before, after in pairwise(times_ns)]
    tracked = bool(steps_s) and statistics.median(steps_s) <= 5
    margin_m = 300 + most_m  # ground beside the positions that belongs to the map
    return text.getvalue(), 2 * margin_m if count else 0.0, tracked, found.kind
