"""One orthophoto file: is it usable, where does it lie, how are its bands made into 8 bits?"""

import re
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.errors import ImageryError, MissingExtraError, MissingFileError
from orthonav.geo.frames import LocalFrame

try:
    import rasterio
    from rasterio._err import CPLE_BaseError
    from rasterio.enums import ColorInterp
    from rasterio.errors import NotGeoreferencedWarning, RasterioError
    from rasterio.warp import transform as transform_coordinates
except ImportError as error:  # pragma: no cover - depends on the installation
    raise MissingExtraError(
        "reading orthophotos needs rasterio; install it with: pip install 'orthonav[geo]'"
    ) from error

OUTLINE_POINTS = 21
SAMPLE_PX = 512
_DATE_TAGS = ("TIFFTAG_DATETIME", "ACQUISITION_DATE", "ACQUISITIONDATE", "DATE")
_DATE_IN_NAME = re.compile(
    r"(?<!\d)((?:19|20)\d\d)(?:[-_]?(0[1-9]|1[0-2])(?:[-_]?([0-3]\d))?)?(?!\d)"
)


@dataclass(frozen=True, eq=False)
class Source:
    """What is known of one orthophoto file without reading it whole.

    `bands` are the 1-based indexes used (one for grey, three for red, green, blue);
    `outline_latlon_deg` is the (N, 2) border; `gsd_m` the ground resolution at the centre;
    `palette` the (256, 3) colours of a colour-mapped image.
    """

    path: Path
    bands: tuple[int, ...]
    dtype: str
    width_px: int
    height_px: int
    crs: str
    gsd_m: float
    outline_latlon_deg: NDArray[np.float64]
    date: str | None
    palette: NDArray[np.uint8] | None = None

    def describe(self) -> dict[str, Any]:
        """What the map's manifest keeps of this source."""
        return {
            "name": self.path.name,
            "date": self.date,
            "crs": self.crs[:200],
            "gsd_m": round(self.gsd_m, 4),
            "width_px": self.width_px,
            "height_px": self.height_px,
            "dtype": self.dtype,
        }


def open_source(path: Path) -> Source:
    """Inspect an orthophoto.

    Raises `MissingFileError`, or `ImageryError` for a file GDAL cannot read, without a
    georeference, or without usable bands.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"orthophoto does not exist: {path}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path) as dataset:
                return _inspect(path, dataset)
    except RasterioError as error:
        raise ImageryError(f"orthophoto cannot be read ({_first_line(error)}): {path}") from error


def _inspect(path: Path, dataset: Any) -> Source:
    if dataset.crs is None:
        raise ImageryError(
            "orthophoto has no coordinate reference system; assign the one it was made in "
            f"(for example: gdal_edit.py -a_srs EPSG:2154 FILE): {path}"
        )
    if dataset.transform.is_identity or dataset.transform.determinant == 0:
        raise ImageryError(f"orthophoto has no georeference (geotransform or world file): {path}")
    if dataset.count < 1 or dataset.dtypes[0].startswith(("complex", "c")):
        raise ImageryError(f"orthophoto has no band of real numbers: {path}")
    if dataset.width < 16 or dataset.height < 16:
        raise ImageryError(
            f"orthophoto is only {dataset.width} x {dataset.height} px, too small to use: {path}"
        )
    bands = _bands(dataset)
    palette = _palette(dataset) if dataset.colorinterp[0] == ColorInterp.palette else None
    outline = _outline_latlon_deg(path, dataset)
    return Source(
        path=path,
        bands=bands,
        dtype=str(dataset.dtypes[bands[0] - 1]),
        width_px=dataset.width,
        height_px=dataset.height,
        crs=dataset.crs.to_string(),
        gsd_m=_gsd_m(dataset),
        outline_latlon_deg=outline,
        date=_date(path, dataset),
        palette=palette,
    )


def _bands(dataset: Any) -> tuple[int, ...]:
    by_colour = {
        colour: index for index, colour in reversed(list(enumerate(dataset.colorinterp, 1)))
    }
    wanted = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
    if all(colour in by_colour for colour in wanted):
        return tuple(by_colour[colour] for colour in wanted)
    colours = [i for i, colour in enumerate(dataset.colorinterp, 1) if colour != ColorInterp.alpha]
    return tuple(colours[:3]) if len(colours) >= 3 else tuple(colours[:1])


def _palette(dataset: Any) -> NDArray[np.uint8]:
    table = np.zeros((256, 3), dtype=np.uint8)
    for value, colour in dataset.colormap(1).items():
        if 0 <= value < 256:
            table[value] = colour[:3]
    return table


def _outline_latlon_deg(path: Path, dataset: Any) -> NDArray[np.float64]:
    share = np.linspace(0, 1, OUTLINE_POINTS)
    zero, one = np.zeros(OUTLINE_POINTS), np.ones(OUTLINE_POINTS)
    cols = np.concatenate([share, share, zero, one]) * dataset.width
    rows = np.concatenate([zero, one, share, share]) * dataset.height
    try:
        latlon = _latlon_deg(dataset, cols, rows)
    except CPLE_BaseError as error:  # a local or engineering system: nowhere on Earth
        raise ImageryError(
            "orthophoto's coordinate system cannot be turned into latitude, longitude; assign the "
            f"one it was made in (for example: gdal_edit.py -a_srs EPSG:2154 FILE): {path}"
        ) from error
    if not np.isfinite(latlon).all() or np.abs(latlon[:, 0]).max() > 90:
        raise ImageryError(f"orthophoto's border cannot be turned into latitude, longitude: {path}")
    return latlon


def _latlon_deg(
    dataset: Any, cols: NDArray[np.float64], rows: NDArray[np.float64]
) -> NDArray[np.float64]:
    x, y = dataset.transform * (cols, rows)
    lon, lat = transform_coordinates(dataset.crs, "EPSG:4326", x, y)[:2]
    return np.stack([np.asarray(lat, dtype=float), np.asarray(lon, dtype=float)], axis=1)


def _gsd_m(dataset: Any) -> float:
    """Square root of the ground area of the central pixel."""
    col, row = dataset.width / 2, dataset.height / 2
    latlon = _latlon_deg(dataset, np.array([col, col + 1, col]), np.array([row, row, row + 1]))
    frame = LocalFrame(float(latlon[0, 0]), float(latlon[0, 1]))
    corner = frame.en_from_latlon(latlon[:, 0], latlon[:, 1])
    right, down = corner[1] - corner[0], corner[2] - corner[0]
    return float(np.sqrt(abs(right[0] * down[1] - right[1] * down[0])))


def _date(path: Path, dataset: Any) -> str | None:
    """Date of acquisition as YYYY[-MM[-DD]], from the file's tags or else its name."""
    tags = dataset.tags()
    candidates = [str(tags[tag]).replace(":", "-") for tag in _DATE_TAGS if tag in tags]
    for text in [*candidates, path.stem]:
        found = _DATE_IN_NAME.search(text)
        if found:
            return "-".join(part for part in found.groups() if part)
    return None


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
    Raises `ImageryError` where 8-bit and other files are mixed or no pixel is valid.
    """
    deep = [source.dtype != "uint8" for source in sources]
    if not any(deep):
        return None
    if not all(deep):
        raise ImageryError(
            "orthophotos of 8 bit and of more bits cannot be mixed in one map; convert one kind"
        )
    values = []
    for source in sources[:: max(1, len(sources) // 12)]:
        with warnings.catch_warnings(), suppress(RasterioError), rasterio.open(source.path) as data:
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            shape = (min(SAMPLE_PX, data.height), min(SAMPLE_PX, data.width))
            pixels = data.read(list(source.bands), out_shape=(len(source.bands), *shape))
            valid = data.dataset_mask(out_shape=shape) > 0
            values.append(pixels[:, valid].ravel())
    every = np.concatenate(values) if values else np.empty(0)
    every = every[np.isfinite(every)]
    if every.size == 0:
        raise ImageryError("orthophotos hold no valid pixel (all nodata)")
    low, high = (float(value) for value in np.percentile(every, [0.5, 99.5]))
    return Stretch(low, high if high > low else low + 1.0)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
