"""The plan as text."""

from typing import Any

from orthonav.cli.common import counted

MAX_SHOWN = 12


def plan_text(plain: dict[str, Any]) -> str:
    """Lines of text for a plan as `orthonav plan --json` prints it."""
    lines = []
    if plain["route"] is not None:
        lines.append(_row("route", _route(plain["route"])))
    if plain["view"] is not None:
        lines += _view(plain["view"])
    out = None if plain.get("out") == "-" else plain.get("out")
    lines += _map(plain["map"], None if plain["route"] is None else out or "FILE")
    if plain["terrain"] is not None:
        lines += _terrain(plain["terrain"])
    for caution in plain["cautions"]:
        lines.append(_row("caution", caution["text"]))
    if "out" in plain:
        lines.append(_row("written", out or "to stdout"))
    return "\n".join(lines)


def _row(name: str, text: str) -> str:
    return f"{name:<9}{text}"


def _route(route: dict[str, Any]) -> str:
    name = f"{route['name']}, " if route["name"] else ""
    text = f"{name}{counted(route['waypoints'], 'waypoint')}, {route['length_m'] / 1000:.2f} km"
    if route["duration_s"] is not None:
        seconds = route["duration_s"]
        text += f", {seconds:.0f} s" if seconds < 300 else f", {seconds / 60:.0f} min"
    if route["heights_above"]:
        text += f", heights above {' and '.join(map(_reference, route['heights_above']))}"
    if route["legs_with_own_band"]:
        text += f", {counted(route['legs_with_own_band'], 'leg')} with a band of its own"
    if route["legs_with_own_band"] < max(1, route["waypoints"] - 1):
        text += f", search band {route['band_m']:.0f} m"
    return text


def _reference(name: str) -> str:
    return {"agl": "ground", "unknown": "an unknown reference"}.get(name, name)


def _view(view: dict[str, Any]) -> list[str]:
    first = (
        f"{view['width_m']:.0f} x {view['height_m']:.0f} m from {view['agl_m']:.0f} m, "
        f"{view['gsd_m']:.3g} m per pixel, {view['across_px']:.0f} map pixels across"
    )
    second = f"overlapping views at most {view['spacing_m']:.0f} m apart"
    if view["rate_hz"] is not None:
        second += f": {view['rate_hz']:.2g} views per second"
    return [_row("view", first), _row("", second)]


def _map(made: dict[str, Any], route: str | None) -> list[str]:
    low, high = made["map_mb"]
    size = f"{low:.1f} to {high:.1f} MB" if high - low > 0.05 else f"{high:.1f} MB"
    lines = [
        _row(
            "build",
            f"--gsd-m {made['gsd_m']:g} --tile-px {made['tile_px']} --overlap {made['overlap']:g}"
            f"{'' if made['registration'] else ' --no-registration'} "
            f"(a tile is {made['tile_m']:g} m wide)",
        ),
        _row(
            "map",
            f"{made['area_km2']:,.2f} km2, {made['tiles']:,} tiles, {size}, "
            f"built in about {made['build_minutes']:,.0f} min on one core; "
            f"imagery needed: {made['imagery_km2']:,.1f} km2",
        ),
    ]
    sheets = made["sheets"]
    if len(sheets) > 1:
        lines.append(
            _row("sheets", f"{len(sheets)}: a map holds one sheet; build one map per sheet")
        )
        if route == "FILE":
            lines.append(_row("", "write the sheets with --out FILE"))
        for sheet in sheets[:MAX_SHOWN]:
            where = f"--route {route}#{sheet['name']}"
            if route is None:
                where = f"--bounds={','.join(map(_degrees, sheet['bounds_deg']))}"
            lines.append(_row("", f"{where}  {sheet['area_km2']:,.0f} km2"))
        if len(sheets) > MAX_SHOWN:
            lines.append(_row("", f"and {len(sheets) - MAX_SHOWN} more (--json)"))
    return lines


def _terrain(legs: list[dict[str, Any]]) -> list[str]:
    lines = [_row("terrain", "leg  length m   ground m      above ground m  relief in a view")]
    for leg in legs[:MAX_SHOWN]:
        ground = "{:.0f}..{:.0f}".format(*leg["ground_m"])
        over = "{:.0f}..{:.0f}".format(*leg["agl_m"])
        text = f"{leg['leg']:>3}  {leg['length_m']:>8.0f}   {ground:<12}  {over:<14}"
        lines.append(_row("", f"{text}  {leg['relief']:.1%}"))
    if len(legs) > MAX_SHOWN:
        lines.append(_row("", f"and {len(legs) - MAX_SHOWN} more (--json)"))
    return lines


def _degrees(value: float) -> str:
    return f"{value:.6f}".rstrip("0").rstrip(".")
