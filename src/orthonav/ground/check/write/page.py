"""The page of a check: one self-contained file, readable without JavaScript and in print."""

import json
from typing import Any

import numpy as np

from orthonav.core.records import CONFIDENT
from orthonav.ground.check.outcome import CELL_VALUES, CheckResult, summarize
from orthonav.ground.check.write.figures import KNEE, MAX_LOOKALIKES, page_jpeg, visible_box
from orthonav.ground.check.write.plain import (
    EDGE_PX,
    RISKS,
    Plain,
    check_to_plain,
    segments,
    stretch_en_m,
)
from orthonav.ground.check.write.wording import (
    SIMULATED,
    SYMBOLS,
    WHAT,
    better_sentence,
    conditions_text,
    lookalike_sentence,
    probability_text,
    remedies,
    seconds_text,
    stretch_row,
    stretch_sentence,
    tolerance_sentence,
    verdict_sentence,
)
from orthonav.ground.report.drawing import Background
from orthonav.ground.report.numbers import metres_text, to_plain
from orthonav.ground.report.page import Figure, data_url, joined_scripts, render, static_text

PACKAGE = "orthonav.ground.check.write"
_SHARED = ("format.js", "plane.js", "chart.js")
_SCRIPTS = ("data.js", "map.js", "profile.js", "page.js")
MAX_ROWS = 200
LAYERS = {
    "probability": "probability of a fix",
    "low": "probability, lower end of its interval",
    "error_m": "expected error of a fix",
    "wrong": "rate of false fixes",
    "persistence": "expected persistence of the ground",
    "changed": "changed since the map was made",
}
INPUTS = (
    "height above ground",
    "footprint of a view",
    "error of prior position",
    "error of reported heading",
    "error of the reported tilt",
    "drift without fixes",
)
DOWNLOADS = {
    "check.geojson": "GeoJSON: route, gaps, cells, ambiguous places",
    "check.tif": "GeoTIFF: a band per layer of the map",
    "check.json": "JSON: all results and conditions",
}
ZERO_IF_UNKNOWN = frozenset({"trials", "changed"})
"""Values that are 0, not None, in cells of which nothing is known."""


def page_of(
    result: CheckResult,
    image: Background,
    figures: list[Figure],
    leaflet: tuple[str, str],
    json_sha256: str,
) -> str:
    about = result.about
    script, style = leaflet
    scripts = (script, joined_scripts(_SHARED, PACKAGE, _SCRIPTS))
    conditions = conditions_text(result.conditions, result.band_m)
    values = {
        "title": f"Check of {about.map_name}" + f" for {about.route_name}" * bool(about.route_name),
        "kind": "Check before take-off",
        "result": result,
        "symbols": {"info": "i", **{word.value: symbol for word, symbol in SYMBOLS.items()}},
        "sentence": verdict_sentence(result),
        "cards": _cards(result),
        "note": "" if result.second_date else SIMULATED,
        "figures": {figure.name: figure for figure in figures},
        "layers": LAYERS,
        "stretches": [
            (*row, ("✓ " if stretch.recoverable else "✕ ") + outcome)
            for number, stretch in enumerate(result.stretches, start=1)
            for *row, outcome in [stretch_row(number, stretch)]
        ],
        "lookalikes": _lookalike_rows(result),
        "max_rows": MAX_ROWS,
        "max_lookalikes": MAX_LOOKALIKES,
        "tolerance": tolerance_sentence(result.envelope) if result.envelope else "",
        "alternatives": _alternatives(result),
        "radius": metres_text(result.conditions.radius_m),
        "conditions": conditions,
        "inputs": [(name, conditions[name]) for name in INPUTS],
        "remedies": remedies(result),
        "downloads": DOWNLOADS,
        "checked": _checked(result, json_sha256),
        "data": _page_data(result, image),
        "image": data_url(page_jpeg(image), "image/jpeg"),
    }
    style += static_text("check.css", PACKAGE)
    return render(PACKAGE, "page.html", values, style=style, scripts=scripts)


def _cards(result: CheckResult) -> list[tuple[str, str]]:
    summary = summarize(result)
    km2 = result.area_km2
    area = f"{km2:.3g} km²" if km2 < 100 else f"{km2:.0f} km²"
    shown = [(probability_text(result.mean), f"mean probability of a fix over {area}")]
    if result.along is not None:
        route = f"of {metres_text(summary['route_m'])} at a probability of {CONFIDENT:g} or more"
        shown += [
            (probability_text(summary["route_share_from_0_9"]), route),
            _longest(result, summary["longest_stretch"]),
        ]
    shown.append((metres_text(summary["error_m"]), "expected error of a correct fix"))
    if result.along is None:
        shown.append((str(int(result.cells.trials.sum())), "trial views"))
    else:
        worst_m = float(result.along.drift_m.max())
        shown.append((metres_text(worst_m), "largest predicted position error along the route"))
    shown.append((str(len(result.lookalikes)), "pairs of ambiguous places"))
    return shown


def _longest(result: CheckResult, number: int | None) -> tuple[str, str]:
    if number is None:
        return "0", "gaps without fixes along the route"
    longest = result.stretches[number - 1]
    duration = seconds_text(longest.end_s - longest.start_s)
    error = metres_text(longest.drift_m)
    text = f"longest gap without fixes: {duration}, error {error} after it"
    return metres_text(longest.length_m), text


def _lookalike_rows(result: CheckResult) -> list[tuple[str, ...]]:
    return [
        (
            str(number),
            "{:.5f}, {:.5f}".format(*each.place_latlon_deg),
            "{:.5f}, {:.5f}".format(*each.other_latlon_deg),
            metres_text(each.apart_m),
            f"{each.similarity:.2f}",
            str(each.trials),
            "! yes" if each.within_prior else "no",
        )
        for number, each in enumerate(result.lookalikes, start=1)
    ]


def _alternatives(result: CheckResult) -> list[Plain]:
    found = result.alternatives
    return [
        {
            "name": WHAT[what],
            "sentence": better_sentence(found, what),
            "rows": [
                (
                    metres_text(each.value),
                    probability_text(each.probability),
                    "● chosen" if each.chosen else "-",
                )
                for each in found
                if each.what == what
            ],
        }
        for what in dict.fromkeys(each.what for each in found)
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
        "band": _band(result),
        "lookalikes": np.array(pairs),
        "blind_texts": [stretch_sentence(*each) for each in enumerate(result.stretches, start=1)],
        "lookalike_texts": [
            lookalike_sentence(*each)
            for each in enumerate(result.lookalikes[:MAX_LOOKALIKES], start=1)
        ],
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


def _band(result: CheckResult) -> list[Any]:
    if result.route_en_m is None or not result.band_m or len(result.route_en_m) < 2:
        return []
    from shapely import LineString

    outline = LineString(result.route_en_m).buffer(result.band_m / 2, quad_segs=8)
    outline = outline.simplify(result.band_m / 500)
    return [np.array(ring.coords) for ring in (outline.exterior, *outline.interiors)]
