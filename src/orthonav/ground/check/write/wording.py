"""Words and sentences of page and terminal, and a check as text for a terminal."""

import math
import textwrap

from orthonav.core.records import CONFIDENT
from orthonav.ground.check.outcome import (
    Alternative,
    BlindStretch,
    CheckResult,
    Conditions,
    Envelope,
    Lookalike,
    Word,
    summarize,
)
from orthonav.ground.report.numbers import aligned, metres_text

SYMBOLS = {Word.GO: "✓", Word.MARGINAL: "!", Word.NO_GO: "✕"}
VERDICTS = {
    Word.GO: "This route can be flown with this map.",
    Word.MARGINAL: "This route does not meet all requirements for GO; see the reasons.",
    Word.NO_GO: "Do not rely on this map for this route; see the reasons.",
}
AREA_VERDICTS = {
    Word.GO: "Views can be localized on this map.",
    Word.MARGINAL: "Views can be localized on parts of this map; see the reasons.",
    Word.NO_GO: "Do not rely on this map; see the reasons.",
}
WHAT = {"agl_m": "height above ground", "band_m": "band width"}
CLEARLY = 0.05
"""Smaller differences may be chance, because an alternative rests on few trials."""
MAX_STRETCHES = 7
_WIDTH = 100
SIMULATED = "Predicted from this map alone, with simulated ageing."


def verdict_sentence(result: CheckResult) -> str:
    sentences = AREA_VERDICTS if result.along is None else VERDICTS
    origin = f", {result.about.height}" if result.about.height else ""
    height = f"Checked at {result.conditions.agl_m:.0f} m above ground{origin}."
    return f"{sentences[result.verdict.word]} {height}"


def probability_text(value: float) -> str:
    """A probability in whole percent, `-` if unknown; 100 % only if it really is."""
    if not math.isfinite(value):
        return "-"
    percent = round(100 * value)
    return f"{99 if percent == 100 and value < 0.9995 else percent} %"


def seconds_text(value: float) -> str:
    """A time in seconds, from two minutes on as `M:SS min`, from an hour on as `H:MM h`."""
    whole = round(value)
    if abs(whole) < 120:
        return f"{whole} s"
    if abs(whole) < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole // 60 % 60:02d} h"


def stretch_row(number: int, stretch: BlindStretch) -> tuple[str, ...]:
    outcome = "recovers" if stretch.recoverable else "lost"
    return (
        str(number),
        f"{stretch.start_m / 1000:.2f} km",
        f"{stretch.end_m / 1000:.2f} km",
        metres_text(stretch.length_m),
        seconds_text(stretch.end_s - stretch.start_s),
        probability_text(stretch.probability),
        metres_text(stretch.drift_m),
        metres_text(stretch.allowed_m),
        "the route ends in it" if stretch.ends_lost else outcome,
    )


def stretch_sentence(number: int, stretch: BlindStretch) -> str:
    _, _, _, length, duration, probability, drift, allowed, outcome = stretch_row(number, stretch)
    return (
        f"Gap {number}: {length}, {duration}, probability {probability}, error {drift} at its end "
        f"(limit {allowed}): {outcome}."
    )


def lookalike_sentence(number: int, pair: Lookalike) -> str:
    where = "within" if pair.within_prior else "outside"
    return (
        f"Ambiguous places {number}: {metres_text(pair.apart_m)} apart, similarity "
        f"{pair.similarity:.2f}, {pair.trials} trials, {where} the prior."
    )


def tolerance_sentence(envelope: Envelope) -> str:
    low, high = abs(envelope.tolerated_agl_low), abs(envelope.tolerated_agl_high)
    return (
        f"Tolerated: a heading error of up to {envelope.tolerated_yaw_deg:g}°, or a reported "
        f"height from {100 * low:.0f} % too low to {100 * high:.0f} % too high. With either error "
        "alone, the rate of correct, confident fixes stays at 85 % or more of that without error."
    )


def conditions_text(conditions: Conditions, band_m: float | None) -> dict[str, str]:
    yaw, prior = conditions.yaw_std_deg, conditions.prior_std_m
    # root mean square of both axes
    off_m = math.sqrt(2) * conditions.agl_m * math.tan(math.radians(conditions.tilt_std_deg))
    rows = {
        "footprint of a view": f"{conditions.width_m:.0f} x {conditions.height_m:.0f} m",
        "height above ground": f"{conditions.agl_m:.0f} m",
        "error of reported height": f"{100 * conditions.agl_std:.1f} % (standard deviation)",
        "error of reported heading": (
            "heading unknown: all headings are searched"
            if yaw is None
            else f"{yaw:g}° (standard deviation)"
        ),
        "error of prior position": (
            "no prior: the whole map is searched"
            if prior is None
            else f"{metres_text(prior)} per axis (standard deviation)"
        ),
        "error of the reported tilt": f"{conditions.tilt_std_deg:g}° (standard deviation)"
        f", displaces fixes by {metres_text(off_m)}",
        "sensor": (
            "of another kind than the map's (assumed)"
            if conditions.other_sensor
            else "like the map's, of another year"
        ),
        "confident fix": f"confidence of {conditions.accept:g} or more",
        "correct fix": f"error of at most {metres_text(conditions.radius_m)}",
        "ground speed": f"{conditions.speed_mps:g} m/s",
        "drift without fixes": f"{100 * conditions.drift:g} % of the distance flown",
    }
    if band_m is not None:
        rows["band along the route"] = f"{metres_text(band_m)} wide"
    return rows


def better_sentence(alternatives: tuple[Alternative, ...], what: str) -> str:
    tried = [each for each in alternatives if each.what == what]
    known = [each for each in tried if math.isfinite(each.probability)]
    chosen = next((each for each in known if each.chosen), None)
    if not known or chosen is None:
        return ""
    best = max(known, key=lambda each: each.probability)
    value = metres_text(chosen.value)
    if best.probability < chosen.probability + CLEARLY:
        return f"No other {WHAT[what]} that was tried is clearly better than {value}."
    return (
        f"A {WHAT[what]} of {metres_text(best.value)} is better: mean probability "
        f"{probability_text(best.probability)}, against {probability_text(chosen.probability)} at "
        f"{value}{' (fewer trials)' * (what == 'agl_m')}."
    )


def remedies(result: CheckResult) -> list[str]:
    if result.verdict.word is Word.GO:
        return []
    found = [better_sentence(result.alternatives, what) for what in WHAT]
    found = [sentence for sentence in found if sentence.startswith("A ")]
    lost = [each for each in result.stretches if not each.recoverable and not each.ends_lost]
    if lost:
        drift = min(each.allowed_m / each.length_m for each in lost)
        assumed = f"{100 * result.conditions.drift:g} %"
        found.append(
            f"Dead reckoning that drifts by at most {100 * drift:.1f} % (assumed: {assumed}) "
            "bridges all gaps."
        )
    if any(each.ends_lost and each.start_m > 0 for each in result.stretches):
        start_km = result.stretches[-1].start_m / 1000
        found.append(
            f"End the route before km {start_km:.1f}, or extend it to where fixes are likely."
        )
    return found or ["Check another route or map."]


def text(result: CheckResult) -> str:
    """Verdict, reasons, key figures and gaps; control characters in names are replaced."""
    lines = [f"{result.verdict.word.value.upper()}: {verdict_sentence(result)}"]
    lines += [line for each in result.verdict.reasons for line in _item(each.text)]
    rows = _figures(result)
    width = max(len(name) for name, _ in rows)
    lines += ["", *(f"{name:<{width}}  {value}" for name, value in rows)]
    lines += _stretches(result)
    helpful = remedies(result)
    if helpful:
        lines += ["", "what may help:", *(line for each in helpful for line in _item(each))]
    return "\n".join("".join(c if c.isprintable() else "\ufffd" for c in line) for line in lines)


def _item(sentence: str) -> list[str]:
    """A sentence as an item of a list, in at most two lines; "%" stays with its number."""
    joined = " ".join(sentence.split()).replace(" %", "\N{NO-BREAK SPACE}%")
    wrapped = textwrap.wrap(joined, _WIDTH - 4, max_lines=2) or [""]
    first, *rest = (line.replace("\N{NO-BREAK SPACE}", " ") for line in wrapped)
    return [f"  - {first}", *(f"    {line}" for line in rest)]


def _figures(result: CheckResult) -> list[tuple[str, str]]:
    summary, conditions = summarize(result), result.conditions
    dates = "also of a second date" if result.second_date else "simulated ageing"
    rows = [
        ("map", result.about.map_name),
        ("area", f"{result.area_km2:.2f} km2, mean probability {probability_text(result.mean)}"),
        ("views", f"{conditions.width_m:.0f} x {conditions.height_m:.0f} m on the ground, {dates}"),
    ]
    if result.along is not None:
        length = f"{metres_text(summary['route_m'])}, {seconds_text(summary['route_s'])}"
        likely = probability_text(summary["route_share_from_0_9"])
        rows.append(
            ("route", f"{length}; {likely} of it with a probability of {CONFIDENT:g} or more")
        )
    rows.append(("error", f"{metres_text(summary['error_m'])} expected for a correct fix"))
    if result.lookalikes:
        near = sum(each.within_prior for each in result.lookalikes)
        rows.append(
            ("ambiguous", f"pairs of places: {len(result.lookalikes)}, within the prior: {near}")
        )
    return rows


def _stretches(result: CheckResult) -> list[str]:
    if result.along is None:
        return []
    if not result.stretches:
        return ["", "no gaps without fixes"]
    worst_first = sorted(result.stretches, key=lambda each: (each.recoverable, -each.length_m))
    worst = worst_first[:MAX_STRETCHES]
    rows: list[tuple[str, ...]] = [
        ("#", "from", "to", "length", "duration", "prob.", "drift", "limit", "")
    ]
    for number, each in enumerate(result.stretches, start=1):
        if each in worst:
            rows.append(stretch_row(number, each))
    return ["", f"gaps without fixes: {len(result.stretches)}, the worst:", *aligned(rows)]
