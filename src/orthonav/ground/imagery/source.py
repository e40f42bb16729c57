"""Inspection of an orthophoto file: usability, georeference, and the bands that are used."""

import logging
import re
import threading
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import ImageryError
from orthonav.core.extras import missing_extra
from orthonav.core.files import require_file
from orthonav.core.geo.frames import LocalFrame

try:
    import rasterio
    from rasterio._err import CPLE_BaseError
    from rasterio.crs import CRS
    from rasterio.enums import ColorInterp, MaskFlags
    from rasterio.errors import NodataShadowWarning, NotGeoreferencedWarning, RasterioError
    from rasterio.transform import Affine
    from rasterio.warp import transform as transform_coordinates
    from rasterio.windows import Window
except ImportError as error:
    raise missing_extra("reading orthophotos", "geo", "rasterio", error) from error

OUTLINE_POINTS = 21
"""Per side, as rasterio's `transform_bounds` uses."""
ALPHA_SAMPLE_PX = 512
ALPHA_WINDOWS = 8
ALPHA_CHECKS = 16
"""Files of one kind that are checked; their producer writes all alike."""
MAX_PARTLY_CLEAR = 0.05
"""Largest fraction of partly transparent pixels of a mask: its resampled edges."""
HEIGHT_TYPES = ("float32", "float64", "int16", "int32")
MIN_SIDE_PX = 16
OPENED_AT_ONCE = 8
TERMS = {
    "attribution": ("ORTHONAV_ATTRIBUTION", "TIFFTAG_COPYRIGHT"),
    "licence": ("ORTHONAV_LICENCE",),
    "source": ("ORTHONAV_SOURCE",),
    "layer": ("ORTHONAV_LAYER",),
    "dates": ("ORTHONAV_DATES",),
}
"""Tags of a file that are copied into the map, by their key there."""
MAX_TERM = 300
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Source:
    path: Path
    name: str
    """What GDAL opens: the path, or a table in the file."""
    bands: tuple[int, ...]
    """Bands that are used, from 1: one for grey, three for red, green, blue."""
    dtype: str
    width_px: int
    height_px: int
    crs: str
    system: Any
    """Of rasterio."""
    is_named: bool
    """The system was taken from names because the file has none."""
    transform: Affine
    """From column, row to coordinates, of the raster or of a sidecar."""
    gsd_m: float
    """At the centre."""
    outline_latlon_deg: NDArray[np.float64]
    """The border (N, 2)."""
    date: str | None
    """Of acquisition, YYYY[-MM[-DD]]."""
    has_palette: bool = False
    marked_alpha: bool = False
    masks: tuple[str, ...] = ()
    """Bands that tell where it is valid, as GDAL's VRT names them; empty where it is everywhere."""
    other_masks: tuple[str, ...] = ()
    """The same where the alpha band is an image, such as near infrared."""
    folder: Path | None = None
    """Given by the user."""
    stamp: tuple[tuple[str, int, int], ...] = ()
    """Path, size and modification time in ns of its files."""
    terms: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def colours(self) -> int:
        return 3 if self.has_palette else len(self.bands)

    def describe(self) -> dict[str, Any]:
        return {
            "name": self.path.name,
            "date": self.date,
            "crs": self.crs[:200],
            "gsd_m": round(self.gsd_m, 4),
            "width_px": self.width_px,
            "height_px": self.height_px,
            "dtype": self.dtype,
            **self.terms,
        }


class UnfitError(ImageryError):
    """A raster that is not an orthophoto: a small image, heights, or not georeferenced."""


def open_sources(
    paths: Sequence[Path], folder: Path | None = None
) -> tuple[list[Source], list[str]]:
    """Inspect orthophotos, several at a time; a file may hold several.

    In a `folder` of the user, other rasters are left out, with a reason in the second list.
    """
    sources: list[Source] = []
    unfit: list[str] = []
    with quiet(), ThreadPoolExecutor(OPENED_AT_ONCE) as pool:
        found = [pool.submit(_opened, Path(path), folder) for path in paths]
        try:
            for each in found:
                try:
                    sources += each.result()
                except UnfitError as error:
                    if folder is None:
                        raise
                    unfit.append(str(error))
        finally:
            pool.shutdown(cancel_futures=True)
        sources = _without_false_alpha(sources)
    named = Counter(source.crs for source in sources if source.is_named)
    for system, count in named.items():
        log.warning("files have no coordinate system; taken from their names: %d %s", count, system)
    return sources, unfit


def _opened(path: Path, folder: Path | None) -> list[Source]:
    require_file(path, "orthophoto")
    try:
        with rasterio.open(path) as dataset:
            tables = list(dataset.subdatasets) if dataset.count == 0 else []
            if not tables:
                return [_inspect(path, dataset, folder)]
        found = []
        for table in tables:
            with rasterio.open(table) as dataset:
                found.append(_inspect(path, dataset, folder))
        return found
    except RasterioError as error:
        raise unreadable(path, error) from error


def _inspect(path: Path, dataset: Any, folder: Path | None) -> Source:
    names = _names_of(path, folder)
    if reason := unwarped(path, dataset):
        raise UnfitError(f"orthophoto {reason}: {path}")
    if folder is not None and dataset.crs is None and _transform(path, dataset).is_identity:
        raise UnfitError(f"raster has no georeference: {path}")
    system = _system(path, dataset, names)
    transform = _transform(path, dataset)
    if transform.is_identity or transform.determinant == 0:
        raise ImageryError(f"orthophoto has no georeference (geotransform or world file): {path}")
    if dataset.count < 1 or dataset.dtypes[0].startswith(("complex", "c")):
        raise ImageryError(f"orthophoto has no band of real numbers: {path}")
    if dataset.width < MIN_SIDE_PX or dataset.height < MIN_SIDE_PX:
        raise UnfitError(
            f"orthophoto is only {dataset.width} x {dataset.height} px, too small to use: {path}"
        )
    bands = _bands(dataset)
    if len(bands) == 1 and dataset.dtypes[0] in HEIGHT_TYPES:
        raise UnfitError(
            f"raster of one band of {dataset.dtypes[0]} may hold heights; an orthophoto has bands "
            f"of 8 or 16 bits without a sign: {path}"
        )
    outline, gsd_m = _outline(path, dataset, system, transform)
    masks, other_masks = _masks(dataset, bands)
    return Source(
        path=path,
        name=str(dataset.name),
        bands=bands,
        dtype=str(dataset.dtypes[bands[0] - 1]),
        width_px=dataset.width,
        height_px=dataset.height,
        crs=system.to_string(),
        system=system,
        is_named=dataset.crs is None or not (dataset.crs.is_projected or dataset.crs.is_geographic),
        transform=transform,
        gsd_m=gsd_m,
        outline_latlon_deg=outline,
        date=date_of(dataset.tags(), names),
        has_palette=dataset.colorinterp[0] == ColorInterp.palette,
        marked_alpha=ColorInterp.alpha in dataset.colorinterp and dataset.count > 1,
        masks=masks,
        other_masks=other_masks,
        folder=folder,
        stamp=_stamp(path, dataset),
        terms=_terms(dataset.tags()),
    )


def unwarped(path: Path, dataset: Any) -> str | None:
    """What georeferences a raster, if not by a geotransform, and how to warp it; else None."""
    points = len(dataset.gcps[0])
    if not _transform(path, dataset).is_identity or not (points or dataset.rpcs):
        return None
    found, option = ("rational polynomials", "-rpc")
    if points:
        found, option = f"{points} ground control points", "-tps"
    return (
        f"is georeferenced by {found} only; warp it to a grid first: gdalwarp {option} "
        f"'{path.name}' warped.tif"
    )


def _terms(tags: Mapping[str, str]) -> Mapping[str, str]:
    """As `orthonav fetch` writes them, else the copyright."""
    found = {}
    for key, names in TERMS.items():
        text = next((tags[name].strip() for name in names if tags.get(name, "").strip()), "")
        if text:
            found[key] = " ".join(text.split())[:MAX_TERM]
    return MappingProxyType(found)


def _names_of(path: Path, folder: Path | None) -> list[str]:
    """To search for metadata: the file's, then of the folders up to the given one."""
    names = [path.stem]
    if folder is not None:
        above = path.parent.resolve().relative_to(folder.resolve()).parts
        names += [*reversed(above), folder.resolve().name]
    return names


def _system(path: Path, dataset: Any, names: Sequence[str]) -> Any:
    if dataset.crs is not None and (dataset.crs.is_projected or dataset.crs.is_geographic):
        return dataset.crs
    named = system_of(names)
    if named is not None:
        return CRS.from_user_input(named)
    if dataset.crs is None:
        raise ImageryError(
            "orthophoto has no coordinate reference system; assign the correct one "
            f"(for example: gdal_edit.py -a_srs EPSG:2154 FILE): {path}"
        )
    return dataset.crs


def _transform(path: Path, dataset: Any) -> Affine:
    transform = dataset.transform
    if transform.is_identity:
        sidecar = tab_transform(path)
        transform = transform if sidecar is None else Affine(*sidecar)
    return transform


def _stamp(path: Path, dataset: Any) -> tuple[tuple[str, int, int], ...]:
    """Of the file, and of those that a VRT refers to."""
    files = [path, *(dataset.files if dataset.driver == "VRT" else ())]
    known = {str(Path(file).resolve()) for file in files}
    found = [(name, Path(name).stat()) for name in sorted(known) if Path(name).is_file()]
    return tuple((name, about.st_size, about.st_mtime_ns) for name, about in found)


def _bands(dataset: Any) -> tuple[int, ...]:
    by_colour = {
        colour: index for index, colour in reversed(list(enumerate(dataset.colorinterp, 1)))
    }
    wanted = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
    if all(colour in by_colour for colour in wanted):
        return tuple(by_colour[colour] for colour in wanted)
    colours = [i for i, colour in enumerate(dataset.colorinterp, 1) if colour != ColorInterp.alpha]
    return tuple(colours[:3]) if len(colours) >= 3 else tuple(colours[:1])


def _masks(dataset: Any, bands: tuple[int, ...]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """`Source.masks` and `Source.other_masks`."""
    flags = dataset.mask_flag_enums[bands[0] - 1]
    if MaskFlags.per_dataset in flags:
        masks = (f"mask,{bands[0]}",)
        return masks, () if MaskFlags.alpha in flags else masks
    others = () if MaskFlags.all_valid in flags else tuple(f"mask,{band}" for band in bands)
    if dataset.count == 4 and ColorInterp.alpha in dataset.colorinterp:  # beside a nodata value
        return (str(dataset.colorinterp.index(ColorInterp.alpha) + 1),), others
    return others, others


def _without_false_alpha(sources: list[Source]) -> list[Source]:
    """Without `masks` where these are an alpha band that is an image."""
    verdicts: dict[Any, list[bool]] = {}
    checked = []
    for source in sources:
        if source.marked_alpha:
            alike = (source.folder, source.path.parent, source.bands, source.dtype, source.crs)
            found = verdicts.setdefault(alike, [])
            if len(found) < ALPHA_CHECKS:
                found.append(_has_false_alpha(source))
            if found[-1] if len(found) < ALPHA_CHECKS else any(found):
                source = replace(source, masks=source.other_masks)
        checked.append(source)
    return checked


def _has_false_alpha(source: Source) -> bool:
    """GDAL marks the fourth of four bands by default; a mask has few values between its ends."""
    try:
        with rasterio.open(source.name) as dataset:
            values = _sample(dataset, dataset.colorinterp.index(ColorInterp.alpha) + 1)
    except RasterioError as error:
        raise unreadable(source.path, error) from error
    partly = float(((values != 0) & (values != values.max())).mean())
    if partly <= MAX_PARTLY_CLEAR:
        return False
    log.info(
        "alpha band is not a mask (%.0f %% of it is neither transparent nor opaque); ignored: %s",
        100 * partly,
        source.path,
    )
    return True


def _sample(dataset: Any, band: int) -> NDArray[Any]:
    """Values (N,) of a small band, else of windows: decimated reads may decode the whole file."""
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


def _outline(
    path: Path, dataset: Any, system: Any, transform: Affine
) -> tuple[NDArray[np.float64], float]:
    """The border (N, 2), degrees, and the ground resolution: root of the central pixel's area."""
    share = np.linspace(0, 1, OUTLINE_POINTS)
    zero, one = np.zeros(OUTLINE_POINTS), np.ones(OUTLINE_POINTS)
    middle_col, middle_row = dataset.width / 2, dataset.height / 2
    cols = np.concatenate([share, share, zero, one]) * dataset.width
    rows = np.concatenate([zero, one, share, share]) * dataset.height
    x, y = transform * (
        np.append(cols, middle_col + np.array([0, 1, 0])),
        np.append(rows, middle_row + np.array([0, 0, 1])),
    )
    try:
        lon, lat = transform_coordinates(system, "EPSG:4326", x, y)[:2]
    except CPLE_BaseError as error:  # a local or engineering system
        raise ImageryError(
            "orthophoto's coordinate system cannot be converted to latitude, longitude; assign the "
            f"correct one (for example: gdal_edit.py -a_srs EPSG:2154 FILE): {path}"
        ) from error
    latlon = np.stack([np.asarray(lat, dtype=float), np.asarray(lon, dtype=float)], axis=1)
    if not np.isfinite(latlon).all() or np.abs(latlon[:, 0]).max() > 90:
        raise ImageryError(
            "orthophoto's border cannot be converted to latitude, longitude: x of "
            f"{x.min():g} to {x.max():g} and y of {y.min():g} to {y.max():g} do not fit its "
            f"coordinate system; assign the correct one: {path}"
        )
    if system.is_geographic and max(-float(x.min()), float(x.max())) > 180 + 1e-6:
        raise ImageryError(
            "orthophoto in degrees lies beyond longitude 180, where GDAL reads one side only; "
            f"reproject it to metres, such as UTM (gdalwarp -t_srs EPSG:32760): {path}"
        )
    frame = LocalFrame(float(latlon[-3, 0]), float(latlon[-3, 1]))
    corner = frame.en_from_latlon(latlon[-3:, 0], latlon[-3:, 1])
    right, down = corner[1] - corner[0], corner[2] - corner[0]
    return latlon[:-3], float(np.sqrt(abs(right[0] * down[1] - right[1] * down[0])))


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress rasterio's warnings of cases that are checked or intended.

    Filters belong to the process: callers enter it in the main thread, elsewhere it does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        warnings.simplefilter("ignore", NodataShadowWarning)
        yield


def unreadable(path: Path, error: Exception) -> ImageryError:
    reason = error.__cause__ or error  # rasterio itself only says "see previous exception"
    line = (str(reason).splitlines() or [type(reason).__name__])[0]
    return ImageryError(f"orthophoto cannot be read ({line}): {path}")


_TAGS = ("TIFFTAG_DATETIME", "ACQUISITION_DATE", "ACQUISITIONDATE", "DATE")
_DATE = re.compile(  # not 2000x2000, nor 2000px
    r"(?<!\d)(?<!\dx)(19\d\d|20[0-3]\d)"
    r"(?:[-_]?(0[1-9]|1[0-2])(?:[-_]?(0[1-9]|[12]\d|3[01]))?)?"
    r"(?![\dx]|[-_ ]?px)",
    re.IGNORECASE,
)
_IGN_SYSTEMS = {
    "LAMB93": "EPSG:2154",
    "LA93": "EPSG:2154",
    "RGAF09UTM20": "EPSG:5490",
    "UTM22RGFG95": "EPSG:2972",
    "RGR92UTM40S": "EPSG:2975",
    "RGM04UTM38S": "EPSG:4471",
    "RGSPM06U21": "EPSG:4467",
}
"""In names of packages, folders and tiles of IGN (France)."""
_IGN_SYSTEM = re.compile(rf"(?<![A-Za-z0-9])({'|'.join(_IGN_SYSTEMS)})(?![A-Za-z0-9])")
_IGN_TILE = re.compile(r"^[0-9][0-9AB]{1,2}-((?:19|20)\d\d)-\d{4}-\d{4}-")
"""Of BD ORTHO: department, year, kilometres east and north, and more."""
_IGN_PACKAGE = re.compile(r"_D\d?\d[0-9AB](?:_|-)((?:19|20)\d\d)(?![0-9])")
_TAB_POINT = re.compile(
    r"\(\s*([-+.\deE]+)\s*,\s*([-+.\deE]+)\s*\)\s*\(\s*([-+.\deE]+)\s*,\s*([-+.\deE]+)\s*\)"
)
_MAX_TAB_BYTES = 100_000
MAX_TAB_OFF_PX = 0.2


def date_of(tags: dict[str, str], names: Iterable[str]) -> str | None:
    """YYYY[-MM[-DD]]; from IGN's names only the year, which numbers of other meaning follow."""
    tagged = [str(tags[tag]).replace(":", "-") for tag in _TAGS if tag in tags]
    for text in (*tagged, *names):
        if years := _IGN_TILE.search(text) or _IGN_PACKAGE.search(text):
            return years.group(1)
        if found := _DATE.search(text):
            return "-".join(part for part in found.groups() if part)
    return None


def system_of(names: Iterable[str]) -> str | None:
    found = next(filter(None, map(_IGN_SYSTEM.search, names)), None)
    return None if found is None else _IGN_SYSTEMS[found.group(1)]


def tab_transform(path: Path) -> tuple[float, ...] | None:
    """Geotransform a..f of MapInfo's sidecar, which GDAL reads for TIFF, but not for JPEG 2000."""
    for sidecar in (path.with_suffix(".tab"), path.with_suffix(".TAB")):
        if sidecar.is_file() and sidecar.stat().st_size <= _MAX_TAB_BYTES:
            return _affine(_TAB_POINT.findall(sidecar.read_text("latin-1")))
    return None


def _affine(points: list[tuple[str, str, str, str]]) -> tuple[float, ...] | None:
    """Least squares of control points x, y, column, row; None where they are not affine."""
    try:
        x, y, col, row = np.array(points, dtype=np.float64).reshape(-1, 4).T
    except ValueError:
        return None
    base = np.stack([col, row, np.ones_like(col)], axis=1)
    if len(points) < 3 or np.linalg.matrix_rank(base) < 3:
        return None
    solved = np.linalg.lstsq(base, np.stack([x, y], axis=1), rcond=None)[0]
    off = np.abs(base @ solved - np.stack([x, y], axis=1)).max()
    if off > MAX_TAB_OFF_PX * np.hypot(*solved[0]):
        return None
    return tuple(solved.T.ravel().tolist())
