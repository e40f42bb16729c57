"""Maps of the rows, as `orthonav build` makes them, and the heights they are given."""

import hashlib
import math
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any
from zlib import crc32

import cv2
import numpy as np
import rasterio
from lab.landscape import DEFAULT_DATES, generate_heights
from lab.terrain import random_relief
from numpy.typing import NDArray
from rasterio.enums import ColorInterp

from benchmarks.real_ground.mapping import strip_ortho
from benchmarks.scenes import DATA, generated, ortho
from orthonav.core.files import replacing
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.ground.build import BuildRequest, build_map

ROOT = Path(__file__).resolve().parents[2]
TRUE_POSTING_M, COARSE_POSTING_M = 2.0, 30.0
"""Of the relief that views show, and of a terrain model such as Copernicus GLO-30."""
COARSE_STD_M, COARSE_LENGTH_M = 4.0, 150.0
"""Error of that terrain model: standard deviation, and distance at which its correlation is 1/e."""
SHORTEST_M, WIDEST_M = 60.0, 6000.0
"""Of the relief: it is smooth below the first, so that slopes come from wavelengths of about 100 m
up, and has none above the second."""
ROUGHNESS = 1.5
"""Power of the wavelength with which amplitudes grow: a fractal dimension of 2.5, the rough end of
measured terrain (2.1 to 2.5)."""
BASE_M = 200.0
BARE, FLAT, COARSE, SURFACE, OUTDATED = "bare", "flat", "coarse", "surface", "outdated"
DRAPED, DISPLACED, HIGH, HOLES = "draped", "displaced", "high", "holes"
"""As `BARE` for imagery that is draped over hills; this displaced by 200 m, 50 m too high, or with
eight holes of 400 m."""
GONE_SHARE, OUTDATED_STD_M, OUTDATED_POSTING_M, LEAST_HOUSE_M = 0.1, 0.3, 1.0, 2.5
"""Of an `OUTDATED` surface: share of the houses and groups of trees, at least so high, that it
lacks, and its noise, independent at so many metres."""
Heights = NDArray[np.float32]


@dataclass(frozen=True)
class Map:
    """A map to be built.

    - `ortho`: orthophoto as `scenes.ortho` takes it, `scaled:GSD:NAME` or
      `strip:NUMBER:NAME`.
    - `ground`: one of `BARE` to `HOLES` of `relief`, or a file of heights below `DATA`; None: the
      map has no terrain.
    - `relief`: root mean square slope of the ground in per cent; None: the ground is not rendered.
    - `land`: what the build says of land without terrain; None: nothing.
    - `datum`: of the heights; None: the file states it.
    """

    ortho: str
    ground: str | None = None
    relief: float | None = None
    land: str | None = None
    datum: str | None = "msl"

    def path(self, work: Path) -> Path:
        name = hashlib.sha256(repr(self).encode()).hexdigest()[:10]
        return work / f"maps-{code()}" / f"{Path(self.ortho.replace(':', '-')).stem}-{name}.onav"

    def build(self, work: Path) -> None:
        """Build the map unless the same code has built it."""
        out = self.path(work)
        if not out.is_file():
            out.parent.mkdir(parents=True, exist_ok=True)
            more: dict[str, Any] = {} if self.land is None else {"relief": self.land}
            if self.ground is not None:
                heights, datum = self.heights(work), {"dem_datum": self.datum}
                is_surface = Path(self.ground).stem in (SURFACE, OUTDATED)
                more |= datum | ({"surface": [heights]} if is_surface else {"dem": heights})
            build_map(BuildRequest([found(self.ortho, work)], out, **more))

    def heights(self, work: Path) -> Path:
        """File of the heights that the map is given."""
        assert self.ground is not None
        if self.relief is None:
            return found(self.ground, work)
        if self.ortho.startswith("generated:") and self.ground not in (FLAT, DRAPED):
            return landscape_heights(self.ortho, work, self.relief, self.ground)
        return relief_file(self.ortho, work, self.relief, self.ground)

    def localizer(self, work: Path) -> Localizer:
        return Localizer(open_map(self.path(work)))


def found(name: str, work: Path) -> Path:
    """The file of a name as `scenes.ortho` takes it, `scaled:GSD:NAME`, or `strip:NUMBER:NAME` of
    mapping photographs."""
    if name.startswith("strip:"):
        return strip_ortho(int(name.split(":")[1]), work)
    return scaled_copy(name, work) if name.startswith("scaled:") else ortho(name, work)


@cache
def code() -> str:
    """Digest of the code of orthonav: maps and rows of other code are not taken for those of it."""
    digest = hashlib.sha256()
    for path in sorted((ROOT / "src" / "orthonav").rglob("*")):
        if path.suffix in (".py", ".so", ".toml"):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:10]


def fractal_relief(shape: tuple[int, int], posting_m: float, slope: float, seed: int) -> Heights:
    """Heights (H, W) whose gradient is `slope` (root mean square) of wavelengths up to
    `WIDEST_M`."""
    side = max(*shape, round(WIDEST_M / posting_m))
    made = random_relief((side, side), posting_m, 1.0, SHORTEST_M, seed, ROUGHNESS)
    made = made[: shape[0], : shape[1]]
    steep = np.sqrt(sum(np.mean(part**2) for part in np.gradient(made, posting_m)))
    return np.asarray(made * np.float32(slope / steep) + np.float32(BASE_M), np.float32)


def coarse_of(heights: Heights, posting_m: float, seed: int) -> Heights:
    """The heights at `COARSE_POSTING_M`, with the error of such a terrain model."""
    factor = posting_m / COARSE_POSTING_M
    size = tuple(max(2, round(side * factor)) for side in heights.shape[::-1])
    small = cv2.resize(heights, size, interpolation=cv2.INTER_AREA)
    pad = 16
    noise = np.random.default_rng(seed).standard_normal((size[1] + 2 * pad, size[0] + 2 * pad))
    # Noise blurred by s has the correlation exp(-d^2 / (4 s^2)).
    error = cv2.GaussianBlur(noise, (0, 0), COARSE_LENGTH_M / COARSE_POSTING_M / 2)
    error *= COARSE_STD_M / error.std()
    return np.asarray(small + error[pad:-pad, pad:-pad], np.float32)


def relief_file(name: str, work: Path, slope: float, kind: str) -> Path:
    """Heights over an orthophoto, in its coordinate system: the relief itself (`BARE`), or a
    terrain model of it."""
    path = Path(name.replace(":", "-"))  # dates of several places have the same name
    out = work / f"{path.parent.name}-{path.stem}-relief{slope:g}-{kind}.tif"
    if out.is_file():
        return out
    with rasterio.open(found(name, work)) as source:
        bounds, crs = source.bounds, source.crs
    width_m, height_m = bounds.right - bounds.left, bounds.top - bounds.bottom
    # Whole cells of the coarse terrain, and some beyond the imagery.
    cols, rows = (int(side // COARSE_POSTING_M) + 11 for side in (width_m, height_m))
    factor = round(COARSE_POSTING_M / TRUE_POSTING_M)
    shape = rows * factor, cols * factor
    seed = crc32(name.encode())  # other hills at every place
    if kind == FLAT:
        made, posting_m = np.full((rows, cols), BASE_M, np.float32), COARSE_POSTING_M
    else:
        made, posting_m = fractal_relief(shape, TRUE_POSTING_M, slope / 100, seed), TRUE_POSTING_M
    if kind == COARSE:
        made, posting_m = coarse_of(made, posting_m, seed + 1), COARSE_POSTING_M
    if kind == DISPLACED:
        made = np.roll(made, round(200 / posting_m), axis=1)
    if kind == HIGH:
        made += np.float32(50)
    if kind == HOLES:
        side = round(200 / posting_m)
        for row, col in np.random.default_rng(7).uniform(0, made.shape, (8, 2)).astype(int):
            made[max(0, row - side) : row + side, max(0, col - side) : col + side] = np.nan
    west_m, north_m = bounds.left - 5 * COARSE_POSTING_M, bounds.top + 5 * COARSE_POSTING_M
    step = rasterio.Affine(posting_m, 0, west_m, 0, -posting_m, north_m)
    return written(out, made, step, crs)


def written(out: Path, heights: Heights, transform: Any, crs: Any) -> Path:
    """Heights above the sea as a GeoTIFF."""
    rows, cols = heights.shape
    about = {"driver": "GTiff", "count": 1, "dtype": "float32", "compress": "deflate"}
    about |= {"width": cols, "height": rows, "crs": crs, "transform": transform}
    with replacing(out) as part, rasterio.open(part, "w", **about) as target:
        target.write(heights, 1)
        target.update_tags(ORTHONAV_VERTICAL_DATUM="msl")
    return out


def landscape_heights(name: str, work: Path, slope: float, kind: str) -> Path:
    """Heights under generated imagery: `BARE`, or the `SURFACE` of the date of the name, or this as
    a survey of another year would have it (`OUTDATED`)."""
    seed, gsd_m, side_m, date = generated(name)
    folder = work / f"area-{seed}-{side_m}m-{gsd_m:g}m-hills{slope:g}"
    if kind == OUTDATED:
        out = folder / f"{date}_outdated.tif"
        if not out.is_file():
            _outdated(out, landscape_heights(name, work, slope, SURFACE), seed)
        return out
    path = folder / ("dem.tif" if kind == BARE else f"{date}_dsm.tif")
    if not path.is_file():
        dates = [each for each in DEFAULT_DATES if each.name == date]
        area = partial(generate_heights, size_m=(side_m, side_m), gsd_m=gsd_m, seed=seed)
        area(folder, slope=slope / 100, dates=dates)
    return path


def _outdated(out: Path, surface: Path, seed: int) -> None:
    rng = np.random.default_rng([seed, 6])
    with rasterio.open(surface) as source:
        heights, transform, crs = source.read(1), source.transform, source.crs
    with rasterio.open(surface.with_name("dem.tif")) as source:
        size = heights.shape[::-1]
        bare = cv2.resize(source.read(1), size, interpolation=cv2.INTER_LINEAR)
    high = (heights - bare > LEAST_HOUSE_M).astype(np.uint8)
    count, labels = cv2.connectedComponents(high)
    gone = np.asarray(rng.random(count) < GONE_SHARE, np.bool_)
    gone[0] = False  # the ground
    lacking = cv2.dilate(gone[labels].astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    heights[lacking] = bare[lacking]
    coarse = tuple(math.ceil(side * transform.a / OUTDATED_POSTING_M) for side in heights.shape)
    noise = cv2.resize(
        rng.normal(0.0, OUTDATED_STD_M, coarse), size, interpolation=cv2.INTER_NEAREST
    )
    written(out, np.asarray(heights + noise, np.float32), transform, crs)


def scaled_copy(name: str, work: Path) -> Path:
    """A copy of imagery of a stand-in scale at another one: `scaled:GSD:NAME`. A palette becomes
    its colours, which `build` needs."""
    _, gsd, source_name = name.split(":")
    out = work / f"{Path(source_name).parent.name}-{Path(source_name).stem}-{gsd}m.tif"
    if out.is_file():
        return out
    with rasterio.open(DATA / source_name) as source:
        bands, mask, step = source.read(), source.dataset_mask(), source.transform
        if source.colorinterp[0] == ColorInterp.palette:
            table = source.colormap(1)
            colours = np.array([table[level][:3] for level in range(256)], np.uint8)
            bands = np.moveaxis(colours[bands[0]], -1, 0)
        crs = source.crs
    scale = float(gsd) / step.a
    transform = rasterio.Affine(float(gsd), 0, step.c, 0, step.e * scale, step.f)
    count, rows, cols = bands.shape
    about = {"driver": "GTiff", "count": count, "dtype": "uint8", "crs": crs}
    about |= {"width": cols, "height": rows, "transform": transform}
    with replacing(out) as part, rasterio.open(part, "w", **about) as target:
        target.write(bands)
        target.write_mask(mask)
    return out
