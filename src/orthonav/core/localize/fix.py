"""The fix of a place: position, attitude and height with covariance, and the confidence."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.localize.camera import CameraEstimate, tilt_std_deg
from orthonav.core.localize.place import FinalPlace
from orthonav.core.localize.search import Found, Search
from orthonav.core.localize.view import PreparedView, off_nadir_deg
from orthonav.core.records import (
    RADIUS_SHARE,
    UNKNOWN_BIAS,
    Fix,
    TelemetryBias,
    probability_within,
)


def fix_of(found: Found) -> Fix:
    """From the camera that the picture shows, else from the place alone."""
    search, best = found
    map_, ground, pose = search.map, search.over_ground, best.place.window_pose
    camera = search.camera(best.place, best.scores.local_ratio)
    orientation, middle_en_m = ground.orientation(pose), None
    if camera is not None:
        exterior = _by_camera(search.view, camera)
        middle_en_m = camera.middle_en_m
    else:
        exterior = _by_similarity(search, best.place)
        if orientation is not None:
            middle_en_m = ground.middle_en_m(ground.sight_en_m(orientation), pose)
    place = math.nan if map_.confidence is None else map_.confidence(best.scores)
    radius_m = max(map_.radius_m, RADIUS_SHARE * exterior.agl_m)
    evidence = _evidence(found)
    if exterior.middle_cov_en_m2 is not None:
        widest = float(np.linalg.eigvalsh(exterior.middle_cov_en_m2)[-1])
        evidence["middle_std_m"] = math.sqrt(widest)
    if orientation is not None and not map_.ground.is_flat:
        evidence["terrain_gain"] = best.place.gain or 1.0
    lat, lon = map_.sheet.frame.latlon_from_en(exterior.place_en_m)
    middle = None
    if middle_en_m is not None:
        middle_deg = map_.sheet.frame.latlon_from_en(np.array(middle_en_m))
        middle = float(middle_deg[0]), float(middle_deg[1])
    for each in (exterior.cov_en_m2, exterior.middle_cov_en_m2, exterior.pose_cov):
        if each is not None:
            each.flags.writeable = False
    heading_deg, pitch_deg, roll_deg = exterior.attitude_deg
    return Fix(
        lat_deg=float(lat),
        lon_deg=float(lon),
        cov_en_m2=exterior.cov_en_m2,
        confidence=probability_within(place, exterior.cov_en_m2, radius_m),
        radius_m=radius_m,
        heading_deg=heading_deg % 360,
        agl_m=exterior.agl_m,
        evidence=evidence,
        ground_latlon_deg=middle,
        ground_cov_en_m2=None if middle is None else exterior.middle_cov_en_m2,
        pitch_deg=pitch_deg,
        roll_deg=roll_deg,
        pose_cov=exterior.pose_cov,
        place_probability=place,
        bias=exterior.bias,
        heading_std_deg=exterior.heading_std_deg,
        log_scale_std=exterior.log_scale_std,
    )


def _evidence(found: Found) -> dict[str, float]:
    """By the keys of `fixes.jsonl` (docs/reference/formats.md)."""
    fit = found.best.place.fit
    gradient, grey = fit.correlations
    return {
        "score": fit.weighted,
        **found.best.scores.evidence(),
        "gradient_correlation": gradient,
        "grey_correlation": grey,
        "blocks_t": fit.blocks_t,
        "agreement": fit.agreement,
        "overlap": fit.overlap,
        "candidates": float(found.search.candidates),
    }


def _by_camera(view: PreparedView, camera: CameraEstimate) -> "_Exterior":
    """From the blocks of the view."""
    heading_deg, pitch_deg, roll_deg = camera.orientation.attitude_deg.tolist()
    _, _, up_m, heading, pitch, roll = np.sqrt(np.diag(camera.covariance)).tolist()
    return _Exterior(
        camera.orientation.position_m[:2],
        (heading_deg, pitch_deg, roll_deg),
        camera.agl_m,
        camera.covariance[:2, :2].copy(),
        camera.middle_covariance,
        heading,
        up_m / camera.agl_m,
        camera.covariance,
        TelemetryBias(
            pitch_bias_deg=pitch_deg - view.telemetry.pitch_deg,
            roll_bias_deg=roll_deg - view.telemetry.roll_deg,
            pitch_bias_std_deg=pitch,
            roll_bias_std_deg=roll,
        ),
    )


def _by_similarity(search: Search, place: FinalPlace) -> "_Exterior":
    """Under the reported pitch and roll."""
    pose, covariance, telemetry = place.camera_pose, place.fit.covariance, search.view.telemetry
    assert covariance is not None
    spread = search.over_ground.camera_covariance(pose, covariance, search.floor_m)
    agl_m = telemetry.agl_m * math.exp(pose.log_scale)
    # A line of sight off nadir meets the ground farther out by 1 / cos^2.
    cos = math.cos(math.radians(off_nadir_deg(telemetry)))
    tilt_m = agl_m * math.radians(tilt_std_deg(telemetry)) / cos**2
    floor_m2 = np.eye(2) * search.floor_m**2
    return _Exterior(
        search.over_ground.camera_en_m(pose),
        (math.degrees(pose.heading_rad), telemetry.pitch_deg, telemetry.roll_deg),
        agl_m,
        spread[:2, :2] + np.eye(2) * tilt_m**2,
        covariance[:2, :2] * search.map.grid.gsd_m**2 + floor_m2,
        math.degrees(math.sqrt(spread[2, 2])),
        math.sqrt(spread[3, 3]),
    )


@dataclass(frozen=True, eq=False)
class _Exterior:
    """What a fix says of the camera."""

    place_en_m: NDArray[np.float64]
    attitude_deg: tuple[float, float, float]
    agl_m: float
    cov_en_m2: NDArray[np.float64]
    middle_cov_en_m2: NDArray[np.float64] | None
    heading_std_deg: float
    log_scale_std: float
    pose_cov: NDArray[np.float64] | None = None
    bias: TelemetryBias = UNKNOWN_BIAS
