"""The request of a check, validated."""

from dataclasses import dataclass, field
from pathlib import Path

from orthonav.core.errors import CheckError
from orthonav.core.files import with_paths
from orthonav.core.geo.camera import Camera
from orthonav.core.records import CONFIDENT
from orthonav.ground.changes.record import ChangedGround
from orthonav.ground.check.estimate import LEARNT, Recalibration
from orthonav.ground.check.outcome import CheckedInputs
from orthonav.ground.planning.route import Route
from orthonav.ground.planning.spacing import DEFAULT_CAMERA, DEFAULT_PRIOR_STD_M

DEFAULT_SPEED_MPS = 20.0
"""Cruise speed of a small fixed-wing aircraft."""
DEFAULT_DRIFT = 0.03
"""Dead reckoning with an airspeed sensor and a known wind is usually off by 2 to 5 %."""
DEFAULT_RELIEF_M = 3.0
"""Height of houses and trees in open country, one standard deviation."""

DEFAULT_TILT_STD_DEG = 1.5
"""Unreported pitch and roll: a good mount and attitude. Drones that report a level gimbal
were tilted by up to 9 deg."""


@dataclass(frozen=True)
class CheckRequest:
    """What to check and under which conditions.

    `map_path`: map file with a registration layer.
    `route`: planned route; None: the whole map.
    `band_m`: width of the band for legs without one; None: derived from the prior.
    `other_date`: orthophoto of the same ground that the map was not built from.
    `agl_m`: height above ground, 1 to 50,000 m; None: the shorter side of a view covers one tile.
    `yaw_std_deg`: standard deviation of the reported heading, 0 to 90; None: heading unknown.
    `agl_std`: standard deviation of the reported height, a fraction of it, 0 to 0.5.
    `prior_std_m`: standard deviation of the prior position per axis; None: no prior.
    `accept`: confidence that a fix needs, 0.01 to 0.999.
    `drift`: error of dead reckoning per metre flown, 0 to 1.
    `relief_m`: standard deviation of the height of houses and trees.
    `effort`: factor on the number of trials, 0.05 to 50.
    `extras`: also try other errors of heading and height, and other heights.
    `workers`: processes; None: one per core.
    `tilt_std_deg`: standard deviation of the error of the reported pitch and roll, 0 to 20.
    `other_sensor`: the camera differs from the map's sensor by more than years do.
    `changes`: ground that changed since the map was made, as a flight saw it.
    """

    map_path: Path
    route: Route | None = None
    band_m: float | None = None
    other_date: Path | None = None
    camera: Camera = DEFAULT_CAMERA
    agl_m: float | None = None
    yaw_std_deg: float | None = 5.0
    agl_std: float = 0.05
    prior_std_m: float | None = DEFAULT_PRIOR_STD_M
    accept: float = CONFIDENT
    speed_mps: float = DEFAULT_SPEED_MPS
    drift: float = DEFAULT_DRIFT
    relief_m: float = DEFAULT_RELIEF_M
    effort: float = 1.0
    extras: bool = True
    workers: int | None = None
    seed: int = 1
    tilt_std_deg: float = DEFAULT_TILT_STD_DEG
    other_sensor: bool = False
    recalibration: Recalibration = LEARNT
    changes: ChangedGround | None = None
    about: CheckedInputs = field(default_factory=CheckedInputs)

    def __post_init__(self) -> None:
        with_paths(self, "map_path", "other_date")
        if self.other_sensor and self.other_date is not None:
            raise CheckError("--other-sensor is for checks without --other-date, which shows it")
        limits: dict[str, tuple[float | None, float, float, str]] = {
            "height above ground": (self.agl_m, 1.0, 50_000.0, "m"),
            "yaw_std_deg": (self.yaw_std_deg, 0.0, 90.0, "deg"),
            "agl_std": (self.agl_std, 0.0, 0.5, "(a fraction of the height: 0.05 is 5 %)"),
            "prior_std_m": (self.prior_std_m, 0.0, 1e6, "m"),
            "accept": (self.accept, 0.01, 0.999, ""),
            "speed_mps": (self.speed_mps, 0.1, 10_000.0, "m/s"),
            "drift": (self.drift, 0.0, 1.0, "(metres per metre flown: 0.03 is 3 %)"),
            "tilt_std_deg": (self.tilt_std_deg, 0.0, 20.0, "deg"),
            "relief_m": (self.relief_m, 0.0, 1000.0, "m"),
            "effort": (self.effort, 0.05, 50.0, ""),
            "workers": (self.workers, 1, 1000, "processes"),
            "seed": (self.seed, 0, 2**63, ""),
        }
        for name, (value, low, high, unit) in limits.items():
            if value is not None and not low <= value <= high:
                unit = f" {unit}" if unit else ""
                raise CheckError(f"{name} must be {low:g} to {high:g}{unit}, got {value}")
