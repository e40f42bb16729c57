"""Buildings: one or more on a plot, aligned with it, with roofs of plane faces."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from lab.landscape.network import Settlement
from lab.landscape.noise import Float64
from lab.landscape.parcels import FIRST_YEAR, LandCover

_ROOF_RGB = np.array(
    [
        [176, 104, 78],
        [160, 92, 70],
        [188, 122, 92],
        [150, 112, 90],
        [112, 104, 104],
        [92, 92, 100],
        [128, 80, 66],
        [196, 150, 120],
    ],
    np.float64,
)
_HALL_RGB = np.array(
    [[205, 206, 204], [170, 172, 175], [225, 222, 214], [132, 140, 150], [160, 130, 112]],
    np.float64,
)
FLAT, GABLE, HIP = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Buildings:
    """N buildings: centre (N, 2), length, width, wall height, direction of the ridge, roof, years.

    shape: FLAT, GABLE or HIP; pitch: rise of the roof per metre; rgb (N, 3): colour of the roof.
    """

    centre_m: Float64
    length_m: Float64
    width_m: Float64
    height_m: Float64
    angle_rad: Float64
    shape: NDArray[np.int8]
    pitch: Float64
    rgb: Float64
    born_year: Float64
    gone_year: Float64

    def where(self, keep: NDArray[np.bool_]) -> "Buildings":
        """Return the buildings for which `keep` (N,) is true."""
        return Buildings(*(getattr(self, field.name)[keep] for field in fields(self)))

    def at(self, time_years: float) -> "Buildings":
        """Return the buildings that stand at a time."""
        return self.where((self.born_year <= time_years) & (time_years < self.gone_year))

    def corners(self) -> Float64:
        """Return the ground corners (N, 4, 2), counter-clockwise from the lower left."""
        unit = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        return self._placed(unit[None] * np.stack([self.length_m, self.width_m], axis=1)[:, None])

    def ridges(self) -> Float64:
        """Return both ends of the ridges (N, 2, 2); those of hip roofs are shorter."""
        inset = np.where(
            self.shape == HIP, 0.5 * np.minimum(self.width_m, 0.9 * self.length_m), 0.0
        )
        half = self.length_m / 2.0 - inset
        ends = np.zeros((len(half), 2, 2))
        ends[:, 0, 0], ends[:, 1, 0] = -half, half
        return self._placed(ends)

    def face_normals(self) -> Float64:
        """Return the upward unit normals (N, 4, 3) of the faces over each side, as `corners`."""
        outward = self.angle_rad[:, None] + np.array([-0.5, 0.0, 0.5, 1.0]) * np.pi
        rise = np.where(self.shape == FLAT, 0.0, self.pitch)[:, None] * np.ones(4)
        normal = np.stack([rise * np.cos(outward), rise * np.sin(outward), np.ones_like(rise)], 2)
        return np.asarray(normal / np.linalg.norm(normal, axis=2, keepdims=True))

    def _placed(self, local_m: Float64) -> Float64:
        c, s = np.cos(self.angle_rad)[:, None], np.sin(self.angle_rad)[:, None]
        x, y = local_m[..., 0], local_m[..., 1]
        return np.stack([c * x - s * y, s * x + c * y], axis=2) + self.centre_m[:, None]


def build(
    centres_m: Float64,
    angle_rad: Float64,
    area_m2: Float64,
    cover: NDArray[np.int8],
    settlements: list[Settlement | None],
    rng: np.random.Generator,
) -> Buildings:
    """Return the buildings of a cell's parcels: houses, sheds, halls and lonely farms.

    centres_m (M, 2), angle_rad, area_m2, cover (M,) and `settlements` describe the parcels.
    """
    in_town = np.array([s is not None and s.plot_m2 < 800.0 for s in settlements])
    plot = (cover == LandCover.GARDEN) & (rng.uniform(size=len(cover)) < 0.9)
    yard = cover == LandCover.YARD
    farm = (cover == LandCover.MEADOW) & (rng.uniform(size=len(cover)) < 0.025)
    main = np.flatnonzero(plot | yard | farm)
    extra = main[rng.uniform(size=len(main)) < np.where(farm[main], 1.0, 0.35)]
    parcel = np.concatenate([main, extra])
    shed = np.arange(len(parcel)) >= len(main)
    count = len(parcel)
    side = np.sqrt(np.minimum(area_m2[parcel], 6000.0))
    hall = (yard[parcel] & ~shed) | (farm[parcel] & shed)
    length = np.minimum(rng.uniform(9.0, 17.0, count), 0.6 * side)
    length = np.where(in_town[parcel], np.minimum(1.35 * length, 0.72 * side), length)
    length = np.where(shed, rng.uniform(4.0, 8.0, count), length)
    length = np.where(hall, np.clip(rng.uniform(0.5, 0.75, count) * side, 14.0, 60.0), length)
    width = length * rng.uniform(0.5, 0.85, count)
    angle = angle_rad[parcel] + (np.pi / 2.0) * (rng.uniform(size=count) < 0.35)
    angle = angle + rng.normal(0.0, 0.03, count)
    away = np.where(shed, rng.uniform(0.24, 0.36, count), rng.uniform(0.0, 0.14, count)) * side
    around = rng.uniform(0.0, 2.0 * np.pi, count)
    offset = away[:, None] * np.stack([np.cos(around), np.sin(around)], axis=1)
    draw = rng.uniform(size=count)
    shape = np.where(draw < 0.62, GABLE, np.where(draw < 0.85, HIP, FLAT)).astype(np.int8)
    shape[hall & (draw > 0.4)] = FLAT
    return Buildings(
        centre_m=centres_m[parcel] + offset,
        length_m=length,
        width_m=width,
        height_m=np.where(shed, 2.7, rng.uniform(4.5, 7.5, count)) + 3.0 * in_town[parcel] * ~shed,
        angle_rad=angle,
        shape=shape,
        pitch=np.where(hall, 0.2, rng.uniform(0.55, 1.0, count)),
        rgb=_roof_colours(hall, shape, rng),
        **_years(shed, rng),
    )


def _roof_colours(
    hall: NDArray[np.bool_], shape: NDArray[np.int8], rng: np.random.Generator
) -> Float64:
    """Return roof colours (N, 3): tiles and slate, or sheet metal and gravel where flat."""
    count = len(hall)
    tiles = _ROOF_RGB[rng.integers(len(_ROOF_RGB), size=count)]
    sheets = _HALL_RGB[rng.integers(len(_HALL_RGB), size=count)]
    rgb = np.where((hall | (shape == FLAT))[:, None], sheets, tiles)
    return np.asarray(rgb * rng.uniform(0.82, 1.12, count)[:, None])


def _years(shed: NDArray[np.bool_], rng: np.random.Generator) -> dict[str, Float64]:
    """Return first and last years of buildings; few houses change, many sheds do."""
    count = len(shed)
    born = FIRST_YEAR - 100.0 + rng.uniform(0.0, 140.0, count)
    gone = FIRST_YEAR + rng.exponential(np.where(shed, 60.0, 300.0), count)
    return {"born_year": np.where(born < FIRST_YEAR, -np.inf, born), "gone_year": gone}
