"""The folder of a check: written whole or not at all; it replaces only an earlier check."""

import json
import math
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from orthonav.core.errors import OutputError
from orthonav.core.extras import needed
from orthonav.core.files import replacing, replacing_folder, write_text
from orthonav.core.mapfile.reader import MapFile
from orthonav.ground.check.outcome import CELL_VALUES, CheckResult
from orthonav.ground.check.write.figures import FIGURE_NAMES, figures, map_image, visible_box
from orthonav.ground.check.write.page import page_of
from orthonav.ground.check.write.plain import FORMAT, to_json
from orthonav.ground.check.write.shapes import to_geojson
from orthonav.ground.report import write_figures
from orthonav.ground.report.figures import FOLDER, LIST
from orthonav.ground.report.leaflet import leaflet_files, load_leaflet

PAGE, JSON, TIF, GEOJSON = "index.html", "check.json", "check.tif", "check.geojson"
_SIDECAR = "check.tif.aux.xml"
"""Written by GIS programs that open the raster."""
_OURS = {
    *(PAGE, JSON, TIF, GEOJSON, _SIDECAR, FOLDER, f"{FOLDER}/{LIST}"),
    *(f"{FOLDER}/{name}.{kind}" for name in FIGURE_NAMES for kind in ("svg", "png")),
}
_EXTRAS = {"rasterio": "geo", "shapely": "geo", "matplotlib": "report", "jinja2": "report"}


def write_check(result: CheckResult, opened: MapFile, out: Path) -> Path:
    """Write page, JSON, GeoTIFF, GeoJSON and figures into the folder `out`; return the page's path.

    `opened` is the checked map, whose imagery the page shows. The folder appears whole or not at
    all; that of an earlier check is replaced. Raises `OutputError` where it holds other files or
    cannot be written, `MissingExtraError` without the extras geo, report and web.
    """
    out = Path(out)
    require_free(out)
    leaflet = load_leaflet()
    image = map_image(opened, visible_box(result))
    drawn = figures(result, image)
    plain = _writable(to_json(result))
    page = page_of(result, image, drawn, leaflet, sha256(plain.encode()).hexdigest())
    with replacing_folder(out, is_ours=lambda folder: _foreign(folder) is None) as folder:
        for name, text in ((JSON, plain), (GEOJSON, to_geojson(result)), (PAGE, page)):
            write_text(folder / name, _writable(text))
        with replacing(folder / TIF) as temporary:
            temporary.write_bytes(tif_bytes(result))
        write_figures(folder, drawn)
    return out / PAGE


def require_free(out: Path) -> None:
    """Raise what `write_check` would raise about the folder and missing extras, before any work."""
    out = Path(out)
    if out.is_dir():
        foreign = _foreign(out)
        if foreign is not None:
            raise OutputError(
                f"output folder holds a file that no check wrote ({foreign}); move it away or "
                f"name another folder: {out}"
            )
    elif out.exists() or out.is_symlink():
        raise OutputError(f"output folder is a file: {out}")
    leaflet_files("leaflet.js", "leaflet.css")
    for module, extra in _EXTRAS.items():
        needed(module, extra, "writing a check")


def _foreign(folder: Path) -> str | None:
    """A file of a folder that is not part of a check; None for a check or an empty folder."""
    try:
        found = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))
        odd = next((name for name in found if name not in _OURS), None)
        if odd is not None or not found:
            return odd
        links = (name for name in found if (folder / name).is_symlink())
        if (link := next(links, None)) is not None:
            return link
        plain = json.loads((folder / JSON).read_text(encoding="utf-8"))
        return None if isinstance(plain, dict) and plain.get("format") == FORMAT else found[0]
    except (FileNotFoundError, ValueError, RecursionError):
        return found[0]
    except OSError as error:
        raise OutputError(f"cannot read folder ({error.strerror or error}): {folder}") from error


def _writable(text: str) -> str:
    """Text without lone surrogates, which come from file names that are not UTF-8."""
    return text.encode("utf-8", "replace").decode("utf-8")


def tif_bytes(result: CheckResult) -> bytes:
    """The file: float32, NaN where unknown, north up, conditions as tags.

    Made in memory (28 bytes per cell before compression), because GDAL does not report a full disk.
    """
    from rasterio import Affine
    from rasterio.io import MemoryFile

    cells = result.cells
    rows, cols = cells.probability.shape
    side = cells.side_m
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": cols,
        "height": rows,
        "count": len(CELL_VALUES),
        "dtype": "float32",
        "nodata": math.nan,
        "crs": result.frame.proj4,
        "transform": Affine(side, 0.0, cells.west_m, 0.0, -side, cells.north_m),
        "compress": "deflate",
        "predictor": 3,
        "interleave": "band",
    }
    with MemoryFile() as memory:
        with memory.open(**profile) as target:
            for number, (name, meaning) in enumerate(CELL_VALUES.items(), start=1):
                target.write(np.asarray(getattr(cells, name), dtype=np.float32), number)
                target.set_band_description(number, name)
                target.update_tags(number, meaning=meaning)
            target.update_tags(**_tags(result))
        return bytes(memory.read())


def _tags(result: CheckResult) -> dict[str, str]:
    """What was checked under which conditions; unknown values are left out."""
    tags = {"TIFFTAG_SOFTWARE": f"orthonav {result.about.version}".strip()}
    values = {
        "map": result.about.map_name,
        "imagery": result.about.imagery,
        "route": result.about.route_name,
        "verdict": result.verdict.word.value,
        **vars(result.conditions),
    }
    for name, value in values.items():
        if value not in (None, ""):
            text = value if isinstance(value, str) else f"{value:.9g}"
            tags[f"ORTHONAV_{name.upper()}"] = _writable(text)
    return tags
