"""Words and sentences of page and terminal, and a check as text for a terminal."""

import textwrap

from orthonav.ground.check.findings import interval_text, range_text
from orthonav.ground.check.flights import after_fix_m
from orthonav.ground.check.records import CheckResult, Conditions, Outage, Word, summarize
from orthonav.ground.report import (
    aligned,
    metres_text,
    percent_text,
    probability_text,
    seconds_text,
)

SYMBOLS = {Word.GO: "✓", Word.MARGINAL: "!", Word.NO_GO: "✕"}
MARKS = {Word.GO: "ok", Word.MARGINAL: "!", Word.NO_GO: "X"}
"""On terminals, which may lack the symbols."""
VERDICTS = {
    Word.GO: "This {} can be flown with this map.",
    Word.MARGINAL: "This {} does not meet all requirements for GO; see the reasons.",
    Word.NO_GO: "Do not rely on this map for this {}; see the reasons.",
}
OUTAGE_COLUMNS = ("no.", "from", "to", "length", "duration", "probability of a fix", "available")
SIMULATED = "Predicted from this map alone, with simulated ageing."


def verdict_sentence(result: CheckResult) -> str:
    sentence = VERDICTS[result.verdict.word].format("area" if result.along is None else "route")
    origin = f", {result.about.height}" if result.about.height else ""
    height = f"Checked at {result.conditions.agl_m:.0f} m above ground{origin}."
    return f"{sentence} {height}"


def outage_row(number: int, outage: Outage) -> tuple[str, ...]:
    return (
        str(number),
        f"{outage.start_m / 1000:.2f} km",
        f"{outage.end_m / 1000:.2f} km",
        metres_text(outage.length_m),
        seconds_text(outage.end_s - outage.start_s),
        probability_text(outage.probability),
        probability_text(outage.available),
    )


def conditions_text(conditions: Conditions, band_m: float | None) -> dict[str, str]:
    yaw, prior = conditions.yaw_std_deg, conditions.prior_std_m
    given = "as given" if conditions.limit_given else "default: give yours with --alert-limit-m"
    rows = {
        "alert limit": f"{metres_text(conditions.alert_limit_m)} ({given})",
        "risk": f"{conditions.risk:g} (probability of an error beyond the protection level)",
        "footprint of a view": f"{conditions.width_m:.0f} x {conditions.height_m:.0f} m",
        "height above ground": f"{conditions.agl_m:.0f} m",
        "error of reported height": f"{100 * conditions.agl_std:.1f} % (standard deviation)",
        "error of reported heading": "heading unknown: all headings are searched",
        "error of prior position": "no prior: the whole map is searched",
        "error of the reported tilt": f"{conditions.tilt_std_deg:g}° (standard deviation)",
        "camera": {
            "colour": "colour or grey, in daylight, as the map's imagery",
            "other": "of another kind than that of the map's imagery (assumed)",
        }.get(conditions.camera_kind, f"{conditions.camera_kind} (assumed)"),
        "confident fix": f"confidence of {conditions.accept:g} or more",
        "correct fix": f"error of at most {metres_text(conditions.radius_m)}",
        "ground speed": f"{conditions.speed_mps:g} m/s",
        "drift between fixes": f"{100 * conditions.drift:g} % of the distance flown",
    }
    if yaw is not None:
        rows["error of reported heading"] = f"{yaw:g}° (standard deviation)"
    if prior is not None:
        rows["error of prior position"] = f"{metres_text(prior)} per axis (standard deviation)"
    if band_m is not None:
        rows["band along the route"] = f"{metres_text(band_m)} wide"
    return rows


def key_figures(result: CheckResult) -> list[tuple[str, str]]:
    """Values and what they are, of page and terminal."""
    conditions, flights, mean = result.conditions, result.flights, result.mean
    limit, between = conditions.limit_text, interval_text(mean, probability_text)
    chance = (probability_text(mean.median), f"mean probability of a fix per view {between}")
    if not conditions.states_level:
        few = f"at a risk of {conditions.risk:g} too few positions have a protection level"
        available = [("-", f"availability: {few}")]
    elif flights is None:
        level = after_fix_m(result.cells.error_m, conditions.risk)
        between = interval_text(level, metres_text)
        name = f"protection level right after a fix {between}; alert limit: {limit}"
        available = [(metres_text(level.median), name)]
    else:
        outage_s, outage_m = flights.outage_s, flights.outage_m
        between = interval_text(flights.availability, probability_text)
        far = range_text(outage_m, metres_text)
        name = f"longest outage {interval_text(outage_s, seconds_text)}, {far}"
        available = [
            (
                probability_text(flights.availability.median),
                f"availability {between} at the alert limit of {limit}",
            ),
            (seconds_text(outage_s.median), name),
        ]
    if flights is None:
        return [
            chance,
            *available,
            (metres_text(summarize(result)["error_m"]), "expected error of a correct fix"),
            (f"{result.area_km2:.3g} km²", "checked"),
            (str(int(result.cells.trials.sum())), "trial views"),
        ]
    error, wrong = flights.error_95_m, flights.false_fix
    largest = f"largest position error, 95 % {interval_text(error, metres_text)}"
    beyond = f"probability of a confident fix beyond {metres_text(conditions.radius_m)} on this "
    beyond += f"route {interval_text(wrong, percent_text)}"
    return [
        *available,
        (metres_text(error.median), largest),
        (percent_text(wrong.median), beyond),
        chance,
    ]


def text(result: CheckResult) -> str:
    """Verdict, reasons, key figures and outages; control characters in names are replaced."""
    lines = [f"{result.verdict.word.value.upper()}: {verdict_sentence(result)}"]
    for each in result.verdict.reasons:
        lines += _item(MARKS[each.word], each.text)
    rows = key_figures(result)
    width = max(len(value) for value, _ in rows)
    lines += ["", *(f"{value:>{width}}  {name}" for value, name in rows)]
    if not result.second_date:
        lines += ["", SIMULATED]
    if result.outages:
        worst = sorted(result.outages, key=lambda each: -each.length_m)[:7]
        numbered = enumerate(result.outages, start=1)
        rows_of_outages = [outage_row(number, each) for number, each in numbered if each in worst]
        lines += ["", "outages, the longest:", *aligned([OUTAGE_COLUMNS, *rows_of_outages])]
    return "\n".join("".join(c if c.isprintable() else "\ufffd" for c in line) for line in lines)


def _item(mark: str, sentence: str) -> list[str]:
    """A sentence as an item of a list; "%" stays with its number."""
    joined = sentence.replace(" %", "\N{NO-BREAK SPACE}%")
    wrapped = textwrap.wrap(
        joined, 100, initial_indent=f"  {mark:<4}", subsequent_indent=" " * len("  ok  ")
    )
    return [line.replace("\N{NO-BREAK SPACE}", " ") for line in wrapped]
