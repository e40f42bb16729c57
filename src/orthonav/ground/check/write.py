"""Writes a check: a page, JSON, GeoTIFF and GeoJSON, in a folder of their own.

The folder is written whole or not at all; it replaces only an earlier check. The page is one
self-contained file, also for print; without JavaScript it lacks map and profile.
"""

import json
from hashlib import sha256
from pathlib import Path

import numpy as np

from orthonav.core.errors import OutputError
from orthonav.core.files import replacing, replacing_folder, write_text
from orthonav.core.mapfile.reader import MapFile
from orthonav.ground.check.layers import FORMAT, check_to_plain, tif_bytes, to_geojson, writable
from orthonav.ground.check.records import CELL_VALUES, Cells, CheckResult
from orthonav.ground.check.wording import (
    OUTAGE_COLUMNS,
    SIMULATED,
    SYMBOLS,
    conditions_text,
    key_figures,
    outage_row,
    verdict_sentence,
)
from orthonav.ground.report import BY_UNIT, metres_text, to_plain
from orthonav.ground.report.imagery import Box, Grey, Mask, SheetImagery, webp
from orthonav.ground.report.page import (
    data_url,
    joined_scripts,
    load_leaflet,
    render,
    static_text,
)

PAGE, JSON, TIF, GEOJSON = "index.html", "check.json", "check.tif", "check.geojson"
PACKAGE = "orthonav.ground.check"


def write_check(result: CheckResult, opened: MapFile, out: Path) -> Path:
    """Write page, JSON, GeoTIFF and GeoJSON into the folder `out`; return the page's path.

    Raises `OutputError` where the folder holds other files or cannot be written,
    `MissingExtraError` without the extras geo, report and web.
    """
    out = Path(out)
    require_free(out)
    plain = writable(f"{json.dumps(check_to_plain(result), ensure_ascii=False, allow_nan=False)}\n")
    page = page_of(result, opened, sha256(plain.encode()).hexdigest())
    with replacing_folder(out, is_ours=lambda folder: _foreign(folder) is None) as folder:
        for name, text in ((JSON, plain), (GEOJSON, to_geojson(result)), (PAGE, page)):
            write_text(folder / name, writable(text))
        with replacing(folder / TIF) as temporary:
            temporary.write_bytes(tif_bytes(result))
    return out / PAGE


def require_free(out: Path) -> None:
    """Raise what `write_check` would raise about the folder, before any work."""
    out = Path(out)
    if out.is_dir():
        foreign = _foreign(out)
        if foreign is not None:
            raise OutputError(
                f"output folder holds a file that no check wrote ({foreign}); move it away or "
                f"name another folder: {out}"
            )
    elif out.exists() or out.is_symlink():
        raise OutputError(f"output folder is a file: {out}")


def _foreign(folder: Path) -> str | None:
    """A file of a folder that is not part of a check; None for a check or an empty folder."""
    ours = {PAGE, JSON, TIF, GEOJSON, f"{TIF}.aux.xml"}  # the last by GIS programs
    try:
        found = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))
        odd = [name for name in found if name not in ours or (folder / name).is_symlink()]
        if odd or not found:
            return next(iter(odd), None)
        plain = json.loads((folder / JSON).read_text(encoding="utf-8"))
        return None if isinstance(plain, dict) and plain.get("format") == FORMAT else found[0]
    except (FileNotFoundError, ValueError, RecursionError):
        return found[0]
    except OSError as error:
        raise OutputError(f"cannot read folder ({error.strerror or error}): {folder}") from error


def page_of(result: CheckResult, opened: MapFile, json_sha256: str) -> str:
    about = result.about
    script, style = load_leaflet()
    own = "data.js", "map.js", "profile.js", "page.js"
    scripts = script, joined_scripts(("format.js", "plane.js", "chart.js"), PACKAGE, own)
    image = webp(*map_image(opened, visible_box(result.cells)))
    values = {
        "title": f"Check of {about.map_name}" + f" for {about.route_name}" * bool(about.route_name),
        "kind": "Check before take-off",
        "result": result,
        "symbols": {word.value: symbol for word, symbol in SYMBOLS.items()},
        "sentence": verdict_sentence(result),
        "cards": key_figures(result),
        "note": "" if result.second_date else SIMULATED,
        "layers": {
            name: meaning for name, meaning in CELL_VALUES.items() if name not in ("high", "trials")
        },
        "outage_columns": OUTAGE_COLUMNS,
        "outages": [outage_row(*each) for each in enumerate(result.outages, start=1)],
        "radius": metres_text(result.conditions.radius_m),
        "conditions": conditions_text(result.conditions, result.band_m),
        "downloads": {
            GEOJSON: "GeoJSON: route, outages, waypoints",
            TIF: "GeoTIFF: a band per layer of the map",
            JSON: "JSON: all results and conditions",
        },
        "checked": [
            ("map", about.map_name),
            ("SHA-256 of the map's manifest", about.map_sha256),
            ("imagery", about.imagery),
            ("build parameters", about.recipe),
            ("second date", about.other_date),
            ("route", about.route_name),
            ("command", about.command),
            ("orthonav", about.version),
            ("SHA-256 of check.json", json_sha256),
        ],
        "data": _page_data(result),
        "image": data_url(image, "image/webp"),
    }
    style += static_text("check.css", PACKAGE)
    return render(PACKAGE, "page.html", values, style=style, scripts=scripts)


def _page_data(result: CheckResult) -> str:
    """JSON for the scripts: `check.json`, and under `drawn` positions in metres. Of the cells, only
    those of which something is known, by number (row after row).

    The text contains no `<`, so that no name can end the script element.
    """
    along, cells = result.along, result.cells
    known = np.isfinite(cells.persistence) | (cells.trials > 0)
    known_m = cells.error_m[np.isfinite(cells.error_m)]
    most_m = float(np.percentile(known_m, 98)) if len(known_m) else 1.0
    most_wrong = float(np.nanmax(cells.wrong, initial=0.0, where=np.isfinite(cells.wrong)))
    drawn = {
        "box": visible_box(cells),
        "values": list(CELL_VALUES),
        "most": {
            "error_m": float(f"{max(most_m, 1.0):.2g}"),
            "wrong": float(f"{max(0.05, most_wrong):.2g}"),
        },
        "route": None if along is None else along.points_en_m,
        "waypoints": [] if result.route_en_m is None else result.route_en_m,
    }
    values = {**check_to_plain(result), "drawn": to_plain(drawn, 2)}
    values["cells"] |= {
        "known": np.flatnonzero(known).tolist(),
        **to_plain({name: getattr(cells, name)[known] for name in CELL_VALUES}, BY_UNIT),
    }
    text = json.dumps(values, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def visible_box(cells: Cells) -> Box:
    """West, south, east, north in metres of the cells, with a margin."""
    west, south, east, north = cells.grid.extent_en_m
    margin_m = 0.04 * max(cells.grid.rows, cells.grid.cols) * cells.grid.side_m
    return west - margin_m, south - margin_m, east + margin_m, north + margin_m


def map_image(opened: MapFile, box: Box) -> tuple[Grey, Mask]:
    """The imagery of the map within a box, north up, and where there is some."""
    sheet = SheetImagery(opened)
    west, south, east, north = box
    gsd_m = max(
        sheet.grid.gsd_m, max(east - west, north - south) / 1500
    )  # an image of 1 MB at most
    size = max(1, round((east - west) / gsd_m)), max(1, round((north - south) / gsd_m))
    return sheet.crop(box, size)
