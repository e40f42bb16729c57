"""Self-contained HTML pages from Jinja2 templates, and their figures as files beside them.

A page extends `base.html` and uses `macros.html`, both in `templates`; it loads nothing from
outside. Everything that a template is given is escaped. The folder of the figures is written whole,
with a list of checksums as `sha256sum` writes it: files that the list does not name are not ours.
"""

import base64
import hashlib
import importlib
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from orthonav.core.errors import MissingExtraError
from orthonav.core.extras import missing_extra
from orthonav.core.files import replacing, replacing_folder, write_text
from orthonav.ground.report.drawing import Drawing

LIST = "orthonav.sha256"


@dataclass(frozen=True)
class Figure:
    """A drawing with the name of its files, a description for screen readers and a caption."""

    name: str
    alt: str
    caption: str
    drawing: Drawing

    @property
    def size_px(self) -> tuple[int, int]:
        """Of text of 10 points, which becomes 15 pixels high."""
        width, height = (round(110 * side) for side in self.drawing.size_in)
        return width, height

    @property
    def data_url(self) -> str:
        """The SVG; in dark mode lightness is inverted, imagery only darkened."""
        dark = """
@media (prefers-color-scheme: dark) {
#figure_1 { filter: invert(1) hue-rotate(180deg) }
[clip-path] > image { filter: brightness(.45) invert(1) } }
"""
        svg = self.drawing.svg.replace("</style>", f"{dark}</style>", 1)
        return data_url(svg.encode("utf-8"), "image/svg+xml")


def render(
    package: str,
    template: str,
    values: Mapping[str, Any],
    *,
    style: str = "",
    scripts: Sequence[str] = (),
) -> str:
    """The page of `template`, in the folder `templates` of `package`.

    `values` must hold `title` and `kind` (of page). `style` is added to the style of reports and
    `scripts` run at the end of the page; a Content-Security-Policy allows these and no others.
    Raises `MissingExtraError` without Jinja2.
    """
    try:
        from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
    except ImportError as error:
        raise missing_extra("writing a page", "report", "jinja2", error) from error
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader("orthonav.ground.report")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    style = static_text("report.css") + style
    allowed = " ".join(map(_source, scripts)) or "'none'"
    policy = (
        f"default-src 'none'; img-src data:; style-src {_source(style)}; script-src {allowed}; "
        "base-uri 'none'; form-action 'none'"
    )
    own = {"style": style, "scripts": scripts, "policy": policy}
    return environment.get_template(template).render({**values, **own})


def write_page(folder: Path, page: str, figures: Iterable[Figure]) -> Path:
    """Write `page` as `folder`/index.html with its figures, or leave the page as it was."""
    path = Path(folder) / "index.html"
    with replacing(path) as temporary:
        temporary.write_bytes(page.encode("utf-8", "replace"))
        write_figures(path.parent, figures)
    return path


def write_figures(folder: Path, figures: Iterable[Figure]) -> None:
    """Write `NAME.svg` and `NAME.png` of each figure into `folder`/figures, whole or not at all.

    Replaces what an earlier call wrote. Raises `OutputError` where the folder holds other or
    changed files, or cannot be written.
    """
    lines = []
    with replacing_folder(Path(folder) / "figures", _is_ours) as made:
        for figure in figures:
            svg = figure.drawing.svg.encode("utf-8")
            for kind, data in (("svg", svg), ("png", figure.drawing.png)):
                (made / f"{figure.name}.{kind}").write_bytes(data)
                lines.append(f"{hashlib.sha256(data).hexdigest()}  {figure.name}.{kind}\n")
        write_text(made / LIST, "".join(lines))


def _is_ours(folder: Path) -> bool:
    try:
        listed = (folder / LIST).read_text(encoding="utf-8", errors="replace").splitlines()
        found = [path for path in folder.iterdir() if path.name != LIST]
        return all(
            path.is_file()
            and not path.is_symlink()
            and f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}" in listed
            for path in found
        )
    except OSError:
        return False


def file_names(texts: Sequence[str]) -> list[str]:
    """A name for files for each text: letters, digits, dots, underscores, single dashes.

    No two are equal, also on file systems that ignore case.
    """
    names: list[str] = []
    taken: set[str] = set()
    for text in texts:
        plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode("ascii")
        plain = re.sub(r"-+", "-", re.sub(r"[^A-Za-z0-9._]+", "-", plain))
        base = plain[:80].strip("-._") or "flight"
        name, count = base, 1
        while name.lower() in taken:
            count += 1
            name = f"{base}-{count}"
        taken.add(name.lower())
        names.append(name)
    return names


def static_text(name: str, package: str = "orthonav.ground.report") -> str:
    return files(package).joinpath("static", name).read_text(encoding="utf-8")


def joined_scripts(shared: Sequence[str], package: str, own: Sequence[str]) -> str:
    """ES modules of `orthonav.ground.report` and scripts of `package` as one script for a page.

    A page that is opened from a disk cannot import modules, so `export` and `import` are removed.
    """
    texts = [static_text(name) for name in shared] + [static_text(name, package) for name in own]
    plain = re.sub(r"^(?:export |import .*$)", "", "".join(texts), flags=re.MULTILINE)
    return f'(() => {{\n"use strict";\n{plain}}})();'


def data_url(data: bytes, media_type: str) -> str:
    return f"data:{media_type};base64,{base64.b64encode(data).decode('ascii')}"


def _source(text: str) -> str:
    digest = hashlib.sha256(text.encode("utf-8", "replace")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def load_leaflet() -> tuple[str, str]:
    """Script and style sheet, images included, without their source map and the rules for Internet
    Explorer 8."""
    script, style = leaflet_files("leaflet.js", "leaflet.css")
    css = re.sub(
        r"url\((images/[\w-]+\.png)\)",
        lambda found: f"url({data_url((style.parent / found[1]).read_bytes(), 'image/png')})",
        style.read_text(encoding="utf-8"),
    )
    text = script.read_text(encoding="utf-8").partition("//# sourceMappingURL")[0]
    return text.strip(), re.sub(r"behavior:\s*url\(#default#VML\);", "", css).strip()


def leaflet_files(*names: str) -> list[Path]:
    """Paths of files of Leaflet, as the package XStatic-Leaflet installs them.

    Raises `MissingExtraError` where one is not installed.
    """
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
