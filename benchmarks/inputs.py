"""Inputs of the benchmarks: generated orthophotos, cached between runs, and simulated flights."""

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.flights import Flight, read_views
from lab import landscape
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.simulate.flight import DEFAULT_CAMERA, Errors, SimulateRequest, simulate_flight

LANDSCAPE_SEED = 1
FLIGHT_SEED = 7
PAST, PRESENT = landscape.DEFAULT_DATES[:2]
REAL_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
DATA = Path(os.environ.get("ORTHONAV_DATA", REAL_DATA))
"""Folder of optional real imagery."""
NAIP = REAL_DATA / "naip_nd"
USUAL_ERRORS = Errors(yaw_std_deg=5.0, agl_std=0.05)
WIDE_ERRORS = Errors(yaw_std_deg=10.0, agl_std=0.1)
# With this deviation only the reported heading is tried; the error is far below a pixel.
NO_ERRORS = Errors(yaw_std_deg=0.001)


@dataclass(frozen=True)
class Workplace:
    """Folders of a run: `scratch` is removed after it, `cache` holds generated areas."""

    scratch: Path
    cache: Path
    quick: bool

    @property
    def views(self) -> int:
        """Views per scene."""
        return 25 if self.quick else 100

    @property
    def repeats(self) -> int:
        """How often a whole process is timed."""
        return 2 if self.quick else 3

    def area(self, side_m: int, gsd_m: float, dates: Sequence[landscape.Epoch]) -> list[Path]:
        """Orthophotos of a generated square; generated again when the generator has changed."""
        name = f"{generator_digest()}-{side_m}m-{gsd_m:g}m"
        paths = [self.cache / name / f"{date.name}.tif" for date in dates]
        missing = [date for date, path in zip(dates, paths, strict=True) if not path.is_file()]
        if missing:
            landscape.generate_area(
                self.cache / name,
                size_m=(side_m, side_m),
                gsd_m=gsd_m,
                dates=missing,
                seed=LANDSCAPE_SEED,
            )
        return paths

    def map(
        self,
        ortho: Path,
        edges: str = "gradient",
        overlap: float = 0.875,
        registration: bool = True,
    ) -> Path:
        """A map with the defaults of `orthonav build`, built once per run."""
        kind = f"{edges}-{overlap}-{'layer' if registration else 'tiles'}"
        out = self.scratch / f"{ortho.parent.name}-{ortho.stem}-{kind}.onav"
        if not out.is_file():
            request = BuildRequest(
                [ortho], out, edges=edges, overlap=overlap, registration=registration
            )
            build_map(request)
        return out

    def flown(self, ortho: Path, count: int, errors: Errors, ground_m: float | None = None) -> Path:
        """Folder of a flight with views at random places over an orthophoto, flown once per run.

        `ground_m`: ground that the shorter side of a view covers; None: 256 px of the orthophoto.
        """
        agl_m = None if ground_m is None else ground_m / min(DEFAULT_CAMERA.extent)
        spreads = (errors.yaw_std_deg, errors.agl_std, errors.prior_std_m, agl_m)
        name = f"{ortho.parent.name}-{ortho.stem}-{count}-" + "-".join(map(str, spreads))
        folder = self.scratch / name
        if not folder.is_dir():
            request = SimulateRequest(
                [ortho], folder, random=count, agl_m=agl_m, errors=errors, seed=FLIGHT_SEED
            )
            simulate_flight(request)
        return folder

    def fly(self, ortho: Path, count: int, errors: Errors) -> Flight:
        """The views of `flown`, all read."""
        folder = self.flown(ortho, count, errors)
        camera, views = read_views(folder)
        return Flight(folder, camera, tuple(views))


def naip(year_file: str) -> Path | None:
    """An orthophoto of the optional real imagery beside the checkout, None where it is absent."""
    path = NAIP / year_file
    return path if path.is_file() else None


NAIP_ABSENT = (
    "NAIP skipped: the optional real imagery beside the checkout (../shared/data) is absent"
)
NAIP_PAST, NAIP_PRESENT = "20090818.tif", "20180716.tif"


def map_of(
    ortho: Path, work: Path, bounds_deg: tuple[float, float, float, float] | None = None
) -> Path:
    """The map of an orthophoto, or of its part within bounds (west, south, east, north), built once
    in `work`."""
    part = "" if bounds_deg is None else "-part"
    path = work / f"{ortho.parent.name}-{ortho.stem}{part}.onav"
    if not path.is_file():
        build_map(BuildRequest([ortho], path, bounds_deg=bounds_deg))
    return path


def file_of(name: str, work: Path) -> Path:
    """A file below `DATA`, or of a generated area (`generated:SEED:DATE`), which `work` holds."""
    if not name.startswith("generated:"):
        return DATA / name
    _, seed, date = name.split(":")
    area = work / f"area{seed}"
    if not area.is_dir():
        landscape.generate_area(area, dates=landscape.DEFAULT_DATES, seed=int(seed))
    return area / f"{date}.tif"


def generator_digest() -> str:
    """Short digest of the generator's sources."""
    folder = Path(landscape.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:8]
