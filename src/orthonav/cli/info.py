"""`orthonav info`: print the contents of a map."""

import argparse
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthonav.cli.common import add_options, print_result

if TYPE_CHECKING:
    from orthonav.core.mapfile.manifest import Manifest, SheetInfo

EXAMPLE = "area.onav"


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("map", type=Path, metavar="MAP.onav", help="map to describe")
    add_options(parser, "--json")


def run(options: argparse.Namespace) -> None:
    from orthonav.core.mapfile import open_map

    opened = open_map(options.map)
    plain = summary(opened.manifest, opened.size_bytes, options.map)
    print_result(options, plain, summary_text(plain))


def summary(manifest: "Manifest", size_bytes: int, path: Path) -> dict[str, Any]:
    area_km2, size_mb = manifest.area_km2, size_bytes / 1e6
    registered = manifest.registration
    radius_m: Any = manifest.radius_m
    calibrated = manifest.confidence is not None
    tile_level = {"tile_radius_m": radius_m, "tiles_calibrated": calibrated}
    if registered is not None:
        radius_m, calibrated = registered.get("radius_m"), registered.get("confidence") is not None
    terrain, surface = manifest.sheets[0].terrain, manifest.sheets[0].surface
    return {
        "map": str(path),
        "created_by": manifest.created_by,
        "area_km2": round(area_km2, 4),
        "tiles": sum(sheet.tiles for sheet in manifest.sheets),
        "size_mb": round(size_mb, 4),
        "mb_per_km2": round(size_mb / area_km2, 4) if area_km2 > 0 else None,
        "recipe": manifest.recipe,
        "radius_m": radius_m if isinstance(radius_m, int | float) else None,
        "calibrated": calibrated,
        **tile_level,
        "registration": _registration(manifest),
        "terrain": None if terrain is None else asdict(terrain),
        "surface": None if surface is None else asdict(surface),
        "lean": None if (lean := manifest.sheets[0].lean) is None else asdict(lean),
        "relief": manifest.sheets[0].relief,
        "sheets": [
            {
                "centre_lat_deg": sheet.frame.lat_deg,
                "centre_lon_deg": sheet.frame.lon_deg,
                "bounds_deg": _bounds_deg(sheet),
                "gsd_m": sheet.grid.gsd_m,
                "tile_px": sheet.grid.tile_px,
                "stride_m": sheet.grid.stride_m,
                "tiles": sheet.tiles,
                "area_km2": sheet.area_km2,
            }
            for sheet in manifest.sheets
        ],
        "imagery": list(manifest.imagery),
    }


def _registration(manifest: "Manifest") -> dict[str, Any] | None:
    """`ground_km2` extends beyond the tile centres."""
    from orthonav.core.mapfile.layer import part_names

    sheet = manifest.sheets[0]
    if sheet.grey is None:
        return None
    parts = [manifest.parts.get(name) for name in part_names(0).values()]
    size = sum(_part_bytes(part) for part in parts if part is not None)
    ground_km2 = sheet.grey.valid_px * sheet.grid.gsd_m**2 / 1e6
    return {
        "levels": sheet.grey.levels,
        "quality": sheet.grey.quality,
        "bytes": size,
        "ground_km2": round(ground_km2, 4),
        "mb_per_km2": round(size / 1e6 / ground_km2, 4) if ground_km2 > 0 else None,
    }


def _bounds_deg(sheet: "SheetInfo") -> list[float]:
    import numpy as np

    grid = sheet.grid
    corners = grid.centres_en_m(np.array([[grid.rows - 1, 0], [0, grid.cols - 1]]))
    lat, lon = sheet.frame.latlon_from_en(corners)
    return [round(float(value), 7) for value in (lon[0], lat[0], lon[1], lat[1])]


def _part_bytes(part: dict[str, Any]) -> int:
    import numpy as np

    return int(np.prod(part["shape"]) * np.dtype(part["dtype"]).itemsize)


def summary_text(plain: dict[str, Any]) -> str:
    lines = [
        f"map        {plain['map']}  ({plain['created_by']})",
        f"area       {plain['area_km2']:.2f} km2 of tile centres, {plain['tiles']} tiles",
        f"size       {plain['size_mb']:.3f} MB, {plain['mb_per_km2'] or 0:.3f} MB per km2",
        f"recipe     {recipe_text(plain['recipe'])}",
    ]
    for sheet in plain["sheets"]:
        lines.append(
            f"sheet      {sheet['gsd_m']:g} m per pixel, tiles of {sheet['tile_px']} px every "
            f"{sheet['stride_m']:g} m, centre {sheet['centre_lat_deg']:.6f}, "
            f"{sheet['centre_lon_deg']:.6f}"
        )
        lines.append(f"bounds     {','.join(f'{each:.6f}' for each in sheet['bounds_deg'])}")
    grey, terrain = plain["registration"], plain["terrain"]
    said = "no registration layer: positions at tile level only"
    if grey is not None:
        said = f"registration layer of {grey['bytes'] / 1e6:.3f} MB, {grey['levels']} levels"
    lines.append(f"grey       {said}")
    if terrain is not None:
        level = "" if "unknown" in terrain["datum"] else " above the sea"
        heights = f"{terrain['low_m']:.0f} to {terrain['high_m']:.0f} m{level}"
        named = "".join(c for c in f"{terrain['name']}, {terrain['datum']}" if c.isprintable())
        lines.append(f"terrain    {heights} every {terrain['posting_m']:g} m ({named})")
        lines += [f"           {text}" for text in _source_text(terrain)]
    else:
        first, second = unknown_ground_text(plain["relief"])
        lines += [f"terrain    {first}", f"           {second}"]
    if (surface := plain["surface"]) is not None:
        named = "".join(c for c in surface["name"] if c.isprintable())
        every = f"every {surface['posting_m']:g} m ({named})"
        lines.append(f"surface    houses and trees up to {surface['high_m']:.0f} m, {every}")
        lines.append(f"           {_lean_text(plain['lean'])}")
    for source in plain["imagery"]:
        files = f"{source['files']} files  " if source.get("files") else ""
        dates = " to ".join(texts(source, "date_from", "date")) or "date unknown"
        lines.append(
            f"imagery    {source.get('name')}  {files}{dates}  {source.get('gsd_m')} m  "
            f"{source.get('crs')}"
        )
        if terms := texts(source, "attribution", "licence"):
            lines.append(f"           {', '.join(terms)}")
    known = "probability of an error below" if plain["calibrated"] else "none, for"
    radius = "-" if plain["radius_m"] is None else f"{plain['radius_m']:g}"
    lines.append(f"confidence {known} {radius} m")
    if "build_s" in plain:
        speed = plain["area_km2"] / plain["build_s"]
        lines.append(f"built in   {plain['build_s']:.1f} s, {speed:.2f} km2/s")
    return "\n".join(lines)


def _source_text(terrain: Mapping[str, Any]) -> list[str]:
    source_m, roughness_m = terrain["source_posting_m"], terrain["roughness_m"]
    said = (
        [] if source_m in (None, terrain["posting_m"]) else [f"from heights every {source_m:g} m"]
    )
    said += [] if roughness_m is None else [f"which differ from these by {roughness_m:.2g} m RMS"]
    return [", ".join(said)] if said else []


def unknown_ground_text(relief: str | None) -> list[str]:
    """What ground without terrain costs, in lines."""
    from orthonav.core.geo.ground import DEFAULT_RELIEF, relief_slope, unknown_slope_share
    from orthonav.core.records import DEFAULT_TILT_STD_DEG

    slope = relief_slope(relief)
    known, unknown = (
        f"{100 * unknown_slope_share(tilt_deg, relief):.1f} %"
        for tilt_deg in (1.0, DEFAULT_TILT_STD_DEG)
    )
    return [
        f"none: {relief or DEFAULT_RELIEF} land is assumed (slopes of {100 * slope:.0f} %); the "
        "standard deviation",
        f"of the camera per axis is {known} of the height where its tilt is known to 1 deg, "
        f"{unknown} where it is not",
    ]


def recipe_text(recipe: dict[str, Any]) -> str:
    parts = [str(recipe.get("method"))]
    for name, key in (("tiles", "embed"), ("images", "represent")):
        found = recipe.get(key)
        variant = dict(found) if isinstance(found, dict) else {}
        title = variant.pop("name", "?")
        values = ", ".join(f"{key} {value}" for key, value in variant.items())
        parts.append(f"{name}: {title} ({values})" if values else f"{name}: {title}")
    return "; ".join([*parts, f"overlap {recipe.get('overlap')}"])


def imagery_text(imagery: Iterable[Mapping[str, Any]]) -> str:
    parts = []
    for source in imagery:
        said = " ".join([str(source.get("name")), *texts(source, "date_from", "date")])
        terms = texts(source, "attribution", "licence")
        parts.append(f"{said} ({', '.join(terms)})" if terms else said)
    return "; ".join(parts[:20])


def texts(source: Mapping[str, Any], *keys: str) -> list[str]:
    return [str(source[key]) for key in keys if source.get(key)]


def _lean_text(lean: dict[str, float] | None) -> str:
    if lean is None:
        return "they may lean in the orthophoto by up to 0.3 m per m of height: not known"
    if not any(lean.values()):
        return "a true orthophoto: they stand upright"
    if not (lean["east"] or lean["north"]):
        return f"they stand upright in the orthophoto, to {lean['std']:g} m per m of height"
    return (
        f"they lean by {lean['east']:g} m east, {lean['north']:g} m north per m of height, as the "
        "orthophoto shows"
    )
