"""Words and sentences of page and terminal, and a check as text for a terminal."""

import textwrap
from collections.abc import Callable

from orthonav.ground.check.findings import probability_text
from orthonav.ground.check.records import CheckResult, Conditions, Outage, Range, Word, summarize
from orthonav.ground.report import aligned, metres_text, percent_text

SYMBOLS = {Word.GO: "✓", Word.MARGINAL: "!", Word.NO_GO: "✕"}
VERDICTS = {
    Word.GO: "This {} can be flown with this map.",
    Word.MARGINAL: "This {} does not meet all requirements for GO; see the reasons.",
    Word.NO_GO: "Do not rely on this map for this {}; see the reasons.",
}
OUTAGE_COLUMNS = (
    "no.",
    "from",
    "to",
    "length",
    "duration",
    "probability of a fix",
    "available",
)
SIMULATED = "Predicted from this map alone, with simulated ageing."


def verdict_sentence(result: CheckResult) -> str:
    sentence = VERDICTS[result.verdict.word].format("area" if result.along is None else "route")
    origin = f", {result.about.height}" if result.about.height else ""
    height = f"Checked at {result.conditions.agl_m:.0f} m above ground{origin}."
    return f"{sentence} {height}"


def seconds_text(value: float) -> str:
    """A time in seconds, from two minutes on as `M:SS min`, from an hour on as `H:MM h`."""
    whole = round(value)
    if abs(whole) < 120:
        return f"{whole} s"
    if abs(whole) < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole // 60 % 60:02d} h"


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
        "alert limit": f"{conditions.alert_limit_m:g} m ({given})",
        "risk": f"{conditions.risk:g} (probability of an error beyond the protection level)",
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
        "error of the reported tilt": f"{conditions.tilt_std_deg:g}° (standard deviation)",
        "sensor": (
            "of another kind than the map's (assumed)"
            if conditions.other_sensor
            else "like the map's, of another year"
        ),
        "confident fix": f"confidence of {conditions.accept:g} or more",
        "correct fix": f"error of at most {metres_text(conditions.radius_m)}",
        "ground speed": f"{conditions.speed_mps:g} m/s",
        "drift between fixes": f"{100 * conditions.drift:g} % of the distance flown",
    }
    if band_m is not None:
        rows["band along the route"] = f"{metres_text(band_m)} wide"
    return rows


def key_figures(result: CheckResult) -> list[tuple[str, str]]:
    """Values and what they are, of page and terminal."""
    flights, limit = result.flights, metres_text(result.conditions.alert_limit_m)
    median, between = probability_text(result.mean.median), _ends(result.mean, probability_text)
    mean = (median, f"mean probability of a fix per view ({between})")
    if flights is None:
        shown = [
            mean,
            (f"{result.area_km2:.3g} km²", "checked"),
            (metres_text(summarize(result)["error_m"]), "expected error of a correct fix"),
            (str(int(result.cells.trials.sum())), "trial views"),
        ]
    else:
        given = "" if result.conditions.limit_given else ", the default"
        available, outage_m, outage_s = flights.availability, flights.outage_m, flights.outage_s
        error, wrong = flights.error_95_m, flights.false_fix
        shown = [
            (
                probability_text(available.median),
                f"availability ({_ends(available, probability_text)}) at the alert limit of {limit}"
                f"{given}",
            ),
            (
                seconds_text(outage_s.median),
                f"longest outage ({_ends(outage_s, seconds_text)}), "
                f"{metres_text(outage_m.median)} ({_ends(outage_m, metres_text)})",
            ),
            (
                metres_text(error.median),
                f"largest position error, 95 % ({_ends(error, metres_text)})",
            ),
            (
                percent_text(wrong.median),
                f"probability of a false fix on this route ({_ends(wrong, percent_text)})",
            ),
            mean,
        ]
    return shown


def _ends(figure: Range, as_text: Callable[[float], str]) -> str:
    """Its 80 % interval."""
    return f"{as_text(figure.low)} to {as_text(figure.high)}"


def text(result: CheckResult) -> str:
    """Verdict, reasons, key figures and outages; control characters in names are replaced."""
    lines = [f"{result.verdict.word.value.upper()}: {verdict_sentence(result)}"]
    lines += [line for each in result.verdict.reasons for line in _item(each.text)]
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


def _item(sentence: str) -> list[str]:
    """A sentence as an item of a list; "%" stays with its number."""
    joined = sentence.replace(" %", "\N{NO-BREAK SPACE}%")
    wrapped = textwrap.wrap(joined, 100, initial_indent="  - ", subsequent_indent="    ")
    return [line.replace("\N{NO-BREAK SPACE}", " ") for line in wrapped]
