"""The folder of a check: all of it or nothing, in place of an earlier check, never of others."""

import json
from pathlib import Path

from orthonav.check.outcome import CheckResult
from orthonav.check.write.figures import FIGURE_NAMES, figures
from orthonav.check.write.geopackage import write_geopackage
from orthonav.check.write.ground import ground_below, seen_box
from orthonav.check.write.leaflet import load_leaflet
from orthonav.check.write.page import render
from orthonav.check.write.plain import is_check, to_json
from orthonav.check.write.raster import tif_bytes
from orthonav.check.write.shapes import layers
from orthonav.check.write.styles import raster_style
from orthonav.errors import OutputError
from orthonav.extras import needed
from orthonav.files import replacing, replacing_folder, write_text
from orthonav.mapfile.reader import MapFile
from orthonav.report import write_figures
from orthonav.report.figures import FOLDER, LIST

PAGE, JSON, TIF, GPKG, STYLE = "index.html", "check.json", "check.tif", "check.gpkg", "check.qml"
_OPENED = ("check.tif.aux.xml", "check.gpkg-wal", "check.gpkg-shm", "check.gpkg-journal")
"""What GIS programs leave beside files that they open."""
_OURS = {
    *(PAGE, JSON, TIF, GPKG, STYLE, FOLDER, *_OPENED),
    *(f"{FOLDER}/{name}.{kind}" for name in FIGURE_NAMES for kind in ("svg", "png")),
    f"{FOLDER}/{LIST}",
}


def write_check(result: CheckResult, opened: MapFile, out: Path) -> Path:
    """Write the page, `check.json`, `check.tif`, `check.gpkg` and figures; return the page's path.

    `opened` is the map that was checked, whose imagery the page shows. The folder `out` appears
    whole or not at all; that of an earlier check is replaced. Raises `OutputError` where it holds
    anything else or cannot be written, `MissingExtraError` without the extras geo, report and web.
    """
    out = Path(out)
    require_free(out)
    leaflet = load_leaflet()
    ground = ground_below(opened, seen_box(result))
    drawn = figures(result, ground)
    page = render(result, ground, drawn, leaflet)
    with replacing_folder(out, is_ours=lambda folder: _foreign(folder) is None) as folder:
        write_text(folder / JSON, _writable(to_json(result)))
        with replacing(folder / TIF) as temporary:
            temporary.write_bytes(tif_bytes(result))
        write_text(folder / STYLE, raster_style())
        with replacing(folder / GPKG) as temporary:
            temporary.unlink()  # GDAL wants to make it
            write_geopackage(temporary, layers(result))
        write_figures(folder, drawn)
        write_text(folder / PAGE, _writable(page))
    return out / PAGE


def require_free(out: Path) -> None:
    """Raise what `write_check` would raise of the folder and of what is installed, beforehand."""
    out = Path(out)
    if out.is_dir():
        foreign = _foreign(out)
        if foreign is not None:
            raise OutputError(
                f"output folder holds something that no check wrote ({foreign}); move it away or "
                f"name another folder: {out}"
            )
    elif out.exists() or out.is_symlink():
        raise OutputError(f"output folder is a file: {out}")
    load_leaflet()
    for module in ("rasterio", "shapely", "pyogrio"):
        needed(module, "geo", "writing a check")
    needed("matplotlib", "report", "writing a check")


def _foreign(folder: Path) -> str | None:
    """A file of a folder that is not of a check; None where all are, or there is none."""
    try:
        found = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))
        odd = next((name for name in found if name not in _OURS), None)
        if odd is not None or not found:
            return odd
        links = (name for name in found if (folder / name).is_symlink())
        return next(links, None) or (None if _is_check(folder / JSON) else found[0])
    except OSError as error:
        raise OutputError(f"cannot look into ({error.strerror or error}): {folder}") from error


def _is_check(path: Path) -> bool:
    try:
        return is_check(json.loads(path.read_text(encoding="utf-8")))
    except (FileNotFoundError, ValueError, RecursionError):
        return False


def _writable(text: str) -> str:
    """Text without what no file can hold: halves of characters, from names that are not UTF-8."""
    return text.encode("utf-8", "replace").decode("utf-8")
