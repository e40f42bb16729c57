"""Writes a check: a page, JSON, GeoTIFF, GeoJSON and figures in a folder of their own.

The folder is written whole or not at all; it replaces only an earlier check.
"""

import json
from hashlib import sha256
from pathlib import Path

from orthonav.core.errors import OutputError
from orthonav.core.extras import needed
from orthonav.core.files import replacing, replacing_folder, write_text
from orthonav.core.mapfile.reader import MapFile
from orthonav.ground.check.outcome import CheckResult
from orthonav.ground.check.write.figures import FIGURE_NAMES, check_figures, map_image, visible_box
from orthonav.ground.check.write.page import page_of
from orthonav.ground.check.write.plain import FORMAT, tif_bytes, to_geojson, to_json, writable
from orthonav.ground.report.page import FOLDER, LIST, leaflet_files, load_leaflet, write_figures

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

    Raises `OutputError` where the folder holds other files or cannot be written,
    `MissingExtraError` without the extras geo, report and web.
    """
    out = Path(out)
    require_free(out)
    image = map_image(opened, visible_box(result))
    drawn = check_figures(result, image)
    plain = writable(to_json(result))
    page = page_of(result, image, drawn, load_leaflet(), sha256(plain.encode()).hexdigest())
    with replacing_folder(out, is_ours=lambda folder: _foreign(folder) is None) as folder:
        for name, text in ((JSON, plain), (GEOJSON, to_geojson(result)), (PAGE, page)):
            write_text(folder / name, writable(text))
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
        odd = [name for name in found if name not in _OURS or (folder / name).is_symlink()]
        if odd or not found:
            return next(iter(odd), None)
        plain = json.loads((folder / JSON).read_text(encoding="utf-8"))
        return None if isinstance(plain, dict) and plain.get("format") == FORMAT else found[0]
    except (FileNotFoundError, ValueError, RecursionError):
        return found[0]
    except OSError as error:
        raise OutputError(f"cannot read folder ({error.strerror or error}): {folder}") from error
