"""`orthonav atlas`: build, inspect, check, change and index an atlas, and cut maps out of it."""

import argparse
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthonav.cli.build import add_recipe, recipe_of
from orthonav.cli.common import add_area, add_dem, add_orthos, print_json, progress

if TYPE_CHECKING:
    from orthonav.ground.atlas.catalog import Atlas
    from orthonav.ground.atlas.cluster import TaskRunner

NOT_WHOLE = 3
SHOWN_FAILURES = 20
COARSE = ("gsd_m", "tile_px", "overlap")
EVERYDAY = {
    "build": (
        *("--route", "--bounds", "--band-m", "--gsd-m", "--sheet-km"),
        *("--replace", "--cluster", "--workers", "--json"),
    ),
    "cut": ("--route", "--bounds", "--band-m"),
}


def add(parser: argparse.ArgumentParser) -> None:
    common = argparse.ArgumentParser(add_help=False)
    for flags, text in (
        (("-v", "--verbose"), "say more, on stderr"),
        (("-q", "--quiet"), "errors only, no progress"),
    ):
        common.add_argument(*flags, action="store_true", default=argparse.SUPPRESS, help=text)
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)

    def action(name: str, text: str) -> argparse.ArgumentParser:
        found = actions.add_parser(
            name, help=text, description=text, parents=[common], allow_abbrev=False
        )
        found.add_argument("atlas", metavar="ATLAS", help="folder or URL: s3://, gs://, abfs://")
        return found

    _add_build(action("build", "build the missing sheets of an atlas, which is created first"))
    info = action("info", "print the contents of an atlas")
    info.add_argument("--json", action="store_true", help="print as JSON")
    check = action(
        "check", "check whether an atlas is complete: exit 0, or 3 and a list of problems"
    )
    check.add_argument(
        "--deep", action="store_true", help="read every file and verify its checksum"
    )
    check.add_argument(
        "--clean", action="store_true", help="remove leftovers of interrupted builds"
    )
    check.add_argument(
        "--min-age-h",
        type=_hours,
        default=24.0,
        metavar="H",
        help="least age of the leftovers that --clean removes; younger files may belong to a "
        "running build (default %(default)g)",
    )
    check.add_argument("--json", action="store_true", help="print as JSON")
    copied = action("add", "copy sheets of another atlas of the same recipe into this one")
    copied.add_argument("source", metavar="FROM", help="folder or URL of the other atlas")
    copied.add_argument("--sheets", nargs="+", metavar="SHEET", help="only these sheets")
    copied.add_argument(
        "--replace", action="store_true", help="replace sheets that differ from those of FROM"
    )
    retire = action("retire", "take sheets out of an atlas")
    retire.add_argument(
        "sheets", nargs="+", metavar="SHEET", help="name of a sheet, such as r001526c001392"
    )
    index = action("index", "build or update the index that is searched without a prior")
    index.add_argument("--rebuild", action="store_true", help="rebuild the whole index")
    cut = action("cut", "cut the map of a route or of bounds out of an atlas")
    add_area(cut, cut.add_mutually_exclusive_group(required=True))
    cut.add_argument(
        "--out", type=Path, required=True, metavar="MAP.onav", help="map file to write"
    )
    cut.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="number of parallel workers: threads that read sheets (default: one per core)",
    )
    cut.add_argument(
        "--allow-holes",
        action="store_true",
        help="write the map even if sheets under the route are missing",
    )


def _hours(text: str) -> float:
    try:
        hours = float(text)
    except ValueError:
        hours = math.nan
    if not (math.isfinite(hours) and hours >= 0):
        raise argparse.ArgumentTypeError(f"expected hours of 0 or more, got '{text}'")
    return hours


def run(options: argparse.Namespace) -> int | None:
    from orthonav.ground.atlas.catalog import Atlas

    if options.action == "build":
        return _build(options)
    if options.action == "add":
        _add(options)
        return None
    actions = {"info": _info, "check": _check, "retire": _retire, "index": _index, "cut": _cut}
    return actions[options.action](options, Atlas.open(options.atlas))


def _add_build(parser: argparse.ArgumentParser) -> None:
    add_orthos(parser, "orthophoto (any georeferenced raster that GDAL reads)")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    area = parser.add_argument_group("area (default: all imagery)")
    add_area(area, area.add_mutually_exclusive_group())
    sheets = parser.add_argument_group("sheets (set by the first build of an atlas)")
    sheets.add_argument(
        "--sheet-km", type=float, metavar="KM", help="greatest width of a sheet (default 10)"
    )
    add_recipe(sheets)
    add_dem(sheets, "which gives sheets a terrain layer, and maps that are cut out of them")
    sheets.add_argument(
        "--replace", action="store_true", help="rebuild sheets that have other imagery or versions"
    )
    coarse = parser.add_argument_group("coarse tiles, for views without a prior")
    coarse.add_argument(
        "--coarse-gsd-m",
        type=float,
        help="ground resolution of coarse tiles, metres per pixel (default 8)",
    )
    coarse.add_argument("--coarse-tile-px", type=int, help="width of a coarse tile (default 128)")
    coarse.add_argument(
        "--coarse-overlap",
        type=float,
        metavar="FRACTION",
        help="overlap of neighbouring coarse tiles, as a fraction of their width (default 0.875)",
    )
    coarse.add_argument(
        "--no-coarse",
        dest="coarse",
        action="store_false",
        help="omit the coarse tiles, from which the search index is made",
    )
    coarse.add_argument(
        "--no-index",
        dest="index",
        action="store_false",
        help="do not update the search index at the end",
    )
    cluster = parser.add_argument_group("workers")
    cluster.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="number of parallel workers: sheets that are built at a time (default: 1; with "
        "--cluster one per core)",
    )
    cluster.add_argument(
        "--cluster",
        metavar="local|ADDRESS",
        help="build with Ray, on the cores of this machine (local) or on the cluster at HOST:PORT "
        "(default: one sheet after the other in this process)",
    )


def _build(options: argparse.Namespace) -> int:
    from orthonav.ground.atlas.build import AtlasRequest, build_atlas
    from orthonav.ground.planning.route import read_route

    request = AtlasRequest(
        url=options.atlas,
        orthos=options.ortho,
        recipe=_recipe(options),
        bounds_deg=options.bounds,
        route=read_route(options.route) if options.route else None,
        band_m=options.band_m,
        replace=options.replace,
        index=options.index,
        dem=options.dem,
        dem_datum=options.dem_datum,
    )
    try:
        with _runner(options) as runner, progress(options) as shown:
            result = build_atlas(request, runner, shown)
    except KeyboardInterrupt:
        print(
            "orthonav: error: interrupted; finished sheets are stored, rerun to resume",
            file=sys.stderr,
        )
        return 1
    plain = result.to_plain()
    if options.json:
        print_json(plain)
    else:
        print(_build_text(plain))
    for line in _failures(plain):
        print(f"orthonav: error: {line}", file=sys.stderr)
    return 0 if result.is_complete else 1


def _recipe(options: argparse.Namespace) -> dict[str, Any]:
    from orthonav.core.errors import AtlasError

    given = recipe_of(options)
    if options.sheet_km is not None:
        given["sheet_km"] = options.sheet_km
    values = {name: getattr(options, f"coarse_{name}") for name in COARSE}
    coarse = {name: value for name, value in values.items() if value is not None}
    if coarse and not options.coarse:
        raise AtlasError("--no-coarse leaves out the coarse tiles: remove the other --coarse-..")
    if coarse or not options.coarse:
        given["coarse"] = coarse or None
    return given


def _runner(options: argparse.Namespace) -> "TaskRunner":
    from orthonav.ground.atlas.cluster import RayRunner, SerialRunner

    if options.cluster is None and options.workers in (None, 1):
        return SerialRunner()
    address = None if options.cluster in (None, "local") else options.cluster
    return RayRunner(address, options.workers)


def _build_text(plain: Mapping[str, Any]) -> str:
    lines = [
        f"atlas        {plain['atlas']}",
        f"sheets       {plain['built']} built, {plain['unchanged']} unchanged, "
        f"{plain['empty']} empty, {len(plain['failed'])} failed"
        + (f", {plain['untried']} not tried" * bool(plain["untried"])),
    ]
    if plain["built"]:
        lines += [
            f"area         {plain['area_km2']:.1f} km2 in {plain['tiles']:,} tiles",
            f"size         {plain['size_mb']:.1f} MB",
            f"time         {plain['wall_s']:.0f} s",
        ]
    return "\n".join(lines)


def _failures(plain: Mapping[str, Any]) -> list[str]:
    lines = [" ".join(f"sheet {x['sheet']}: {x['error']}".split()) for x in plain["failed"]]
    if len(lines) > SHOWN_FAILURES:
        more = f"and {len(lines) - SHOWN_FAILURES} more sheets, see --json"
        lines = [*lines[:SHOWN_FAILURES], more]
    return lines


def _info(options: argparse.Namespace, atlas: "Atlas") -> None:
    plain = summary(atlas)
    if options.json:
        print_json(plain)
    else:
        print(summary_text(plain))


def summary(atlas: "Atlas") -> dict[str, Any]:
    sheets = list(atlas.sheets().values())
    dates = sorted({date for sheet in sheets for date in sheet.dates})
    sources = {}
    for source in (source for sheet in sheets for source in sheet.imagery):
        terms = {key: source.get(key) for key in ("name", "attribution", "licence")}
        sources[tuple(map(str, terms.values()))] = terms
    size = sum(sheet.size_bytes for sheet in sheets)
    area_km2, bounds = sum(sheet.area_km2 for sheet in sheets), atlas.bounds_deg
    return {
        "atlas": str(atlas.store),
        "sheets": len(sheets),
        "tiles": sum(sheet.tiles for sheet in sheets),
        "area_km2": round(area_km2, 4),
        "bytes": size,
        "mb_per_km2": round(size / 1e6 / area_km2, 4) if area_km2 > 0 else None,
        "bounds_deg": bounds and [round(value, 7) for value in bounds],
        "date_from": dates[0] if dates else None,
        "date": dates[-1] if dates else None,
        "recipe": atlas.recipe.to_plain(),
        "imagery": [sources[key] for key in sorted(sources)],
        "made_by": sorted({" ".join(each) for sheet in sheets for each in sheet.made_by.items()}),
        "names": [sheet.id for sheet in sheets],
    }


def summary_text(plain: dict[str, Any]) -> str:
    recipe = dict(plain["recipe"])
    coarse = recipe.pop("coarse")
    values = ", ".join(f"{name} {value}" for name, value in recipe.items() if value is not None)
    lines = [
        f"atlas      {plain['atlas']}",
        f"sheets     {plain['sheets']} of {recipe['sheet_km']:g} km, {plain['tiles']} tiles",
        f"area       {plain['area_km2']:.2f} km2 of tile centres",
        f"size       {plain['bytes'] / 1e6:.3f} MB, {plain['mb_per_km2'] or 0:.3f} MB per km2",
        f"recipe     {values}",
    ]
    if coarse:
        of_coarse = ", ".join(f"{name} {value}" for name, value in coarse.items())
        lines.append(f"coarse     {of_coarse}")
    if plain["bounds_deg"]:
        west, south, east, north = plain["bounds_deg"]
        lines.append(
            f"bounds     {west:.4f},{south:.4f},{east:.4f},{north:.4f} (W,S,E,N in degrees)"
        )
    dates = dict.fromkeys(str(plain[key]) for key in ("date_from", "date") if plain[key])
    lines.append(f"dates      {' to '.join(dates) or 'unknown'}")
    for source in plain["imagery"][:20]:
        terms = [str(source[key]) for key in ("attribution", "licence") if source[key]]
        lines.append(f"imagery    {', '.join([str(source['name']), *terms])}")
    if len(plain["imagery"]) > 20:
        lines.append(f"           and {len(plain['imagery']) - 20} more (--json lists all)")
    return "\n".join(lines)


def _check(options: argparse.Namespace, atlas: "Atlas") -> int:
    from orthonav.ground.atlas.integrity import check_atlas

    with progress(options) as shown:
        found = check_atlas(
            atlas, options.deep, shown, clean=options.clean, min_age_s=options.min_age_h * 3600
        )
    left = [problem for problem in found if not problem.removed]
    if options.json:
        print_json(
            {
                "atlas": str(atlas.store),
                "whole": not left,
                "deep": options.deep,
                "problems": [vars(problem) for problem in found],
            }
        )
    else:
        for problem in found:
            done = " (fixed)" if problem.removed else ""
            print(f"{problem.kind:15} {problem.name}: {problem.detail}{done}")
        verdict = f"{len(left)} problems" if left else "whole"
        print(f"{verdict}{'' if options.deep else ', by names and sizes'}: {atlas.store}")
    return NOT_WHOLE if left else 0


def _add(options: argparse.Namespace) -> None:
    from orthonav.ground.atlas.catalog import Atlas, copy_sheets

    source = Atlas.open(options.source)
    atlas = Atlas.open_or_create(options.atlas, source.recipe)
    with progress(options) as shown:
        copied, unchanged = copy_sheets(source, atlas, options.sheets, options.replace, shown)
    print(f"{len(copied)} sheets added, {len(unchanged)} unchanged: {atlas.store}")


def _retire(options: argparse.Namespace, atlas: "Atlas") -> None:
    for sheet in dict.fromkeys(options.sheets):
        atlas.retire(sheet)
        print(f"retired    {sheet}")
    atlas.snapshot()


def _index(options: argparse.Namespace, atlas: "Atlas") -> None:
    from orthonav.ground.atlas.index import make_index

    with progress(options) as shown:
        made = make_index(atlas, progress=shown, rebuild=options.rebuild)
    if made is None:
        print(f"no sheet has coarse tiles, nothing to index: {atlas.store}")
        return
    rows = sum(part.rows for shard in made.shards for part in shard.parts)
    size = sum(file.size_bytes for file in made.files.values())
    print(f"{rows} tiles of {len(made.sheets)} sheets, {size / 1e6:.3f} MB: {atlas.store}")


def _cut(options: argparse.Namespace, atlas: "Atlas") -> None:
    from orthonav.cli.info import summary as map_summary
    from orthonav.cli.info import summary_text as map_text
    from orthonav.ground.atlas.cut import cut_map
    from orthonav.ground.planning.area import Area, require_one_area
    from orthonav.ground.planning.route import read_route

    if options.route is None:
        require_one_area(None, options.band_m, options.bounds)
        area = Area.from_bounds(options.bounds)
    else:
        area = Area.from_route(read_route(options.route), options.band_m)
    with progress(options) as shown:
        result = cut_map(
            atlas,
            options.out,
            area,
            workers=options.workers,
            allow_holes=options.allow_holes,
            progress=shown,
        )
    print(map_text(map_summary(result.manifest, result.size_bytes, options.out)))
