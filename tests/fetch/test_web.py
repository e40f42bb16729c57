"""Documents: temporary failures are repeated, others end, keys stay with their origin."""

import gzip
import logging

import pytest
import servers
from servers import QUICK

from orthonav.core.errors import FetchError
from orthonav.ground.fetch.urls import Secret
from orthonav.ground.fetch.web import MAX_DOCUMENT_BYTES, Web

SECRET = "s3cr3t/v4lue&#?"


def get(answer, limits=QUICK):
    """What comes of one request to a server, and what the server saw."""
    with servers.serving(answer) as server, Web(limits) as web:
        return web.get(f"{server.url}/one?a=1"), server.log


@pytest.mark.parametrize(
    "first",
    [
        *(servers.Answer(b"no", status) for status in (408, 425, 429, 500, 502, 503, 504)),
        servers.Answer(b"x" * 1000, cut=300),
        servers.Answer(reset=True),
        servers.Answer(b"no gzip", headers={"Content-Encoding": "gzip"}),
    ],
    ids=lambda answer: f"{answer.status} {answer.cut} {answer.reset} {answer.headers}",
)
def test_temporary_failures_are_repeated(first):
    found, log = get(lambda asked: servers.Answer(b"good") if asked.before else first)
    assert found == b"good" and len(log) == 2
    assert log[0].headers["User-Agent"].startswith("orthonav/")


@pytest.mark.parametrize("status, attempts", [(503, QUICK.attempts), (404, 1)])
def test_attempts_are_limited(status, attempts):
    asked = []
    with pytest.raises(FetchError, match=rf"HTTP {status} \(no such luck\): .*127.0.0.1"):
        get(lambda a: asked.append(a) or servers.Answer(b"<p>no such luck</p>", status))
    assert len(asked) == attempts


def test_large_bodies_and_redirects_to_files_are_errors():
    bomb = gzip.compress(b"\0" * (MAX_DOCUMENT_BYTES + 1))
    with pytest.raises(FetchError, match="body is over"):
        get(lambda _: servers.Answer(bomb, headers={"Content-Encoding": "gzip"}))
    with pytest.raises(FetchError):
        get(lambda _: servers.Answer(status=302, headers={"Location": "file:///etc/passwd"}))


def test_a_proxy_of_the_environment_is_used(monkeypatch):
    with servers.serving(lambda a: servers.Answer(a.target.encode())) as proxy:
        monkeypatch.setenv("http_proxy", proxy.url)
        monkeypatch.delenv("no_proxy", raising=False)
        monkeypatch.delenv("NO_PROXY", raising=False)
        with Web(QUICK) as web:
            assert web.get("http://service.example/one") == b"http://service.example/one"


def keyed(server):
    return Web(QUICK, (Secret("{key}", server.url, SECRET),))


def test_a_key_is_sent_to_its_origin_and_never_shown(caplog):
    caplog.set_level(logging.DEBUG)
    with servers.serving(lambda a: servers.Answer(SECRET.encode(), 503)) as server:
        with keyed(server) as web, pytest.raises(FetchError) as raised:
            web.get(f"{server.url}/one?token={{key}}&x=1")
        assert server.log[0].query == {"TOKEN": SECRET, "X": "1"}
        with keyed(server) as web, pytest.raises(FetchError, match="key is for another host"):
            web.get("http://127.0.0.1:1/one?token={key}")
    chain = raised.value
    while chain is not None:  # what -v would print
        assert SECRET not in repr(chain)
        chain = None if chain.__suppress_context__ else chain.__context__
    assert SECRET not in caplog.text and SECRET not in repr(web.secrets)


BOMB = b"""<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "bbbbbbbbbb"><!ENTITY c "&b;&b;&b;">]>
<Capabilities version="1.0.0">&c;</Capabilities>"""
OUTSIDE = b"""<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]>
<Capabilities version="1.0.0">&b;</Capabilities>"""


@pytest.mark.parametrize(
    "body, words",
    [
        (BOMB, "entities"),
        (BOMB.decode().encode("utf-16"), "entities"),
        (OUTSIDE, "entities"),
        (b"<html><p>no", r"not an XML document \(no\)"),
        (b"", "not an XML"),
    ],
)
def test_harmful_documents_are_rejected(body, words):
    with (
        servers.serving(lambda _: servers.Answer(body)) as server,
        Web(QUICK) as web,
        pytest.raises(FetchError, match=words),
    ):
        web.get_xml(server.url)
