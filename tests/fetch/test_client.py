"""HTTP requests: temporary failures are repeated, others end, keys stay with their origin."""

import gzip
import logging
import os
import threading
import time
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime

import pytest
import servers
from servers import QUICK

from orthonav.core.errors import FetchError
from orthonav.ground.fetch.client import BadReplyError, Client
from orthonav.ground.fetch.politeness import (
    RequestLimits,
    Stopped,
    Turns,
    retry_after_s,
    retry_policy,
)
from orthonav.ground.fetch.urls import Secret

SECRET = "s3cr3t-v4lue"


def body(reply):
    return reply.body if reply.status == 200 else pytest.fail(f"HTTP {reply.status}")


def get(answer, limits=QUICK, check=body, **rest):
    """What comes of one request to a server, and what the server saw."""
    with servers.serving(answer) as server, Client(limits) as client:
        return client.get(f"{server.url}/one?a=1", check, **rest), server.log


def failing(answer, words, limits=QUICK, **rest):
    with pytest.raises(FetchError, match=words) as raised:
        get(answer, limits, **rest)
    assert "127.0.0.1" in str(raised.value)


@pytest.mark.parametrize("status", [408, 425, 429, 500, 502, 503, 504])
def test_temporary_status_is_repeated(status):
    def answer(asked):
        return servers.Answer(b"good" if asked.before else b"no", 200 if asked.before else status)

    found, log = get(answer)
    assert found == b"good" and len(log) == 2
    assert log[0].headers["User-Agent"].startswith("orthonav/")


@pytest.mark.parametrize(
    "first",
    [
        servers.Answer(b"x" * 1000, cut=300),
        servers.Answer(reset=True),
        servers.Answer(slow_s=0.5),
        servers.Answer(gzip.compress(os.urandom(999))[:600], headers={"Content-Encoding": "gzip"}),
        servers.Answer(b"no gzip", headers={"Content-Encoding": "gzip"}),
    ],
    ids=["cut short", "reset", "slow", "half packed", "not packed"],
)
def test_broken_connections_are_repeated(first):
    limits = RequestLimits(per_second=2000, attempts=2, backoff_s=0.01, read_s=0.2)
    found, log = get(lambda asked: servers.Answer(b"good") if asked.before else first, limits)
    assert found == b"good" and len(log) == 2


def test_attempts_are_limited():
    asked = []
    failing(lambda a: asked.append(a) or servers.Answer(status=503), "HTTP 503")
    assert len(asked) == QUICK.attempts


def test_a_slow_body_times_out():
    limits = RequestLimits(per_second=2000, attempts=1, total_s=0.3)
    failing(lambda _: servers.Answer(b"x" * 100, drip_s=0.05), "longer than 0.3 s", limits)


def test_retry_after_pauses_the_host():
    def answer(asked):
        if asked.before:
            return servers.Answer(b"good")
        return servers.Answer(status=429, headers={"Retry-After": "1"})

    start = time.monotonic()
    found, _ = get(answer)
    assert found == b"good" and time.monotonic() - start >= 0.99


def test_retry_after_as_date_or_seconds():
    limits = RequestLimits(wait_max_s=60)
    later = format_datetime(datetime.now(UTC) + timedelta(seconds=30), usegmt=True)
    assert 0 < retry_after_s(later, limits) <= 30
    assert retry_after_s("Sat, 01 Jan 2000 00:00:00 GMT", limits) == 0
    assert retry_after_s("7", limits) == 7
    assert retry_after_s(None, limits) is None and retry_after_s("soon", limits) is None
    assert retry_after_s("9" * 9000, limits) is None
    with pytest.raises(FetchError, match="come back in 3600 s"):
        retry_after_s("3600", limits)


def test_pauses_double_with_jitter_from_the_first_repetition():
    limits = RequestLimits(backoff_s=1.0, backoff_max_s=10.0, attempts=20)
    for failures, least in ((1, 1), (2, 2), (3, 4), (4, 8), (9, 10)):
        pauses = []
        for _ in range(100):
            retry = retry_policy(limits)
            for _ in range(failures):
                retry = retry.increment(error=BadReplyError("odd"))
            pauses.append(retry.get_backoff_time())
        assert least <= min(pauses) and max(pauses) <= min(least + 1, 10)
        assert least == 10 or max(pauses) - min(pauses) > 0.5


def test_requests_are_sent_at_the_rate():
    turns = Turns(RequestLimits(per_second=100.0))
    start = time.monotonic()
    for _ in range(70):  # 50 at once, 20 at the rate
        turns.wait("a")
    assert time.monotonic() - start >= 0.19
    turns.wait("b")
    turns.stop.set()
    with pytest.raises(Stopped):
        turns.wait("a")


def test_a_wait_ends_with_the_run():
    turns = Turns(RequestLimits())
    ended = []

    def waiting():
        with pytest.raises(Stopped):
            turns.sleep(60)
        ended.append(True)

    thread = threading.Thread(target=waiting)
    thread.start()
    turns.stop.set()
    thread.join(5)
    assert ended


def test_gzip_is_unpacked_and_bombs_are_rejected():
    packed = {"Content-Encoding": "gzip"}
    found, _ = get(lambda _: servers.Answer(gzip.compress(b"y" * 9999), headers=packed))
    assert found == b"y" * 9999
    bomb = gzip.compress(b"\0" * 20_000_000)
    failing(lambda _: servers.Answer(bomb, headers=packed), "over the limit", max_bytes=100_000)


def test_bodies_over_the_limit_are_not_read():
    asked = []

    def answer(a):
        asked.append(a)
        return servers.Answer(b"x" * 5000)

    failing(answer, "5000 bytes is over the limit", max_bytes=4000)
    assert len(asked) == 1
    failing(
        lambda _: servers.Answer(
            b"1388\r\n" + b"x" * 5000 + b"\r\n0\r\n\r\n",
            headers={"Transfer-Encoding": "chunked", "Content-Length": "x"},
        ),
        "over the limit|cut short|failed",
        max_bytes=4000,
    )


def test_redirects_are_followed_within_limits():
    def answer(asked):
        where = {"/one": "/two", "/two": "three"}.get(asked.path)
        if where:
            return servers.Answer(status=302, headers={"Location": where})
        return servers.Answer(asked.path.encode())

    assert get(answer)[0] == b"/three"
    failing(lambda _: servers.Answer(status=302, headers={"Location": "/one"}), "too many")
    failing(lambda _: servers.Answer(status=301), "without a Location")
    for place in ("file:///etc/passwd", "ftp://a/b", "http://user:pw@a/b"):
        failing(lambda _, p=place: servers.Answer(status=307, headers={"Location": p}), "redirect")


def test_a_check_decides_whether_to_repeat():
    def again(reply):
        raise BadReplyError("odd")

    def never(reply):
        raise BadReplyError("odd", again=False)

    asked = []
    failing(lambda a: asked.append(a) or servers.Answer(b"x"), "odd", check=again)
    assert len(asked) == QUICK.attempts
    failing(lambda a: asked.append(a) or servers.Answer(b"x"), "odd", check=never)
    assert len(asked) == QUICK.attempts + 1


def test_no_connection_is_an_error():
    with Client(QUICK) as client, pytest.raises(FetchError, match="connection failed"):
        client.get("http://127.0.0.1:1/x", body)


def keyed(server, *, limits=QUICK):
    return Client(limits, (Secret("{key}", server.url, SECRET),))


def test_a_key_is_sent_to_its_origin_and_never_shown(caplog):
    caplog.set_level(logging.DEBUG)
    with servers.serving(lambda a: servers.Answer(SECRET.encode(), 503)) as server:
        with keyed(server) as client, pytest.raises(FetchError) as raised:
            client.get(f"{server.url}/one?token={{key}}", body)
        assert server.log[0].query["TOKEN"] == SECRET
    assert SECRET not in str(raised.value) and "{key}" in str(raised.value)
    chain = raised.value
    while chain is not None:  # what -v would print
        assert SECRET not in repr(chain)
        chain = None if chain.__suppress_context__ else chain.__context__
    assert SECRET not in caplog.text and SECRET not in repr(client._secrets)


def test_a_key_does_not_follow_redirects():
    with servers.serving(lambda a: servers.Answer(b"")) as other:

        def answer(asked):
            where = f"{other.url}/steal?{asked.target.partition('?')[2]}"
            return servers.Answer(status=302, headers={"Location": where})

        with servers.serving(answer) as server, keyed(server) as client:
            with pytest.raises(FetchError, match="key of another host"):
                client.get(f"{server.url}/one?token={{key}}", body)
            with pytest.raises(FetchError, match="key of another host"):
                client.get(f"{other.url}/one?token={{key}}", body)
        assert not other.log


def test_a_key_is_escaped():
    with servers.serving(lambda a: servers.Answer(b"")) as server:
        secret = Secret("{key}", server.url, "a&b=c d/#?")
        with Client(QUICK, (secret,)) as client:
            client.get(f"{server.url}/one?token={{key}}&x=1", body)
        assert server.log[0].query == {"TOKEN": "a&b=c d/#?", "X": "1"}


@pytest.mark.parametrize("url", ["file:///etc/passwd", "ftp://host/a", "/etc/passwd", "http://"])
def test_other_schemes_are_rejected(url):
    with Client(QUICK) as client, pytest.raises(FetchError, match="only http"):
        client.get(url, body)
