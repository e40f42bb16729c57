"""The files of the page: ours, and those of Leaflet, which a Python package brings."""

import importlib
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path

from orthonav.errors import MissingExtraError
from orthonav.extras import missing_extra

_TYPES = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "png": "image/png",
    "svg": "image/svg+xml",
}
LEAFLET = (
    "leaflet.css",
    "leaflet-src.esm.js",
    "images/layers.png",
    "images/layers-2x.png",
    "images/marker-icon.png",
)
"""What of Leaflet the page may ask for."""


@dataclass(frozen=True)
class Asset:
    """A file of the page and its media type."""

    data: bytes
    media_type: str


def load_assets() -> dict[str, Asset]:
    """All files of the page by the path they are asked for with, `/` for the page itself.

    Only these can be asked for: no path is ever made of what a browser sends. Raises
    `MissingExtraError` where Leaflet is not installed.
    """
    ours = files("orthonav.web").joinpath("static")
    found = {f"/static/{entry.name}": _asset(entry) for entry in ours.iterdir() if _is_ours(entry)}
    found["/"] = found.pop("/static/index.html")
    leaflet = _leaflet()
    for name in LEAFLET:
        found[f"/leaflet/{name}"] = _asset(leaflet / name)
    return found


def _is_ours(entry: Traversable) -> bool:
    return entry.is_file() and entry.name.rpartition(".")[2] in _TYPES


def _asset(entry: Traversable) -> Asset:
    return Asset(entry.read_bytes(), _TYPES[entry.name.rpartition(".")[2]])


def _leaflet() -> Path:
    try:
        package = importlib.import_module("xstatic.pkg.leaflet")
        folder = Path(package.BASE_DIR)
    except (ImportError, AttributeError) as error:
        raise missing_extra("the page in the browser", "web", "xstatic", error) from error
    missing = [name for name in LEAFLET if not (folder / name).is_file()]
    if missing:
        raise MissingExtraError(
            f"the Leaflet that is installed lacks {missing[0]}: pip install -U 'orthonav[web]'"
        )
    return folder
