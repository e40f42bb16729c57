"""The page of a check: one file that opens from a disk, asks for nothing, and is read without
JavaScript too.
"""

import base64
import hashlib
from html import escape
from importlib.resources import files

from orthonav.check.outcome import CheckResult, Word
from orthonav.check.write.figures import MOST_LOOKALIKES
from orthonav.check.write.ground import Ground, seen_box
from orthonav.check.write.leaflet import Leaflet
from orthonav.check.write.numbers import page_numbers
from orthonav.check.write.said import (
    SYMBOLS,
    better_said,
    conditions_said,
    fine_said,
    metres_text,
    outcome_text,
    place_text,
    seconds_text,
    share_text,
    value_text,
    verdict_said,
    what_text,
)
from orthonav.check.write.summary import summarize
from orthonav.records import CONFIDENT
from orthonav.report import (
    SAID_STYLE,
    STYLE,
    Figure,
    cards,
    definitions,
    document,
    figure_html,
    html_table,
    notes,
    pictures,
)

_SCRIPTS = ("numbers.js", "map.js", "profile.js", "main.js")
_MOST_ROWS = 200
LAYERS = {
    "probability": "probability of a fix",
    "low": "probability, lower end of its interval",
    "error_m": "expected error of a fix",
    "wrong": "confident and wrong",
    "texture": "lasting structure of the ground",
}
_UNKNOWN = (
    "clouds, haze and shadow of clouds",
    "snow, floods, night and low sun",
    "what was built, felled or ploughed since the imagery was taken",
    "relief and tall buildings: the ground is taken as flat below each view",
    "blur, exposure and dirt of the camera",
)


def render(result: CheckResult, ground: Ground, figures: list[Figure], leaflet: Leaflet) -> str:
    """The whole page as HTML text."""
    drawn = {figure.name: figure for figure in figures}
    shown = [_verdict(result), _cards(result), notes(_notes(result)), _where(result, drawn)]
    shown += [_stretches(result), _lookalikes(result), _envelope(result, drawn)]
    shown += [_alternatives(result), _how_to_read(result)]
    shown += ["<h2>Checked for</h2>", _conditions(result)]
    shown += ["<h2>Made from</h2>", _made_from(result)]
    data = page_numbers(result, ground, seen_box(result))
    script = _script()
    shown += [
        f'<script type="application/json" id="check-data">{data}</script>',
        f'<img id="check-ground" alt="" hidden src="{_address(ground.jpeg())}">',
        f"<script>{leaflet.script}</script>",
        f"<script>{script}</script>",
    ]
    style = STYLE + SAID_STYLE + leaflet.style + _static("check.css")
    about = result.about
    title = f"Check of {about.map_name}" + (f" for {about.route_name}" * bool(about.route_name))
    page = document(title, "\n".join(shown), style, "Check before take-off")
    return _guarded(page, style, (leaflet.script, script))


def _guarded(page: str, style: str, scripts: tuple[str, ...]) -> str:
    """The page with a policy: only its own scripts run, and nothing is asked for."""
    ours = " ".join(_source(script) for script in scripts)
    policy = (
        f"default-src 'none'; img-src data:; style-src {_source(style)}; script-src {ours}; "
        "base-uri 'none'; form-action 'none'"
    )
    meta = f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
    start = '<meta charset="utf-8">\n'  # the first: titles are escaped
    return page.replace(start, start + meta, 1)


def _source(text: str) -> str:
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def _script() -> str:
    """Our scripts as one, with names of their own."""
    return f'(() => {{\n"use strict";\n{"".join(map(_static, _SCRIPTS))}}})();'


def _static(name: str) -> str:
    return files("orthonav.check.write").joinpath("static", name).read_text(encoding="utf-8")


def _address(jpeg: bytes) -> str:
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode('ascii')}"


def _verdict(result: CheckResult) -> str:
    verdict = result.verdict
    word = verdict.word
    reasons = "".join(
        f'<li class="{_kind(each.word)}"><b aria-label="{each.word.value}">'
        f"{SYMBOLS[each.word]}</b> "
        f"{escape(each.text)}</li>"
        for each in verdict.reasons
    )
    return (
        f'<section class="verdict {_kind(word)}" aria-label="Verdict">'
        f'<p class="word"><span aria-hidden="true">{SYMBOLS[word]}</span> {word.value.upper()}</p>'
        f"<div><p>{escape(verdict_said(result))}</p><ul>{reasons}</ul></div></section>"
    )


def _kind(word: Word) -> str:
    return f"is-{word.value}"


def _cards(result: CheckResult) -> str:
    summary, conditions = summarize(result), result.conditions
    shown = [(share_text(result.mean), f"probability of a fix, mean over {_area(result)}")]
    if result.along is not None:
        shown.append(
            (
                share_text(summary.confident_share),
                f"of {metres_text(summary.route_m)} at {CONFIDENT:g} or more",
            )
        )
        shown.append(_longest(result))
    shown.append((metres_text(summary.error_m), "expected error of a correct fix"))
    prior = conditions.prior_std_m
    shown.append(
        ("whole map", "searched: no prior")
        if prior is None
        else (metres_text(prior), "prior, standard deviation per axis")
    )
    shown.append((metres_text(conditions.agl_m), "above ground"))
    if result.along is None:
        shown.append((str(int(result.cells.trials.sum())), "views tried"))
        shown.append((str(len(result.lookalikes)), "pairs of lookalikes"))
    return cards(shown)


def _area(result: CheckResult) -> str:
    return f"{result.area_km2:.3g} km²" if result.area_km2 < 100 else f"{result.area_km2:.0f} km²"


def _longest(result: CheckResult) -> tuple[str, str]:
    longest = summarize(result).longest
    if longest is None:
        return "none", "blind stretch along the route"
    lasts = seconds_text(longest.end_s - longest.start_s)
    return (
        metres_text(longest.length_m),
        f"longest blind stretch: {lasts}, off by {metres_text(longest.drift_m)} at its end",
    )


def _notes(result: CheckResult) -> list[str]:
    said = []
    if not result.second_date:
        said.append(
            "No second date was given: views are the map's own imagery, changed as years change "
            "what looks like this. A second date (--ortho) shows what really changed."
        )
    return said


def _where(result: CheckResult, drawn: dict[str, Figure]) -> str:
    """Map and course, to be used where scripts run, as figures where they do not and in print."""
    static = pictures(
        figure_html(drawn[name], True) for name in ("map", "profile") if name in drawn
    )
    return (
        "<h2>Where a view can be localized</h2>"
        f'<div class="live-part">{_map_part(result)}{_profile_part(result, drawn)}'
        '<p id="said" class="unseen" role="status" aria-live="polite"></p></div>'
        f'<div class="still-part">{static}</div>'
    )


def _map_part(result: CheckResult) -> str:
    options = "".join(f'<option value="{name}">{said}</option>' for name, said in LAYERS.items())
    check = '<label><input type="checkbox" id="show-{0}" checked> {1}</label>'
    shown = [check.format("route", "route")] if result.along is not None else []
    shown += [check.format("lookalikes", "lookalikes")] if result.lookalikes else []
    return (
        '<div class="tools"><label>Show <select id="layer">'
        f'{options}<option value="">imagery only</option></select></label>'
        '<label>Opacity <input type="range" id="opacity" min="0" max="100" value="55"></label>'
        f'{"".join(shown)}<button type="button" id="whole">Whole area</button></div>'
        '<div class="map-part"><div class="map-box"><div id="map" role="application" '
        'aria-label="Map. Arrow keys move it, plus and minus zoom, Enter tells the figures at its '
        'middle."></div><span class="cross" aria-hidden="true"></span></div>'
        '<aside aria-label="Figures of the chosen place"><h3>Chosen place</h3>'
        '<p id="hint" class="small">Click the map or the course, or press Enter on the map.</p>'
        '<dl id="figures" class="said"></dl><div id="legend"></div></aside></div>'
    )


def _profile_part(result: CheckResult, drawn: dict[str, Figure]) -> str:
    if result.along is None or "profile" not in drawn:
        return ""
    last = len(result.along.distance_m) - 1
    return (
        "<h3>Along the route</h3>"
        '<p class="small key"><span class="k-line">probability</span> <span class="k-area">its '
        '80 % interval</span> <span class="k-low">lowest across the band</span> '
        '<span class="k-drift">position off by (one standard deviation)</span> '
        '<span class="k-error">error of one fix'
        '</span> <span class="k-blind">blind</span> <span class="k-lost">blind and lost</span></p>'
        '<div id="profile"></div><label class="slide">Place along the route '
        f'<input type="range" id="along" min="0" max="{last}" value="0"></label>'
    )


def _stretches(result: CheckResult) -> str:
    if result.along is None:
        return ""
    if not result.stretches:
        return "<h2>Blind stretches</h2><p>There is none: a view is likely placed all the way.</p>"
    header = ("no.", "from", "to", "length", "lasts", "probability", "off by", "allowed", "then")
    rows = [
        (
            str(i + 1),
            *(place_text(each.start_m), place_text(each.end_m), metres_text(each.length_m)),
            seconds_text(each.end_s - each.start_s),
            share_text(each.probability),
            metres_text(each.drift_m),
            metres_text(each.allowed_m),
            ("✓ " if each.bearable else "✕ ") + outcome_text(each),
        )
        for i, each in enumerate(result.stretches[:_MOST_ROWS])
    ]
    said = (
        "Where a view is unlikely to be placed. “Off by” is what dead reckoning may be off by at "
        "the end; “allowed”, how far it may be off there and the next view still be searched in "
        "the right place."
    )
    return (
        f'<h2>Blind stretches</h2><p class="small">{said}</p>'
        f"{html_table(header, rows, label='blind stretches')}{_left_out(result.stretches)}"
    )


def _left_out(rows: tuple[object, ...], most: int = _MOST_ROWS) -> str:
    more = len(rows) - most
    return f'<p class="small">{more} more are in check.json and check.gpkg.</p>' if more > 0 else ""


def _lookalikes(result: CheckResult) -> str:
    if not result.lookalikes:
        return "<h2>Lookalikes</h2><p>No place was taken for another one.</p>"
    header = ("no.", "place", "is taken for", "apart", "likeness", "trials", "searched together")
    rows = [
        (
            str(i + 1),
            *(
                f"{lat:.5f}, {lon:.5f}"
                for lat, lon in (each.place_latlon_deg, each.other_latlon_deg)
            ),
            metres_text(each.apart_m),
            f"{each.likeness:.2f}",
            str(each.trials),
            "! yes, within the prior" if each.within_prior else "no, beyond the prior",
        )
        for i, each in enumerate(result.lookalikes[:MOST_LOOKALIKES])
    ]
    return (
        '<h2>Lookalikes</h2><p class="small">Places of which a view may be put at the other.</p>'
        f"{html_table(header, rows, label='lookalikes')}"
        f"{_left_out(result.lookalikes, MOST_LOOKALIKES)}"
    )


def _envelope(result: CheckResult, drawn: dict[str, Figure]) -> str:
    if result.envelope is None or "envelope" not in drawn:
        return ""
    return (
        "<h2>How wrong heading and height may be</h2>"
        f"<p>{escape(fine_said(result.envelope))}</p>{figure_html(drawn['envelope'])}"
    )


def _alternatives(result: CheckResult) -> str:
    found = result.alternatives
    if not found:
        return ""
    parts = ["<h2>What else could be chosen</h2>"]
    for what in dict.fromkeys(each.what for each in found):
        tried = [each for each in found if each.what == what]
        rows = [
            (value_text(each), share_text(each.probability), "● chosen" if each.chosen else "-")
            for each in tried
        ]
        over = "along the route" if result.along is not None else "over the map"
        header = (what_text(what), f"mean probability {over}", "choice")
        parts.append(f"<p>{escape(better_said(found, what))}</p>")
        parts.append(html_table(header, rows, label=what_text(what)))
    return "".join(parts)


def _how_to_read(result: CheckResult) -> str:
    conditions = result.conditions
    own = "" if result.second_date else " All of them were made from the map's own date."
    said = (
        "A probability is that of one single view, taken anywhere in a cell under the conditions "
        f"below: that orthonav places it with a confidence of {conditions.accept:g} or more, and "
        f"not farther than {metres_text(conditions.radius_m)} from where it was taken. It was "
        f"predicted from views made of imagery, not flown.{own} Low and high hold 80 %: few trials "
        "make them wide, and years that differ.",
        "A flight takes many views, so a place of probability 0.5 is passed with a fix soon; what "
        "matters is how far the aircraft flies without one. A stretch is blind where a view is "
        "unlikely to be placed; what dead reckoning drifts meanwhile must stay below what is "
        "allowed, or the next view is searched in the wrong place.",
    )
    unknown = "".join(f"<li>{each}</li>" for each in _UNKNOWN)
    return (
        f"<h2>How to read this</h2>{''.join(f'<p>{escape(each)}</p>' for each in said)}"
        f"<p>It does not know of:</p><ul>{unknown}</ul>"
        "<p>A check is a prediction, and GO is no promise. Where the answer matters, fly the way "
        "with GNSS once and compare.</p>"
    )


def _conditions(result: CheckResult) -> str:
    return definitions(conditions_said(result.conditions, result.band_m), sentences=True)


def _made_from(result: CheckResult) -> str:
    about = result.about
    said = {
        "map": about.map_name,
        "imagery": about.imagery,
        "recipe": about.recipe,
        "views of": about.other_date,
        "route": about.route_name,
        "command": about.command,
        "orthonav": about.version,
    }
    said = {name: text for name, text in said.items() if text}
    terms = "".join(f"<li>{escape(each)}</li>" for each in about.terms)
    listed = f'<h3>Terms of the imagery</h3><ul class="terms">{terms}</ul>' if terms else ""
    return (
        definitions(said)
        + listed
        + '<p class="small">The map is drawn by Leaflet, © its contributors, BSD-2.</p>'
    )
