"""A check as text for a terminal."""

import textwrap

from orthonav.check.outcome import CheckResult
from orthonav.check.write.summary import summarize
from orthonav.check.write.wording import (
    better_sentence,
    seconds_text,
    share_text,
    stretch_row,
    verdict_sentence,
)
from orthonav.records import CONFIDENT
from orthonav.report.numbers import metres_text

MAX_STRETCHES = 8
_MAX_REASONS = 5
_WIDTH = 100


def text(result: CheckResult) -> str:
    """Verdict, reasons, key figures and blind stretches, in about 25 lines at most.

    Control characters in names are replaced.
    """
    lines = [f"{result.verdict.word.value.upper()}: {verdict_sentence(result)}"]
    lines += _reasons(result)
    rows = _figures(result)
    width = max(len(name) for name, _ in rows)
    lines += ["", *(f"{name:<{width}}  {value}" for name, value in rows)]
    lines += _stretches(result)
    sentences = [better_sentence(result.alternatives, what) for what in ("agl_m", "band_m")]
    better = [sentence for sentence in sentences if sentence.startswith("A ")]
    lines += ["", *better] if better else []
    return "\n".join("".join(c if c.isprintable() else "\ufffd" for c in line) for line in lines)


def _reasons(result: CheckResult) -> list[str]:
    reasons = result.verdict.reasons
    lines = []
    for each in reasons[:_MAX_REASONS]:
        wrapped = textwrap.wrap(" ".join(each.text.split()), _WIDTH - 4, max_lines=2) or [""]
        lines += [f"  - {wrapped[0]}", *(f"    {rest}" for rest in wrapped[1:])]
    more = len(reasons) - _MAX_REASONS
    return [*lines, f"  - and {more} more"] if more > 0 else lines


def _figures(result: CheckResult) -> list[tuple[str, str]]:
    summary, conditions = summarize(result), result.conditions
    dates = "also of a second date" if result.second_date else "simulated ageing"
    rows = [
        ("map", result.about.map_name),
        ("area", f"{result.area_km2:.2f} km2, mean probability {share_text(result.mean)}"),
        ("views", f"{conditions.width_m:.0f} x {conditions.height_m:.0f} m on the ground, {dates}"),
    ]
    if result.along is not None:
        length = f"{metres_text(summary.route_m)}, {seconds_text(summary.route_s)}"
        share = f"{share_text(summary.confident_share)} of it at {CONFIDENT:g} or more"
        rows.append(("route", f"{length}; {share}"))
    rows.append(("error", f"{metres_text(summary.error_m)} expected for a correct fix"))
    if result.lookalikes:
        near = sum(each.within_prior for each in result.lookalikes)
        rows.append(("lookalikes", f"{len(result.lookalikes)} pairs, {near} within the prior"))
    return rows


def _stretches(result: CheckResult) -> list[str]:
    if result.along is None:
        return []
    if not result.stretches:
        return ["", "no blind stretches"]
    worst_first = sorted(result.stretches, key=lambda each: (each.recoverable, -each.length_m))
    worst = worst_first[:MAX_STRETCHES]
    rows: list[tuple[str, ...]] = [
        ("#", "from", "to", "length", "duration", "prob.", "drift", "allowed", "")
    ]
    for number, each in enumerate(result.stretches, start=1):
        if each in worst:
            rows.append(stretch_row(number, each))
    more = len(result.stretches) - len(worst)
    head = f"blind stretches ({len(result.stretches)})" + (f", the {len(worst)} worst" * (more > 0))
    return ["", head, *_columns(rows)]


def _columns(rows: list[tuple[str, ...]]) -> list[str]:
    """Aligned columns: right, the last one left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if i == len(row) - 1 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
