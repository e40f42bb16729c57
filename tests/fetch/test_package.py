"""Packages of a department: listed page by page, downloaded, checked."""

import hashlib
import os
from contextlib import contextmanager
from xml.sax.saxutils import escape

import pytest
import servers

from orthonav.core.errors import FetchError, OutputError
from orthonav.ground.fetch.package import (
    PackageFile,
    download_package,
    find_package,
    package_files,
    parse_package,
)
from orthonav.ground.fetch.web import Web

FEED = (
    '<?xml version="1.0" encoding="UTF-8"?><feed xmlns="http://www.w3.org/2005/Atom" '
    'xmlns:gpf_dl="https://data.geopf.fr/annexes/ressources/xsd/gpf_dl.xsd" '
    'gpf_dl:page="{page}" gpf_dl:pagesize="2" gpf_dl:pagecount="{pages}">{entries}</feed>'
)
NAMES = [
    ("BDORTHO_2-0_RVB-0M50_JP2-E080_LAMB93_D003_2013-01-01", "D003", "2013-01-01"),
    ("BDORTHO_2-0_IRC-0M50_JP2-E080_LAMB93_D003_2013-01-01", "D003", "2013-01-01"),
    ("BDORTHO_2-0_RVB-0M20_JP2-E080_LAMB93_D003_2022-01-01", "D003", "2022-01-01"),
    ("BDORTHO_1-0_RVB-0M50_JP2-E080_LAMB93_D003_2022-01-01", "D003", "2022-01-01"),
    ("BDORTHO_2-0_GRAPHE-MOSAIQUAGE_LAMB93_D003_2022-01-01", "D003", "2022-01-01"),
    ("BDORTHO_2-0_RVB-0M20_JP2-E080_LAMB93_D075_2022-01-01", "D075", "2022-01-01"),
]
PARTS = {f"x.7z.{n:03d}": os.urandom(size) for n, size in ((1, 5000), (2, 5000), (3, 700))}
LIMITS = servers.QUICK


def entry(title, url, *, zone="", date="", kind="application/atom+xml", length="", md5=""):
    extra = f'<gpf_dl:zone term="{zone}" label="{zone}"/>' if zone else ""
    extra += f"<gpf_dl:editionDate>{date}</gpf_dl:editionDate>" if date else ""
    extra += f"<content>{md5}</content>" if md5 else ""
    size = f' gpf_dl:length="{length}"' if length else ""
    link = f'<link href="{url}" type="{kind}"{size}/>'
    return f"<entry><title>{escape(title)}</title>{link}{extra}</entry>"


def service(url, *, parts=None, changed=None):
    """The download service: packages two a page, files with length and sum."""
    parts = PARTS if parts is None else parts
    plain = servers.files({f"/dl/{name}": body for name, body in (changed or parts).items()})

    def answer(asked):
        page = int(asked.query.get("PAGE", 1))
        if asked.path == "/resource/BDORTHO":
            chosen = NAMES[2 * page - 2 : 2 * page]
            entries = "".join(
                entry(n, f"{url[0]}/resource/BDORTHO/{n}", zone=z, date=d) for n, z, d in chosen
            )
            return servers.Answer(FEED.format(page=page, pages=3, entries=entries).encode())
        if asked.path.startswith("/resource/BDORTHO/"):
            entries = entry("x.md5", f"{url[0]}/dl/x.md5", kind="text/plain", length="99")
            for name, body in parts.items():
                stated = {"length": str(len(body)), "md5": hashlib.md5(body).hexdigest()}
                entries += entry(name, f"{url[0]}/dl/{name}", kind="application/x-7z", **stated)
            return servers.Answer(FEED.format(page=1, pages=1, entries=entries).encode())
        return plain(asked)

    return answer


@contextmanager
def served(**rest):
    """A server of packages."""
    url = []
    with servers.serving(service(url, **rest)) as server:
        url.append(server.url)
        yield server


NAMED = {"D003:2013": ("D003", "2013", "RVB"), "03:2013:irc": ("D003", "2013", "IRC")}
NAMED |= {"2A:2021": ("D02A", "2021", "RVB"), "971:2022": ("D971", "2022", "RVB")}


@pytest.mark.parametrize("text", [*NAMED, "3:2013", "D003", "D003:13", "../etc:2013"])
def test_package_names_are_parsed(text):
    if text in NAMED:
        assert parse_package(text) == NAMED[text]
        return
    with pytest.raises(FetchError, match="such as D003:2013"):
        parse_package(text)


def test_the_finest_package_of_a_year():
    with served() as server, Web(LIMITS) as web:
        assert find_package(web, "D003", "2022", service=server.url).name == NAMES[2][0]
        assert find_package(web, "D003", "2013", "IRC", server.url).name == NAMES[1][0]
        words = "no RVB package of D003 of 2019; available: 2013, 2022"
        with pytest.raises(FetchError, match=words):
            find_package(web, "D003", "2019", service=server.url)
    assert {asked.query["ZONE"] for asked in server.log} == {"D003"}
    assert all(int(asked.query["LIMIT"]) <= 50 for asked in server.log)


def fetched(server, folder):
    with Web(LIMITS) as web:
        files = package_files(web, find_package(web, "D003", "2013", service=server.url))
        return download_package(web, files, folder, lambda stage, share: None)


def test_files_are_downloaded_once(tmp_path):
    (tmp_path / "x.7z.002.part").write_bytes(PARTS["x.7z.002"][:4321])
    with served() as server:
        for _ in range(2):
            paths = fetched(server, tmp_path)
            assert {path.name: path.read_bytes() for path in paths} == PARTS
            asked = [asked for asked in server.log if asked.path.startswith("/dl/")]
            assert len(asked) == len(PARTS) and not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize(
    "changed, words",
    [
        (os.urandom(5000), "another MD5"),
        (b"", "0 bytes instead of 5000"),
        (bytes(5001), "over 5000"),
    ],
)
def test_a_wrong_size_or_sum_is_rejected(tmp_path, changed, words):
    with (
        served(changed=PARTS | {"x.7z.002": changed}) as server,
        pytest.raises(FetchError, match=words),
    ):
        fetched(server, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["x.7z.001"]


def test_names_that_leave_the_folder_are_rejected(tmp_path):
    with (
        served(parts={"..%2F..%2Fevil.7z": b"x"}) as server,
        pytest.raises(FetchError, match="unsafe file"),
    ):
        fetched(server, tmp_path)


def test_a_small_disk_is_reported_before_the_download(tmp_path):
    files = [PackageFile("a.7z", "http://127.0.0.1:1/a.7z", 10**18, None)]
    with Web(LIMITS) as web, pytest.raises(OutputError, match="disk is too small"):
        download_package(web, files, tmp_path, lambda stage, share: None)
