"""Words and sentences that page and terminal share."""

import math

from orthonav.check.outcome import Alternative, CheckResult, Conditions, Envelope, Stretch, Word

SYMBOLS = {Word.GO: "✓", Word.MARGINAL: "!", Word.NO_GO: "✕"}
VERDICTS = {
    Word.GO: "The way can be flown by the map.",
    Word.MARGINAL: "The way can be flown by the map with care: read why.",
    Word.NO_GO: "Do not rely on the map for this: read why.",
}
AREA_VERDICTS = {
    Word.GO: "Views can be placed on this map.",
    Word.MARGINAL: "Views can be placed on much of this map: read why not everywhere.",
    Word.NO_GO: "Do not rely on this map: read why.",
}
WHAT = {"agl_m": "height above ground", "band_m": "width of the band"}
CLEARLY = 0.05
"""Less than this is chance: few trials stand behind an alternative."""


def verdict_said(result: CheckResult) -> str:
    """The verdict as a sentence, of the route or of the map where there is none."""
    said = AREA_VERDICTS if result.along is None else VERDICTS
    return said[result.verdict.word]


def share_text(value: float) -> str:
    """A probability as whole percent, `-` where it is not known; 100 % only where it is."""
    if not math.isfinite(value):
        return "-"
    percent = round(100 * value)
    return f"{99 if percent == 100 and value < 0.9995 else percent} %"


def metres_text(value: float | None) -> str:
    """A length: kilometres from 10 km on, `-` where it is not known."""
    if value is None or not math.isfinite(value):
        return "-"
    if abs(value) >= 10_000:
        return f"{value / 1000:.1f} km"
    return f"{value:.1f} m" if abs(value) < 10 and value != round(value) else f"{value:.0f} m"


def place_text(value: float) -> str:
    """A distance from the start of the route, in kilometres to ten metres."""
    return f"{value / 1000:.2f} km" if math.isfinite(value) else "-"


def seconds_text(value: float) -> str:
    """A time: seconds, from two minutes on `M:SS min`, from an hour on `H:MM h`."""
    if not math.isfinite(value):
        return "-"
    whole = round(value)
    if abs(whole) < 120:
        return f"{whole} s"
    if abs(whole) < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole // 60 % 60:02d} h"


def outcome_text(stretch: Stretch) -> str:
    """What becomes of the aircraft in a blind stretch."""
    if stretch.ends_lost:
        return "the route ends in it"
    return "found again" if stretch.bearable else "lost"


def fine_said(envelope: Envelope) -> str:
    """How wrong told heading and height may be, as a sentence."""
    low, high = abs(envelope.fine_agl_low), abs(envelope.fine_agl_high)
    if not all(map(math.isfinite, (envelope.fine_yaw_deg, low, high))):
        return "How far told heading and height may be off is not known."
    return (
        f"Fine up to {envelope.fine_yaw_deg:g}° of error in heading, and with a height that is "
        f"told {100 * low:.0f} % too low to {100 * high:.0f} % too high: with either alone, the "
        "share of correct, confident fixes stays at 85 % or more of the one without error."
    )


def conditions_said(conditions: Conditions, band_m: float | None) -> dict[str, str]:
    """What was checked for, by name."""
    yaw, prior, height = conditions.yaw_std_deg, conditions.prior_std_m, conditions.agl_m
    said = {
        "view on the ground": f"{conditions.width_m:.0f} x {conditions.height_m:.0f} m",
        "height above ground": "not told" if height is None else f"{height:.0f} m",
        "told height is off by": f"{100 * conditions.agl_std:.1f} % (one standard deviation)",
        "told heading is off by": (
            "not known: every heading is tried"
            if yaw is None
            else f"{yaw:g}° (one standard deviation)"
        ),
        "told position is off by": (
            "not known: the whole map is searched"
            if prior is None
            else f"{metres_text(prior)} per axis (one standard deviation)"
        ),
        "a fix counts as confident": f"from a confidence of {conditions.accept:g} on",
        "a fix counts as correct": f"within {metres_text(conditions.radius_m)}",
        "speed over ground": f"{conditions.speed_mps:g} m/s",
        "drift without fixes": f"{100 * conditions.drift:g} % of the way flown",
    }
    if band_m is not None:
        said["band along the route"] = f"{metres_text(band_m)} wide"
    return said


def value_text(alternative: Alternative) -> str:
    """The value of an alternative with its unit."""
    value = alternative.value
    return metres_text(value) if alternative.what.endswith("_m") else f"{value:g}"


def what_text(what: str) -> str:
    """What an alternative changes, in words."""
    return WHAT.get(what, what.replace("_", " "))


def better_said(alternatives: tuple[Alternative, ...], what: str) -> str:
    """What would be better than what was chosen, or that nothing tried is; empty if not known."""
    tried = [each for each in alternatives if each.what == what]
    known = [each for each in tried if math.isfinite(each.probability)]
    chosen = next((each for each in known if each.chosen), None)
    if not known or chosen is None:
        return ""
    best = max(known, key=lambda each: each.probability)
    if best.probability < chosen.probability + CLEARLY:
        return f"No other {what_text(what)} that was tried is better than {value_text(chosen)}."
    return (
        f"A {what_text(what)} of {value_text(best)} instead of {value_text(chosen)} would be "
        f"better: {share_text(best.probability)} instead of {share_text(chosen.probability)}."
    )
