"""The static files of the page: ours, those shared with reports, and Leaflet."""

from dataclasses import dataclass
from importlib.resources import files
from pathlib import PurePath

from orthonav.ground.report.leaflet import leaflet_files

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".png": "image/png",
    ".svg": "image/svg+xml",
}
LEAFLET = (
    "leaflet.css",
    "leaflet-src.esm.js",
    "images/layers.png",
    "images/layers-2x.png",
    "images/marker-icon.png",
)
"""Files of Leaflet that the page may request."""
SHARED = ("chart.js", "format.js", "plane.js")
"""Scripts of `orthonav.ground.report` that the page uses."""


@dataclass(frozen=True)
class StaticFile:
    """A file of the page and its media type."""

    data: bytes
    media_type: str


def load_assets() -> dict[str, StaticFile]:
    """All files of the page by the path of their request, `/` for the page itself.

    Only these can be requested: no path is derived from what a browser sends. Raises
    `MissingExtraError` where Leaflet is not installed.
    """
    own = list(files("orthonav.ground.view").joinpath("static").iterdir())
    own += [files("orthonav.ground.report").joinpath("static", name) for name in SHARED]
    found = {
        f"/static/{entry.name}": _static_file(entry.read_bytes(), entry.name)
        for entry in own
        if entry.is_file() and PurePath(entry.name).suffix in _TYPES
    }
    found["/"] = found.pop("/static/index.html")
    for name, path in zip(LEAFLET, leaflet_files(*LEAFLET), strict=True):
        found[f"/leaflet/{name}"] = _static_file(path.read_bytes(), name)
    return found


def _static_file(data: bytes, name: str) -> StaticFile:
    return StaticFile(data, _TYPES[PurePath(name).suffix])
