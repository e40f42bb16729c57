"""Asking over HTTP: what may pass is asked again, what may not ends, keys stay where they are."""

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

from orthonav.errors import FetchError
from orthonav.fetch.client import BadReplyError, Client
from orthonav.fetch.politeness import Limits, Stopped, Turns, backoff_s, retry_after_s
from orthonav.fetch.urls import Secret

SECRET = "s3cr3t-v4lue"


def body(reply):
    return reply.body if reply.status == 200 else pytest.fail(f"HTTP {reply.status}")


def get(answer, limits=QUICK, judge=body, **rest):
    """What comes of one request to a server, and what the server saw."""
    with servers.serving(answer) as server, Client(limits) as client:
        return client.get(f"{server.url}/one?a=1", judge, **rest), server.log


def failing(answer, words, limits=QUICK, **rest):
    with pytest.raises(FetchError, match=words) as told:
        get(answer, limits, **rest)
    assert "127.0.0.1" in str(told.value)


@pytest.mark.parametrize("status", [408, 425, 429, 500, 502, 503, 504])
def test_what_may_pass_is_asked_again(status):
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
def test_broken_connections_are_tried_again(first):
    limits = Limits(per_second=2000, attempts=2, backoff_s=0.01, read_s=0.2)
    found, log = get(lambda asked: servers.Answer(b"good") if asked.before else first, limits)
    assert found == b"good" and len(log) == 2


def test_an_end_after_so_many_tries():
    asked = []
    failing(lambda a: asked.append(a) or servers.Answer(status=503), "HTTP 503")
    assert len(asked) == QUICK.attempts


def test_a_server_that_drips_is_left_in_the_end():
    limits = Limits(per_second=2000, attempts=1, total_s=0.3)
    failing(lambda _: servers.Answer(b"x" * 100, drip_s=0.05), "longer than 0.3 s", limits)


def test_retry_after_holds_the_whole_host_back():
    def answer(asked):
        if asked.before:
            return servers.Answer(b"good")
        return servers.Answer(status=429, headers={"Retry-After": "1"})

    start = time.monotonic()
    found, _ = get(answer)
    assert found == b"good" and time.monotonic() - start >= 0.99


def test_retry_after_in_words_of_http():
    limits = Limits(wait_max_s=60)
    later = format_datetime(datetime.now(UTC) + timedelta(seconds=30), usegmt=True)
    assert 0 < retry_after_s(later, limits) <= 30
    assert retry_after_s("Sat, 01 Jan 2000 00:00:00 GMT", limits) == 0
    assert retry_after_s("7", limits) == 7
    assert retry_after_s(None, limits) is None and retry_after_s("soon", limits) is None
    with pytest.raises(FetchError, match="come back in 3600 s"):
        retry_after_s("3600", limits)


def test_backoff_doubles_and_jitters():
    limits = Limits(backoff_s=1.0, backoff_max_s=10.0)
    for attempt, longest in ((1, 1), (2, 2), (3, 4), (9, 10)):
        waits = [backoff_s(limits, attempt) for _ in range(200)]
        assert longest / 2 <= min(waits) < max(waits) <= longest
        assert max(waits) - min(waits) > longest / 4


def test_turns_are_given_at_the_rate():
    turns = Turns(Limits(per_second=100.0))
    start = time.monotonic()
    for _ in range(70):  # 50 at once, 20 at the rate
        turns.wait("a")
    assert time.monotonic() - start >= 0.19
    turns.wait("b")
    turns.stop.set()
    with pytest.raises(Stopped):
        turns.wait("a")


def test_a_wait_ends_when_the_run_does():
    turns = Turns(Limits())
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


def test_packed_bodies_are_unpacked_and_bursting_ones_refused():
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


def test_redirects_are_followed_within_reason():
    def answer(asked):
        where = {"/one": "/two", "/two": "three"}.get(asked.path)
        if where:
            return servers.Answer(status=302, headers={"Location": where})
        return servers.Answer(asked.path.encode())

    assert get(answer)[0] == b"/three"
    failing(lambda _: servers.Answer(status=302, headers={"Location": "/one"}), "too many")
    failing(lambda _: servers.Answer(status=301), "without a place")
    for place in ("file:///etc/passwd", "ftp://a/b", "http://user:pw@a/b"):
        failing(lambda _, p=place: servers.Answer(status=307, headers={"Location": p}), "redirect")


def test_a_judge_may_ask_again_or_not():
    def again(reply):
        raise BadReplyError("odd")

    def never(reply):
        raise BadReplyError("odd", again=False)

    asked = []
    failing(lambda a: asked.append(a) or servers.Answer(b"x"), "odd", judge=again)
    assert len(asked) == QUICK.attempts
    failing(lambda a: asked.append(a) or servers.Answer(b"x"), "odd", judge=never)
    assert len(asked) == QUICK.attempts + 1


def test_no_connection_is_told_in_words():
    with Client(QUICK) as client, pytest.raises(FetchError, match="connection failed"):
        client.get("http://127.0.0.1:1/x", body)


def keyed(server, *, limits=QUICK):
    return Client(limits, (Secret("{key}", server.url, SECRET),))


def test_a_key_is_sent_to_its_server_and_shown_nowhere(caplog):
    caplog.set_level(logging.DEBUG)
    with servers.serving(lambda a: servers.Answer(SECRET.encode(), 503)) as server:
        with keyed(server) as client, pytest.raises(FetchError) as told:
            client.get(f"{server.url}/one?token={{key}}", body)
        assert server.log[0].query["TOKEN"] == SECRET
    assert SECRET not in str(told.value) and "{key}" in str(told.value)
    chain = told.value
    while chain is not None:  # what -v would print
        assert SECRET not in repr(chain)
        chain = None if chain.__suppress_context__ else chain.__context__
    assert SECRET not in caplog.text and SECRET not in repr(client._secrets)


def test_a_key_leaves_its_server_by_no_redirect():
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
def test_only_http_is_asked(url):
    with Client(QUICK) as client, pytest.raises(FetchError, match="only http"):
        client.get(url, body)
