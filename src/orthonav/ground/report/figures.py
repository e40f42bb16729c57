"""Figures of a report as files: SVG and PNG side by side in a folder of their own.

The folder holds a list of written files with checksums in the format of `sha256sum`. Files that
match the list may be replaced; all others are neither changed nor removed.
"""

import hashlib
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

from orthonav.core.errors import OutputError
from orthonav.core.files import replacing, write_text
from orthonav.ground.report.canvas import Drawing
from orthonav.ground.report.page import data_url

FOLDER = "figures"
LIST = "orthonav.sha256"
"""Name of the list of written files."""
_LONGEST_NAME = 80
_PX_PER_IN = 110
"""Pixels of a page per inch of a drawing: text of 10 points becomes 15 pixels high."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_LISTED = re.compile(r"([0-9a-f]{64})  ([A-Za-z0-9][A-Za-z0-9._-]*\.(?:png|svg))")


@dataclass(frozen=True)
class Figure:
    """A drawing with its texts.

    `name`: of its files (letters, digits, dots, underscores, dashes).
    `alt`: description for screen readers; `caption`: text below it.
    """

    name: str
    alt: str
    caption: str
    drawing: Drawing

    @property
    def width_px(self) -> int:
        """Width in a page."""
        return round(self.drawing.size_in[0] * _PX_PER_IN)

    @property
    def height_px(self) -> int:
        """Height in a page."""
        return round(self.drawing.size_in[1] * _PX_PER_IN)

    @property
    def data_url(self) -> str:
        """The PNG as an address that needs no file."""
        return data_url(self.drawing.png, "image/png")


def write_page(folder: Path, page: str, figures: Iterable[Figure]) -> Path:
    """Write `page` as `folder`/index.html, and figures as `write_figures` does; return its path.

    Raises as `write_figures` does, and then leaves page and figures as they were.
    """
    path = Path(folder) / "index.html"
    _write(path.parent / FOLDER, _contents(figures), {path: page.encode("utf-8", "replace")})
    return path


def write_figures(folder: Path, figures: Iterable[Figure]) -> list[Path]:
    """Write `NAME.svg` and `NAME.png` of each figure into `folder`/figures; return their paths.

    Figures of an earlier call that are not among these are removed; other files are not touched.
    Raises `ValueError` for names that are not plain file names or not unique, `OutputError` where a
    name is taken by a file of somebody else, or where a file cannot be written.
    """
    contents = _contents(figures)
    _write(Path(folder) / FOLDER, contents, {})
    return [Path(folder) / FOLDER / name for name in contents]


def _write(folder: Path, contents: Mapping[str, bytes], others: Mapping[Path, bytes]) -> None:
    """Write figures into `folder` and `others`; all are written before any is renamed."""
    sums = {name: hashlib.sha256(data).hexdigest() for name, data in contents.items()}
    earlier = _listed(folder)
    _check_free(folder, sums, earlier)
    new = [(total, name) for name, total in sums.items()]
    with ExitStack() as stack:
        for path, data in (*((folder / n, d) for n, d in contents.items()), *others.items()):
            stack.enter_context(replacing(path)).write_bytes(data)
        # Old and new names until all are in place: an interrupted call leaves nothing unlisted.
        old = [(total, name) for name, totals in earlier.items() for total in totals]
        if old or new:
            _write_list(folder, [*old, *new])
    for name in earlier.keys() - sums.keys():
        if _is_ours(folder / name, earlier[name]):
            (folder / name).unlink(missing_ok=True)
    if old or new:
        with suppress(OutputError):  # all is in place, and the list names more than that
            _write_list(folder, new)


def file_names(texts: Sequence[str]) -> list[str]:
    """A name for files for each text: letters, digits, dots, underscores, single dashes.

    No two are equal, also on file systems that ignore case.
    """
    names: list[str] = []
    taken: set[str] = set()
    for text in texts:
        plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode("ascii")
        plain = re.sub(r"-+", "-", re.sub(r"[^A-Za-z0-9._]+", "-", plain))
        base = plain[:_LONGEST_NAME].strip("-._") or "flight"
        name, count = base, 1
        while name.lower() in taken:
            count += 1
            name = f"{base}-{count}"
        taken.add(name.lower())
        names.append(name)
    return names


def _contents(figures: Iterable[Figure]) -> dict[str, bytes]:
    """File name -> bytes, of all figures."""
    contents: dict[str, bytes] = {}
    taken: set[str] = set()
    for figure in figures:
        if not _NAME.fullmatch(figure.name):
            raise ValueError(f"a figure needs a plain file name, got {figure.name!r}")
        if figure.name.lower() in taken:
            raise ValueError(f"two figures have the same name: {figure.name!r}")
        taken.add(figure.name.lower())
        contents[f"{figure.name}.svg"] = figure.drawing.svg.encode("utf-8")
        contents[f"{figure.name}.png"] = figure.drawing.png
    return contents


def _listed(folder: Path) -> dict[str, set[str]]:
    """File name -> checksums of earlier figures in `folder`; empty where unknown."""
    try:
        text = (folder / LIST).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return {}
    found: dict[str, set[str]] = {}
    for line in text.splitlines():
        if match := _LISTED.fullmatch(line):
            found.setdefault(match[2], set()).add(match[1])
    return found


def _check_free(folder: Path, sums: Mapping[str, str], earlier: Mapping[str, set[str]]) -> None:
    for name, total in sums.items():
        path = folder / name
        if (path.exists() or path.is_symlink()) and not _is_ours(
            path, {total, *earlier.get(name, ())}
        ):
            raise OutputError(
                "a figure would overwrite a file that orthonav did not write or that was changed; "
                f"move it or name another folder: {path}"
            )


def _is_ours(path: Path, totals: Iterable[str]) -> bool:
    """Whether a file is unchanged since we wrote it."""
    try:
        plain = path.is_file() and not path.is_symlink()
        return plain and hashlib.sha256(path.read_bytes()).hexdigest() in totals
    except OSError:
        return False


def _write_list(folder: Path, lines: Iterable[tuple[str, str]]) -> None:
    unique = sorted({(name, total) for total, name in lines})
    write_text(folder / LIST, "".join(f"{total}  {name}\n" for name, total in unique))
