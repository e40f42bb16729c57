"""`orthonav info`: print the contents of a map."""

import argparse
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthonav.cli.common import beside, print_json

if TYPE_CHECKING:
    from orthonav.core.mapfile.manifest import Manifest, SheetInfo


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("map", type=Path, metavar="MAP.onav", help="map to describe")
    parser.add_argument("--json", action="store_true", help="print as JSON")
    parser.add_argument(
        "--footprint",
        type=Path,
        metavar="FILE.geojson",
        help="write the outline of the area with imagery as GeoJSON; -: stdout",
    )
    parser.add_argument(
        "--preview",
        type=Path,
        metavar="FILE.png",
        help="write the imagery as a grey .png or .tif for QGIS, georeferenced by FILE.aux.xml",
    )


def run(options: argparse.Namespace) -> None:
    from orthonav.core.files import write_text
    from orthonav.core.mapfile import open_map
    from orthonav.core.mapfile.shown import footprint_geojson, write_preview

    opened = open_map(options.map)
    if options.footprint is not None:
        write_text(options.footprint, footprint_geojson(opened))
    if options.preview is not None:
        write_preview(opened, options.preview)
    plain = summary(opened.manifest, opened.size_bytes, options.map)
    with beside(options.footprint):
        if options.json:
            print_json(plain)
        else:
            print(summary_text(plain))


def summary(manifest: "Manifest", size_bytes: int, path: Path) -> dict[str, Any]:
    area_km2 = manifest.area_km2
    size_mb = size_bytes / 1e6
    return {
        "map": str(path),
        "created_by": manifest.created_by,
        "area_km2": round(area_km2, 4),
        "tiles": sum(sheet.tiles for sheet in manifest.sheets),
        "size_mb": round(size_mb, 4),
        "mb_per_km2": round(size_mb / area_km2, 4) if area_km2 > 0 else None,
        "recipe": manifest.recipe,
        **_confidence(manifest),
        "registration": _registration(manifest),
        "terrain": _terrain(manifest),
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
        "parts_mb": {
            name: round(_part_bytes(part) / 1e6, 4) for name, part in manifest.parts.items()
        },
    }


def _confidence(manifest: "Manifest") -> dict[str, Any]:
    tiles = {
        "tile_radius_m": manifest.radius_m,
        "tiles_calibrated": manifest.confidence is not None,
    }
    registered = manifest.registration
    if registered is None:
        return {"radius_m": manifest.radius_m, "calibrated": tiles["tiles_calibrated"], **tiles}
    radius_m = registered.get("radius_m")
    return {
        "radius_m": radius_m if isinstance(radius_m, int | float) else None,
        "calibrated": registered.get("confidence") is not None,
        **tiles,
    }


def _confidence_text(plain: Mapping[str, Any]) -> str:
    radius = "-" if plain["radius_m"] is None else f"{plain['radius_m']:g}"
    text = f"{'probability of an error below' if plain['calibrated'] else 'none, for'} {radius} m"
    if plain["registration"] is None:
        return text
    tiles = f"{'' if plain['tiles_calibrated'] else 'none, for '}{plain['tile_radius_m']:g} m"
    return f"{text}; with --registration off, {tiles}"


def _registration(manifest: "Manifest") -> dict[str, Any] | None:
    """`ground_km2` extends beyond the tile centres; `raw_bytes` is that of uncompressed RGB."""
    from orthonav.core.mapfile.layer import part_names

    size, raw, ground_km2 = 0, 0, 0.0
    infos = [sheet.grey for sheet in manifest.sheets if sheet.grey is not None]
    for number, sheet in enumerate(manifest.sheets):
        if sheet.grey is not None:
            found = [manifest.parts.get(name) for name in part_names(number).values()]
            size += sum(_part_bytes(part) for part in found if part is not None)
            raw += sheet.grey.raw_bytes
            ground_km2 += sheet.grey.valid_px * sheet.grid.gsd_m**2 / 1e6
    if not infos:
        return None
    return {
        "levels": max(info.levels for info in infos),
        "quality": max(info.quality for info in infos),
        "bytes": size,
        "raw_bytes": raw,
        "raw_ratio": round(raw / size, 2) if size else None,
        "ground_km2": round(ground_km2, 4),
        "mb_per_km2": round(size / 1e6 / ground_km2, 4) if ground_km2 > 0 else None,
    }


def _terrain(manifest: "Manifest") -> dict[str, Any] | None:
    from orthonav.core.mapfile.terrain import terrain_part_names

    info = manifest.sheets[0].terrain
    if info is None:
        return None
    parts = [manifest.parts[name] for name in terrain_part_names(0) if name in manifest.parts]
    size = sum(_part_bytes(part) for part in parts)
    ground_km2 = info.known * info.posting_m**2 / 1e6
    return {
        "low_m": info.low_m,
        "high_m": info.high_m,
        "posting_m": info.posting_m,
        "name": info.name,
        "datum": info.datum,
        "bytes": size,
        "ground_km2": round(ground_km2, 4),
        "mb_per_km2": round(size / 1e6 / ground_km2, 5) if ground_km2 > 0 else None,
    }


def _bounds_deg(sheet: "SheetInfo") -> list[float]:
    """West, south, east, north of the outer tile centres."""
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
    lines.append(f"grey       {_registration_text(plain['registration'])}")
    lines += _terrain_lines(plain["terrain"])
    for source in plain["imagery"]:
        dates = [source[key] for key in ("date_from", "date") if source.get(key)]
        files = f"{source['files']} files  " if source.get("files") else ""
        lines.append(
            f"imagery    {source.get('name')}  {files}{' to '.join(dates) or 'date unknown'}  "
            f"{source.get('gsd_m')} m  {source.get('crs')}"
        )
        terms = [source[key] for key in ("attribution", "licence") if source.get(key)]
        if terms:
            lines.append(f"           {', '.join(map(str, terms))}")
    lines.append(f"confidence {_confidence_text(plain)}")
    if "build_s" in plain:
        speed = plain["area_km2"] / plain["build_s"]
        lines.append(f"built in   {plain['build_s']:.1f} s, {speed:.2f} km2/s")
    return "\n".join(lines)


def _registration_text(layer: dict[str, Any] | None) -> str:
    if layer is None:
        return "no registration layer: positions at tile level only"
    return (
        f"registration layer of {layer['bytes'] / 1e6:.3f} MB, {layer['mb_per_km2'] or 0:.2f} MB "
        f"per km2 of ground, {layer['levels']} levels, 1/{layer['raw_ratio'] or 0:.0f} of the raw "
        "orthophoto"
    )


def _terrain_lines(layer: dict[str, Any] | None) -> list[str]:
    if layer is None:
        return []
    printable = "".join(c for c in f"{layer['name']}, {layer['datum']}" if c.isprintable())
    return [
        f"terrain    {layer['low_m']:.0f} to {layer['high_m']:.0f} m above the sea every "
        f"{layer['posting_m']:g} m, {layer['bytes'] / 1e6:.3f} MB, {layer['mb_per_km2'] or 0:.4f} "
        f"MB per km2 ({printable})"
    ]


def recipe_text(recipe: dict[str, Any]) -> str:
    parts = [str(recipe.get("method"))]
    for name in ("represent", "embed"):
        found = recipe.get(name)
        variant = dict(found) if isinstance(found, dict) else {}
        title = variant.pop("name", "?")
        values = ",".join(
            f"{key}={value:g}" if isinstance(value, int | float) else f"{key}={value!r}"
            for key, value in variant.items()
        )
        parts.append(f"{name} {title}:{values}" if values else f"{name} {title}")
    return ", ".join(parts) + f", overlap {recipe.get('overlap')}"


def imagery_text(imagery: Iterable[Mapping[str, Any]]) -> str:
    parts = []
    for source in imagery:
        dates = [str(source[key]) for key in ("date_from", "date") if source.get(key)]
        terms = [str(source[key]) for key in ("attribution", "licence") if source.get(key)]
        said = " ".join([str(source.get("name")), *dates])
        parts.append(f"{said} ({', '.join(terms)})" if terms else said)
    return "; ".join(parts[:20])
