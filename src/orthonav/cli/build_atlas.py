"""`orthonav build --atlas`: make the sheets of an atlas, on one machine or many."""

import argparse
import logging
import os
import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from orthonav.cli.common import print_json, progress

if TYPE_CHECKING:
    from orthonav.atlas.build import AtlasBuilt
    from orthonav.atlas.cluster import Runner

log = logging.getLogger(__name__)

COARSE = ("gsd_m", "tile_px", "overlap")
ONLY_ATLAS = ("sheet_km", "cluster", "cpu_hour_price", *(f"coarse_{name}" for name in COARSE))
ONLY_ATLAS_FLAGS = {"replace": False, "index": True, "coarse": True}
SHOWN_FAILURES = 20


def add(parser: argparse.ArgumentParser, target: Any) -> None:
    """`--atlas` to the group of targets, and what belongs to it."""
    target.add_argument(
        "--atlas",
        metavar="ATLAS",
        help="build the sheets of an atlas instead: a folder, or a URL such as s3://BUCKET/NAME; "
        "sheets that are there are kept, so a build that was interrupted goes on",
    )
    group = parser.add_argument_group("atlas")
    group.add_argument(
        "--sheet-km", type=float, metavar="KM", help="greatest width of a sheet (default 10)"
    )
    group.add_argument("--coarse-gsd-m", type=float, help="of the tiles of its index (default 8)")
    group.add_argument("--coarse-tile-px", type=int, help="width of such a tile (default 128)")
    group.add_argument("--coarse-overlap", type=float, help="share in common (default 0.75)")
    group.add_argument(
        "--no-coarse",
        dest="coarse",
        action="store_false",
        help="leave out the tiles by which views are looked for in the whole atlas",
    )
    group.add_argument(
        "--cluster",
        metavar="local|ADDRESS",
        help="sheets are built by Ray: on the cores of this machine, or by the cluster at "
        "HOST:PORT (default: one after the other in this process)",
    )
    group.add_argument(
        "--replace", action="store_true", help="build sheets anew that were made otherwise"
    )
    group.add_argument(
        "--no-index",
        dest="index",
        action="store_false",
        help="do not make the index of the coarse tiles at the end",
    )
    group.add_argument(
        "--cpu-hour-price",
        type=float,
        metavar="PRICE",
        help="price of an hour of a core: the summary then tells what the sheets cost",
    )


def refuse(options: argparse.Namespace) -> None:
    """Raises `AtlasError` for options that only an atlas has."""
    from orthonav.errors import AtlasError

    for name in ONLY_ATLAS:
        if getattr(options, name) is not None:
            raise AtlasError(f"--{name.replace('_', '-')} is for an atlas: give --atlas")
    for name, usual in ONLY_ATLAS_FLAGS.items():
        if getattr(options, name) is not usual:
            flag = f"no-{name}" if usual else name
            raise AtlasError(f"--{flag} is for an atlas: give --atlas")


def run(options: argparse.Namespace, recipe: Mapping[str, Any]) -> int:
    """Build, print a summary; returns 1 where a sheet failed."""
    from orthonav.atlas.build import AtlasRequest, build_atlas
    from orthonav.errors import AtlasError
    from orthonav.geo.route import read_route

    if options.other_date or options.work is not None:
        name = "--other-date" if options.other_date else "--work"
        raise AtlasError(f"{name} is for a single map, not for an atlas")
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise AtlasError("torchrun is for a single map: sheets of an atlas are spread by --cluster")
    request = AtlasRequest(
        url=options.atlas,
        orthos=options.ortho,
        recipe=_recipe(options, recipe),
        bounds_deg=options.bounds,
        route=read_route(options.route) if options.route else None,
        band_m=options.band_m,
        replace=options.replace,
        index=options.index,
    )
    try:
        with _runner(options) as runner, progress(options) as shown:
            result = build_atlas(request, runner, shown, teller(options))
    except KeyboardInterrupt:
        print(
            "orthonav: error: interrupted; the sheets that are finished are kept, the same "
            "command goes on from there",
            file=sys.stderr,
        )
        return 1
    plain = result.to_plain(options.cpu_hour_price)
    if options.json:
        print_json(plain)
    else:
        print(_text(plain))
    for line in _failures(result):
        print(f"orthonav: error: {line}", file=sys.stderr)
    return 0 if result.is_complete else 1


def teller(options: argparse.Namespace) -> Callable[[str], None]:
    """What shows lines about the work on a terminal, and logs them elsewhere."""
    if options.quiet or not sys.stderr.isatty():
        return log.info
    return lambda line: print(line, file=sys.stderr)


def _recipe(options: argparse.Namespace, recipe: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of `AtlasRecipe` that were given."""
    from orthonav.errors import AtlasError

    given = dict(recipe)
    if options.sheet_km is not None:
        given["sheet_km"] = options.sheet_km
    told = {name: getattr(options, f"coarse_{name}") for name in COARSE}
    coarse = {name: value for name, value in told.items() if value is not None}
    if coarse and not options.coarse:
        raise AtlasError("--no-coarse leaves out the coarse tiles: say nothing else of them")
    if coarse or not options.coarse:
        given["coarse"] = coarse or None
    return given


def _runner(options: argparse.Namespace) -> "Runner":
    from orthonav.atlas.cluster import PlainRunner, RayRunner

    if options.cluster is None and options.workers in (None, 1):
        return PlainRunner()
    address = None if options.cluster in (None, "local") else options.cluster
    return RayRunner(address, options.workers)


def _text(plain: Mapping[str, Any]) -> str:
    """The summary for people."""
    lines = [
        f"atlas        {plain['atlas']}",
        f"sheets       {plain['built']} built, {plain['kept']} kept, {plain['empty']} empty, "
        f"{len(plain['failed'])} failed"
        + (f", {plain['untried']} not tried" * bool(plain["untried"])),
    ]
    if plain["built"]:
        lines += [
            f"area         {plain['area_km2']:.1f} km2 in {plain['tiles']:,} tiles",
            f"size         {plain['size_mb']:.1f} MB, {plain['mb_per_km2']:.2f} MB per km2",
            f"time         {plain['wall_s']:.0f} s: {plain['km2_per_hour']:,.0f} km2 per hour, "
            f"{plain['cpu_s_per_km2']:.2f} CPU s per km2",
            f"memory       {plain['peak_mb']:.0f} MB at most in a process",
        ]
        if "cost" in plain:
            lines.append(f"cost         {plain['cost']:.4g}, {plain['cost_per_km2']:.4g} per km2")
    return "\n".join(lines)


def _failures(result: "AtlasBuilt") -> list[str]:
    lines = [" ".join(f"sheet {sheet}: {error}".split()) for sheet, error in result.failed]
    if len(lines) > SHOWN_FAILURES:
        more = f"and {len(lines) - SHOWN_FAILURES} more sheets, see --json"
        lines = [*lines[:SHOWN_FAILURES], more]
    if result.finish_error:
        lines.append(f"snapshot and index could not be written: {result.finish_error}")
    return lines
