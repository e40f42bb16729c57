"""Metrics of a track as text and as JSON values."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from orthonav.core.flight.fixes import STATES
from orthonav.ground.evaluate.calibration import nees_bound
from orthonav.ground.evaluate.calibration_report import nees_text
from orthonav.ground.evaluate.figures import FloatArray, or_none
from orthonav.ground.evaluate.gaps import Longest
from orthonav.ground.evaluate.metrics import radius_key
from orthonav.ground.evaluate.track import Spread, TrackConsistency, TrackMetrics, TrackSeries
from orthonav.ground.report.numbers import percent_text


def track_rows(track: TrackMetrics) -> tuple[tuple[str, str], ...]:
    """The metrics of a track as names and texts."""
    after, far = track.after, f"{track.far_m:g} m"
    within = ", ".join(f"{percent_text(s)} within {r:g} m" for r, s in after.acc_at_m.items())
    found = "never"
    if math.isfinite(track.first_view):
        found = (
            f"view {track.first_view:.0f} of {track.n_views}, {_s(track.first_s)} after the first"
        )
    return (
        ("first confirmed fix", found),
        (
            "errors from then on",
            f"median {_m(after.error_median_m)}, 95 % {_m(after.error_p95_m)}, "
            f"largest {_m(after.error_max_m)}; of {after.n_views} views {within}"
            if after.n_views
            else "unknown",
        ),
        ("states", _states_text(track)),
        (
            "longest without a confident fix",
            f"{longest_text(track.low_confidence)}; from the first confirmed fix on "
            f"{longest_text(track.low_confidence_after)}",
        ),
        (
            "false locks",
            f"{track.n_false_locks}, the longest {_s(track.false_lock_longest_s)}; "
            f"{track.n_confident_wrong} confident or tracking views wrong by more than {far} and "
            "their own radius",
        ),
        ("ahead of the ground truth", spread_text(track.along)),
        ("right of the ground truth", spread_text(track.across)),
        ("covariance", consistency_text(track.consistency)),
    )


def track_lines(track: TrackMetrics, name: str = "") -> list[str]:
    """The same for a terminal."""
    head = f"track of {' '.join(name.split())}:" if name else "track:"
    return [head, *(f"  {name}: {text}" for name, text in track_rows(track))]


def consistency_text(found: TrackConsistency) -> str:
    """Consistency of a track in a sentence."""
    if not found.n_views:
        return "unknown, no tracking view has a usable one and a true position"
    left_out = f"; {found.n_left_out} without a usable one" if found.n_left_out else ""
    return (
        f"{nees_text(found.nees_mean, found.effective_low, found.effective_high)}; "
        f"NEES of {found.n_views} tracking views has mean {found.nees_mean:.3g} "
        f"(2 expected; 95 % interval {found.effective_low:.2f} to {found.effective_high:.2f} for "
        f"{found.n_effective:.0f} effective views, as errors are correlated; for independent views "
        f"{found.independent_low:.2f} to {found.independent_high:.2f}); "
        f"{percent_text(found.nees_within_95)} below {nees_bound(0.95):.2f} (95 % expected)"
        f"{left_out}"
    )


def track_to_json(track: TrackMetrics) -> dict[str, object]:
    """`track` as values for strict JSON, units in the names; undefined ones become None.

    `over_time` has one value per compared view, rounded to milliseconds and millimetres.
    """
    values: dict[str, Any] = {}
    for name, value in vars(track).items():
        if isinstance(value, TrackSeries):
            names = ("seconds_s", "sigma_m", "bound_95_m", "along_m", "across_m")
            values["over_time"] = {each: _rounded(getattr(value, each)) for each in names}
        elif isinstance(value, Mapping):
            values[name] = {key: or_none(part) for key, part in value.items()}
        elif hasattr(value, "__dataclass_fields__"):
            values[name] = {key: _plain(part) for key, part in vars(value).items()}
        else:
            values[name] = _plain(value)
    values["first_view"] = int(track.first_view) if math.isfinite(track.first_view) else None
    after = values["after"]
    after |= {radius_key(r): or_none(s) for r, s in after.pop("acc_at_m").items()}
    return values


def tracks_to_json(tracks: Sequence[TrackMetrics]) -> dict[str, object]:
    """Sums, shares of views and maxima over several tracks.

    Medians, biases and consistency are given per flight only.
    """
    n_after = sum(track.after.n_views for track in tracks)
    known = [track.after for track in tracks if track.after.n_views]
    within = {
        radius_key(r): sum(a.acc_at_m[r] * a.n_views for a in known) / n_after if known else None
        for r in tracks[0].after.acc_at_m
    }
    n_views = sum(track.n_views for track in tracks)
    shares = {
        state: sum(t.share_of_views[state] * t.n_views for t in tracks) / n_views
        for state in tracks[0].share_of_views
    }
    return {
        "n_tracks": len(tracks),
        "n_found": sum(math.isfinite(track.first_view) for track in tracks),
        "n_views": n_views,
        "first_s_max": _most(track.first_s for track in tracks),
        "after": {
            "n_views": n_after,
            "error_max_m": _most(t.after.error_max_m for t in tracks),
            **within,
        },
        "share_of_views": shares,
        "n_lost": sum(track.n_lost for track in tracks),
        "low_confidence_seconds_s_max": _most(track.low_confidence.seconds_s for track in tracks),
        "low_confidence_path_m_max": _most(track.low_confidence.path_m for track in tracks),
        "n_confident_wrong": sum(track.n_confident_wrong for track in tracks),
        "n_false_locks": sum(track.n_false_locks for track in tracks),
        "false_lock_longest_s": _most(track.false_lock_longest_s for track in tracks),
    }


def _states_text(track: TrackMetrics) -> str:
    by_view = ", ".join(f"{name} {percent_text(track.share_of_views[name])}" for name in STATES)
    by_time = ", ".join(percent_text(track.share_of_time[name]) for name in STATES)
    lost = f"lost {track.n_lost} time{'s' * (track.n_lost != 1)}"
    return f"{by_view} of views; {by_time} of the time; {lost}"


def longest_text(longest: Longest) -> str:
    """Time and path of a stretch."""
    return f"{_s(longest.seconds_s)}, {_m(longest.path_m)}"


def spread_text(spread: Spread) -> str:
    """Bias and spread of signed errors in a sentence."""
    if not spread.n_views:
        return "unknown"
    return (
        f"mean {spread.mean_m:+.1f} m, standard deviation {spread.std_m:.1f} m, "
        f"RMSE {spread.rmse_m:.1f} m of {spread.n_views} tracking views"
    )


def _m(value: float) -> str:
    return f"{value:.1f} m" if math.isfinite(value) else "- m"


def _s(value: float) -> str:
    return f"{value:.1f} s" if math.isfinite(value) else "- s"


def _plain(value: Any) -> Any:
    """A value for strict JSON."""
    if isinstance(value, float):
        return or_none(value)
    return None if value == "" else value


def _rounded(values: FloatArray) -> list[float | None]:
    return [or_none(round(float(value), 3)) for value in values]


def _most(values: Iterable[float]) -> float | None:
    """The largest known value; None without any."""
    return max((value for value in values if math.isfinite(value)), default=None)
