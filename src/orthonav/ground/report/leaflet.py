"""Leaflet, the map of interactive pages, as the Python package XStatic-Leaflet installs it."""

import importlib
import re
from dataclasses import dataclass
from pathlib import Path

from orthonav.core.errors import MissingExtraError
from orthonav.core.extras import missing_extra
from orthonav.ground.report.page import data_url

_IMAGE = re.compile(r"url\((images/[\w-]+\.png)\)")
_SOURCE_MAP = re.compile(r"^//# sourceMappingURL=.*$", re.MULTILINE)
_VML = re.compile(r"behavior:\s*url\(#default#VML\);")  # for Internet Explorer 8


@dataclass(frozen=True)
class Leaflet:
    """Script and style to put into a page; neither requests another file."""

    script: str
    style: str


def load_leaflet() -> Leaflet:
    """Leaflet with its images embedded. Raises as `leaflet_files` does."""
    script, style = leaflet_files("leaflet.js", "leaflet.css")
    css = style.read_text(encoding="utf-8")
    css = _IMAGE.sub(
        lambda found: f"url({data_url((style.parent / found[1]).read_bytes(), 'image/png')})", css
    )
    text = _SOURCE_MAP.sub("", script.read_text(encoding="utf-8")).strip()
    return Leaflet(text, _VML.sub("", css).strip())


def leaflet_files(*names: str) -> list[Path]:
    """Paths of files of Leaflet. Raises `MissingExtraError` where one is not installed."""
    try:
        folder = Path(importlib.import_module("xstatic.pkg.leaflet").BASE_DIR)
    except (ImportError, AttributeError) as error:
        raise missing_extra("the map of the page", "web", "xstatic", error) from error
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        raise MissingExtraError(
            f"the installed Leaflet lacks {missing[0]}: pip install -U 'orthonav[web]'"
        )
    return [folder / name for name in names]
