"""The places where a view may have been taken, as measurements of six numbers with their odds."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.core.localize.camera import CameraEstimate
from orthonav.core.localize.confidence import RegisteredConfidence, Scores, logit
from orthonav.core.localize.odometry import tilt_lever_m
from orthonav.core.localize.place import BestPlace, FinalPlace
from orthonav.core.localize.search import Found, Search
from orthonav.core.records import Telemetry

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SightingLimits:
    """Which places count."""

    min_log_odds: float = -12.0  # less likely places are left out
    min_probability: float = 1e-12  # of a place, and of none, for finite odds
    apart: float = 0.05  # of the side of a view: closer places are one
    examined_log_odds: float = 5.0
    """Places so much less likely than the best one are not examined for their tilt."""
    unseen_tilt_rad: float = math.radians(20.0)
    """Standard deviation of a tilt that a view does not show."""


LIMITS = SightingLimits()


@dataclass(frozen=True, eq=False)
class Sighting:
    """One place where a view may have been taken.

    `mean` (6,), `covariance` (6, 6): metres east and north, heading (rad), log scale, pitch, roll
    (rad). `log_odds`: of this place, given that the aircraft is on the map.
    `single_view_probability`: of it by the view."""

    mean: Array
    covariance: Array
    log_odds: float
    single_view_probability: float = 1.0


def sightings(
    found: Found, telemetry: Telemetry, log_scale: float, searched_share: float
) -> Iterator[Sighting]:
    """Of the best place and its rivals; the map has a confidence.

    `telemetry`: as searched, its height corrected by `log_scale`. `searched_share`: of the map."""
    search, best = found
    confidence = search.map.confidence
    assert confidence is not None
    near_px = LIMITS.apart * search.view.side_px
    places = places_of(best, confidence, near_px, searched_share)
    for log_odds, by_view, place in places:
        likely = log_odds > places[0][0] - LIMITS.examined_log_odds
        local_ratio = best.scores.local_ratio if place is best.place else 1.0
        camera = search.camera(place, local_ratio) if likely else None
        if camera is None:
            mean, covariance = _by_similarity(search, place, telemetry)
        else:
            mean, covariance = _by_camera(camera, telemetry)
        mean[3] += log_scale
        if np.isfinite(covariance).all():
            yield Sighting(mean, covariance, log_odds, by_view)


def places_of(
    best: BestPlace, confidence: RegisteredConfidence, near_px: float, searched_share: float
) -> list[tuple[float, float, FinalPlace]]:
    """Log odds, probability by the view alone, and place: the best, and rivals `near_px` apart.

    A search of a share of the map finds fewer rivals, and chance is lower: the log odds are those
    within the area times `searched_share`, or, if less, those of a whole search whose rivals are
    what chance makes (docs/tracking.md)."""
    share, chances = math.log(searched_share), confidence.chances
    out: list[tuple[float, float, FinalPlace]] = []
    for place in (best.place, *best.rivals):
        pose = place.camera_pose
        if any(pose.distance_px(other.camera_pose) < near_px for *_, other in out):
            continue
        scores = _as_rival(best, place) if out else best.scores
        by_chance = replace(
            scores,
            rival=max(scores.rival, chances.of_strength(scores)),
            mid_rival=max(scores.mid_rival, chances.mid),
            fine_rival=max(scores.fine_rival, chances.fine),  # NaN stays
        )
        by_view = confidence(by_chance)
        edge = LIMITS.min_probability
        log_odds = min(logit(confidence(scores), edge) + share, logit(by_view, edge))
        if out:  # the best place may have won in detail, against stronger total scores
            log_odds, by_view = min(log_odds, out[0][0]), min(by_view, out[0][1])
        if not out or log_odds > LIMITS.min_log_odds:
            out.append((log_odds, by_view, place))
    return out


def _as_rival(best: BestPlace, place: FinalPlace) -> Scores:
    """As if it were the best place, and the best one its rival."""
    mid_score = best.scores.mid_score
    return replace(
        best.scores,
        strength=place.score,
        rival=best.place.score,
        mid_score=mid_score * (place.score / max(best.place.score, 1e-6)),
        mid_rival=mid_score,
        fine=math.nan,
        fine_rival=math.nan,
    )


def _by_camera(camera: CameraEstimate, telemetry: Telemetry) -> tuple[Array, Array]:
    """Mean (6,) and covariance (6, 6) by the view alone."""
    rad, agl_m = math.pi / 180, camera.agl_m
    east, north, up_m = camera.image_only.position_m.tolist()
    heading, pitch, roll = np.radians(camera.image_only.attitude_deg).tolist()
    above_m = agl_m + up_m - float(camera.orientation.position_m[2])
    scale = math.log(max(above_m, agl_m / 2) / telemetry.agl_m)
    units = np.diag([1.0, 1.0, 1 / agl_m, rad, rad, rad])
    order = [0, 1, 3, 2, 4, 5]
    covariance = (units @ camera.image_only_covariance @ units)[np.ix_(order, order)]
    return np.array([east, north, heading, scale, pitch, roll]), covariance


def _by_similarity(search: Search, place: FinalPlace, telemetry: Telemetry) -> tuple[Array, Array]:
    """The same of a view that does not show its tilt."""
    over_ground, pose, spread = search.over_ground, place.camera_pose, place.fit.covariance
    if spread is None:
        spread = search.refiner.covariance_at(pose)
    tilt_rad = np.radians([telemetry.pitch_deg, telemetry.roll_deg])
    state = [*over_ground.camera_en_m(pose), pose.heading_rad, pose.log_scale]
    mean = np.array([*state, *tilt_rad])
    lever = tilt_lever_m(replace(telemetry, yaw_deg=math.degrees(pose.heading_rad)))
    covariance = np.zeros((6, 6))
    covariance[:4, :4] = over_ground.camera_covariance(pose, spread, search.floor_m)
    covariance[:2, :2] += LIMITS.unseen_tilt_rad**2 * lever @ lever.T
    covariance[:2, 4:] = -(LIMITS.unseen_tilt_rad**2) * lever
    covariance[4:, :2] = covariance[:2, 4:].T
    covariance[4:, 4:] = LIMITS.unseen_tilt_rad**2 * np.eye(2)
    return mean, covariance
