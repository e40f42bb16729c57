"""A check as text for a terminal."""

import textwrap

from orthonav.check.outcome import CheckResult, Stretch
from orthonav.check.write.said import (
    better_said,
    metres_text,
    outcome_text,
    place_text,
    seconds_text,
    share_text,
    verdict_said,
)
from orthonav.check.write.summary import summarize
from orthonav.records import CONFIDENT

MOST_STRETCHES = 8
_MOST_REASONS = 5
_WIDTH = 100


def text(result: CheckResult) -> str:
    """Verdict, reasons, a few figures and the blind stretches, in at most some 25 lines.

    Ends without a line break. Control characters of names are not passed on.
    """
    lines = [f"{result.verdict.word.value.upper()}: {verdict_said(result)}"]
    lines += _reasons(result)
    lines += ["", *_rows(_figures(result))]
    lines += _stretches(result)
    said = [better_said(result.alternatives, what) for what in ("agl_m", "band_m")]
    found = [sentence for sentence in said if sentence.startswith("A ")]
    lines += ["", *found] if found else []
    return "\n".join("".join(c if c.isprintable() else "\ufffd" for c in line) for line in lines)


def _reasons(result: CheckResult) -> list[str]:
    reasons = result.verdict.reasons
    lines = []
    for each in reasons[:_MOST_REASONS]:
        said = " ".join(each.text.split())
        wrapped = textwrap.wrap(said, _WIDTH - 4, max_lines=2) or [""]
        lines += [f"  - {wrapped[0]}", *(f"    {rest}" for rest in wrapped[1:])]
    more = len(reasons) - _MOST_REASONS
    return [*lines, f"  - and {more} more"] if more > 0 else lines


def _figures(result: CheckResult) -> list[tuple[str, str]]:
    summary, conditions = summarize(result), result.conditions
    own = "the map's own ground, changed as years change it"
    dates = "another date too" if result.second_date else own
    rows = [
        ("map", result.about.map_name),
        ("area", f"{result.area_km2:.2f} km2, probability {share_text(result.mean)} on average"),
        ("views", f"{conditions.width_m:.0f} x {conditions.height_m:.0f} m on the ground, {dates}"),
    ]
    if result.along is not None:
        rows += [
            (
                "route",
                f"{metres_text(summary.route_m)}, {seconds_text(summary.route_s)}; "
                f"{share_text(summary.confident_share)} of it at {CONFIDENT:g} or more",
            )
        ]
    rows.append(("error", f"{metres_text(summary.error_m)} expected of a correct fix"))
    if result.lookalikes:
        near = sum(each.within_prior for each in result.lookalikes)
        rows.append(("lookalikes", f"{len(result.lookalikes)} pairs, {near} within the prior"))
    return rows


def _stretches(result: CheckResult) -> list[str]:
    if result.along is None:
        return []
    if not result.stretches:
        return ["", "no blind stretch"]
    worst = sorted(result.stretches, key=_badness)[:MOST_STRETCHES]
    rows: list[tuple[str, ...]] = [
        ("#", "from", "to", "long", "lasts", "prob.", "drift", "allowed", "")
    ]
    for number, each in enumerate(result.stretches, start=1):
        if each in worst:
            rows.append(
                (
                    str(number),
                    *(place_text(each.start_m), place_text(each.end_m), metres_text(each.length_m)),
                    seconds_text(each.end_s - each.start_s),
                    share_text(each.probability),
                    metres_text(each.drift_m),
                    metres_text(each.allowed_m),
                    outcome_text(each),
                )
            )
    more = len(result.stretches) - len(worst)
    head = f"blind stretches ({len(result.stretches)})" + (f", the {len(worst)} worst" * (more > 0))
    return ["", head, *_columns(rows)]


def _badness(stretch: Stretch) -> tuple[bool, float]:
    """Worst first."""
    return stretch.bearable, -stretch.length_m


def _rows(rows: list[tuple[str, str]]) -> list[str]:
    width = max(len(name) for name, _ in rows)
    return [f"{name:<{width}}  {said}" for name, said in rows]


def _columns(rows: list[tuple[str, ...]]) -> list[str]:
    """Numbers to the right, the last column to the left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if i == len(row) - 1 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
