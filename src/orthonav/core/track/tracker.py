"""From the views of a flight to one track: registration measures, the mixture decides.

Every view is registered around the predicted position, or anywhere while that is unknown; all
plausible places go to the mixture with their odds. Overlapping views are registered on each other.
"""

import logging
import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MapFileError
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.ground import Ground
from orthonav.core.localize.localizer import HALF_EARTH_M, Localizer
from orthonav.core.localize.odometry import (
    CameraDisplacement,
    OdometryView,
    Terrain,
    ViewDisplacement,
    corrected_by,
    displacement,
    over_terrain,
)
from orthonav.core.localize.search import Found, Search
from orthonav.core.localize.sighting import Sighting, sightings
from orthonav.core.localize.view import check_view
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.records import (
    MAX_STD,
    PRIOR_SIGMAS,
    RADIUS_SHARE,
    Fix,
    NoFix,
    Prior,
    Telemetry,
    TelemetryBias,
    View,
    probability_within,
)
from orthonav.core.register.window import rotation
from orthonav.core.track.filter import (
    BIASES,
    HEADING,
    HORIZON,
    LEAST_NEW,
    OBSERVES,
    POSITION,
    SCALE,
    TILT,
    VELOCITY,
    WHITE_SHARE,
    Array,
    Model,
    Motion,
    ReportedAttitude,
    ReportedVelocity,
    observed,
    usual_velocity_std_mps,
)
from orthonav.core.track.hypothesis import EXACT_M, State
from orthonav.core.track.mixture import Estimate, Mixture
from orthonav.core.track.smooth import History, Smoothed

LOCAL_SHARE = 0.75  # Belief to search around it only. Values without a source: docs/tracking.md.
LOCAL_SIGMAS = 4.0  # half width of that search,
MIN_LOCAL_M = LOCAL_SIGMAS * EXACT_M  # and its least
LEAST_TILT_STD_DEG = 0.1  # least that a track expects of a view
UNAIDED_STD_MPS, UNAIDED_S = 3.0, 15.0
"""A reported velocity with at least this deviation errs for so long: an autopilot without aids."""
LEARNT_S = 10.0  # over which the error of a reported velocity is learnt from odometry
LONGEST_GAP_S = 600.0
"""As which longer gaps are predicted: the position is then known to no more than the map."""
UNKNOWN_STEP_S = 1.0  # where the clock stands still or jumps back
KNOWN_MPS = 5.0  # least certainty of an estimated velocity that predicts the next displacement
KNOWN_PLACE_M = 50.0  # least certainty of a position whose ground is known
log = logging.getLogger(__name__)


class SearchArea(NamedTuple):
    """`circle`: middle (2,) and radius in metres, None: all; `confirms`: places found there do."""

    circle: tuple[Array, float] | None
    confirms: bool

    @property
    def area_m2(self) -> float:
        return math.inf if self.circle is None else math.pi * self.circle[1] ** 2


WHOLE_MAP = SearchArea(None, True)


class _Past(NamedTuple):
    """What a prediction needs of the view before. `velocity` (2,): as reported, and the variance of
    its error, learnt over `learnt_s`."""

    time_ns: int
    view: OdometryView | None
    velocity: Array | None = None
    velocity_variance: float = 0.0
    learnt_s: float = 0.0


class _Step(NamedTuple):
    """From the view before to this one. `motion`: None at the first view. `overlap` of both;
    `ground`: share that the one before cannot have shown, 0..1."""

    here: _Past
    motion: Motion | None = None
    overlap: float = 0.0
    ground: float = 1.0


class Tracker:
    """Follows one flight over one map. Mutable; not to be shared between threads."""

    def __init__(
        self,
        localizer: Localizer | MapFile,
        *,
        model: Model | None = None,
        heading_known: bool = True,
        use_prior: bool = True,
        every_prior: bool = False,
        smooth: bool = False,
        area_m2: float = 0.0,
    ) -> None:
        """`localizer`: or an opened map. `model`: None: the usual one, with a mount as good as the
        height asks for. `area_m2`: where the aircraft may be, if that is more than the map.

        With `use_prior` the track starts at the first view's prior; with `every_prior` all priors
        are position measurements, such as GNSS. `smooth` records the history for `smoothed_track`.

        Raises `MapFileError` where the map has no registration layer or no confidence."""
        if not isinstance(localizer, Localizer):
            localizer = Localizer(localizer)
        self._heading_known = heading_known
        self._usual_model = self._usual_scale = model is None
        self.mixture = Mixture(model or Model(), self._use(localizer), area_m2)
        self._usual_horizon_rad = self.model.horizon_rad
        self._past: _Past | None = None
        self._predicted_ns: int | None = None  # a view predicted, but without an outcome so far
        self._sightings: list[Sighting] = []
        self._whole_map = False
        self._use_prior, self._every_prior = use_prior, every_prior
        self._history = History() if smooth else None
        self._outcomes: list[tuple[Fix | NoFix, Telemetry]] = []
        self.state = State.SEARCHING

    @property
    def model(self) -> Model:
        return self.mixture.model

    def _use(self, localizer: Localizer) -> tuple[float, float, float, float]:
        """Extent (west, south, east, north) in metres."""
        registration = localizer.registration
        if registration is None or registration.confidence is None:
            raise MapFileError("a track needs a map with a registration layer and its confidence")
        self._registration = registration
        self._localizer = localizer
        return localizer.grid.extent_en_m

    def continue_on(self, localizer: Localizer) -> None:
        """Continue the track between two views on another map, which shows the aircraft too.

        Not with `smooth`, whose history is in the plane of one map. Raises as the constructor."""
        frame = self._localizer.sheet.frame
        self.mixture.move(frame, localizer.sheet.frame, self._use(localizer))

    def locate(self, view: View) -> Fix | NoFix:
        """The position of the aircraft, by this view and all before it.

        A view that shows nothing is bridged by dead reckoning. Raises `CameraError` if the camera
        has another size than the picture."""
        refused = check_view(view, self._localizer.grid.gsd_m, self._heading_known)
        if self._usual_scale:
            self._usual_scale = False
            scale = math.hypot(Model.log_scale, view.camera.focal_std)
            self.mixture.model = replace(self.model, log_scale=scale)
        if refused is not None:
            return self.passed(view.telemetry, refused)
        step = self._predict(view, view.telemetry)
        self._sightings = []
        outcome = self._outcome(view.telemetry, self._update(view, step))
        self._predicted_ns = None
        return outcome

    def update(
        self,
        image: NDArray[Any] | None,
        camera: Camera,
        *,
        time_s: float,
        agl_m: float,
        heading_deg: float | None = None,
        pitch_deg: float = 0.0,
        roll_deg: float = 0.0,
        prior: Prior | None = None,
        heading_std_deg: float | None = None,
        agl_std_m: float | None = None,
        tilt_std_deg: float | None = None,
        vel_en_mps: tuple[float, float] | None = None,
    ) -> Fix | NoFix:
        """The position of the aircraft by this image and all before it; arguments as of `View.of`.

        `time_s`: seconds, greater than that of the image before by at most 600: other steps count
        as 1 s or 600 s, with a warning. `heading_deg` may be None in a tracker made with
        `heading_known=False`. Standard deviations are those from view to view, without constant
        errors, which are estimated; None: `heading_std_deg` 2 deg, `agl_std_m` 2 % of the height,
        `tilt_std_deg` 2 deg. Raises as `View.of`."""
        view = View.of(
            image,
            camera,
            time_s=time_s,
            agl_m=agl_m,
            heading_deg=heading_deg,
            pitch_deg=pitch_deg,
            roll_deg=roll_deg,
            prior=prior,
            heading_std_deg=heading_std_deg,
            agl_std_m=agl_std_m,
            tilt_std_deg=tilt_std_deg,
            vel_en_mps=vel_en_mps,
        )
        if self._past is not None:
            step_s = (view.telemetry.time_ns - self._past.time_ns) / 1e9
            if not 0 < step_s <= LONGEST_GAP_S:
                log.warning(
                    "time_s changed by %+g s since the image before: it is in seconds, not ms or "
                    "ns, and grows; the position is known to little more than the map now",
                    step_s,
                )
        return self.locate(view)

    def __repr__(self) -> str:
        return f"Tracker({self._localizer.opened.path}, {self.state.value})"

    @property
    def state_name(self) -> str:
        """The state as it stands in `fixes.jsonl`."""
        return self.state.value

    def passed(self, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
        """The position by dead reckoning, at a view whose picture cannot be used for `reason`, as
        where `locate` raised an error."""
        self._sightings = []
        self.mixture.unrecognize()  # an error may have come after the places were found
        if telemetry.time_ns != self._predicted_ns:  # else the error came after the prediction
            self._predict(None, telemetry)
        self._predicted_ns = None
        return self._outcome(telemetry, reason)

    def smoothed_track(self) -> list[Fix | NoFix]:
        """Positions at all views so far, each estimated from the views after it too."""
        if self._history is None:
            raise ValueError("smoothing needs a tracker made with smooth=True")
        smoothed = self._history.smoothed()
        return [self._smoothed_fix(*pair) for pair in zip(smoothed, self._outcomes, strict=True)]

    @property
    def recorded_ns(self) -> list[int]:
        """Times of the views of `smoothed_track`: those at which no error was raised."""
        return [telemetry.time_ns for _, telemetry in self._outcomes]

    def _smoothed_fix(
        self, smoothed: Smoothed | None, filtered: tuple[Fix | NoFix, Telemetry]
    ) -> Fix | NoFix:
        """The filtered one where smoothing makes it less certain, as where the most likely track
        passes over a view far from its neighbours."""
        before, telemetry = filtered
        if smoothed is None:
            return NoFix("searching", "no position was found")
        spread = float(np.trace(smoothed.covariance[:2, :2]))
        if isinstance(before, Fix) and spread > float(np.trace(before.cov_en_m2)):
            return before
        place = min(smoothed.belief, 1.0)
        return self._fix(smoothed.mean, smoothed.covariance, place, telemetry, {})

    def _radius_m(self, telemetry: Telemetry) -> float:
        high = RADIUS_SHARE * telemetry.agl_m
        least = self._registration.radius_m
        return max(least, high) if math.isfinite(high) else least

    def _outcome(self, telemetry: Telemetry, refused: NoFix | None) -> Fix | NoFix:
        estimate = self.mixture.conclude(self._radius_m(telemetry))
        self.state = State.SEARCHING if estimate is None else estimate.state
        outcome: Fix | NoFix = refused or NoFix("searching", "no position has been found yet")
        if estimate is not None:
            more = {
                "hypotheses": float(len(self.mixture.hypotheses)),
                "elsewhere": self.mixture.elsewhere,
            }
            mean, covariance = estimate.mean, estimate.covariance
            place = estimate.place_probability
            fix = self._fix(mean, covariance, place, telemetry, more)
            outcome = replace(fix, recognized=estimate.shown.now)
            if not self._heading_known:
                outcome = replace(outcome, heading_deg=self._registered_heading_deg(outcome, mean))
        if self._history is not None:  # once, also where an error makes `passed` begin again
            self._history.record(self.mixture, len(self._outcomes))
            self._outcomes.append((outcome, telemetry))
        return outcome

    def _registered_heading_deg(self, fix: Fix, mean: Array) -> float:
        """NaN where the view was not registered at the fix."""
        off_m, turn_rad = min(
            ((math.dist(each.mean[:2], mean[:2]), each.mean[2]) for each in self._sightings),
            default=(math.inf, math.nan),
        )
        return math.degrees(turn_rad) % 360 if off_m <= fix.radius_m else math.nan

    def _predict(self, view: View | None, telemetry: Telemetry) -> _Step:
        """Time and picture change with the mixture: an error before leaves all as they were."""
        if self._usual_model and math.isfinite(telemetry.agl_m):
            self._usual_model = view is None  # as on the ground
            self.mixture.model = self.model.at_height(telemetry.agl_m)
        tilt = telemetry.horizon_std_deg
        horizon = self._usual_horizon_rad if tilt is None else math.radians(tilt)
        self.mixture.model = replace(self.model, horizon_rad=horizon)
        step, prior = self._step(view, telemetry), telemetry.prior
        if step.motion is not None:
            self.mixture.predict(*step.motion)
        elif prior is not None and (self._use_prior or self._every_prior):
            self.mixture.start(*self._position_of(prior))
        # No call comes between: it could raise an error.
        self._past, self._predicted_ns = step.here, telemetry.time_ns
        if step.motion is not None and prior is not None and self._every_prior:
            self.mixture.measure_position(*self._position_of(prior))
        return step

    def _step(self, view: View | None, telemetry: Telemetry) -> _Step:
        """Changes nothing. `view`: None where its picture is not used."""
        past, now = self._past, None
        before = None if past is None else past.view
        if view is not None and self._heading_known:
            bias, _ = self.mixture.bias()
            before = None if before is None else before.corrected(bias)
            now = self._odometry_view(view, before, bias)
        if past is None:
            return _Step(_Past(telemetry.time_ns, now))
        seconds = (telemetry.time_ns - past.time_ns) / 1e9
        if not 0 < seconds < LONGEST_GAP_S:
            seconds = UNKNOWN_STEP_S if seconds <= 0 else LONGEST_GAP_S
        noise = self._telemetry_noise(telemetry)
        velocity = _reported_velocity(past, telemetry)
        expected = self._expected_displacement(seconds, velocity)
        moved = self._displacement(before, now, noise, expected)
        camera = None if moved is None else moved.displacement
        here = past._replace(time_ns=telemetry.time_ns, view=now, velocity=None)
        if velocity is not None:
            here = here._replace(velocity=velocity.now_en_mps)
            if camera is not None and seconds <= LEARNT_S:
                here = self._with_learnt(here, velocity, camera, seconds)
        # Clouds do not fit each other, but show no new ground either.
        if moved is not None:
            ground = 1 - moved.overlap
        else:
            ground = 1.0 if view is None else self._ground_by_speed(view, seconds, expected)
        # An image that is not used makes no error independent.
        overlap = 1.0 if view is None else 1 - ground
        motion = Motion(seconds, velocity, camera, noise, overlap)
        return _Step(here, motion, 0.0 if moved is None else moved.overlap, ground)

    def _ground_by_speed(self, view: View, seconds: float, expected: Array | None) -> float:
        """By the expected displacement or the largest usual speed."""
        moved_m = self.model.speed_mps * seconds
        if expected is not None:
            moved_m = float(np.hypot(*expected))
        side_m = view.telemetry.agl_m * min(view.camera.extent)
        return min(moved_m / side_m, 1.0) if side_m > 0 else 1.0

    def _position_of(self, prior: Prior) -> tuple[Array, float]:
        frame = self._localizer.sheet.frame
        std_m = min(max(prior.std_m, 1.0), HALF_EARTH_M)
        return frame.en_from_latlon(prior.lat_deg, prior.lon_deg), std_m

    def _telemetry_noise(self, telemetry: Telemetry) -> Array:
        """Variances (3,) of heading (rad) and log scale between views and of the horizon (rad)."""
        noise = self.model.telemetry_noise.copy()
        if telemetry.yaw_std_deg is not None:
            noise[0] = math.radians(telemetry.yaw_std_deg) ** 2
        if telemetry.agl_std_m is not None and telemetry.agl_m > 0:
            noise[1] = (telemetry.agl_std_m / telemetry.agl_m) ** 2
        return noise

    def _odometry_view(
        self, view: View, before: OdometryView | None, bias: Array
    ) -> OdometryView | None:
        """In pixels of the one before unless they differ too much."""
        if before is not None:
            made = OdometryView.of(view, before.pixel_m, bias)
            if made is None or math.prod(made.shape) < 4 * math.prod(before.shape):
                return made
        return OdometryView.of(view, None, bias)

    def _with_learnt(
        self, here: _Past, velocity: ReportedVelocity, moved: CameraDisplacement, seconds: float
    ) -> _Past:
        """The variance less that of odometry itself: a horizon that changes looks like motion."""
        bias, _ = self.mixture.bias()
        off = (
            rotation(-bias[0], math.exp(bias[1])) @ moved.moved_en_m - velocity.now_en_mps * seconds
        )
        model = self.model
        changed = 2 * model.horizon_rad**2 * (1 - math.exp(-seconds / model.horizon_s))
        own = float(np.trace(moved.covariance)) + changed * float(np.sum(moved.levers_m[0] ** 2))
        shown = (float(off @ off) - own) / (2 * seconds**2)
        learnt_s, before = here.learnt_s + seconds, here.velocity_variance
        share = max(1 - math.exp(-seconds / LEARNT_S), seconds / learnt_s)
        return here._replace(velocity_variance=before + share * (shown - before), learnt_s=learnt_s)

    def _expected_displacement(
        self, seconds: float, velocity: ReportedVelocity | None
    ) -> Array | None:
        """(2,) by the reported or estimated velocity; None without one."""
        if velocity is not None:
            return velocity.now_en_mps * seconds
        best = self.mixture.likeliest
        if best is None or np.trace(best.covariance[VELOCITY, VELOCITY]) > KNOWN_MPS**2:
            return None
        return best.mean[VELOCITY] * seconds

    def _displacement(
        self,
        before: OdometryView | None,
        now: OdometryView | None,
        telemetry_noise: Array,
        expected_en_m: Array | None,
    ) -> ViewDisplacement | None:
        """None where it cannot be measured."""
        if before is None or now is None or before.pixel_m != now.pixel_m:
            return None
        white = WHITE_SHARE * math.sqrt(telemetry_noise[2])
        made = displacement(before, now, white, telemetry_noise, expected_en_m)
        if made is None or self._registration.ground.is_flat:
            return made
        heights_m = before.view.telemetry.agl_m, now.view.telemetry.agl_m
        ahead_en_m = (before.ahead_en_m + now.ahead_en_m) / 2
        # What both views show lies half a displacement ahead of what the earlier one shows.
        common_en_m = ahead_en_m + made.displacement.moved_en_m / 2
        terrain = self._terrain(heights_m[0], common_en_m)
        return over_terrain(made, heights_m, terrain, ahead_en_m)

    def _terrain(self, agl_m: float, ahead_en_m: Array) -> Terrain | None:
        """None where unknown. `ahead_en_m` (2,): as reported, on level ground."""
        best = self.mixture.likeliest
        if best is None or np.trace(best.covariance[POSITION, POSITION]) > KNOWN_PLACE_M**2:
            return None
        scale = math.exp(best.mean[SCALE])
        ahead_m = rotation(-best.mean[HEADING], scale) @ ahead_en_m
        relief = self._registration.ground
        return Terrain.ahead(relief, best.mean[POSITION], agl_m * scale, ahead_m)

    def _update(self, view: View, step: _Step) -> NoFix | None:
        """`NoFix` where the view shows too little."""
        telemetry = view.telemetry
        expected = self.mixture.estimate(self._radius_m(telemetry))
        if expected is not None and expected.shown.followed and self._must_compete(expected):
            self._whole_map = not self._whole_map  # the whole map and the surroundings by turns
        searched = self._search_area(expected, whole_map=self._whole_map)
        prior = self._prior(searched)
        bias, spread = self._correction(telemetry, expected, prior)
        known = _known(corrected_by(telemetry, bias), spread)
        if prior is not None and expected is not None and telemetry.below is not None:
            known = self._above_expected(known, expected.mean[:2])
        corrected = replace(
            view,
            camera=replace(view.camera, focal_std=0.0),  # part of the spread of the scale
            telemetry=known,
        )
        search = Search.of(self._registration, corrected, prior, self._heading_known)
        if isinstance(search, NoFix):
            return search
        newness = max(1 - step.overlap, LEAST_NEW)
        found = search.run()
        if isinstance(found, Found):
            share = min(searched.area_m2, self.mixture.map_m2) / self.mixture.area_m2
            self._sightings = list(sightings(found, known, bias[1], share))
        attitude = ReportedAttitude(
            math.radians(telemetry.yaw_deg) if self._heading_known else None,
            math.radians(telemetry.pitch_deg),
            math.radians(telemetry.roll_deg),
        )
        found_at, ground = self._sightings, step.ground
        self.mixture.update(
            attitude, found_at, newness, searched.circle, ground, confirms=searched.confirms
        )
        return None

    def _above_expected(self, telemetry: Telemetry, place_en_m: Array) -> Telemetry:
        """The correction includes the error of the ground assumed before."""
        relief = self._registration.ground
        height_m = float(relief.terrain.at_en_m(place_en_m))
        if relief.is_flat or not math.isfinite(height_m):
            return replace(telemetry, below=None)
        return replace(telemetry, below=Ground(height_m, 0.0, 1.0))

    def _correction(
        self, telemetry: Telemetry, expected: Estimate | None, prior: Prior | None
    ) -> tuple[Array, Array]:
        """Mean (4,) and covariance (4, 4) of the track's biases, in its surroundings.

        A search of the whole map has to find any place at its own heading and height."""
        if expected is None or prior is None:
            variances = self.model.initial_bias()
            variances += self._telemetry_noise(telemetry)[[0, 1, 2, 2]]
            return np.zeros(4), np.diag(variances)
        return (OBSERVES @ expected.mean)[2:], observed(expected.covariance)[2:, 2:]

    def _must_compete(self, expected: Estimate) -> bool:
        """Whether places near the track have to compete with the whole map to confirm it.

        Not while a reported start is likely."""
        if expected.state is State.SEARCHING:
            return expected.belief < LOCAL_SHARE
        return not (expected.state.is_followed and expected.shown.is_confirmed)

    def _search_area(self, expected: Estimate | None, *, whole_map: bool) -> SearchArea:
        """Around a nearly certain position, else all. `whole_map`: places there have to compete."""
        if expected is None or not expected.shown.followed:
            return WHOLE_MAP  # an unconfirmed place must compete with the whole map
        competes = self._must_compete(expected)
        is_lost = expected.state is State.TRACKING and expected.confidence < LOCAL_SHARE
        if whole_map if competes else is_lost:
            return WHOLE_MAP
        spread = float(np.linalg.eigvalsh(expected.covariance[:2, :2])[-1])
        reach_m = max(LOCAL_SIGMAS * math.sqrt(spread), MIN_LOCAL_M)
        if 4 * reach_m**2 > self.mixture.area_m2 / 4:
            return WHOLE_MAP
        # Dead reckoning from a confirmed place that is still exact is as good as tracking.
        confirmed = expected.state is not State.SEARCHING and expected.shown.is_confirmed
        exact = confirmed and reach_m <= MIN_LOCAL_M
        return SearchArea((expected.mean[:2], reach_m), exact or not competes)

    def _prior(self, area: SearchArea) -> Prior | None:
        if area.circle is None:
            return None
        middle, reach_m = area.circle
        lat, lon = self._localizer.sheet.frame.latlon_from_en(middle)
        return Prior(float(lat), float(lon), reach_m / PRIOR_SIGMAS)

    def _fix(
        self,
        mean: Array,
        covariance: Array,
        place_probability: float,
        telemetry: Telemetry,
        more: dict[str, float],
    ) -> Fix:
        """Of a state (16,), (16, 16); `more` is its evidence."""
        lat, lon = self._localizer.sheet.frame.latlon_from_en(mean[:2])
        spread = covariance[:2, :2] + np.eye(2) * self.model.map_m**2
        spread.flags.writeable = False
        radius_m = self._radius_m(telemetry)
        whole = mean[TILT] + mean[HORIZON]
        units = np.array([math.degrees(1.0), 1.0, math.degrees(1.0), math.degrees(1.0)])
        stds = np.sqrt(np.maximum(np.diag(covariance)[BIASES], 0.0)) * units
        return Fix(
            lat_deg=float(lat),
            lon_deg=float(lon),
            cov_en_m2=spread,
            confidence=probability_within(place_probability, spread, radius_m),
            place_probability=place_probability,
            radius_m=radius_m,
            heading_deg=(telemetry.yaw_deg + math.degrees(mean[HEADING])) % 360,
            agl_m=telemetry.agl_m * math.exp(mean[SCALE]),
            evidence=more,
            bias=TelemetryBias(*(mean[BIASES] * units).tolist(), *stds.tolist()),
            pitch_deg=telemetry.pitch_deg + math.degrees(whole[0]),
            roll_deg=telemetry.roll_deg + math.degrees(whole[1]),
            vel_en_mps=(float(mean[2]), float(mean[3])),
            vel_std_mps=math.sqrt(float(np.linalg.eigvalsh(covariance[VELOCITY, VELOCITY])[-1])),
        )


def _reported_velocity(past: _Past, telemetry: Telemetry) -> ReportedVelocity | None:
    """None where none is given, or an impossible one."""
    reported, std = telemetry.vel_en_mps, telemetry.vel_std_mps
    if reported is None or not np.abs(reported).max() <= MAX_STD:  # NaN too
        return None
    now = np.array(reported)
    if std is None or not std > 0:
        std = usual_velocity_std_mps(float(np.hypot(*now)))
    std = max(std, math.sqrt(max(past.velocity_variance, 0.0)))
    unaided_s = UNAIDED_S if std >= UNAIDED_STD_MPS else None
    return ReportedVelocity(now, past.velocity, std, unaided_s)


def _known(corrected: Telemetry, spread: Array) -> Telemetry:
    """With the uncertainty (4, 4) of the correction: it bounds the search."""
    heading, scale, pitch, roll = np.sqrt(np.diag(spread)).tolist()
    return replace(
        corrected,
        yaw_std_deg=math.degrees(heading),
        agl_std_m=scale * corrected.agl_m,
        tilt_std_deg=max(math.degrees(max(pitch, roll)), LEAST_TILT_STD_DEG),
        mount_std_deg=None,
    )
