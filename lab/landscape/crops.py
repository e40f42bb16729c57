"""Appearance of the parcels at one date: crop of the year, colour of the season, rows and lanes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.landscape.epoch import Epoch
from lab.landscape.noise import Float32, Float64, key_of, uniform
from lab.landscape.parcels import LandCover
from lab.landscape.plan import CellPlan

# Fraction of the fields; display colours in spring, summer and autumn; rows of the crop: strength,
# spacing (m), strength of the tractor lanes.
_Colours = tuple[tuple[int, int, int], ...]
_CROPS: tuple[tuple[str, float, _Colours, tuple[float, float, float]], ...] = (
    ("wheat", 0.23, ((92, 124, 66), (206, 182, 122), (150, 128, 100)), (0.03, 3.0, 0.16)),
    ("barley", 0.12, ((134, 150, 88), (214, 198, 150), (128, 126, 88)), (0.04, 4.0, 0.15)),
    ("rape", 0.11, ((186, 184, 74), (176, 156, 110), (92, 122, 66)), (0.03, 3.0, 0.14)),
    ("maize", 0.14, ((164, 142, 114), (82, 116, 58), (176, 156, 104)), (0.07, 3.2, 0.03)),
    ("sunflower", 0.08, ((172, 150, 122), (144, 142, 66), (124, 106, 84)), (0.06, 3.0, 0.04)),
    ("beet", 0.07, ((146, 136, 98), (86, 128, 64), (98, 124, 66)), (0.05, 2.8, 0.10)),
    ("ploughed", 0.10, ((146, 120, 94), (168, 142, 112), (122, 98, 76)), (0.10, 3.6, 0.0)),
    ("clover", 0.09, ((98, 136, 66), (116, 134, 74), (98, 122, 66)), (0.03, 4.5, 0.03)),
    ("fallow", 0.06, ((138, 142, 96), (168, 160, 112), (136, 130, 94)), (0.02, 4.0, 0.03)),
)
_COVER_COLOURS: dict[LandCover, tuple[tuple[_Colours, float], ...]] = {
    LandCover.MEADOW: (
        (((104, 136, 70), (134, 142, 86), (106, 126, 70)), 0.6),
        (((114, 142, 78), (164, 160, 106), (116, 130, 74)), 0.4),
    ),
    LandCover.ORCHARD: ((((112, 136, 80), (132, 140, 90), (122, 130, 84)), 1.0),),
    LandCover.VINEYARD: ((((156, 146, 112), (138, 144, 98), (164, 146, 100)), 1.0),),
    LandCover.FOREST: ((((76, 92, 58), (66, 80, 50), (96, 88, 60)), 1.0),),
    LandCover.GARDEN: (
        (((112, 138, 82), (126, 140, 88), (108, 126, 76)), 0.7),
        (((142, 142, 112), (154, 148, 116), (138, 132, 106)), 0.3),
    ),
    LandCover.YARD: ((((168, 164, 156), (176, 170, 160), (156, 154, 150)), 1.0),),
    LandCover.ROUGH: ((((108, 118, 74), (132, 130, 88), (124, 112, 80)), 1.0),),
}
CLEARING_YEARS = 30.0
"""Duration for which a felled wood stays low scrub."""


@dataclass(frozen=True, eq=False)
class Appearance:
    """Appearance of M parcels at one date, in the order of the given plans; row 0 is bare meadow.

    - `rgb` (M, 3): display colour.
    - `cover` (M,): `LandCover`, after felling.
    - `soil`, `growth`, `grain` (M,): strength of permanent patches, patches of the year, texture.
    - `row_turn` (M, 2): unit vector across the rows. `row_m` (M,): spacing of the rows.
    - `row`, `lane` (M,): strength of rows and of tractor lanes. `lane_m` (M,): spacing of lanes.
    """

    rgb: Float32
    cover: NDArray[np.int8]
    soil: Float32
    growth: Float32
    grain: Float32
    row_turn: Float64
    row_m: Float32
    row: Float32
    lane: Float32
    lane_m: Float32


def appearance_of(plans: Sequence[CellPlan], epoch: Epoch) -> Appearance:
    """Return the appearance of the parcels of `plans`, in order, at `epoch`."""
    time = epoch.time_years
    merged = _gather([plan.merge_year for plan in plans], np.inf) <= time
    own = _gather([plan.identity for plan in plans], 0)
    identity = np.where(merged, _gather([plan.twin for plan in plans], 0), own).astype(np.int64)
    cover = _gather([plan.cover for plan in plans], int(LandCover.MEADOW)).astype(np.int8)
    felled = _gather([plan.felled_year for plan in plans], np.inf)
    cleared = (cover == LandCover.FOREST) & (felled <= time) & (time < felled + CLEARING_YEARS)
    cover[cleared] = LandCover.ROUGH
    rgb, rows, lanes, row_m = _colours(cover, identity, epoch)
    arable = cover == LandCover.ARABLE
    strength = _draw("patch", identity, epoch)
    return Appearance(
        rgb=rgb.astype(np.float32),
        cover=cover,
        soil=np.where(arable, 0.15 * (1.4 * strength - 0.25), 0.07).astype(np.float32),
        growth=np.where(cover == LandCover.YARD, 0.03, 0.03 + 0.085 * strength**2).astype(
            np.float32
        ),
        grain=_GRAIN[cover],
        row_turn=_row_turn(cover, identity, _gather([plan.angle_rad for plan in plans], 0), epoch),
        row_m=row_m.astype(np.float32),
        row=rows.astype(np.float32),
        lane=lanes.astype(np.float32),
        lane_m=(18.0 + 6.0 * np.floor(4.0 * _draw("lane", identity))).astype(np.float32),
    )


_GRAIN = np.array([0.055, 0.08, 0.09, 0.09, 0.15, 0.19, 0.09, 0.22], np.float32)


def _gather(columns: Sequence[NDArray[np.generic]], default: float) -> NDArray[np.float64]:
    """Return the columns joined, after a row for pixels outside all parcels."""
    return np.concatenate([[default], *columns]).astype(np.float64)


def _draw(name: str, identity: NDArray[np.int64], epoch: Epoch | None = None) -> Float64:
    """Return a number in [0, 1) per parcel, different in every year if an epoch is given."""
    return uniform(key_of("looks", name), identity, epoch.year if epoch else 0)


def _colours(
    cover: NDArray[np.int8], identity: NDArray[np.int64], epoch: Epoch
) -> tuple[Float64, Float64, Float64, Float64]:
    """Return colour (M, 3), row strength, lane strength and row spacing (M,)."""
    season = epoch.season.value
    shares = np.cumsum([crop[1] for crop in _CROPS])
    crop = np.minimum(
        np.searchsorted(shares, _draw("crop", identity, epoch) * shares[-1]), len(_CROPS) - 1
    )
    rgb = np.array([entry[2][season] for entry in _CROPS], np.float64)[crop]
    manner = np.array([entry[3] for entry in _CROPS])[crop]
    rows, row_m, lanes = manner[:, 0].copy(), manner[:, 1].copy(), manner[:, 2].copy()
    pick = _draw("kind", identity, epoch)
    for kind, choices in _COVER_COLOURS.items():
        low = 0.0
        for colours, share in choices:
            rgb[(cover == kind) & (pick >= low)] = colours[season]
            low += share
    # the contribution of the soil is the same every year
    shade = 1.0 + 0.12 * (_draw("shade", identity, epoch) - 0.5)
    shade *= 1.0 + 0.30 * (_draw("earth", identity) - 0.5)
    rows *= 0.25 + 0.9 * _draw("drill", identity, epoch) ** 1.5
    lanes *= 0.5 + 0.7 * _draw("wheel", identity, epoch)
    row_m = row_m * (0.85 + 0.8 * _draw("span", identity, epoch))
    other = cover != LandCover.ARABLE
    lanes[other] = 0.0
    rows[other], row_m[other] = 0.0, 6.0
    mown = (cover == LandCover.MEADOW) & (pick < 0.5)
    rows[mown] = 0.04
    vines = cover == LandCover.VINEYARD
    rows[vines], row_m[vines] = 0.22, 2.6
    tint = 1.0 + 0.09 * (
        np.stack([_draw(f"tint{channel}", identity, epoch) for channel in "rgb"], axis=1) - 0.5
    )
    tilled = (cover == LandCover.ARABLE) | (cover == LandCover.MEADOW)
    return rgb * np.where(tilled, shade, 1.0)[:, None] * tint, rows, lanes, row_m


def _row_turn(
    cover: NDArray[np.int8], identity: NDArray[np.int64], angle_rad: Float64, epoch: Epoch
) -> Float64:
    """Return unit vectors (M, 2) across the rows; most rows follow the longer side."""
    tilled = (cover == LandCover.ARABLE) | (cover == LandCover.MEADOW)
    draw = _draw("turn", identity, epoch)
    angle = angle_rad + np.pi / 2.0
    angle = angle + np.where(tilled & (draw < 0.22), np.pi / 2.0, 0.0)
    angle = angle + np.where(tilled, 0.16 * (_draw("veer", identity, epoch) - 0.5), 0.0)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)
