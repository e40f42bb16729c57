"""Writes a check: a page, JSON, GeoTIFF, GeoJSON and the map as a figure, in a folder of their own.

The folder is written whole or not at all; it replaces only an earlier check. The page is one
self-contained file, readable without JavaScript and in print.
"""

import json
import math
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthonav.core.errors import OutputError
from orthonav.core.extras import needed
from orthonav.core.files import replacing, replacing_folder, write_text
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.records import CONFIDENT
from orthonav.ground.check.records import CELL_VALUES, Along, CheckResult
from orthonav.ground.check.write.plain import (
    EDGE_PX,
    FORMAT,
    RISKS,
    Plain,
    check_to_plain,
    segments,
    stretch_en_m,
    tif_bytes,
    to_geojson,
    to_json,
    writable,
)
from orthonav.ground.check.write.wording import (
    GAP_COLUMNS,
    SIMULATED,
    SYMBOLS,
    conditions_text,
    key_figures,
    probability_text,
    remedies,
    stretch_row,
    verdict_sentence,
)
from orthonav.ground.report.drawing import (
    BACKING,
    INK,
    LEGEND_ABOVE,
    OFFSET,
    Background,
    draw_axes,
    draw_map,
    map_size_in,
)
from orthonav.ground.report.imagery import Box, SheetImagery, jpeg, shrunk
from orthonav.ground.report.numbers import metres_text, to_plain
from orthonav.ground.report.page import (
    FOLDER,
    LIST,
    Figure,
    data_url,
    joined_scripts,
    leaflet_files,
    load_leaflet,
    render,
    static_text,
    write_figures,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PAGE, JSON, TIF, GEOJSON = "index.html", "check.json", "check.tif", "check.geojson"
_SIDECAR = "check.tif.aux.xml"
"""Written by GIS programs that open the raster."""
_OURS = {
    *(PAGE, JSON, TIF, GEOJSON, _SIDECAR, FOLDER, f"{FOLDER}/{LIST}"),
    # The last two are of checks by earlier versions.
    *(
        f"{FOLDER}/{name}.{kind}"
        for name in ("map", "profile", "envelope")
        for kind in ("svg", "png")
    ),
}
_EXTRAS = {"rasterio": "geo", "shapely": "geo", "matplotlib": "report", "jinja2": "report"}
PACKAGE = "orthonav.ground.check.write"
_SHARED = ("format.js", "plane.js", "chart.js")
_SCRIPTS = ("data.js", "map.js", "profile.js", "page.js")
MAX_ROWS = 200
MAX_LOOKALIKES = 20
"""Shown on map and page, the most similar ones; the files hold all."""
LAYERS = {
    "probability": "probability of a fix",
    "low": "probability, lower end of its interval",
    "error_m": "expected error of a fix",
    "wrong": "rate of false fixes",
    "persistence": "expected persistence of the ground",
    "changed": "changed since the map was made",
}
DOWNLOADS = {
    "check.geojson": "GeoJSON: route, gaps, cells, ambiguous places",
    "check.tif": "GeoTIFF: a band per layer of the map",
    "check.json": "JSON: all results and conditions",
}
ZERO_IF_UNKNOWN = frozenset({"trials", "changed"})
"""Values that are 0, not None, in cells of which nothing is known."""
MAX_SIDE_PX, MAX_AREA_PX = 2000, 2_000_000
"""Limits of the image: its longer side, and its area."""
KNEE = 0.5, 0.2
"""A probability and its place on the colour scale: most of the scale is for what is likely."""
_MARGIN = 0.04
_EMPTY = 226
"""Grey level without imagery, as light as a light page."""
_QUALITY = 60
_BACKGROUND_PX = 825
_STEPS = 20


def write_check(result: CheckResult, opened: MapFile, out: Path) -> Path:
    """Write page, JSON, GeoTIFF, GeoJSON and the map into the folder `out`; return the page's path.

    Raises `OutputError` where the folder holds other files or cannot be written,
    `MissingExtraError` without the extras geo, report and web.
    """
    out = Path(out)
    require_free(out)
    image = map_image(opened, visible_box(result))
    figure = map_figure(result, image)
    plain = writable(to_json(result))
    page = page_of(result, image, figure, sha256(plain.encode()).hexdigest())
    with replacing_folder(out, is_ours=lambda folder: _foreign(folder) is None) as folder:
        for name, text in ((JSON, plain), (GEOJSON, to_geojson(result)), (PAGE, page)):
            write_text(folder / name, writable(text))
        with replacing(folder / TIF) as temporary:
            temporary.write_bytes(tif_bytes(result))
        write_figures(folder, [figure])
    return out / PAGE


def require_free(out: Path) -> None:
    """Raise what `write_check` would raise about the folder and missing extras, before any work."""
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
    leaflet_files("leaflet.js", "leaflet.css")
    for module, extra in _EXTRAS.items():
        needed(module, extra, "writing a check")


def _foreign(folder: Path) -> str | None:
    """A file of a folder that is not part of a check; None for a check or an empty folder."""
    try:
        found = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))
        odd = [name for name in found if name not in _OURS or (folder / name).is_symlink()]
        if odd or not found:
            return next(iter(odd), None)
        plain = json.loads((folder / JSON).read_text(encoding="utf-8"))
        return None if isinstance(plain, dict) and plain.get("format") == FORMAT else found[0]
    except (FileNotFoundError, ValueError, RecursionError):
        return found[0]
    except OSError as error:
        raise OutputError(f"cannot read folder ({error.strerror or error}): {folder}") from error


def page_of(result: CheckResult, image: Background, figure: Figure, json_sha256: str) -> str:
    about = result.about
    script, style = load_leaflet()
    scripts = (script, joined_scripts(_SHARED, PACKAGE, _SCRIPTS))
    values = {
        "title": f"Check of {about.map_name}" + f" for {about.route_name}" * bool(about.route_name),
        "kind": "Check before take-off",
        "result": result,
        "symbols": {"info": "i", **{word.value: symbol for word, symbol in SYMBOLS.items()}},
        "sentence": verdict_sentence(result),
        "cards": key_figures(result),
        "note": "" if result.second_date else SIMULATED,
        "map": figure,
        "layers": LAYERS,
        "gap_columns": GAP_COLUMNS,
        "stretches": [
            stretch_row(number, each) for number, each in enumerate(result.stretches, start=1)
        ],
        "lookalikes": _lookalike_rows(result),
        "max_rows": MAX_ROWS,
        "max_lookalikes": MAX_LOOKALIKES,
        "radius": metres_text(result.conditions.radius_m),
        "conditions": conditions_text(result.conditions, result.band_m),
        "remedies": remedies(result),
        "downloads": DOWNLOADS,
        "checked": _checked(result, json_sha256),
        "data": _page_data(result, image),
        "image": data_url(jpeg(image.grey, _QUALITY), "image/jpeg"),
    }
    style += static_text("check.css", PACKAGE)
    return render(PACKAGE, "page.html", values, style=style, scripts=scripts)


def _lookalike_rows(result: CheckResult) -> list[tuple[str, ...]]:
    return [
        (
            str(number),
            "{:.5f}, {:.5f}".format(*each.place_latlon_deg),
            "{:.5f}, {:.5f}".format(*each.other_latlon_deg),
            metres_text(each.apart_m),
            f"{each.similarity:.2f}",
            str(each.trials),
            "yes" if each.within_prior else "no",
        )
        for number, each in enumerate(result.lookalikes, start=1)
    ]


def _checked(result: CheckResult, json_sha256: str) -> list[tuple[str, str]]:
    about = result.about
    return [
        ("map", about.map_name),
        ("SHA-256 of the map's manifest", about.map_sha256),
        ("imagery", about.imagery),
        ("build parameters", about.recipe),
        ("second date", about.other_date),
        ("route", about.route_name),
        ("command", about.command),
        ("orthonav", about.version),
        ("SHA-256 of check.json", json_sha256),
    ]


def _page_data(result: CheckResult, image: Background) -> str:
    """JSON for the scripts: `check.json`, and under `drawn` positions in metres and colours.

    The text contains no `<`, so that no name can end the script element.
    """
    along, cells = result.along, result.cells
    known_m = cells.error_m[np.isfinite(cells.error_m)]
    most_m = float(np.percentile(known_m, 98)) if len(known_m) else 1.0
    most_wrong = float(np.nanmax(cells.wrong, initial=0.0, where=np.isfinite(cells.wrong)))
    pairs = [
        [result.frame.en_from_latlon(*place) for place in (p.place_latlon_deg, p.other_latlon_deg)]
        for p in result.lookalikes[:MAX_LOOKALIKES]
    ]
    drawn = {
        "box": visible_box(result),
        "image": image.box,
        "values": list(CELL_VALUES),
        "colours": _colours(),
        "confident": CONFIDENT,
        "risks": [vars(risk) for risk in RISKS],
        "edge_px": EDGE_PX,
        "knee": KNEE,
        "most": {
            "error_m": float(f"{max(most_m, 1.0):.2g}"),
            "wrong": float(f"{max(0.05, most_wrong):.2g}"),
        },
        "route": None if along is None else along.points_en_m,
        "segments": [] if along is None else segments(along.probability),
        "blind": [
            stretch_en_m(along, each.start_m, each.end_m) for each in result.stretches if along
        ],
        "waypoints": [] if result.route_en_m is None else result.route_en_m,
        "lookalikes": np.array(pairs),
    }
    values = {**check_to_plain(result), "drawn": to_plain(drawn, 2)}
    values["cells"] = _known_cells(values["cells"])
    text = json.dumps(values, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def _known_cells(cells: Plain) -> Plain:
    """The cells of `check.json` with `known`, the numbers of those of which something is known, row
    after row, and the values of these alone."""
    grids = {name: [value for row in cells[name] for value in row] for name in CELL_VALUES}
    known = [
        number
        for number, values in enumerate(zip(*grids.values(), strict=True))
        if any(
            value is not None and (value > 0 or name not in ZERO_IF_UNKNOWN)
            for name, value in zip(CELL_VALUES, values, strict=True)
        )
    ]
    found = {name: [values[number] for number in known] for name, values in grids.items()}
    return {**cells, "known": known, **found}


def _colours() -> list[str]:
    """Colours of ten equal steps from 0 to 1, interpolated in between.

    Cividis (Nunez et al. 2018, doi 10.1371/journal.pone.0199239) reads alike with and without
    colour blindness.
    """
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return [to_hex(colour) for colour in colormaps["cividis"](np.linspace(0, 1, 10))]


def map_figure(result: CheckResult, image: Background) -> Figure:
    west, south, east, north = visible_box(result)
    visible = west, east, south, north
    width, height = map_size_in(visible, 7.0, (4.0, 3.0))
    marks = ["Black with a number: gaps."] if result.stretches else []
    marks += ["Dotted: pairs of ambiguous places."] if result.lookalikes else []
    background = replace(image, grey=shrunk(image.grey, _BACKGROUND_PX))

    def draw(axes: "Axes") -> None:
        draw_map(axes, visible, background)
        _draw_cells(axes, result)
        if result.along is not None:
            _draw_route(axes, result, result.along)
        _draw_lookalikes(axes, result)
        axes.set(xlim=visible[:2], ylim=visible[2:])

    return Figure(
        "map",
        f"Map of the probability of a fix, mean {probability_text(result.mean)} over "
        f"{result.area_km2:.2f} square kilometres; {len(result.stretches)} gaps without fixes",
        "Probability of a correct, confident fix of one view; white where unknown. "
        + " ".join(marks),
        draw_axes((width + 1.0, height), draw),
    )


def _draw_cells(axes: "Axes", result: CheckResult) -> None:
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    cells = result.cells
    steps = (np.arange(_STEPS) + 0.5) / _STEPS  # few colours: a PNG has a palette
    shades = np.interp(steps, [0.0, KNEE[0], 1.0], [0.0, KNEE[1], 1.0])
    rows, cols = cells.probability.shape
    extent = (
        *(cells.west_m, cells.west_m + cols * cells.side_m),
        *(cells.north_m - rows * cells.side_m, cells.north_m),
    )
    shown = axes.imshow(
        np.ma.masked_invalid(cells.probability),
        cmap=ListedColormap(colormaps["cividis"](shades)),
        vmin=0,
        vmax=1,
        alpha=0.55,
        extent=extent,
        interpolation="none",
        zorder=1,
    )
    assert axes.figure is not None
    axes.figure.colorbar(shown, ax=axes, shrink=0.75, label="probability of a fix")


def _draw_route(axes: "Axes", result: CheckResult, along: Along) -> None:
    points = along.points_en_m
    drawn = segments(along.probability)
    for number, risk in enumerate(RISKS):
        style: Any = (0, [each / risk.width for each in risk.dash]) if risk.dash else "-"
        looks = {"color": risk.colour, "linewidth": 0.5 * risk.width, "linestyle": style}
        found = [points[first : last + 1] for kind, first, last in drawn if kind == number]
        edge: dict[str, Any] = {
            "color": risk.edge,
            "linewidth": 0.5 * (risk.width + EDGE_PX),
            "zorder": 3,
        }
        for i, line in enumerate(found):
            axes.plot(*line.T, **edge, solid_capstyle="round")
            axes.plot(*line.T, **looks, label="" if i else risk.range_text, zorder=4)
    for number, each in enumerate(result.stretches, start=1):
        line = stretch_en_m(along, each.start_m, each.end_m)
        if len(line) > 1:
            axes.plot(*line.T, color=INK, linewidth=1.0, zorder=5)
            middle = line[len(line) // 2]
            bold: dict[str, Any] = {"weight": "bold", "bbox": BACKING}
            axes.annotate(str(number), middle, (7, 5), **OFFSET, **bold, zorder=7)
    if drawn:
        axes.legend(ncols=5, title="probability along the route", **LEGEND_ABOVE)


def _draw_lookalikes(axes: "Axes", result: CheckResult) -> None:
    for each in result.lookalikes[:MAX_LOOKALIKES]:
        ends = [
            result.frame.en_from_latlon(*each.place_latlon_deg),
            result.frame.en_from_latlon(*each.other_latlon_deg),
        ]
        axes.plot(*np.array(ends).T, "o:", color="#8a2f63", markersize=3, linewidth=1, zorder=6)


def visible_box(result: CheckResult) -> Box:
    """West, south, east, north in metres of cells and route, with a margin."""
    cells = result.cells
    rows, cols = np.nonzero(np.isfinite(cells.probability) | (cells.trials > 0))
    if not len(rows):
        height, width = cells.probability.shape
        rows, cols = np.array([0, height - 1]), np.array([0, width - 1])
    side = cells.side_m
    corners = [
        (cells.west_m + cols.min() * side, cells.north_m - (rows.max() + 1) * side),
        (cells.west_m + (cols.max() + 1) * side, cells.north_m - rows.min() * side),
    ]
    half_m = (result.band_m or 0.0) / 2
    if result.route_en_m is not None and len(result.route_en_m):
        corners += [tuple(result.route_en_m.min(0) - half_m)]
        corners += [tuple(result.route_en_m.max(0) + half_m)]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    margin = _MARGIN * float((high - low).max())
    west, south, east, north = (float(v) for v in (*(low - margin), *(high + margin)))
    return west, south, east, north


def map_image(opened: MapFile, box: Box) -> Background:
    sheet = SheetImagery(opened)
    limits = np.array(sheet.grid.extent_en_m)
    low, high = np.tile(limits[:2], 2), np.tile(limits[2:], 2)
    west, south, east, north = (float(edge) for edge in np.clip(box, low, high))
    width_m, height_m = east - west, north - south
    gsd_m = max(
        sheet.grid.gsd_m,
        max(width_m, height_m) / MAX_SIDE_PX,
        math.sqrt(width_m * height_m / MAX_AREA_PX),
    )
    size = max(1, round(width_m / gsd_m)), max(1, round(height_m / gsd_m))
    grey, valid = sheet.crop((west, south, east, north), size)
    grey[~valid] = _EMPTY
    return Background(grey, (west, south, east, north))
