"""`orthonav fetch`: download orthophotos of an area from open services."""

import argparse
import logging
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from orthonav.cli.common import (
    add_area,
    add_options,
    area_of,
    given,
    print_json,
    progress,
    say,
)
from orthonav.cli.version import require_extras
from orthonav.core.errors import AreaError, FetchError, OutputError, UsageError

if TYPE_CHECKING:
    from orthonav.ground.fetch.run import CostEstimate, FetchRequest, FetchResult

log = logging.getLogger(__name__)
EXAMPLE = "--route route.kml --source ign --out ortho.tif"
EVERYDAY = (
    *("--route", "--bounds", "--band-m", "--source", "--list", "--out", "--dry-run", "--gsd-m"),
    *("--layer", "--time", "--heights", "--json"),
)


def add(parser: argparse.ArgumentParser) -> None:
    text = "a service by name, such as ign:2021, or wmts|wms|wcs|xyz|stac|cog:https://..."
    parser.add_argument("--source", metavar="NAME[:YEAR]|PROTOCOL:ADDRESS", help=text)
    text = "table of services of your own, as in docs/imagery.md"
    parser.add_argument("--services", type=Path, metavar="FILE.toml", help=text)
    parser.add_argument("--list", action="store_true", help="list the services known by name")
    parser.add_argument("--out", type=Path, metavar="ORTHO.tif", help="GeoTIFF to write")
    text = "written beside the imagery: the terrain, as ORTHO_dem.tif (default); with surface also "
    text += "houses and trees, as ORTHO_dsm.tif, where a model of them is known"
    heights = ("none", "terrain", "surface")
    parser.add_argument("--heights", choices=heights, default="terrain", help=text)
    text = "print the estimated cost and fetch nothing"
    parser.add_argument("--dry-run", action="store_true", help=text)
    add_options(parser, "--json")
    group = parser.add_argument_group("area")
    add_area(group)
    text = "width of the margin that is fetched around the area (default 200)"
    group.add_argument("--margin-m", type=float, default=200.0, help=text)
    group = parser.add_argument_group("imagery")
    text = "ground resolution, metres per pixel: the service's next finer one, or exactly this "
    text += "from a WMS (default 0.5; the files' own from stac and cog)"
    add_options(group, "--gsd-m", help=text)
    add = group.add_argument
    add("--layer", help="layer of the service, coverage of a WCS, or collection of a STAC")
    add("--time", help="ISO 8601 time, or interval A/B of a STAC")
    add("--key-env", metavar="VARIABLE", help="environment variable with the key for {key}")
    text = "compression of the GeoTIFF (default jpeg)"
    add("--compress", choices=("jpeg", "deflate"), default="jpeg", help=text)
    add_options(group, "--allow-holes")
    text = "refuse to fetch more than this (default 2000)"
    add("--max-mb", type=float, default=2000.0, help=text)


def run(options: argparse.Namespace) -> None:
    if options.list:
        _print_presets(options)
        return
    if options.source is None or (options.out is None and not options.dry_run):
        raise UsageError("give a --source (--list shows the known ones) and an --out")
    require_extras("fetch --source")
    from orthonav.ground.fetch.presets import DEFAULT_TERRAIN
    from orthonav.ground.fetch.run import estimate_fetch, fetch, holds_heights

    request = _request(options)
    names = _heights_presets(options)
    if options.dry_run:
        _print_estimate(options, estimate_fetch(request), names)
        return
    with progress(options) as shown:
        result = fetch(request, shown, lambda estimate: say(options, f"fetching {estimate.text()}"))
    imagery = request.spec.provenance.datum is None and not holds_heights(options.out)
    found: dict[str, tuple[Path, FetchResult]] = {}
    for kind, name in names.items():
        if name is not None and imagery:
            found |= _heights(options, request, kind, name)
    if names["terrain"] is None and names["surface"] is not None and imagery and not found:
        found = _heights(options, request, "terrain", DEFAULT_TERRAIN)
    if options.json:
        more: dict[str, object] = dict.fromkeys(names)
        more |= {kind: {"out": str(out), **got.describe()} for kind, (out, got) in found.items()}
        print_json({"out": str(options.out), **result.describe(), **more})
        return
    parts = [(options.out, result), *found.values()]
    print("\n\n".join(_summary(out, got) for out, got in parts))
    if any(names.values()) and imagery:
        paths = {kind: out for kind, (out, _) in found.items()}
        print(f"\nbuild the map:\n  {_build_line(options, paths)}")


def _heights_presets(options: argparse.Namespace) -> dict[str, str | None]:
    """Presets of the heights that are fetched too, by kind; None where there are none."""
    from orthonav.ground.fetch.presets import DEFAULT_TERRAIN, surface_preset, terrain_preset

    asked = options.source, options.services
    surface = surface_preset(*asked) if options.heights == "surface" else None
    terrain = terrain_preset(*asked) if options.heights != "none" else None
    if surface is not None and terrain == DEFAULT_TERRAIN:
        terrain = None  # it includes trees and houses: the lower envelope of the surface is better
    return {"terrain": terrain, "surface": surface}


def _print_estimate(
    options: argparse.Namespace, estimate: "CostEstimate", names: dict[str, str | None]
) -> None:
    from orthonav.ground.fetch.presets import DEFAULT_TERRAIN

    if options.json:
        print_json(vars(estimate) | {"provenance": vars(estimate.provenance), **names})
    else:
        more = "".join(f", and {kind} from {name}" for kind, name in names.items() if name)
        if names["terrain"] is None and names["surface"] is not None:
            more += f" (terrain from {DEFAULT_TERRAIN} where that cannot be had)"
        print(f"would fetch {estimate.text()}{more}")


def _heights(
    options: argparse.Namespace, imagery: "FetchRequest", kind: str, name: str
) -> "dict[str, tuple[Path, FetchResult]]":
    """Nothing, with a warning, where they cannot be had: the imagery is kept."""
    from orthonav.ground.fetch.presets import DEFAULT_TERRAIN, ImageryOptions, parse_source
    from orthonav.ground.fetch.run import fetch_heights

    say(options, f"fetching the {kind} of {name}")
    try:
        spec = parse_source(name, ImageryOptions(), own=options.services)
        with progress(options) as shown:
            return {kind: fetch_heights(imagery, kind, spec, shown)}
    except (FetchError, AreaError, OutputError) as error:
        other = DEFAULT_TERRAIN if kind == "terrain" else name
        log.warning(
            "no %s was fetched (%s); the imagery is complete; fetch a %s with --source %s, or "
            "build with one of your own, or without: %s",
            *(kind, error, kind, other, options.out),
        )
        return {}


def _build_line(options: argparse.Namespace, heights: dict[str, Path]) -> str:
    words = ["orthonav", "build", "--ortho", options.out]
    for kind, option in (("terrain", "--dem"), ("surface", "--surface")):
        words += [option, heights[kind]] if kind in heights else []
    if options.bounds is not None:
        words.append(f"--bounds={','.join(map(str, options.bounds))}")
    else:
        words += ["--route", options.route]
        words += [] if options.band_m is None else ["--band-m", f"{options.band_m:g}"]
    return shlex.join(map(str, [*words, "--out", options.out.with_suffix(".onav")]))


def _request(options: argparse.Namespace) -> "FetchRequest":
    from orthonav.ground.fetch.presets import ImageryOptions, parse_source
    from orthonav.ground.fetch.run import FetchRequest

    if options.gsd_m is not None and not 0 < options.gsd_m < 1000:
        raise UsageError(f"--gsd-m must be above 0, below 1000; got {options.gsd_m:g}")
    named = {"key_env": options.key_env, "own": options.services}
    asked = ImageryOptions(**given(options, ImageryOptions))
    more = {
        "spec": parse_source(options.source, asked, **named),
        "area": area_of(options),
        "out": options.out or Path("none.tif"),
    }
    return FetchRequest(**given(options, FetchRequest) | more)


def _summary(out: Path, result: "FetchResult") -> str:
    estimate, terms = result.estimate, result.estimate.provenance
    lines = {
        "file": out,
        "size": f"{estimate.width_px} x {estimate.height_px} px of {estimate.gsd_m:.4g} m",
        "tiles": estimate.tiles,
        "missing": result.holes() or "none",
        "layer": terms.layer,
        "date": terms.date or "unknown",
        "licence": terms.licence or "unknown: ask the service before you pass imagery on",
        "attribution": terms.attribution or "unknown",
        "note": terms.note,
    }
    return "\n".join(f"{name:<12}{value}" for name, value in lines.items() if value)


def _print_presets(options: argparse.Namespace) -> None:
    from orthonav.ground.fetch.presets import presets

    known = presets(options.services).values()
    if options.json:
        print_json([asdict(preset) for preset in known])
        return
    for preset in known:
        print(f"{preset.name}: {preset.title} ({preset.country})")
        print(f"  {', '.join(preset.layers)}")
        print(f"  {preset.licence}; {preset.attribution}")
        if preset.surface:
            print(f"  --heights surface fetches {preset.surface}")
        if preset.key_env:
            print(f"  needs a key in {preset.key_env}")
