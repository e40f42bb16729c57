"""What a check is asked."""

from dataclasses import dataclass
from pathlib import Path

from orthonav.check.outcome import About
from orthonav.errors import CheckError
from orthonav.geo.camera import Camera
from orthonav.geo.route import Route

DEFAULT_CAMERA = Camera(1280, 960, 1000.0, 1000.0, 640.0, 480.0)
"""A field of view of 65 by 51 degrees."""
DEFAULT_SPEED_MPS = 20.0
DEFAULT_DRIFT = 0.03
"""Dead reckoning without GNSS: metres of error per metre flown. With the wind known from before and
an airspeed sensor 2 to 5 % are usual."""
DEFAULT_PRIOR_STD_M = 150.0
DEFAULT_RELIEF_M = 3.0
NOTHING_SAID = About("", "", "")


@dataclass(frozen=True)
class CheckRequest:
    """What to check: a map for views of `camera` from `agl_m` above ground.

    Without `agl_m` it is the height at which the shorter side of a view covers a tile of the map.
    `band_m` is for legs of `route` that do not say theirs. `other_date` is an orthophoto of the
    same ground that is not in the map. Standard deviations as in `orthonav.check.outcome`.
    `relief_m` is that of the height of houses and trees, which tilt in pictures from low;
    `effort` multiplies the number of trials; `workers` None: one process per core.
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
    accept: float = 0.9
    speed_mps: float = DEFAULT_SPEED_MPS
    drift: float = DEFAULT_DRIFT
    relief_m: float = DEFAULT_RELIEF_M
    effort: float = 1.0
    extras: bool = True
    workers: int | None = None
    seed: int = 1
    about: About = NOTHING_SAID

    def __post_init__(self) -> None:
        """Raises `CheckError` on impossible numbers."""
        limits: dict[str, tuple[float | None, float, float, str]] = {
            "height above ground": (self.agl_m, 1.0, 50_000.0, "m"),
            "yaw_std_deg": (self.yaw_std_deg, 0.0, 90.0, "deg"),
            "agl_std": (self.agl_std, 0.0, 0.5, "(a share of the height: 0.05 is 5 %)"),
            "prior_std_m": (self.prior_std_m, 0.0, 1e6, "m"),
            "accept": (self.accept, 0.01, 0.999, ""),
            "speed_mps": (self.speed_mps, 0.1, 10_000.0, "m/s"),
            "drift": (self.drift, 0.0, 1.0, "(a share of the way: 0.03 is 3 %)"),
            "relief_m": (self.relief_m, 0.0, 1000.0, "m"),
            "effort": (self.effort, 0.05, 50.0, ""),
            "workers": (self.workers, 1, 1000, "processes"),
            "seed": (self.seed, 0, 2**63, ""),
        }
        for name, (value, low, high, unit) in limits.items():
            if value is not None and not low <= value <= high:
                unit = f" {unit}" if unit else ""
                raise CheckError(f"{name} must be {low:g} to {high:g}{unit}, got {value}")
