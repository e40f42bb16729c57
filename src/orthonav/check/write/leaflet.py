"""Leaflet as text to put into a page: its script and style, the pictures inside."""

import base64
import importlib
import re
from dataclasses import dataclass
from pathlib import Path

from orthonav.errors import MissingExtraError
from orthonav.extras import missing_extra

_SCRIPT, _STYLE = "leaflet.js", "leaflet.css"
_PICTURE = re.compile(r"url\((images/[\w-]+\.png)\)")
_ELSEWHERE = re.compile(r"^//# sourceMappingURL=.*$", re.MULTILINE)
_VML = re.compile(r"behavior:\s*url\(#default#VML\);")  # for Internet Explorer 8


@dataclass(frozen=True)
class Leaflet:
    """Script and style, without a word that makes a browser ask for another file."""

    script: str
    style: str


def load_leaflet() -> Leaflet:
    """Leaflet as it is installed. Raises `MissingExtraError` where it is not."""
    try:
        folder = Path(importlib.import_module("xstatic.pkg.leaflet").BASE_DIR)
        script = (folder / _SCRIPT).read_text(encoding="utf-8")
        style = (folder / _STYLE).read_text(encoding="utf-8")
        style = _PICTURE.sub(lambda found: f"url({_address(folder / found[1])})", style)
    except (ImportError, AttributeError) as error:
        raise missing_extra("the page of a check", "web", "xstatic", error) from error
    except FileNotFoundError as error:
        raise MissingExtraError(
            f"the Leaflet that is installed lacks {Path(error.filename).name}: "
            "pip install -U 'orthonav[web]'"
        ) from error
    return Leaflet(_ELSEWHERE.sub("", script).strip(), _VML.sub("", style).strip())


def _address(path: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"
