"""Figures of a report as files: SVG and PNG side by side in a folder of their own.

The folder keeps a list of what was written, with checksums as `sha256sum` writes them. A file is
ours while it is in the list as it is; all others are left alone, and never written over.
"""

import hashlib
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from orthonav.errors import OutputError
from orthonav.files import replacing, write_text
from orthonav.report.canvas import Drawing

FOLDER = "figures"
LIST = "orthonav.sha256"
"""Name of the list of what was written."""
_LONGEST_NAME = 80
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_LISTED = re.compile(r"([0-9a-f]{64})  ([A-Za-z0-9][A-Za-z0-9._-]*\.(?:png|svg))")


@dataclass(frozen=True)
class Figure:
    """A drawing and what is said of it.

    `name` is that of its files (letters, digits, dots and dashes), `alt` for who cannot see it.
    """

    name: str
    alt: str
    caption: str
    drawing: Drawing


def write_page(folder: Path, page: str, figures: Iterable[Figure]) -> Path:
    """Write `page` as `folder`/index.html, and figures as `write_figures` does; return its path.

    Raises as `write_figures` does, and then leaves page and figures as they were.
    """
    path = Path(folder) / "index.html"
    _write(path.parent / FOLDER, _contents(figures), {path: page.encode("utf-8", "replace")})
    return path


def write_figures(folder: Path, figures: Iterable[Figure]) -> list[Path]:
    """Write `NAME.svg` and `NAME.png` of each figure into `folder`/figures; return their paths.

    Figures that an earlier call left there and that are not among these are removed, no other
    files. Raises `ValueError` for names that are no file names or are given twice, `OutputError`
    where a name is taken by a file that is not ours, or where something cannot be written.
    """
    contents = _contents(figures)
    _write(Path(folder) / FOLDER, contents, {})
    return [Path(folder) / FOLDER / name for name in contents]


def _write(folder: Path, contents: Mapping[str, bytes], others: Mapping[Path, bytes]) -> None:
    """Figures into `folder`, `others` where they say; all are written before any is in place."""
    sums = {name: hashlib.sha256(data).hexdigest() for name, data in contents.items()}
    earlier = _listed(folder)
    _check_free(folder, sums, earlier)
    new = [(total, name) for name, total in sums.items()]
    with ExitStack() as stack:
        for path, data in (*((folder / n, d) for n, d in contents.items()), *others.items()):
            stack.enter_context(replacing(path)).write_bytes(data)
        # Old and new until all are in place: what is cut off leaves nothing that looks foreign.
        old = [(total, name) for name, totals in earlier.items() for total in totals]
        if old or new:
            _write_list(folder, [*old, *new])
    for name in earlier.keys() - sums.keys():
        if _is_ours(folder / name, earlier[name]):
            (folder / name).unlink(missing_ok=True)
    if old or new:
        _write_list(folder, new)


def file_names(texts: Sequence[str]) -> list[str]:
    """A name for files for each text: letters, digits, dots, underscores, single dashes.

    No two are alike, also where large and small letters are not told apart.
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
    """File name -> checksums, of what was written into `folder` before; empty where unknown."""
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
                "this file was changed, or not written by orthonav, and stands where a figure is "
                f"to go; move it away or name another folder: {path}"
            )


def _is_ours(path: Path, totals: Iterable[str]) -> bool:
    """Whether a file is as we wrote it."""
    try:
        plain = path.is_file() and not path.is_symlink()
        return plain and hashlib.sha256(path.read_bytes()).hexdigest() in totals
    except OSError:
        return False


def _write_list(folder: Path, lines: Iterable[tuple[str, str]]) -> None:
    unique = sorted({(name, total) for total, name in lines})
    write_text(folder / LIST, "".join(f"{total}  {name}\n" for name, total in unique))
