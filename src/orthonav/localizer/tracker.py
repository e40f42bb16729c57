"""From the views of a flight to one track: registration sees, the mixture decides.

Every view is placed where the track expects it, or anywhere on the map while that is not known,
and whatever it may be is handed to the mixture with its odds. Views that overlap are registered on
each other too, which is odometry without instruments.
"""

import math
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from orthonav.errors import MapFileError
from orthonav.localizer.checks import check_view
from orthonav.localizer.levelled import levelled
from orthonav.localizer.localizer import Localizer
from orthonav.localizer.odometry import Footprint, Moved, corrected_by, moved_between
from orthonav.localizer.places import places_of
from orthonav.localizer.registration import PreparedView
from orthonav.records import Fix, NoFix, Prior, Telemetry, View
from orthonav.register.registrar import Registered
from orthonav.track import Estimate, Mixture, Model, ReportedVelocity, Sighting, State, Told
from orthonav.track.hypotheses import within
from orthonav.track.model import HEADING, SCALE, TILT, VELOCITY
from orthonav.track.smooth import History, Smoothed

LOCAL_SHARE = 0.75
"""Belief in one place from which on views are looked for around it only."""
LOCAL_SIGMAS = 4.0
MIN_LOCAL_M = 30.0
LEAST_NEW = 0.15
"""Share of a view that counts as new although it was seen before: noise, light and tilt differ."""
TILT_NEW = 0.3
"""Views' worth of new ground after which perspective is looked at again: of ground that was seen it
says the same, and it costs as much as all the rest."""
LONGEST_GAP_S = 600.0
UNKNOWN_STEP_S = 1.0
"""Time that is taken to have passed where the clock stands still or jumps back."""
NEAR_SHARE = 0.05
"""Places nearer to each other than this share of the view's side are one."""
RADIUS_SHARE = 0.025
"""Of the height, the least radius that a confidence is about: what an angle of 1.4 deg makes."""
KNOWN_MPS = 5.0
"""A velocity known to so much says where the next view will be."""
VELOCITY_STD_MPS = 1.0
VELOCITY_SHARE = 0.02
Array = NDArray[np.float64]


class Tracker:
    """Follows one flight over one map. Mutable; not to be shared between threads."""

    def __init__(
        self,
        localizer: Localizer,
        *,
        model: Model | None = None,
        heading_known: bool = True,
        use_prior: bool = True,
        every_prior: bool = False,
        smooth: bool = False,
        lag: int | None = None,
    ) -> None:
        """With `use_prior` the flight begins where the first view's prior says; with `every_prior`
        those of all views are measured positions, such as GNSS.

        With `smooth` what is needed for `smoothed_track` is kept: every view by all, or, with
        `lag`, by those before it and so many after it.
        Raises `MapFileError` where the map has no registration layer or no confidence.
        """
        registration = localizer.registration
        if registration is None or registration.confidence is None:
            raise MapFileError("a track needs a map with a registration layer and its confidence")
        self._registration, self._confidence = registration, registration.confidence
        self._localizer, self._heading_known = localizer, heading_known
        self.model, self._usual_model = model or Model(), model is None
        grid = localizer.grid
        east_m, south_m = grid.width_px * grid.gsd_m, -grid.height_px * grid.gsd_m
        extent = grid.west_m, grid.north_m + south_m, grid.west_m + east_m, grid.north_m
        self.mixture = Mixture(self.model, extent)
        self._time_ns: int | None = None
        self._before: Footprint | None = None
        self._velocity: Array | None = None
        self._unlevelled = np.full(2, np.inf)
        self._start_was_reported = False
        self._use_prior, self._every_prior = use_prior, every_prior
        self._history = History() if smooth else None
        self._lag = lag
        self._seen: list[tuple[Fix | NoFix, Telemetry]] = []
        self._lagged: list[Fix | NoFix] = []
        self.state = State.SEARCHING

    def locate(self, view: View) -> Fix | NoFix:
        """Where the aircraft is, with this view and all before it.

        A view that shows nothing moves the track on by what is known of the velocity. Raises
        `CameraError` if the camera is not that of the image.
        """
        refused = check_view(view, self._localizer.grid.gsd_m, self._heading_known)
        overlap = self._predict(None if refused else view, view.telemetry)
        self._unlevelled += 1 - overlap
        if refused is None:
            refused = self._observe(view, overlap)
        return self._outcome(view.telemetry, refused)

    @property
    def state_name(self) -> str:
        """The state as `fixes.jsonl` has it."""
        return self.state.value

    def passed(self, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
        """Where the aircraft is at a view whose picture cannot be used, for `reason`."""
        self._predict(None, telemetry)
        return self._outcome(telemetry, reason)

    def smoothed_track(self) -> list[Fix | NoFix]:
        """Where the aircraft was at each view so far, by views after it too."""
        if self._history is None:
            raise ValueError("this tracker keeps no history")
        left = len(self._seen) - len(self._lagged)
        smoothed = self._history.smoothed(left) if left else []
        return self._lagged + [
            self._smoothed_fix(*pair)
            for pair in zip(smoothed, self._seen[len(self._lagged) :], strict=True)
        ]

    def _smoothed_fix(
        self, smoothed: Smoothed | None, seen: tuple[Fix | NoFix, Telemetry]
    ) -> Fix | NoFix:
        """A view by those after it; as it was at the time where those know less of it.

        That is so where the likeliest track passes over a view that is far from its neighbours.
        """
        before, telemetry = seen
        if smoothed is None:
            return NoFix("searching", "no place was found")
        spread = float(np.trace(smoothed.covariance[:2, :2]))
        if isinstance(before, Fix) and spread > float(np.trace(before.cov_en_m2)):
            return before
        inside = within(smoothed.mean, smoothed.covariance, self._radius_m(telemetry))
        belief = min(smoothed.belief, 1.0) * inside
        return self._fix(smoothed.mean, smoothed.covariance, belief, telemetry, {})

    def _radius_m(self, telemetry: Telemetry) -> float:
        """The error that a confidence is about."""
        high = RADIUS_SHARE * telemetry.agl_m
        least = self._registration.radius_m
        return max(least, high) if math.isfinite(high) else least

    def _outcome(self, telemetry: Telemetry, refused: NoFix | None) -> Fix | NoFix:
        estimate = self.mixture.estimate(self._radius_m(telemetry))
        self.state = State.SEARCHING if estimate is None else estimate.state
        outcome: Fix | NoFix = refused or NoFix("searching", "no place has been found yet")
        if estimate is not None:
            more = {
                "hypotheses": float(len(self.mixture.hypotheses)),
                "elsewhere": self.mixture.elsewhere,
            }
            mean, covariance = estimate.mean, estimate.covariance
            outcome = self._fix(mean, covariance, estimate.confidence, telemetry, more)
        if self._history is not None:
            self._history.record(self.mixture)
            self._seen.append((outcome, telemetry))
            if self._lag is not None and len(self._seen) > self._lag:
                smoothed = self._history.smoothed(self._lag + 1)[0]
                self._lagged.append(self._smoothed_fix(smoothed, self._seen[-self._lag - 1]))
        return outcome

    def _predict(self, view: View | None, telemetry: Telemetry) -> float:
        """Move the track to the time of this view; the share of it that was seen before."""
        before, now = self._before, None
        if view is not None and self._heading_known:
            bias, _ = self.mixture.bias()
            before = None if before is None else before.by(bias)
            now = self._footprint(view, before, bias)
        prior = telemetry.prior if self._use_prior or self._every_prior else None
        if self._usual_model and math.isfinite(telemetry.agl_m):
            self._usual_model = False
            self.model = self.mixture.model = self.model.at_height(telemetry.agl_m)
        if self._time_ns is None:
            self._time_ns, self._before = telemetry.time_ns, now
            if prior is not None:
                self._start_was_reported = True
                self.mixture.start(*self._place(prior))
            return 0.0
        seconds = (telemetry.time_ns - self._time_ns) / 1e9
        if not 0 < seconds < LONGEST_GAP_S:
            seconds = UNKNOWN_STEP_S if seconds <= 0 else LONGEST_GAP_S
        self._time_ns = telemetry.time_ns
        noise = self._telemetry_noise(telemetry)
        told = self._reported_velocity(telemetry)
        seen = self._seen_way(before, now, noise, self._way(seconds, told))
        self._before = now
        self.mixture.predict(seconds, told, None if seen is None else seen.way, noise)
        if self._every_prior and prior is not None:
            self.mixture.told_position(*self._place(prior))
        return 0.0 if seen is None else seen.overlap

    def _place(self, prior: Prior) -> tuple[Array, float]:
        """Metres east and north (2,) of a prior, and its standard deviation."""
        frame = self._localizer.sheet.frame
        return frame.en_from_latlon(prior.lat_deg, prior.lon_deg), max(prior.std_m, 1.0)

    def _telemetry_noise(self, telemetry: Telemetry) -> Array:
        """Variances (2,) of told heading and log scale from view to view, as told or as usual."""
        noise = self.model.telemetry_noise.copy()
        if telemetry.yaw_std_deg is not None:
            noise[0] = math.radians(telemetry.yaw_std_deg) ** 2
        if telemetry.agl_std_m is not None and telemetry.agl_m > 0:
            noise[1] = (telemetry.agl_std_m / telemetry.agl_m) ** 2
        return noise

    def _footprint(
        self,
        view: View,
        before: Footprint | None,
        bias: Array,
    ) -> Footprint | None:
        """The view for odometry, in pixels of the one before unless they differ too much."""
        if before is not None:
            made = Footprint.of(view, before.pixel_m, bias)
            if made is None or made.grey.size < 4 * before.grey.size:
                return made
        return Footprint.of(view, None, bias)

    def _reported_velocity(self, telemetry: Telemetry) -> ReportedVelocity | None:
        """The told velocity beside that of the view before, None where none is told."""
        before, told = self._velocity, telemetry.vel_en_mps
        self._velocity = None
        if told is None or not np.isfinite(told).all():
            return None
        self._velocity = now = np.array(told)
        std = telemetry.vel_std_mps
        if std is None or not std > 0:
            std = VELOCITY_STD_MPS + VELOCITY_SHARE * float(np.hypot(*now))
        return ReportedVelocity(now, before, std)

    def _tilt_noise(self, telemetry: Telemetry) -> float:
        """How far told pitch and roll are off from view to view (rad), as told or as usual."""
        told = telemetry.tilt_std_deg
        return self.model.tilt_noise_rad if told is None else math.radians(told)

    def _way(self, seconds: float, told: ReportedVelocity | None) -> Array | None:
        """Metres east and north (2,) that should have been flown, None where nobody knows."""
        if told is not None:
            return told.now_en_mps * seconds
        best = self.mixture.likeliest
        if best is None or np.trace(best.covariance[VELOCITY, VELOCITY]) > KNOWN_MPS**2:
            return None
        return best.mean[VELOCITY] * seconds

    def _seen_way(
        self,
        before: Footprint | None,
        now: Footprint | None,
        telemetry_noise: Array,
        expected_en_m: Array | None,
    ) -> Moved | None:
        """The way since the last view by the camera, and how much of it both views showed."""
        if before is None or now is None or before.pixel_m != now.pixel_m:
            return None
        tilt_noise = self._tilt_noise(now.telemetry)
        return moved_between(before, now, tilt_noise, telemetry_noise, expected_en_m)

    def _observe(self, view: View, overlap: float) -> NoFix | None:
        """Look for the view and hand what it may be to the mixture; why not, if it cannot be."""
        telemetry = view.telemetry
        expected = self.mixture.estimate(self._radius_m(telemetry), between_views=True)
        bias, spread = self.mixture.bias()
        corrected = replace(view, telemetry=_known(corrected_by(telemetry, bias), spread))
        prepared = self._registration.prepared(corrected, self._heading_known)
        if isinstance(prepared, NoFix):
            return prepared
        prior, searched = self._where(expected)
        sightings, newness = [], max(1 - overlap, LEAST_NEW)
        if prior is None or self._registration.touches_map(prior, prepared):
            found = self._registration.best(prepared, prior)
            if found is not None:
                area = math.inf if searched is None else math.pi * searched[1] ** 2
                share = min(area / self.mixture.area_m2, 1.0)
                worth = self._worth_of_tilt(newness, math.isfinite(found.fine_score))
                sightings = self._sightings(corrected, prepared, found, bias[1], share, worth)
        told = Told(
            math.radians(telemetry.yaw_deg) if self._heading_known else None,
            math.radians(telemetry.pitch_deg),
            math.radians(telemetry.roll_deg),
            self._tilt_noise(telemetry),
        )
        self.mixture.update(told, sightings, newness, searched)
        return None

    def _worth_of_tilt(self, newness: float, costly: bool) -> Array:
        """How much more perspective counts than the view, of which a share `newness` is new, for
        pitch and roll: by all the ground that is new since it was looked at last.

        0 where that is too little. Views that follow closely have little time: they are looked at
        for one of the two, and, where the view was `costly` before, later.
        """
        due = self._unlevelled >= (2 * TILT_NEW if costly else TILT_NEW)
        if newness < TILT_NEW:
            due &= np.arange(2) == np.argmax(self._unlevelled)
        new = np.where(due, np.minimum(self._unlevelled, 1.0), 0.0)
        self._unlevelled[due] = 0.0
        return np.where(due, np.maximum(new, newness) / newness, 0.0)

    def _where(self, expected: Estimate | None) -> tuple[Prior | None, tuple[Array, float] | None]:
        """The part of the map to look at: around the track where that is nearly certain."""
        if expected is None:
            return None, None
        likely = expected.confidence
        if expected.state is State.SEARCHING:
            if not self._start_was_reported:
                return None, None  # what is not confirmed must stand against the whole map
            likely = expected.belief  # however wide it was told
        if likely < LOCAL_SHARE:
            return None, None
        spread = float(np.linalg.eigvalsh(expected.covariance[:2, :2])[-1])
        reach = max(LOCAL_SIGMAS * math.sqrt(spread), MIN_LOCAL_M)
        if 4 * reach**2 > self.mixture.area_m2 / 4:
            return None, None
        lat, lon = self._localizer.sheet.frame.latlon_from_en(expected.mean[:2])
        return Prior(float(lat), float(lon), reach / 3), (expected.mean[:2], reach)

    def _sightings(
        self,
        view: View,
        prepared: PreparedView,
        found: Registered,
        log_scale: float,
        looked_at: float,
        worth: Array,
    ) -> list[Sighting]:
        """What the view may be, `log_scale` of its height corrected already, its perspective
        counted `worth` (2,) times."""
        made = []
        for log_odds, alone, placed in places_of(
            found, self._confidence, NEAR_SHARE * prepared.side_px, looked_at
        ):
            seen = levelled(self._registration, view, prepared, placed, worth)
            if seen is None:
                continue
            mean = seen.mean.copy()
            mean[3] += log_scale
            made.append(Sighting(mean, seen.covariance, log_odds, alone))
        return made

    def _fix(
        self,
        mean: Array,
        covariance: Array,
        confidence: float,
        telemetry: Telemetry,
        more: dict[str, float],
    ) -> Fix:
        lat, lon = self._localizer.sheet.frame.latlon_from_en(mean[:2])
        spread = covariance[:2, :2] + np.eye(2) * self.model.map_m**2
        spread.flags.writeable = False
        pitch, roll = np.degrees(mean[TILT])
        evidence = {
            "heading_bias_deg": math.degrees(mean[HEADING]),
            "log_scale_bias": float(mean[SCALE]),
            "pitch_bias_deg": float(pitch),
            "roll_bias_deg": float(roll),
            **_stds(covariance),
            "vel_east_mps": float(mean[2]),
            "vel_north_mps": float(mean[3]),
            "vel_std_mps": math.sqrt(float(np.linalg.eigvalsh(covariance[VELOCITY, VELOCITY])[-1])),
            **more,
        }
        return Fix(
            lat_deg=float(lat),
            lon_deg=float(lon),
            cov_en_m2=spread,
            confidence=confidence,
            radius_m=self._radius_m(telemetry),
            heading_deg=(telemetry.yaw_deg + math.degrees(mean[HEADING])) % 360,
            agl_m=telemetry.agl_m * math.exp(mean[SCALE]),
            evidence=MappingProxyType(evidence),
        )


def _stds(covariance: Array) -> dict[str, float]:
    """How well it is known what is wrong with what is told."""
    std = np.sqrt(np.maximum(np.diag(covariance)[4:], 0.0))
    names = (
        "heading_bias_std_deg",
        "log_scale_bias_std",
        "pitch_bias_std_deg",
        "roll_bias_std_deg",
    )
    values = np.where([True, False, True, True], np.degrees(std), std)
    return dict(zip(names, values.tolist(), strict=True))


def _known(corrected: Telemetry, spread: Array) -> Telemetry:
    """Told values with how well they are known by now, which says how widely to look."""
    heading, scale = np.sqrt(np.diag(spread)[:2]).tolist()
    return replace(corrected, yaw_std_deg=math.degrees(heading), agl_std_m=scale * corrected.agl_m)
