"""`orthonav atlas`: build, inspect, check, change and index an atlas, and cut maps out of it."""

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthonav.cli import verbosity
from orthonav.cli.build import asked
from orthonav.cli.common import add_area, add_options, area_of, given, print_json, progress

if TYPE_CHECKING:
    from orthonav.ground.atlas.catalog import Atlas
    from orthonav.ground.atlas.cluster import TaskRunner

NOT_WHOLE = 3
SHOWN_FAILURES = 20
EXAMPLE = "build ATLAS --ortho orthos/"
EVERYDAY = {
    "build": (
        *("--route", "--bounds", "--band-m", "--gsd-m", "--sheet-km"),
        *("--replace", "--cluster", "--workers", "--json"),
    ),
    "cut": ("--route", "--bounds", "--band-m"),
}


def add(parser: argparse.ArgumentParser) -> None:
    common = verbosity(default=argparse.SUPPRESS)
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)

    def action(name: str, text: str) -> argparse.ArgumentParser:
        found = actions.add_parser(name, help=text, description=text, parents=[common])
        found.add_argument("atlas", metavar="ATLAS", help="folder or URL: s3://, gs://, abfs://")
        return found

    _add_build(action("build", "build the missing sheets of an atlas, which is created first"))
    add_options(action("info", "print the contents of an atlas"), "--json")
    text = "check whether an atlas is complete: exit 0, or 3 and a list of problems"
    check = action("check", text)
    text = "read every file and verify its checksum"
    check.add_argument("--deep", action="store_true", help=text)
    text = "remove leftovers of interrupted builds that are older than 24 hours"
    check.add_argument("--clean", action="store_true", help=text)
    add_options(check, "--json")
    copied = action("add", "copy sheets of another atlas of the same recipe into this one")
    copied.add_argument("source", metavar="FROM", help="folder or URL of the other atlas")
    text = "replace sheets that differ from those of FROM"
    copied.add_argument("--replace", action="store_true", help=text)
    retire = action("retire", "take sheets out of an atlas")
    text = "name of a sheet, such as r001526c001392"
    retire.add_argument("sheets", nargs="+", metavar="SHEET", help=text)
    index = action("index", "build or update the index that is searched without a prior")
    index.add_argument("--replace", action="store_true", help="build the whole index again")
    cut = action("cut", "cut the map of a route or of bounds out of an atlas")
    add_area(cut, required=True)
    text = "map file to write"
    cut.add_argument("--out", type=Path, required=True, metavar="MAP.onav", help=text)
    add_options(cut, "--workers", "--allow-holes")


def _add_build(parser: argparse.ArgumentParser) -> None:
    add_options(parser, "--ortho", "--json")
    add_area(parser.add_argument_group("area (default: all imagery)"))
    group = parser.add_argument_group("sheets (set by the first build of an atlas)")
    text = "greatest width of a sheet (default 10)"
    group.add_argument("--sheet-km", type=float, help=text)
    add_options(group, "--gsd-m", "--tile-px", "--overlap")
    add_options(group, "--dem", "--surface", "--true-ortho", "--dem-datum", "--relief")
    text = "rebuild sheets that have other imagery or versions"
    group.add_argument("--replace", action="store_true", help=text)
    add = parser.add_argument_group("coarse tiles, for views without a prior").add_argument
    text = "ground resolution of coarse tiles, metres per pixel (default 8)"
    add("--coarse-gsd-m", type=float, help=text)
    group = parser.add_argument_group("workers")
    text = "sheets that are built at a time (default: 1; with --cluster one per core)"
    add_options(group, "--workers", help=text)
    text = "build with Ray, on the cores of this machine (local) or on the cluster at HOST:PORT "
    text += "(default: one sheet after the other in this process)"
    group.add_argument("--cluster", metavar="local|ADDRESS", help=text)


def run(options: argparse.Namespace) -> int | None:
    from orthonav.ground.atlas.catalog import Atlas

    if options.action == "build":
        return _build(options)
    if options.action == "add":
        _add(options)
        return None
    actions = {"info": _info, "check": _check, "retire": _retire, "index": _index, "cut": _cut}
    return actions[options.action](options, Atlas.open(options.atlas))


def _build(options: argparse.Namespace) -> int:
    from orthonav.ground.atlas.build import AtlasRequest, build_atlas
    from orthonav.ground.atlas.catalog import AtlasRecipe

    recipe = given(options, AtlasRecipe)
    if options.coarse_gsd_m is not None:
        recipe["coarse"] = {"gsd_m": options.coarse_gsd_m}
    fields = asked(options, AtlasRequest) | {"url": options.atlas, "recipe": recipe}
    request = AtlasRequest(**fields)
    try:
        with _runner(options) as runner, progress(options) as shown:
            result = build_atlas(request, runner, shown)
    except KeyboardInterrupt as stopped:
        stopped.args = ("finished sheets are stored, rerun to resume",)
        raise
    plain = result.to_plain()
    if options.json:
        print_json(plain)
    else:
        _print_rows(plain, "failed")
    for line in _failures(plain):
        print(f"orthonav: error: {line}", file=sys.stderr)
    return 0 if result.is_complete else 1


def _runner(options: argparse.Namespace) -> "TaskRunner":
    from orthonav.ground.atlas.cluster import RayRunner, SerialRunner

    if options.cluster is None and options.workers in (None, 1):
        return SerialRunner()
    address = None if options.cluster in (None, "local") else options.cluster
    return RayRunner(address, options.workers)


def _print_rows(plain: Mapping[str, Any], *left_out: str) -> None:
    for name, value in plain.items():
        if name not in left_out:
            print(f"{name:<17}{'unknown' if value is None else value}")


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
        return
    _print_rows(plain, "recipe", "imagery", "names")
    recipe = ((name, value) for name, value in plain["recipe"].items() if value is not None)
    print(f"{'recipe':<17}{', '.join(f'{name} {value}' for name, value in recipe)}")
    for terms in plain["imagery"]:
        print(f"{'imagery':<17}{', '.join(str(value) for value in terms.values() if value)}")


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


def _check(options: argparse.Namespace, atlas: "Atlas") -> int:
    from orthonav.ground.atlas.integrity import check_atlas

    with progress(options) as shown:
        found = check_atlas(atlas, options.deep, shown, clean=options.clean)
    left = [problem for problem in found if not problem.removed]
    if options.json:
        plain = {"atlas": str(atlas.store), "whole": not left, "deep": options.deep}
        print_json(plain | {"problems": [vars(problem) for problem in found]})
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
        copied, unchanged = copy_sheets(source, atlas, options.replace, shown)
    print(f"{len(copied)} sheets added, {len(unchanged)} unchanged: {atlas.store}")


def _retire(options: argparse.Namespace, atlas: "Atlas") -> None:
    for sheet in dict.fromkeys(options.sheets):
        atlas.retire(sheet)
        print(f"retired    {sheet}")
    atlas.snapshot()


def _index(options: argparse.Namespace, atlas: "Atlas") -> None:
    from orthonav.ground.atlas.index import make_index

    atlas.snapshot()
    with progress(options) as shown:
        made = make_index(atlas, progress=shown, rebuild=options.replace)
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

    with progress(options) as shown:
        result = cut_map(
            atlas,
            options.out,
            area_of(options),
            workers=options.workers,
            allow_holes=options.allow_holes,
            progress=shown,
        )
    print(map_text(map_summary(result.manifest, result.size_bytes, options.out)))
