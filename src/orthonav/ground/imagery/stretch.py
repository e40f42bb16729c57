"""Contrast stretch of pixels with more than 8 bits to 8 bits, common to files of one kind."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.errors import RasterioError

from orthonav.core.errors import ImageryError
from orthonav.ground.imagery.joined import lattices_of
from orthonav.ground.imagery.source import Source, quiet, unreadable

log = logging.getLogger(__name__)

SAMPLE_PX = 512
"""Side of the decimated image that percentiles are computed from."""
SAMPLED_SOURCES = 12
"""Files of one kind that are sampled."""


@dataclass(frozen=True)
class ContrastStretch:
    """Linear map of raw values to 0..255: `low` becomes 0, `high` 255."""

    low: float
    high: float

    def apply(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        """8-bit values, same shape."""
        scale = 255.0 / (self.high - self.low)
        scaled = (values.astype(np.float32) - self.low) * scale
        return np.asarray(np.clip(np.nan_to_num(scaled) + 0.5, 0, 255), dtype=np.uint8)


def sample_stretches(sources: Sequence[Source]) -> tuple[ContrastStretch | None, ...]:
    """The stretch of each source: None for 8 bit, else common to all of one kind.

    A kind has one pixel type, number of bands, ground resolution and coordinate system: the files
    of one product. From the 0.5 and 99.5 percentiles of valid pixels of up to `SAMPLED_SOURCES`.
    Raises `ImageryError` where none can be read or no pixel is valid.
    """
    alike: dict[Any, list[int]] = {}
    for index, source in enumerate(sources):
        if source.dtype != "uint8" and not source.has_palette:
            kind = source.dtype, source.colours, round(source.gsd_m, 2), source.crs
            alike.setdefault(kind, []).append(index)
    found: list[ContrastStretch | None] = [None] * len(sources)
    for members in alike.values():
        stretch = _common([sources[index] for index in members])
        for index in members:
            found[index] = stretch
    deep = sum(len(members) for members in alike.values())
    if len(alike) > 1 or 0 < deep < len(sources):
        log.warning(
            "orthophotos have several pixel types; each kind is stretched to 8 bits separately"
        )
    return tuple(found)


def _common(sources: list[Source]) -> ContrastStretch:
    values = []
    broken: ImageryError | None = None
    for source in sources[:: max(1, -(-len(sources) // SAMPLED_SOURCES))]:
        try:
            values.append(_valid_values(source))
        except RasterioError as error:  # it may not be needed; reported where it is
            broken = broken or unreadable(source.path, error)
    if broken is not None and not values:
        raise broken
    every = np.concatenate(values)
    if every.size == 0:
        raise ImageryError("orthophotos have no valid pixel (all nodata)")
    low, high = (float(value) for value in np.percentile(every, [0.5, 99.5]))
    return ContrastStretch(low, high if high > low else low + 1.0)


def _valid_values(source: Source) -> NDArray[Any]:
    """Finite values (N,) of valid pixels of a decimated read."""
    (lattice,) = lattices_of([source])
    with quiet(), lattice.open(np.ones(1, np.bool_)) as data:
        shape = (min(SAMPLE_PX, data.height), min(SAMPLE_PX, data.width))
        pixels = data.read(lattice.bands, out_shape=(source.colours, *shape))
        valid = data.dataset_mask(out_shape=shape) > 0
    sampled = pixels[:, valid].ravel()
    return np.asarray(sampled[np.isfinite(sampled)])
