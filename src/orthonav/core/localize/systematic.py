"""What displaces blocks of a view together, and is not the camera.

Heights of the ground that the map does not know, houses and trees, a nominal lens, and imagery of
two dates that is stretched. A slope of the ground displaces blocks as a tilt of the camera does.
Each is Gaussian; `resection` solves for them with the camera and marginalizes them."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import Camera
from orthonav.core.geo.ground import relief_slope
from orthonav.core.mapfile.manifest import TerrainInfo

Array = NDArray[np.float64]
Field = tuple[float, float]
"""A random field: standard deviation and correlation length, both m or both pixels."""


@dataclass(frozen=True)
class ErrorModel:
    """Sizes of the errors; values without a source are in docs/decisions/camera.md."""

    objects_m: Field = (3.0, 15.0)
    """Houses and trees: 6 to 8 m high on a fifth of the ground."""
    surface_m: Field = (0.5, 10.0)
    """A surface model, whose houses and trees are those of another date."""
    bare_earth_m: Field = (0.5, 50.0)
    """Bare earth of laser scanning or photogrammetry, 0.1 to 0.5 m."""
    coarse_std_m: float = 6.0
    coarse_posting_m: float = 30.0
    """Copernicus GLO-30 and its like on slopes, and their posting. Finer models err by less,
    coarser ones by more: the slope of the error stays."""
    std_per_slope_m: float = 100.0
    """Standard deviation over the root mean square slope of the terrain, which its errors add to;
    of coarser models in proportion."""
    coarse_length_m: float = 150.0
    max_coarser: float = 8.0
    """Correlation length of these errors, in proportion to the posting up to a multiple at which
    they are longer than any view; at least that of bare earth."""
    rough_m: float = 1.0
    rough_per_slope_m: float = 4.0
    """Terrain as rough within a sample shows houses and trees; steep bare earth is rough too."""
    undulation_m: Field = (50.0, 100.0)
    """Of unknown ground, and what a terrain of a posting above 50 m leaves out: standard deviation
    over the slope, and correlation length."""
    stretch_px: Field = (0.3, 80.0)
    """Of imagery of two dates, pixels of the map: as residuals of blocks show."""
    min_mode: float = (
        1e-3  # weaker modes of a field, of the variance of its strongest, are left out
    )
    min_known: float = 0.1
    min_unknown: float = 0.7
    """Least factors on the variance of errors by what a view shows: ground that does not undulate
    may still slope."""
    centre_share: float = 0.01
    distortion: float = 0.05
    """Of a nominal lens: principal point over the width, and first radial coefficient."""


ERRORS = ErrorModel()


@dataclass(frozen=True)
class GroundErrors:
    """Errors of the heights that are assumed under a view.

    `slope`: standard deviation of its unknown slope, per axis (rise over run). `shift`: of its
    picture on the map, per axis."""

    slope: float
    fields: tuple[Field, ...]
    shift: Field | None = None


def unknown_ground(relief: str | None) -> GroundErrors:
    """Errors of assumed level ground; `relief`: what the land is like, None: nobody said."""
    slope = relief_slope(relief)
    per_slope_m, length_m = ERRORS.undulation_m
    return GroundErrors(slope / math.sqrt(2), ((per_slope_m * slope, length_m), ERRORS.objects_m))


def surface_errors(lean_std: float, above_m: Array) -> GroundErrors:
    """Errors of a map that knows houses and trees, `above_m` (N,) above its terrain under a view,
    NaN where unknown, which lean in its picture by more or less than known."""
    high_m = math.sqrt(float(np.nanmean(above_m**2)))
    shift = (lean_std * high_m, ERRORS.surface_m[1]) if lean_std * high_m > 0 else None
    return GroundErrors(0.0, (ERRORS.surface_m,), shift)


def terrain_errors(source: TerrainInfo | None, slopes: Array) -> GroundErrors:
    """Errors of a map's terrain with slopes (N, 2) under a view, NaN where unknown.

    `source`: None: a terrain like Copernicus'."""
    known = slopes[np.isfinite(slopes).all(axis=1)]
    steep = math.sqrt(float((known**2).sum(axis=1).mean())) if len(known) else math.inf
    posting_m = ERRORS.coarse_posting_m
    if source is not None:
        posting_m = source.source_posting_m or source.posting_m
        rough_m = source.roughness_m or 0.0
        if rough_m > max(
            ERRORS.rough_m, ERRORS.rough_per_slope_m * steep
        ):  # houses and trees, smoothed
            return GroundErrors(0.0, (ERRORS.surface_m, (rough_m, ERRORS.objects_m[1])))
    least_m, least_length_m = ERRORS.bare_earth_m
    coarser = min(posting_m / ERRORS.coarse_posting_m, ERRORS.max_coarser)
    most_m = max(ERRORS.coarse_std_m * coarser, least_m)
    std_m = min(max(ERRORS.std_per_slope_m * max(coarser, 1.0) * steep, least_m), most_m)
    fields = [(std_m, max(ERRORS.coarse_length_m * coarser, least_length_m))]
    per_slope_m, length_m = ERRORS.undulation_m
    if length_m < 2 * posting_m:
        fields.append((min(per_slope_m * steep, most_m), length_m))
    return GroundErrors(0.0, (*fields, ERRORS.objects_m))


class Component(NamedTuple):
    """Errors whose common variance the view itself shows, and the least factor on it."""

    at: slice
    least: float


class Systematic(NamedTuple):
    """Displacements of blocks (N, 2, K), pixels right and down at level 0, by one standard
    deviation of each error; `slope_rad`: standard deviation of the slope among them."""

    moves_px: Array
    components: tuple[Component, ...]
    slope_rad: float


def systematic(
    errors: GroundErrors,
    *,
    places_m: Array,
    by_height_px: Array,
    by_lens_px: Array | None,
    block_px: float,
    gsd_m: float,
) -> Systematic:
    """Displacements of blocks `block_px` wide at places (N, 2) on the ground, m.

    They move by `by_height_px` (N, 2) per metre of height, and by `by_lens_px` (N, 2, L) per
    standard deviation of each error of the lens; None: it is calibrated."""
    heights_m = [field_modes(places_m, field, block_px * gsd_m) for field in errors.fields]
    least = [ERRORS.min_known] * len(heights_m)
    if errors.slope > 0:
        sloped_m = errors.slope * (places_m - places_m.mean(axis=0))
        heights_m[0] = np.concatenate([sloped_m, heights_m[0]], axis=1)
        least[0] = ERRORS.min_unknown
    moves_px = [by_height_px[:, :, None] * each[:, None] for each in heights_m]
    on_map = [ERRORS.stretch_px]
    if errors.shift is not None:
        on_map.append((errors.shift[0] / gsd_m, errors.shift[1] / gsd_m))
    for each in on_map:
        along_px = field_modes(places_m / gsd_m, each, block_px)
        none_px = np.zeros(along_px.shape)
        both_px = [[along_px, none_px], [none_px, along_px]]
        moves_px.append(np.concatenate([np.stack(axis, axis=1) for axis in both_px], axis=2))
    least += [ERRORS.min_known] * len(on_map)
    ends = np.cumsum([each.shape[2] for each in moves_px]).tolist()
    components = tuple(
        Component(slice(start, end), low)
        for start, end, low in zip([0, *ends[:-1]], ends, least, strict=True)
    )
    if by_lens_px is not None:
        moves_px.append(by_lens_px)
    return Systematic(np.concatenate(moves_px, axis=2), components, errors.slope)


def lens_px(camera: Camera, seen_px: Array) -> Array:
    """By which a nominal lens displaces points of the picture (N, 2), (N, 2, 4): its principal
    point, focal length and radial distortion, by one standard deviation of each."""
    off_px = seen_px - [camera.cx_px, camera.cy_px]
    square = (off_px**2).sum(axis=1, keepdims=True) / camera.fx_px**2
    centre_px = np.full(len(seen_px), ERRORS.centre_share * camera.width_px)
    right_px, down_px = (np.outer(centre_px, axis) for axis in np.eye(2))
    scaled_px, bent_px = off_px * camera.focal_std, off_px * (ERRORS.distortion * square)
    return np.stack([right_px, down_px, scaled_px, bent_px], axis=2)


def field_modes(places: Array, field: Field, block: float) -> Array:
    """Values (N, K) of a random field with a Gaussian covariance, mean over blocks at places
    (N, 2), by one standard deviation of each of its modes. All in one unit."""
    squares = ((places[:, None] - places) ** 2).sum(axis=-1)
    std, length = field
    # The mean over a square block is that over a Gaussian with the same second moments.
    wide = length**2 + block**2 / 6
    covariance = std**2 * length**2 / wide * np.exp(-squares / (2 * wide))
    values, vectors = np.linalg.eigh(covariance)
    used = values > ERRORS.min_mode * values[-1]
    return np.asarray(vectors[:, used] * np.sqrt(values[used]))
