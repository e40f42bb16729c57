"""BD ORTHO packages of a French department, from the download service of the Géoplateforme.

The service answers in Atom: pages of packages, and for each package its files with length and MD5
(in `content`). Files are downloaded by ranges into `NAME.part` and renamed once length and MD5 are
verified. They are split 7z archives, which 7-Zip unpacks (`7z x NAME.7z.001`).
"""

import hashlib
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote, urlsplit
from xml.etree.ElementTree import Element

from orthonav.core.errors import FetchError, OutputError
from orthonav.core.files import Progress
from orthonav.ground.fetch.client import Client
from orthonav.ground.fetch.documents import get_xml
from orthonav.ground.fetch.options import listed
from orthonav.ground.fetch.politeness import RequestLimits
from orthonav.ground.fetch.urls import joined, with_query

SERVICE = "https://data.geopf.fr/telechargement"
RESOURCE = "BDORTHO"
PAGE = 50
"""Packages per page, the most that the service returns."""
MAX_PAGES = 200
PART_BYTES = 16 * 2**20
"""Bytes per request: seconds on a usual line, so little is lost by an interrupt."""
LIMITS = RequestLimits(parallel=2, per_second=1.0, total_s=600.0)
"""One request a second: the service documents ten, and has refused more than one."""
ATTRIBUTION = "IGN, BD ORTHO; Licence Ouverte / Open Licence 2.0 (Etalab)"
_ATOM = "{http://www.w3.org/2005/Atom}"
_GPF = "{https://data.geopf.fr/annexes/ressources/xsd/gpf_dl.xsd}"
_NAME = re.compile(r"^[\w.-]{1,200}$")
_ASKED = re.compile(r"^(D?\d{2,3}|D?\d[AB]|D?0\d[AB]):(\d{4})(?::(RVB|IRC))?$", re.IGNORECASE)


@dataclass(frozen=True)
class Package:
    """A package: its name, address, zone such as D003, and date of edition."""

    name: str
    url: str
    zone: str
    date: str


@dataclass(frozen=True)
class PackageFile:
    """A file of a package; `size_bytes` and `md5` where the service states them."""

    name: str
    url: str
    size_bytes: int | None
    md5: str | None


def parse_package(text: str) -> tuple[str, str, str]:
    """Zone (D003), year and kind (RVB or IRC) of `D003:2013[:IRC]`. Raises `FetchError`."""
    found = _ASKED.match(text.strip())
    if not found:
        raise FetchError(f"a package is DEPARTMENT:YEAR[:IRC], such as D003:2013, got '{text}'")
    zone = found.group(1).upper().removeprefix("D").rjust(3, "0")
    return f"D{zone}", found.group(2), (found.group(3) or "RVB").upper()


def find_package(
    client: Client, zone: str, year: str, kind: str = "RVB", service: str = SERVICE
) -> Package:
    """The finest package of a department and year. Raises `FetchError` with the available years."""
    here = [
        package
        for package in _packages(client, zone, service)
        if package.zone == zone and f"_{kind}-" in package.name
    ]
    dated = [package for package in here if package.date.startswith(year)]
    if not dated:
        years = sorted({package.date[:4] for package in here})
        raise FetchError(f"no {kind} package of {zone} of {year}; available: {listed(years)}")
    newest_first = sorted(dated, key=lambda package: package.name, reverse=True)
    return min(newest_first, key=_centimetres)


def package_files(client: Client, package: Package) -> list[PackageFile]:
    """Files of a package, in order of their names. Raises `FetchError`."""
    files: dict[str, PackageFile] = {}
    for entry in _entries(client, package.url, {}):
        link = entry.find(f"{_ATOM}link")
        if link is None:
            continue
        url = joined(package.url, link.get("href", ""))
        name = unquote(urlsplit(url).path.rpartition("/")[2])
        if not _NAME.match(name) or name.startswith("."):
            raise FetchError(f"package names an unsafe file: {name[:100]!r}")
        length = link.get(f"{_GPF}length", "")
        md5 = (entry.findtext(f"{_ATOM}content") or "").strip().lower()
        files[name] = PackageFile(
            name,
            url,
            int(length) if length.isdecimal() else None,
            md5 if re.fullmatch(r"[0-9a-f]{32}", md5) else None,
        )
    archives = [file for file in files.values() if re.search(r"\.7z(\.\d{3})?$", file.name)]
    if not archives:
        raise FetchError(f"package has no archive: {package.url}")
    return sorted(archives, key=lambda file: file.name)


def download_package(
    client: Client, files: list[PackageFile], folder: Path, progress: Progress
) -> list[Path]:
    """Download what is missing of these files into `folder`; returns them in order.

    A complete file is not requested again; an incomplete one is resumed. Raises `FetchError`, and
    `OutputError` where the disk is too small or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the folder ({error.strerror}): {folder}") from error
    missing = [file for file in files if not (folder / file.name).is_file()]
    parts = [path for file in missing if (path := _part(folder, file)).is_file()]
    needed = sum(file.size_bytes or 0 for file in missing) - sum(p.stat().st_size for p in parts)
    if needed > shutil.disk_usage(folder).free:
        raise OutputError(f"disk is too small: {needed / 1e9:.1f} GB are needed: {folder}")
    for number, file in enumerate(files):

        def shown(share: float, number: int = number) -> None:
            progress("package", (number + share) / len(files))

        if file in missing:
            _download(client, file, folder, shown)
        shown(1.0)
    return [folder / file.name for file in files]


def _download(
    client: Client, file: PackageFile, folder: Path, progress: Callable[[float], None]
) -> None:
    part = _part(folder, file)
    size: int | None = file.size_bytes
    try:
        with part.open("ab") as stream:
            at = stream.tell()
            while size is None or at < size:
                data, size, _ = client.get_range(file.url, at, at + PART_BYTES)
                if file.size_bytes not in (None, size):
                    raise FetchError(f"file has {size} bytes, not {file.size_bytes}: {file.url}")
                stream.write(data)
                stream.flush()
                at += len(data)
                progress(at / size if size else 1.0)
        _check(file, part, size)
        part.replace(folder / file.name)
    except OSError as error:
        if isinstance(error, FetchError | OutputError):
            raise
        raise OutputError(f"cannot write ({error.strerror or error}): {part}") from error


def _check(file: PackageFile, part: Path, size: int | None) -> None:
    """Remove a file whose size or MD5 is wrong, and raise `FetchError`."""
    problem = ""
    if size is not None and part.stat().st_size != size:
        problem = f"has {part.stat().st_size} bytes instead of {size}"
    elif file.md5 is not None:
        with part.open("rb") as stream:
            found = hashlib.file_digest(
                stream, lambda: hashlib.md5(usedforsecurity=False)
            ).hexdigest()
        problem = "" if found == file.md5 else "has another MD5 than the service states"
    if problem:
        part.unlink()
        raise FetchError(f"file {problem}; it was removed, run the command again: {file.url}")


def _packages(client: Client, zone: str, service: str) -> list[Package]:
    found = []
    url = f"{service}/resource/{RESOURCE}"
    for entry in _entries(client, url, {"zone": zone}):
        name = (entry.findtext(f"{_ATOM}title") or "").strip()
        link, place = entry.find(f"{_ATOM}link"), entry.find(f"{_GPF}zone")
        date = (entry.findtext(f"{_GPF}editionDate") or "").strip()
        if link is None or not _NAME.match(name):
            continue
        term = place.get("term", "") if place is not None else ""
        found.append(Package(name, joined(url, link.get("href", "")), term, date))
    return found


def _entries(client: Client, url: str, parameters: dict[str, str]) -> list[Element]:
    """Entries of all pages of a feed. Raises `FetchError`."""
    found: list[Element] = []
    pages = number = 1
    while number <= pages:
        query = {**parameters, "page": str(number), "limit": str(PAGE)}
        _, feed = get_xml(client, with_query(url, query))
        count = feed.get(f"{_GPF}pagecount", "1")
        pages = int(count) if count.isdecimal() else 1
        if pages > MAX_PAGES:
            raise FetchError(f"feed has {pages} pages, more than are read: {url}")
        found += feed.findall(f"{_ATOM}entry")
        number += 1
    return found


def _centimetres(package: Package) -> int:
    """Pixel width in a name: 0M20 is 20 cm."""
    found = re.search(r"-(\d+)M(\d+)_", package.name)
    return int(found.group(1)) * 100 + int(found.group(2)) if found else 10**6


def _part(folder: Path, file: PackageFile) -> Path:
    return folder / f"{file.name}.part"
