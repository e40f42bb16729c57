"""Standard figures, confidence criteria and calibration as JSON values, text, rows and figures."""

import math
from dataclasses import asdict

from orthonav.ground.evaluate import calibration_plots
from orthonav.ground.evaluate.calibration import (
    NEES_LEVELS,
    ConfidenceCalibration,
    CovarianceConsistency,
    nees_bound,
    nees_mean_bounds,
)
from orthonav.ground.evaluate.figures import or_none
from orthonav.ground.evaluate.metrics import CriterionRow, Metrics, wrong_key
from orthonav.ground.evaluate.standard import RPE_FRAMES, ErrorStatistics
from orthonav.ground.report.figures import Figure
from orthonav.ground.report.numbers import measure_text, percent_text, plain_text


def row_to_json(row: CriterionRow) -> dict[str, object]:
    """One threshold of a criterion as values for strict JSON."""
    return {
        "name": row.name,
        "threshold": row.threshold,
        "share_accepted": or_none(row.share_accepted),
        "accuracy": or_none(row.accuracy),
        "n_accepted": row.n_accepted,
        "n_right": row.n_right,
        "share_of_right_accepted": or_none(row.recall),
        f"n_{wrong_key(row.far_m)}": row.n_far,
        wrong_key(row.far_m): or_none(row.share_far),
    }


def calibration_to_json(calibration: ConfidenceCalibration) -> dict[str, object]:
    """`calibration` as values for strict JSON; undefined ones become None."""
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


def consistency_to_json(consistency: CovarianceConsistency) -> dict[str, object]:
    """`consistency` as values for strict JSON; undefined ones become None."""
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
    """Standard figures, confidence and covariance in lines for a terminal."""
    standard, of_confident = metrics.standard, metrics.of_confident
    low, high = map(percent_text, metrics.availability_95)
    frames = f"{RPE_FRAMES} frame{'s' * (RPE_FRAMES != 1)}"
    rows = [row for row in metrics.criteria if row.name == "confidence"]
    accepted = [f"  >= {row.threshold:g}: {_accepted(row, metrics.radius_m)}" for row in rows]
    return [
        f"availability: {percent_text(metrics.availability)} of views have a confident fix (95 % "
        f"interval {low} to {high}); longest gap {measure_text(metrics.gap.seconds_s, ' s')}, "
        f"{measure_text(metrics.gap.path_m, ' m')}",
        f"CEP50: {measure_text(of_confident.cep50_m, ' m')} of confident fixes, "
        f"{measure_text(standard.cep50_m, ' m')} of all",
        f"CEP95: {measure_text(of_confident.cep95_m, ' m')} of confident fixes, "
        f"{measure_text(standard.cep95_m, ' m')} of all",
        f"APE: {_statistics_text(standard.ape)}",
        f"RPE over {frames}: {_statistics_text(standard.rpe_frames)}",
        f"RPE over {standard.distance_m:g} m: {_statistics_text(standard.rpe_distance)}",
        f"confidence: {confidence_text(metrics)}",
        *(accepted if metrics.calibration.n_fixes else []),
        f"covariance: {covariance_text(metrics.consistency)}",
    ]


def _statistics_text(found: ErrorStatistics) -> str:
    if not found.n:
        return "not defined"
    return (
        f"RMSE {measure_text(found.rmse_m)}, mean {measure_text(found.mean_m)}, "
        f"median {measure_text(found.median_m)}, std {measure_text(found.std_m)}, "
        f"max {measure_text(found.max_m)} m ({found.n} values)"
    )


def standard_rows(
    metrics: Metrics,
) -> tuple[list[tuple[str, ...]], list[tuple[str, str]]]:
    """Rows of the table of standard figures, and definitions of those that are not in it."""
    rows = []
    for kind, standard in (("confident", metrics.of_confident), ("all", metrics.standard)):
        named = (
            ("APE", standard.ape),
            (f"RPE over {RPE_FRAMES} frame", standard.rpe_frames),
            (f"RPE over {standard.distance_m:g} m", standard.rpe_distance),
        )
        for name, found in named:
            values = (found.rmse_m, found.mean_m, found.median_m, found.std_m, found.max_m)
            rows.append((name, kind, *map(measure_text, values), str(found.n)))
    more = [
        ("ECE", plain_text(metrics.calibration.ece)),
        ("NEES (mean, 2 expected)", plain_text(metrics.consistency.nees_mean)),
        ("definitions", "APE and RPE as evo defines them: horizontal, not aligned, fixes only"),
    ]
    return rows, more


def calibration_figures(metrics: Metrics) -> tuple[Figure, Figure]:
    """Reliability diagram and covariance plot."""
    return (
        Figure(
            "reliability",
            f"Reliability diagram of confidence: {confidence_text(metrics)}",
            "Fraction of correct fixes over their confidence, with 95 % intervals (Wilson); "
            "dashed: ideal; orange: the difference. Below: fixes per bin.",
            calibration_plots.reliability_picture(metrics.calibration),
        ),
        Figure(
            "covariance",
            f"Errors of correct fixes against covariance: {covariance_text(metrics.consistency)}",
            "Errors of correct fixes in units of their covariance C; dashed: ideal; shaded: where "
            "95 % of samples of this size stay.",
            calibration_plots.nees_picture(metrics.consistency),
        ),
    )


def criteria_header(metrics: Metrics) -> tuple[str, ...]:
    """Column names of `criteria_rows`."""
    radius = f"{metrics.radius_m:g} m"
    far = f"{metrics.criteria[0].far_m:g} m" if metrics.criteria else ""
    return (
        "criterion",
        "at least",
        "accepted",
        "of all views",
        f"precision within {radius}",
        "recall",
        f"wrong by > {far}",
    )


def criteria_rows(metrics: Metrics, labels: dict[str, str]) -> list[tuple[str, ...]]:
    """What each threshold of each criterion accepts; `labels` are names to show."""
    return [
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


def confidence_text(metrics: Metrics) -> str:
    """A sentence that compares stated confidence with the share of right fixes."""
    calibration = metrics.calibration
    if not calibration.n_fixes:
        return "unknown, no fix states one"
    n_default = calibration.n_fixes - calibration.n_own_radius
    default = f" ({n_default} state no radius; {metrics.radius_m:g} m is used)" if n_default else ""
    stated = "1 fix states" if calibration.n_fixes == 1 else f"{calibration.n_fixes} fixes state"
    return (
        f"{stated} a mean confidence of {calibration.mean_confidence:.3f}; the fraction within the "
        f"stated radius is {calibration.share_right:.3f}{default}; "
        f"ECE {calibration.ece:.3f}, Brier score {calibration.brier:.3f}"
    )


def covariance_card(consistency: CovarianceConsistency) -> tuple[str, str, str]:
    """A word on the stated covariances, its explanation, and "bad" where they are too small."""
    if not consistency.nees.size:
        return "-", "covariance: no correct fix states one", ""
    found = nees_text(consistency.nees_mean, *nees_mean_bounds(consistency.nees.size))
    word, _, times = found.partition(": ")
    why = f"{times}; " if times else ""
    word = word if times else "right"
    label = f"covariance: {why}NEES {consistency.nees_mean:.3g}, 2 expected"
    return word, label, "bad" if found.startswith("too small") else ""


def covariance_verdict(consistency: CovarianceConsistency) -> str:
    """A sentence that answers whether the stated covariances can be used."""
    if not consistency.nees.size:
        return "Whether covariances are right is unknown: no correct fix states one."
    judged = nees_text(consistency.nees_mean, *nees_mean_bounds(consistency.nees.size))
    return f"Covariances are {judged}."


def covariance_text(consistency: CovarianceConsistency) -> str:
    """Consistency of the covariance in a sentence."""
    if not consistency.n_right:
        return "unknown, no fix is correct"
    counts = ((consistency.n_without, "without one"), (consistency.n_unusable, "unusable"))
    left_out = ", ".join(f"{count} {kind}" for count, kind in counts if count)
    if not consistency.nees.size:
        return f"unknown; of {consistency.n_right} correct fixes {left_out}"
    levels = " / ".join(f"{100 * level:g}" for level in NEES_LEVELS)
    found = " / ".join(f"{100 * consistency.within[level]:.1f}" for level in NEES_LEVELS)
    return (
        f"{nees_text(consistency.nees_mean, *nees_mean_bounds(consistency.nees.size))}; "
        f"NEES of {consistency.nees.size} correct fixes has mean {consistency.nees_mean:.3g} "
        f"(2 expected), median {consistency.nees_median:.3g} ({nees_bound(0.5):.2f} expected); "
        f"{found} % within the bounds of {levels} %" + (f"; {left_out}" if left_out else "")
    )


def nees_text(nees: float, low: float, high: float) -> str:
    """What a mean NEES says, given the 95 % interval of that of a consistent covariance."""
    times = f"errors are {math.sqrt(nees / 2):.1f} times as large as stated"
    if nees > high:
        return f"too small: {times}"
    return f"conservative: {times}" if nees < low else "consistent with the errors"


def _accepted(row: CriterionRow, radius_m: float) -> str:
    return (
        f"{percent_text(row.share_accepted)} of views accepted, precision within {radius_m:g} m "
        f"{percent_text(row.accuracy)}, recall {percent_text(row.recall)}; "
        f"{row.n_far} of {row.n_accepted} wrong by more than {row.far_m:g} m "
        f"({percent_text(row.share_far)})"
    )


def bins_rows(calibration: ConfidenceCalibration) -> list[tuple[str, ...]]:
    """Rows of the reliability diagram; empty where no fix states a confidence."""
    if not calibration.n_fixes:
        return []
    return [
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


def levels_rows(consistency: CovarianceConsistency) -> list[tuple[str, ...]]:
    """Rows of the bounds of chi-square; empty where no covariance is usable."""
    if not consistency.nees.size:
        return []
    return [
        (f"{100 * level:g} %", f"{nees_bound(level):.2f}", percent_text(level), percent_text(share))
        for level, share in consistency.within.items()
    ]
