"""BD ORTHO packages of a French department, from the download service of the Géoplateforme.

The service answers in Atom: pages of packages, and for each package its files with length and MD5
(in `content`). Files are downloaded into `NAME.part` and renamed once length and MD5 are verified.
They are split 7z archives, which 7-Zip unpacks (`7z x NAME.7z.001`).
"""

import hashlib
import re
import shutil
from functools import partial
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote, urlsplit
from xml.etree.ElementTree import Element

from orthonav.core.errors import FetchError, OutputError
from orthonav.core.files import Progress
from orthonav.ground.fetch.options import listed
from orthonav.ground.fetch.urls import linked, with_query
from orthonav.ground.fetch.web import Web

SERVICE = "https://data.geopf.fr/telechargement"
PAGE = 50  # packages per page, the most that the service returns
MAX_PAGES = 200
ATTRIBUTION = "IGN, BD ORTHO; Licence Ouverte / Open Licence 2.0 (Etalab)"
_ASKED = re.compile(r"^(D?\d{2,3}|D?\d[AB]|D?0\d[AB]):(\d{4})(?::(RVB|IRC))?$", re.IGNORECASE)


class Package(NamedTuple):
    """A package: its name, address, and date of edition."""

    name: str
    url: str
    date: str


class PackageFile(NamedTuple):
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
    web: Web, zone: str, year: str, kind: str = "RVB", service: str = SERVICE
) -> Package:
    """The finest package of a department and year. Raises `FetchError` with the available years."""
    url = f"{service}/resource/BDORTHO"
    here = []
    for entry in _entries(web, url, {"zone": zone}):
        name, link, place = entry.findtext("title", ""), entry.find("link"), entry.find("zone")
        term = place.get("term") if place is not None else None
        if term == zone and f"_{kind}-" in name and link is not None:
            date = entry.findtext("editionDate", "").strip()
            here.append(Package(name.strip(), linked(url, link.get("href", "")), date))
    dated = [package for package in here if package.date.startswith(year)]
    if not dated:
        years = sorted({package.date[:4] for package in here})
        raise FetchError(f"no {kind} package of {zone} of {year}; available: {listed(years)}")

    def centimetres(package: Package) -> int:  # 0M20 is 20 cm
        found = re.search(r"-(\d+)M(\d+)_", package.name)
        return int(found.group(1)) * 100 + int(found.group(2)) if found else 10**6

    return min(sorted(dated, reverse=True), key=centimetres)


def package_files(web: Web, package: Package) -> list[PackageFile]:
    """Files of a package, in order of their names. Raises `FetchError`."""
    files = []
    for entry in _entries(web, package.url, {}):
        link = entry.find("link")
        if link is None:
            continue
        url = linked(package.url, link.get("href", ""))
        name = unquote(urlsplit(url).path.rpartition("/")[2])
        if not re.fullmatch(r"\w[\w.-]{,199}", name):
            raise FetchError(f"package names an unsafe file: {name[:100]!r}")
        length, md5 = link.get("length", ""), entry.findtext("content", "").strip().lower()
        if re.search(r"\.7z(\.\d{3})?$", name):
            size = int(length) if length.isdecimal() else None
            files.append(PackageFile(name, url, size, md5 if len(md5) == 32 else None))
    if not files:
        raise FetchError(f"package has no archive: {package.url}")
    return sorted(files)


def download_package(
    web: Web, files: list[PackageFile], folder: Path, progress: Progress
) -> list[Path]:
    """Download what is missing of these files into `folder`; returns them in order.

    A complete file is not requested again. Raises `FetchError`, and `OutputError` where the disk
    is too small or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the folder ({error.strerror}): {folder}") from error
    missing = [file for file in files if not (folder / file.name).is_file()]
    needed = sum(file.size_bytes or 0 for file in missing)
    if needed > shutil.disk_usage(folder).free:
        raise OutputError(f"disk is too small: {needed / 1e9:.1f} GB are needed: {folder}")
    for number, file in enumerate(files):

        def received(size: int, number: int = number, file: PackageFile = file) -> None:
            share = min(1.0, size / file.size_bytes) if file.size_bytes else 0.0
            progress("package", (number + share) / len(files))

        if file in missing:
            part = folder / f"{file.name}.part"
            try:
                with part.open("wb") as stream:
                    web.download(file.url, stream, max_bytes=file.size_bytes, received=received)
                with part.open("rb") as written:
                    md5 = hashlib.file_digest(written, partial(hashlib.md5, usedforsecurity=False))
                    size = written.tell()
                if file.size_bytes not in (None, size) or file.md5 not in (None, md5.hexdigest()):
                    raise FetchError(
                        f"file has {size} bytes instead of {file.size_bytes}, or another MD5 than "
                        f"the service states; it was removed, run the command again: {file.url}"
                    )
                part.replace(folder / file.name)
            except OSError as error:
                part.unlink(missing_ok=True)
                if isinstance(error, FetchError | OutputError):
                    raise
                raise OutputError(f"cannot write ({error.strerror or error}): {part}") from error
        progress("package", (number + 1) / len(files))
    return [folder / file.name for file in files]


def _entries(web: Web, url: str, parameters: dict[str, str]) -> list[Element]:
    found: list[Element] = []
    for number in range(1, MAX_PAGES + 1):
        feed = web.get_xml(with_query(url, parameters | {"page": str(number), "limit": str(PAGE)}))
        found += feed.findall("entry")
        pages = feed.get("pagecount", "1")
        if not pages.isdecimal() or number >= int(pages):
            return found
    raise FetchError(f"feed has more pages than are read: {url}")
