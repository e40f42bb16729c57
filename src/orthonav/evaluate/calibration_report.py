"""What fixes say about themselves, checked: as JSON values, as lines, as pieces of the page."""

from dataclasses import asdict

from orthonav.evaluate import calibration_plots
from orthonav.evaluate.calibration import NEES_LEVELS, Calibration, Consistency, nees_bound
from orthonav.evaluate.figures import or_none
from orthonav.evaluate.metrics import CriterionRow, Metrics, wrong_key
from orthonav.report.figures import Figure
from orthonav.report.numbers import percent_text, plain_text
from orthonav.report.page import html_table


def row_to_json(row: CriterionRow) -> dict[str, object]:
    """One threshold of a criterion as values for strict JSON."""
    return {
        "name": row.name,
        "threshold": row.threshold,
        "share_accepted": or_none(row.share_accepted),
        "accuracy": or_none(row.accuracy),
        "n_accepted": row.n_accepted,
        "n_right": row.n_right,
        "share_of_right_kept": or_none(row.recall),
        f"n_{wrong_key(row.far_m)}": row.n_far,
        wrong_key(row.far_m): or_none(row.share_far),
    }


def calibration_to_json(calibration: Calibration) -> dict[str, object]:
    """`calibration` as values for strict JSON; what is not defined becomes None."""
    bins = [
        {key: or_none(value) if isinstance(value, float) else value for key, value in one.items()}
        for one in (asdict(b) for b in calibration.bins)
    ]
    return {
        "n_fixes": calibration.n_fixes,
        "n_own_radius": calibration.n_own_radius,
        "ece": or_none(calibration.ece),
        "brier": or_none(calibration.brier),
        "mean_confidence": or_none(calibration.mean_confidence),
        "share_right": or_none(calibration.share_right),
        "bins": bins,
    }


def consistency_to_json(consistency: Consistency) -> dict[str, object]:
    """`consistency` as values for strict JSON; what is not defined becomes None."""
    return {
        "n_right": consistency.n_right,
        "n_nees": consistency.nees.size,
        "n_without_covariance": consistency.n_without,
        "n_unusable_covariance": consistency.n_unusable,
        "nees_mean": or_none(consistency.nees_mean),
        "nees_median": or_none(consistency.nees_median),
        **{
            f"nees_within_{100 * level:g}": or_none(share)
            for level, share in consistency.within.items()
        },
    }


def calibration_lines(metrics: Metrics) -> list[str]:
    """The same for a terminal: a line on confidence, one per threshold, one on covariance."""
    rows = [row for row in metrics.criteria if row.name == "confidence"]
    kept = [f"  >= {row.threshold:g}: {_kept(row, metrics.radius_m)}" for row in rows]
    if not metrics.calibration.n_fixes:
        kept = []
    return [
        f"confidence: {_confidence_said(metrics)}",
        *kept,
        f"covariance: {_covariance_said(metrics.consistency)}",
    ]


def calibration_figures(metrics: Metrics) -> tuple[Figure, Figure]:
    """Reliability diagram and covariance plot."""
    return (
        Figure(
            "reliability",
            f"Reliability diagram of confidence: {_confidence_said(metrics)}",
            "Share of right fixes over the confidence they state, with 95 % intervals (Wilson); "
            "dashed: as stated; orange: the gap. Below: fixes per bin.",
            calibration_plots.reliability_picture(metrics.calibration),
        ),
        Figure(
            "covariance",
            f"Errors of right fixes against covariance: {_covariance_said(metrics.consistency)}",
            "Errors of right fixes in units of their covariance C; dashed: as they should be; "
            "shaded: where 95 % of samples of this size stay.",
            calibration_plots.nees_picture(metrics.consistency),
        ),
    )


def calibration_html(metrics: Metrics) -> str:
    """The figures of both pictures as tables, and words where there are none."""
    calibration, consistency = metrics.calibration, metrics.consistency
    parts = [f'<p class="small">Confidence: {_confidence_said(metrics)}.</p>']
    if calibration.n_fixes:
        parts.append(_bins_table(calibration))
    parts.append(f'<p class="small">Covariance: {_covariance_said(consistency)}.</p>')
    if consistency.nees.size:
        parts.append(_levels_table(consistency))
    return "".join(parts)


def criteria_html(metrics: Metrics, labels: dict[str, str]) -> str:
    """What each threshold of each criterion keeps, as a table; `labels` are names to show."""
    radius = f"{metrics.radius_m:g} m"
    far = f"{metrics.criteria[0].far_m:g} m" if metrics.criteria else ""
    header = (
        "criterion",
        "at least",
        "kept",
        "of all views",
        f"of these within {radius}",
        f"of all within {radius} kept",
        f"of these wrong by > {far}",
    )
    rows = [
        (
            labels[row.name],
            f"{row.threshold:g}",
            str(row.n_accepted),
            percent_text(row.share_accepted),
            percent_text(row.accuracy),
            percent_text(row.recall),
            percent_text(row.share_far) + (f" ({row.n_far})" if row.n_accepted else ""),
        )
        for row in metrics.criteria
    ]
    return html_table(header, rows, label="confidence criteria")


def _confidence_said(metrics: Metrics) -> str:
    calibration = metrics.calibration
    if not calibration.n_fixes:
        return "not known, no fix states one"
    n_held = calibration.n_fixes - calibration.n_own_radius
    held = f" ({n_held} state no radius and are held to {metrics.radius_m:g} m)" if n_held else ""
    return (
        f"{calibration.n_fixes} fixes state {calibration.mean_confidence:.3f} on average, and "
        f"{calibration.share_right:.3f} of them err by no more than the radius they state{held}; "
        f"ECE {calibration.ece:.3f}, Brier score {calibration.brier:.3f}"
    )


def _covariance_said(consistency: Consistency) -> str:
    if not consistency.n_right:
        return "not known, no fix is right"
    counts = ((consistency.n_without, "state none"), (consistency.n_unusable, "one of no use"))
    left_out = ", ".join(f"{count} {said}" for count, said in counts if count)
    if not consistency.nees.size:
        return f"not known, of {consistency.n_right} right fixes {left_out}"
    levels = " / ".join(f"{100 * level:g}" for level in NEES_LEVELS)
    found = " / ".join(f"{100 * consistency.within[level]:.1f}" for level in NEES_LEVELS)
    return (
        f"NEES of {consistency.nees.size} right fixes has mean {consistency.nees_mean:.3g} "
        f"(2 expected), median {consistency.nees_median:.3g} ({nees_bound(0.5):.2f} expected); "
        f"{found} % within the bounds of {levels} %" + (f"; {left_out}" if left_out else "")
    )


def _kept(row: CriterionRow, radius_m: float) -> str:
    return (
        f"{percent_text(row.share_accepted)} of views kept, {percent_text(row.accuracy)} of them "
        f"within {radius_m:g} m ({percent_text(row.recall)} of all that are); "
        f"{row.n_far} of {row.n_accepted} wrong by more than {row.far_m:g} m "
        f"({percent_text(row.share_far)})"
    )


def _bins_table(calibration: Calibration) -> str:
    header = ("confidence", "fixes", "mean", "share right", "95 % from", "to")
    rows = [
        (
            f"{b.lower:g} to {b.upper:g}",
            str(b.n_fixes),
            plain_text(b.mean_confidence),
            plain_text(b.share_right),
            plain_text(b.right_low),
            plain_text(b.right_high),
        )
        for b in calibration.bins
    ]
    return html_table(header, rows, label="confidence against shares of right fixes")


def _levels_table(consistency: Consistency) -> str:
    header = ("bound of chi-square, 2 degrees of freedom", "eᵀC⁻¹e below", "expected", "found")
    rows = [
        (f"{100 * level:g} %", f"{nees_bound(level):.2f}", percent_text(level), percent_text(share))
        for level, share in consistency.within.items()
    ]
    return html_table(header, rows, label="covariance against errors")
