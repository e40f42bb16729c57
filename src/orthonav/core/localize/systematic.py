"""What displaces blocks of a view together, and is not the camera.

Heights of the ground that the map does not know, houses and trees, a nominal lens, and imagery of
two dates that is stretched. A slope of the ground displaces blocks as a tilt of the camera does.
Each is Gaussian; `resection` solves for them with the camera and marginalizes them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import Camera
from orthonav.core.geo.ground import relief_slope
from orthonav.core.mapfile.manifest import TerrainInfo

OBJECTS_M = 3.0, 15.0
"""Houses and trees: 6 to 8 m high on a fifth of the ground."""
SURFACE_M = 0.5, 10.0  # a surface model, whose houses and trees are those of another date
BARE_EARTH_M = 0.5, 50.0
"""Bare earth of laser scanning or photogrammetry, 0.1 to 0.5 m (docs/decisions/camera.md)."""
COARSE_STD_M, COARSE_POSTING_M = 6.0, 30.0
"""Copernicus GLO-30 and its like on slopes, and their posting; finer models err by less."""
STD_PER_SLOPE_M = 100.0
"""Standard deviation over the root mean square slope of the terrain, which its errors add to."""
LENGTH_POSTINGS = 5.0  # correlation length of its errors, in postings, at least that of bare earth
ROUGH_M = 1.0  # terrain as rough within a sample shows houses and trees
UNDULATION_M = 50.0, 100.0
"""Of unknown ground: standard deviation over its slope, and correlation length."""
STRETCH_PX = 0.3, 80.0
"""Of imagery of two dates, pixels of the map: as residuals of blocks show (docs/decisions)."""
LEAST_SHARE = 0.02  # weaker modes of a field, of the variance of its strongest, are left out
LEAST_KNOWN, LEAST_UNKNOWN = 0.1, 0.7
"""Least factors on the variance of errors by what a view shows: ground that does not undulate may
still slope."""
CENTRE_SHARE, DISTORTION = 0.01, 0.05
"""Of a nominal lens: principal point over the width, and first radial coefficient."""
Array = NDArray[np.float64]
Field = tuple[float, float]
"""A random field: standard deviation and correlation length, both m or both pixels."""


@dataclass(frozen=True)
class GroundErrors:
    """Errors of the heights that are assumed under a view.

    `slope`: standard deviation of its unknown slope, per axis (rise over run)."""

    slope: float
    fields: tuple[Field, ...]


def unknown_ground(relief: str | None) -> GroundErrors:
    """Of level ground that is assumed; `relief`: what the land is like, None: nobody said."""
    slope = relief_slope(relief)
    per_slope_m, length_m = UNDULATION_M
    return GroundErrors(slope / math.sqrt(2), ((per_slope_m * slope, length_m), OBJECTS_M))


def terrain_errors(source: TerrainInfo | None, slopes: Array) -> GroundErrors:
    """Of a map's terrain with slopes (N, 2) under a view; `source`: None: one like Copernicus'."""
    posting_m = COARSE_POSTING_M
    if source is not None:
        posting_m = source.source_posting_m or source.posting_m
        if (source.roughness_m or 0.0) > ROUGH_M:
            return GroundErrors(0.0, (SURFACE_M,))
    least_m, length_m = BARE_EARTH_M
    steep = math.sqrt(float(np.nan_to_num(slopes**2).sum(axis=1).mean()))
    most_m = max(COARSE_STD_M * min(posting_m / COARSE_POSTING_M, 1.0), least_m)
    std_m = min(max(STD_PER_SLOPE_M * steep, least_m), most_m)
    return GroundErrors(0.0, ((std_m, max(length_m, LENGTH_POSTINGS * posting_m)), OBJECTS_M))


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
    """Of blocks `block_px` wide at places (N, 2) on the ground, m. They move by `by_height_px`
    (N, 2) per metre of height, and by `by_lens_px` (N, 2, L) per standard deviation of each error
    of the lens; None: it is calibrated."""
    heights_m = field_modes(places_m, errors.fields, block_px * gsd_m)
    if errors.slope > 0:
        middle = places_m - places_m.mean(axis=0)
        heights_m = np.concatenate([errors.slope * middle, heights_m], axis=1)
    stretch_px = field_modes(places_m / gsd_m, (STRETCH_PX,), block_px)
    none_px = np.zeros(stretch_px.shape)
    ground, stretched = heights_m.shape[1], 2 * stretch_px.shape[1]
    moves_px = [
        by_height_px[:, :, None] * heights_m[:, None],
        np.stack([stretch_px, none_px], axis=1),
        np.stack([none_px, stretch_px], axis=1),
    ]
    if by_lens_px is not None:
        moves_px.append(by_lens_px)
    components = (
        Component(slice(0, ground), LEAST_UNKNOWN if errors.slope > 0 else LEAST_KNOWN),
        Component(slice(ground, ground + stretched), LEAST_KNOWN),
    )
    return Systematic(np.concatenate(moves_px, axis=2), components, errors.slope)


def lens_px(camera: Camera, seen_px: Array) -> Array:
    """By which a nominal lens displaces points of the picture (N, 2), (N, 2, 4): its principal
    point, focal length and radial distortion, by one standard deviation of each."""
    off_px = seen_px - [camera.cx_px, camera.cy_px]
    square = (off_px**2).sum(axis=1, keepdims=True) / camera.fx_px**2
    centre_px = np.full(len(seen_px), CENTRE_SHARE * camera.width_px)
    right_px, down_px = (np.outer(centre_px, axis) for axis in np.eye(2))
    scaled_px, bent_px = off_px * camera.focal_std, off_px * (DISTORTION * square)
    return np.stack([right_px, down_px, scaled_px, bent_px], axis=2)


def field_modes(places: Array, fields: Sequence[Field], block: float) -> Array:
    """Values (N, K) of random fields with a Gaussian covariance, mean over blocks at places (N, 2),
    by one standard deviation of each of their modes. All in one unit."""
    squares = ((places[:, None] - places) ** 2).sum(axis=-1)
    covariance = np.zeros(squares.shape)
    for std, length in fields:
        # The mean over a square block is that over a Gaussian with the same second moments.
        wide = length**2 + block**2 / 6
        covariance += std**2 * length**2 / wide * np.exp(-squares / (2 * wide))
    values, vectors = np.linalg.eigh(covariance)
    used = values > LEAST_SHARE * values[-1]
    return np.asarray(vectors[:, used] * np.sqrt(values[used]))
