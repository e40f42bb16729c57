"""One orthophoto file: is it usable, where does it lie, which of its bands are used?"""

import logging
import re
import warnings
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
    from rasterio.windows import Window
except ImportError as error:  # pragma: no cover - depends on the installation
    raise MissingExtraError(
        "reading orthophotos needs rasterio; install it with: pip install 'orthonav[geo]'"
    ) from error

OUTLINE_POINTS = 21
ALPHA_SAMPLE_PX = 512
ALPHA_WINDOWS = 8
MAX_PARTLY_CLEAR = 0.05
_DATE_TAGS = ("TIFFTAG_DATETIME", "ACQUISITION_DATE", "ACQUISITIONDATE", "DATE")
_DATE_IN_NAME = re.compile(  # not 2000x2000, nor 2000px
    r"(?<!\d)(?<!\dx)(19\d\d|20[0-3]\d)(?:[-_]?(0[1-9]|1[0-2])(?:[-_]?([0-3]\d))?)?"
    r"(?![\dx]|[-_ ]?px)",
    re.IGNORECASE,
)

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Source:
    """What is known of one orthophoto file without reading it whole.

    `bands` are the 1-based indexes used (one for grey, three for red, green, blue);
    `outline_latlon_deg` is the (N, 2) border; `gsd_m` the ground resolution at the centre;
    `palette` the (N, 3) colours of a colour-mapped image; `false_alpha` tells that the band the
    file calls alpha is a picture, such as near infrared, so it says nothing of what is missing.
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
    false_alpha: bool = False

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
        raise unreadable(path, error) from error


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
        false_alpha=_has_false_alpha(path, dataset),
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


def _has_false_alpha(path: Path, dataset: Any) -> bool:
    """Whether the band marked alpha, as GDAL marks the fourth of four by default, is no mask.

    A mask is clear or opaque nearly everywhere; a picture holds every value between.
    """
    if ColorInterp.alpha not in dataset.colorinterp or dataset.count < 2:
        return False
    values = _sample(dataset, dataset.colorinterp.index(ColorInterp.alpha) + 1)
    partly = float(((values != 0) & (values != values.max())).mean())
    if partly <= MAX_PARTLY_CLEAR:
        return False
    log.info(
        "band marked alpha is no mask (%.0f %% of it is neither clear nor opaque); ignored: %s",
        100 * partly,
        path,
    )
    return True


def _sample(dataset: Any, band: int) -> NDArray[Any]:
    """Values (N,) of a band: all of a small one, else of windows spread evenly over it.

    A thinned read of a large file without overviews would unpack all of it.
    """
    if max(dataset.width, dataset.height) <= ALPHA_SAMPLE_PX:
        return np.asarray(dataset.read(band)).ravel()
    side = ALPHA_SAMPLE_PX // ALPHA_WINDOWS
    cols = np.linspace(0, max(0, dataset.width - side), ALPHA_WINDOWS).astype(int)
    rows = np.linspace(0, max(0, dataset.height - side), ALPHA_WINDOWS).astype(int)
    windows = [
        Window(col, row, min(side, dataset.width), min(side, dataset.height))
        for row in rows.tolist()
        for col in cols.tolist()
    ]
    return np.concatenate([dataset.read(band, window=window).ravel() for window in windows])


def _palette(dataset: Any) -> NDArray[np.uint8]:
    size = 256 if dataset.dtypes[0] == "uint8" else 65_536
    table = np.zeros((size, 3), dtype=np.uint8)
    for value, colour in dataset.colormap(1).items():
        if 0 <= value < size:
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
    if dataset.crs.is_geographic and max(-dataset.bounds.left, dataset.bounds.right) > 180 + 1e-6:
        raise ImageryError(
            "orthophoto in degrees lies beyond longitude 180, where GDAL reads one side only; "
            f"reproject it to metres, such as UTM (gdalwarp -t_srs EPSG:32760): {path}"
        )
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


def unreadable(path: Path, error: Exception) -> ImageryError:
    """What GDAL says of a file it cannot read, in one line."""
    reason = error.__cause__ or error  # rasterio says no more than "see previous exception"
    line = (str(reason).splitlines() or [type(reason).__name__])[0]
    return ImageryError(f"orthophoto cannot be read ({line}): {path}")
