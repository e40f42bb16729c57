"""Inspection of an orthophoto file: usability, georeference, and the bands that are used."""

import logging
import math
import re
import sqlite3
import threading
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import ImageryError, MissingFileError
from orthonav.core.extras import missing_extra
from orthonav.core.files import require_file
from orthonav.core.flight.recording import chosen
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.planning.area import outline

try:
    import rasterio
    from rasterio.crs import CRS
    from rasterio.enums import ColorInterp, MaskFlags
    from rasterio.errors import (
        CRSError,
        NodataShadowWarning,
        NotGeoreferencedWarning,
        RasterioError,
    )
    from rasterio.transform import Affine
    from rasterio.windows import Window

    from orthonav.ground.imagery.systems import accuracy_of, converted
except ImportError as error:
    raise missing_extra("reading orthophotos", "geo", "rasterio", error) from error

GDAL_ERRORS = RasterioError, UnicodeDecodeError
"""Of damaged files; the last of names that are no text."""
MIN_VALUES = 16
"""In a grey picture; masks, classes and quality layers hold fewer."""
RASTERS = {".tif", ".tiff", ".jp2", ".j2k", ".vrt", ".mbtiles", ".gpkg", ".img"}
RASTERS |= {".png", ".jpg", ".jpeg", ".webp"}
log = logging.getLogger(__name__)


def _word(words: str) -> re.Pattern[str]:
    """One of some words in the name of a file."""
    return re.compile(rf"(?:^|[-_. ])({words})(?:[-_. ]|$)", re.IGNORECASE)


SMALL_PICTURE = _word(
    "(?:thumb(?:nail)?|quicklook|preview|browse|overview|assemblage|mask|msk|alpha)s?"
)
LAYER = _word(
    "hill-?shade|shaded[-_ ]?relief|aot|wvp|scl|fmask|udm2?|bqa|qa60|"
    "qa(?:[-_](?:pixel|radsat|aerosol))?"
)


@dataclass(frozen=True, eq=False)
class Source:
    path: Path
    bands: tuple[int, ...]  # that are used, from 1: one for grey, three for red, green, blue
    dtype: str
    width_px: int
    height_px: int
    crs: str
    system: Any  # of rasterio
    is_named: bool  # the system was taken from names or a .prj because the file has none
    transform: Affine  # from column, row to coordinates
    gsd_m: float  # at the centre
    outline_latlon_deg: NDArray[np.float64]  # the border (N, 2)
    date: str | None  # of acquisition, YYYY[-MM[-DD]]
    masks: tuple[str, ...] = ()
    """Bands that tell where it is valid, as GDAL's VRT names them; empty where it is everywhere."""
    is_indexed: bool = False
    """The only band holds numbers of colours, and is used for red, green and blue."""
    folder: Path | None = None  # given by the user
    stamp: tuple[tuple[str, int, int], ...] = ()  # path, size and time in ns of its files
    terms: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    accuracy_m: float | None = None
    caution: str = ""  # of its coordinate system, by `accuracy_of`

    def describe(self) -> dict[str, Any]:
        return {
            "name": self.path.name,
            "date": self.date,
            "crs": self.crs[:200],
            "gsd_m": round(self.gsd_m, 4),
            "width_px": self.width_px,
            "height_px": self.height_px,
            "dtype": self.dtype,
            **({"crs_accuracy_m": self.accuracy_m} if self.accuracy_m else {}),
            **self.terms,
        }


class UnfitError(ImageryError):
    """A raster that is not an orthophoto: heights, a photograph, or not georeferenced."""


class LayerError(UnfitError):
    """A mask or another layer, or a tile of one colour: left out of files given one by one too."""


def sources_in(folder: Path, bands: tuple[int, ...] | None = None) -> list[Source]:
    """The orthophotos of a folder, newest first, then the finest; other files are logged.

    `bands`: as of `open_sources`."""
    if not folder.is_dir():
        raise MissingFileError(f"folder of orthophotos does not exist: {folder}")
    paths = (path for path in folder.rglob("*") if path.is_file() and path.name[0] != ".")
    by_kind: dict[str, list[Path]] = {}
    for path in sorted(paths):
        kind = path.suffix.lower() or path.name
        if kind in RASTERS and SMALL_PICTURE.search(path.stem):
            kind = "thumbnails, overviews or masks, by their names"
        by_kind.setdefault(kind, []).append(path)
    if not RASTERS.isdisjoint(by_kind.keys() - {".vrt"}):
        skipped_vrts = by_kind.pop(".vrt", [])  # of the files that are there
        by_kind |= {"virtual rasters (.vrt)": skipped_vrts} if skipped_vrts else {}
    files = sorted(path for kind in RASTERS for path in by_kind.pop(kind, ()))
    sources = _first_of_each_place(open_sources(files, folder, bands), folder, bands is not None)
    seen = ", ".join(f"{len(others)} {kind}" for kind, others in by_kind.items()) or "nothing"
    if not sources:
        raise ImageryError(
            f"folder holds no usable orthophotos (unpack archives first); it holds {seen}: {folder}"
        )
    log.info("%d orthophotos; skipped %s: %s", len(sources), seen, folder)
    return sources


def name_bands(sources: Sequence[Source]) -> None:
    """Warn where grey files given one by one are of one place and date, as bands of a scene are."""
    for first, *others in _by_place(sources):
        if others and len(first.bands) == 1:
            names = [each.path.name for each in others]
            why = "of one place and date: they fill its holes only, and bands are not joined"
            log.warning("%s", chosen("imagery", first.path.name, names, why))


def _by_place(sources: Sequence[Source]) -> list[list[Source]]:
    places: dict[Any, list[Source]] = {}
    for each in sources:
        place = each.crs, each.transform, each.width_px, each.height_px, each.date
        places.setdefault(place, []).append(each)
    return list(places.values())


def _first_of_each_place(sources: Sequence[Source], folder: Path, asked: bool) -> list[Source]:
    """In the order of preference, of one place and date only the first, which is in colours."""
    said, places = [], _by_place(sorted(sources, key=_preference))
    for first, *others in places:  # neighbouring packages share tiles of one name
        names = [each.path.name for each in others if each.path.name != first.path.name]
        if names and len(first.bands) == 1 and not asked:
            raise ImageryError(
                f"{', '.join([first.path.name, *names])} are grey and of one place and date: give "
                "the one that shows the ground, or join the bands of a scene (gdalbuildvrt "
                f"-separate rgb.vrt RED GREEN BLUE, of Sentinel-2 B04 B03 B02): {folder}"
            )
        if names:
            said.append(chosen("imagery", first.path.name, names, "of one place and date"))
    if said:
        log.warning("%s (%d such places)", said[0], len(said))
    return [first for first, *_ in places]


def _preference(source: Source) -> tuple[object, ...]:
    date = tuple(-int(part) for part in (source.date or "0").split("-"))
    kind = round(source.gsd_m, 3), source.crs, source.dtype, source.bands, str(source.path)
    return date, -len(source.bands), *kind


def open_sources(
    paths: Sequence[Path], folder: Path | None = None, bands: tuple[int, ...] | None = None
) -> list[Source]:
    """Inspect orthophotos, several at a time; in a `folder` of the user, skip other rasters.

    `bands`: that are used, one or three, from 1; None: the colours, or the first."""
    with quiet(), ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda path: _opened(Path(path), folder, bands), paths))
    sources = [each for each in found if isinstance(each, Source)]
    unfit = [each for each in found if isinstance(each, UnfitError)]
    for each in unfit:
        log.info("skipped: %s", each)
    if unfit and not sources:
        several = f"{len(unfit)} rasters are no orthophotos; " if len(unfit) > 1 else ""
        raise ImageryError(f"{several}{unfit[0]}")
    if unfit:
        names = ", ".join(str(each).rpartition(": ")[2] for each in unfit[:5])
        log.warning("skipped %d rasters that are not orthophotos (-v: why): %s", len(unfit), names)
    named = Counter(source.crs for source in sources if source.is_named)
    for system, count in named.items():
        said = "files have no coordinate system; taken from their names or .prj: %d %s"
        log.warning(said, count, system)
    for caution in sorted({source.caution for source in sources} - {""}):
        log.warning("%s", caution)
    return sources


def _opened(
    path: Path, folder: Path | None, bands: tuple[int, ...] | None
) -> "Source | UnfitError":
    require_file(path, "orthophoto")
    try:
        with rasterio.open(path) as dataset:
            return _inspect(path, dataset, folder, bands)
    except UnfitError as error:
        if folder is None and not isinstance(error, LayerError):
            raise
        return error
    except GDAL_ERRORS as error:
        raise unreadable(path, error) from error


def _inspect(
    path: Path, dataset: Any, folder: Path | None, bands: tuple[int, ...] | None
) -> Source:
    if dataset.count < 1 or dataset.dtypes[0].startswith(("complex", "c")):
        raise ImageryError(f"orthophoto has no band of real numbers: {path}")
    names = _names_of(path, folder)
    if reason := unwarped(path, dataset):
        raise UnfitError(f"orthophoto {reason}: {path}")
    _require_picture(path, dataset)
    if folder is not None and dataset.crs is None and dataset.transform.is_identity:
        raise UnfitError(f"raster has no georeference: {path}")
    system = _system(path, dataset, names)
    if dataset.transform.is_identity or dataset.transform.determinant == 0:
        raise ImageryError(f"orthophoto has no georeference (geotransform or world file): {path}")
    asked = bands is not None
    if bands is None:
        bands = _bands(dataset)
    else:
        _check_bands(path, dataset, bands)
    alone = dataset.count == 1 or not asked
    signed = ("float32", "float64", "int16", "int32")
    if alone and len(bands) == 1 and dataset.dtypes[bands[0] - 1] in signed:
        raise UnfitError(
            f"raster of one band of {dataset.dtypes[0]} may hold heights; an orthophoto has bands "
            f"of 8 or 16 bits without a sign: {path}"
        )
    outline = outline_of(path, dataset, system)
    accuracy_m, caution = accuracy_of(system, outline, path)
    return Source(
        path=path,
        bands=bands,
        dtype=str(dataset.dtypes[bands[0] - 1]),
        width_px=dataset.width,
        height_px=dataset.height,
        crs=system.to_string(),
        system=system,
        is_named=dataset.crs is None or not (dataset.crs.is_projected or dataset.crs.is_geographic),
        transform=dataset.transform,
        gsd_m=ground_m(dataset, system),
        outline_latlon_deg=outline,
        date=date_of(dataset.tags(), names),
        masks=_masks(path, dataset, bands),
        is_indexed=not asked and _is_indexed(dataset),
        folder=folder,
        stamp=_stamp(path, dataset),
        terms=_terms(dataset.tags()),
        accuracy_m=accuracy_m,
        caution=caution,
    )


def system_beside(path: Path) -> Any:
    """Of a .prj beside a raster, else None."""
    beside = path.with_suffix(".prj")
    beside = beside if beside.is_file() else path.with_suffix(".PRJ")
    text = beside.read_text(errors="replace") if beside.is_file() else ""
    try:
        return CRS.from_wkt(text, morph_from_esri_dialect=True) if text else None
    except CRSError as error:
        raise UnfitError(
            f"coordinate system is not WKT as GDAL and ESRI write it: {beside}"
        ) from error


def _require_picture(path: Path, dataset: Any) -> None:
    """Raise `UnfitError` for photographs, and for layers of one band that show no ground."""
    if dataset.transform.is_identity and (
        dataset.tags().keys() & {"EXIF_Make", "EXIF_FocalLength", "EXIF_GPSLatitude"}
    ):
        raise UnfitError(
            f"this is a photograph: build the map from an orthophoto, and localize this: {path}"
        )
    if dataset.driver == "MBTiles" and _counts_from_north(path, dataset.tags()):
        raise ImageryError(
            "rows of the MBTiles count from the north (xyz), which GDAL takes as from the south: "
            f"convert it to scheme tms: {path}"
        )
    if dataset.count > 1 or _is_indexed(dataset):
        return
    values = np.unique(_sampled(dataset, 1, valid=True))
    if 0 < len(values) < MIN_VALUES:  # all windows may lie on water
        shape = min(dataset.height, 512), min(dataset.width, 512)
        values = np.unique(dataset.read(1, out_shape=shape, masked=True).compressed())
    named = LAYER.search(path.stem)
    if named or _are_codes(values):
        why = f"by its name ({named[1]})" if named else f"of {len(values)} values where sampled"
        raise LayerError(f"raster is a mask or another layer, not a picture, {why}: {path}")


def _are_codes(values: NDArray[Any]) -> bool:
    """Whether grey levels are those of a mask, of classes or of one colour, which compression makes
    up to three; haze and snow have few too, next to each other."""
    few = 0 < len(values) < MIN_VALUES
    alone = few and (len(values) <= 3 or float(values[-1]) < MIN_VALUES)
    return alone or (few and float(values[-1]) - float(values[0]) > 4 * len(values))


def _counts_from_north(path: Path, tags: Mapping[str, str]) -> bool:
    """Whether rows of an MBTiles do, by its scheme, or as only they then lie within its bounds."""
    if tags.get("scheme") == "xyz":
        return True
    try:
        _, south, _, north = map(float, tags["bounds"].split(","))
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as file:
            zoom, low, high = file.execute(
                "SELECT zoom_level, MIN(tile_row), MAX(tile_row) FROM tiles "
                "GROUP BY zoom_level ORDER BY zoom_level DESC LIMIT 1"
            ).fetchone()
    except (KeyError, ValueError, TypeError, sqlite3.Error):
        return False
    from_north = (1 - math.asinh(math.tan(math.radians((south + north) / 2))) / math.pi) / 2
    row = from_north * 2**zoom
    return not low <= 2**zoom - row <= high + 1 and low <= row <= high + 1


def unwarped(path: Path, dataset: Any) -> str | None:
    """What georeferences a raster, if not by a geotransform, and how to warp it; else None."""
    points = len(dataset.gcps[0])
    if not dataset.transform.is_identity or not (points or dataset.rpcs):
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
    keys = ("attribution", "licence", "source", "layer", "dates")
    found = {key: " ".join(tags.get(f"ORTHONAV_{key.upper()}", "").split()) for key in keys}
    found["attribution"] = found["attribution"] or " ".join(
        tags.get("TIFFTAG_COPYRIGHT", "").split()
    )
    return MappingProxyType({key: text[:300] for key, text in found.items() if text})


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
    named = system_beside(path) or system_of(names)
    if named is not None:
        return CRS.from_user_input(named)
    if dataset.crs is None:
        raise ImageryError(
            "orthophoto has no coordinate reference system; assign the correct one "
            f"(for example: gdal_edit.py -a_srs EPSG:2154 FILE): {path}"
        )
    return dataset.crs


def _stamp(path: Path, dataset: Any) -> tuple[tuple[str, int, int], ...]:
    """Of the file, and of those that a VRT refers to."""
    files = [path, *(dataset.files if dataset.driver == "VRT" else ())]
    known = {str(Path(file).resolve()) for file in files}
    found = [(name, Path(name).stat()) for name in sorted(known) if Path(name).is_file()]
    return tuple((name, about.st_size, about.st_mtime_ns) for name, about in found)


def _check_bands(path: Path, dataset: Any, bands: tuple[int, ...]) -> None:
    text = ", ".join(map(str, bands))
    if len(bands) not in (1, 3):
        raise ImageryError(f"bands of an orthophoto are one or three, not {text}")
    if not all(1 <= band <= dataset.count for band in bands):
        raise UnfitError(f"orthophoto has bands 1 to {dataset.count}, not {text}: {path}")
    if _is_indexed(dataset):
        raise ImageryError(f"band 1 holds numbers of colours: leave --bands out: {path}")


def _is_indexed(dataset: Any) -> bool:
    return bool(dataset.colorinterp[0] == ColorInterp.palette)


def _bands(dataset: Any) -> tuple[int, ...]:
    if _is_indexed(dataset):
        return 1, 1, 1
    by_colour = {
        colour: index for index, colour in reversed(list(enumerate(dataset.colorinterp, 1)))
    }
    wanted = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
    if all(colour in by_colour for colour in wanted):
        return tuple(by_colour[colour] for colour in wanted)
    colours = [i for i, colour in enumerate(dataset.colorinterp, 1) if colour != ColorInterp.alpha]
    return tuple(colours[:3]) if len(colours) >= 3 else tuple(colours[:1])


def _masks(path: Path, dataset: Any, bands: tuple[int, ...]) -> tuple[str, ...]:
    """`Source.masks`; an alpha band that is an image, such as near infrared, is none."""
    flags = dataset.mask_flag_enums[bands[0] - 1]
    has_alpha = ColorInterp.alpha in dataset.colorinterp and dataset.count > 1
    is_image = has_alpha and not _is_mask(path, dataset)
    if MaskFlags.per_dataset in flags and not (is_image and MaskFlags.alpha in flags):
        return (f"mask,{bands[0]}",)
    if has_alpha and not is_image and dataset.count == 4:  # beside a nodata value
        return (str(dataset.colorinterp.index(ColorInterp.alpha) + 1),)
    if MaskFlags.all_valid in flags or MaskFlags.alpha in flags:
        clear = _is_indexed(dataset) and any(not each[3] for each in dataset.colormap(1).values())
        return ("1",) if clear else ()
    return tuple(f"mask,{band}" for band in bands)


def _sampled(dataset: Any, band: int, *, valid: bool = False) -> NDArray[Any]:
    """Values in windows all over a file: decimated reads may decode the whole file."""
    side = 64
    cols = np.linspace(0, max(0, dataset.width - side), 4).astype(int).tolist()
    rows = np.linspace(0, max(0, dataset.height - side), 4).astype(int).tolist()
    windows = [
        Window(col, row, min(side, dataset.width), min(side, dataset.height))
        for row in rows
        for col in cols
    ]
    parts = (dataset.read(band, window=each, masked=valid) for each in windows)
    return np.concatenate([each.compressed() if valid else each.ravel() for each in parts])


def _is_mask(path: Path, dataset: Any) -> bool:
    """GDAL marks the fourth of four bands by default; a mask has few values between its ends, those
    of resampled edges."""
    values = _sampled(dataset, dataset.colorinterp.index(ColorInterp.alpha) + 1)
    partly = float(((values != 0) & (values != values.max())).mean())
    if partly <= 0.05:
        return True
    log.info(
        "alpha band is not a mask (%.0f %% of it is neither transparent nor opaque); ignored: %s",
        100 * partly,
        path,
    )
    return False


def outline_of(path: Path, dataset: Any, system: Any) -> NDArray[np.float64]:
    """The border (N, 2), degrees."""
    box = 0, 0, dataset.width, dataset.height
    x, y = dataset.transform * outline(box, 20).T  # as many as rasterio's `transform_bounds`
    latlon = np.stack(converted(system, "EPSG:4326", x, y)[::-1], axis=1)
    if not np.isfinite(latlon).all() or np.abs(latlon[:, 0]).max() > 90:
        raise ImageryError(
            "orthophoto's border cannot be converted to latitude, longitude: x of "
            f"{x.min():g} to {x.max():g} and y of {y.min():g} to {y.max():g} do not fit its "
            "coordinate system; assign the correct one (for example: gdal_edit.py -a_srs EPSG:2154 "
            f"FILE): {path}"
        )
    if system.is_geographic and max(-float(x.min()), float(x.max())) > 180 + 1e-6:
        raise ImageryError(
            "orthophoto in degrees lies beyond longitude 180, where GDAL reads one side only; "
            f"reproject it to metres, such as UTM (gdalwarp -t_srs EPSG:32760): {path}"
        )
    return latlon


def ground_m(dataset: Any, system: Any) -> float:
    """The ground resolution, m: root of the area of the central pixel."""
    col = dataset.width / 2 + np.array([0, 1, 0])
    row = dataset.height / 2 + np.array([0, 0, 1])
    lon, lat = converted(system, "EPSG:4326", *(dataset.transform * (col, row)))
    corner = LocalFrame(float(lat[0]), float(lon[0])).en_from_latlon(lat, lon)
    right, down = corner[1] - corner[0], corner[2] - corner[0]
    return float(np.sqrt(abs(right[0] * down[1] - right[1] * down[0])))


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
        warnings.filterwarnings("ignore", "Best transformation is not available")
        yield


def unreadable(path: Path, error: Exception, what: str = "orthophoto") -> ImageryError:
    reason = error.__cause__ or error  # rasterio itself only says "see previous exception"
    line = (str(reason).splitlines() or [type(reason).__name__])[0]
    return ImageryError(f"{what} cannot be read ({line}): {path}")


DATE = re.compile(  # not 2000x2000, nor 2000px
    r"(?<!\d)(?<!\dx)(19\d\d|20[0-3]\d)"
    r"(?:[-_]?(0[1-9]|1[0-2])(?:[-_]?(0[1-9]|[12]\d|3[01]))?)?"
    r"(?![\dx]|[-_ ]?px)",
    re.IGNORECASE,
)
IGN_DATE = re.compile(
    # A tile of BD ORTHO: department, year, kilometres east and north, ..; a package of it.
    r"^[0-9][0-9AB]{1,2}-((?:19|20)\d\d)-\d{4}-\d{4}-|_D\d?\d[0-9AB](?:_|-)((?:19|20)\d\d)(?![0-9])"
)
IGN_SYSTEMS = {
    "LAMB93": "EPSG:2154",
    "LA93": "EPSG:2154",
    "RGAF09UTM20": "EPSG:5490",
    "UTM22RGFG95": "EPSG:2972",
    "RGR92UTM40S": "EPSG:2975",
    "RGM04UTM38S": "EPSG:4471",
    "RGSPM06U21": "EPSG:4467",
}
"""In names of packages, folders and tiles of IGN (France)."""


def date_of(tags: dict[str, str], names: Iterable[str]) -> str | None:
    """YYYY[-MM[-DD]]; from IGN's names only the year, which numbers of other meaning follow."""
    known = ("TIFFTAG_DATETIME", "ACQUISITION_DATE", "ACQUISITIONDATE", "DATE")
    tagged = [str(tags[tag]).replace(":", "-") for tag in known if tag in tags]
    for text in (*tagged, *names):
        if year := IGN_DATE.search(text):
            return year.group(1) or year.group(2)
        if found := DATE.search(text):
            return "-".join(part for part in found.groups() if part)
    return None


def system_of(names: Iterable[str]) -> str | None:
    """The coordinate system that a name of IGN states."""
    named = re.compile(rf"(?<![A-Za-z0-9])({'|'.join(IGN_SYSTEMS)})(?![A-Za-z0-9])")
    found = next(filter(None, map(named.search, names)), None)
    return None if found is None else IGN_SYSTEMS[found.group(1)]
