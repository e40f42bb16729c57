"""Pixels of more than 8 bits made into 8 bits, all orthophotos of a map alike."""

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from orthonav.errors import ImageryError
from orthonav.imagery.source import Source, unreadable
from orthonav.imagery.thin import read_mask

SAMPLE_PX = 512
SAMPLED_SOURCES = 12


@dataclass(frozen=True)
class Stretch:
    """Linear map of raw values to 0..255: `low` becomes 0, `high` 255."""

    low: float
    high: float

    def apply(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        """8-bit values, same shape."""
        scale = 255.0 / (self.high - self.low)
        scaled = (values.astype(np.float32) - self.low) * scale
        return np.asarray(np.clip(np.nan_to_num(scaled) + 0.5, 0, 255), dtype=np.uint8)


def sample_stretch(sources: list[Source]) -> Stretch | None:
    """Common stretch of sources that are not 8 bit; None where all are 8 bit.

    From the 0.5 and 99.5 percentiles of valid pixels in a thinned read of up to 12 sources.
    Raises `ImageryError` where 8-bit and other files are mixed, no source can be read or no pixel
    is valid.
    """
    deep = [source.dtype != "uint8" for source in sources]
    if not any(deep):
        return None
    if not all(deep):
        raise ImageryError(
            "orthophotos of 8 bit and of more bits cannot be mixed in one map; convert one kind"
        )
    values = []
    broken: ImageryError | None = None
    for source in sources[:: max(1, -(-len(sources) // SAMPLED_SOURCES))]:
        try:
            values.append(_valid_values(source))
        except RasterioError as error:  # it may not be needed, and is reported if it is
            broken = broken or unreadable(source.path, error)
    if broken is not None and not values:
        raise broken
    every = np.concatenate(values)
    if every.size == 0:
        raise ImageryError("orthophotos hold no valid pixel (all nodata)")
    low, high = (float(value) for value in np.percentile(every, [0.5, 99.5]))
    return Stretch(low, high if high > low else low + 1.0)


def _valid_values(source: Source) -> NDArray[Any]:
    """Finite values (N,) of valid pixels of a thinned read."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(source.path) as data:
            shape = (min(SAMPLE_PX, data.height), min(SAMPLE_PX, data.width))
            pixels = data.read(list(source.bands), out_shape=(len(source.bands), *shape))
            valid = read_mask(data, source, out_shape=shape) > 0
    sampled = pixels[:, valid].ravel()
    return np.asarray(sampled[np.isfinite(sampled)])
