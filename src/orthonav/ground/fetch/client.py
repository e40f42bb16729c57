"""HTTP requests with rate limits, size limits and repetition; keys are inserted on sending only.

Errors never quote messages of the HTTP library, because those contain whole addresses with keys.
"""

import gzip
import io
import logging
import re
import threading
import time
import zlib
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar
from urllib.parse import quote, urljoin

import requests
import urllib3

from orthonav import __version__
from orthonav.core.errors import FetchError
from orthonav.ground.fetch.politeness import (
    RETRY_STATUS,
    RequestLimits,
    Stopped,
    Turns,
    retry_after_s,
    retry_policy,
)
from orthonav.ground.fetch.urls import (
    KEY,
    Secret,
    carrying_key,
    checked_url,
    host_of,
    joined,
    origin_of,
    shown,
)

USER_AGENT = f"orthonav/{__version__} (fetches orthophotos for one area; +orthonav fetch)"
REDIRECTS = frozenset({301, 302, 303, 307, 308})
_CHUNK = 64 * 1024
_EXCERPT_CHARACTERS = 300
_CONTENT_RANGE = re.compile(r"bytes (\d+)-(\d+)/(\d+)")
_EXCEPTION_TEXT = re.compile(
    r"<(?:\w+:)?(?:ServiceException|ExceptionText)\b[^>]*>(.*?)</", re.DOTALL | re.IGNORECASE
)
log = logging.getLogger(__name__)
Checked = TypeVar("Checked")


@dataclass(frozen=True, eq=False)
class HttpReply:
    """An answer: `status`, `headers` by lower-case name, `body` unpacked, `url` without keys."""

    url: str
    status: int
    headers: Mapping[str, str]
    body: bytes


class ByteRange(NamedTuple):
    """Part of a file on a server, the file's size in bytes, and the version the server names."""

    data: bytes
    size: int
    version: str


class BadReplyError(FetchError):
    """An answer that is not what was requested; the request is repeated where `again`."""

    def __init__(self, message: str, *, again: bool = True) -> None:
        super().__init__(message)
        self.again = again


class Client:
    """Sends the requests of all threads of a run; a context manager.

    `secrets` are keys by placeholder, each for one origin. `received_bytes` counts bodies as sent.
    """

    def __init__(
        self, limits: RequestLimits | None = None, secrets: tuple[Secret, ...] = ()
    ) -> None:
        # Debug messages of urllib3 contain whole addresses.
        logging.getLogger("urllib3").setLevel(logging.WARNING)
        self.limits = limits or RequestLimits()
        self.turns = Turns(self.limits)
        self.received_bytes = 0
        self._secrets = list(secrets)
        self._local = threading.local()
        self._sessions: list[Any] = []
        self._lock = threading.Lock()

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *exc: object) -> None:
        """End every wait and every connection."""
        self.turns.stop.set()
        with self._lock:
            for session in self._sessions:
                session.close()
            self._sessions.clear()

    def add_secret(self, secret: Secret) -> None:
        """Add a key, such as a signature issued by a service; it replaces one for the same use."""
        with self._lock:
            self._secrets = [
                known
                for known in self._secrets
                if (known.placeholder, known.origin) != (secret.placeholder, secret.origin)
            ] + [secret]

    def redacted(self, text: str) -> str:
        """`text` with every key replaced by its placeholder."""
        for secret in self._secrets:
            for value in {secret.value, quote(secret.value, safe="")}:
                if len(value) >= 4:
                    text = text.replace(value, secret.placeholder)
        return text

    def linked(self, base: str, reference: str) -> str:
        """The absolute address of a reference in the document at `base`, with the key of `base`."""
        return carrying_key(base, joined(base, self.redacted(reference)))

    def get(
        self,
        url: str,
        check: Callable[[HttpReply], Checked],
        *,
        headers: Mapping[str, str] | None = None,
        max_bytes: int | None = None,
        json: Any = None,
    ) -> Checked:
        """The result of `check` on the answer. `json` is sent with POST.

        The request is repeated, with growing pauses, after a temporary status (429, 5xx), a broken
        connection, and where `check` raises `BadReplyError` with `again`. Raises `FetchError` at
        last, and `Stopped` when the run is ended.
        """
        checked_url(url)
        retry = retry_policy(self.limits)
        while True:
            try:
                reply = self._follow(url, dict(headers or {}), max_bytes, json)
                self._refuse_status(reply)
                return check(reply)
            except BadReplyError as error:
                where = self.redacted(shown(url))
                if not error.again or retry.total == 0:
                    raise FetchError(f"{self.redacted(str(error))}: {where}") from None
                log.info("repeated after a failure (%s): %s", error, where)
                retry = retry.increment(error=error)
                self.turns.sleep(retry.get_backoff_time())

    def get_range(self, url: str, start: int, end: int) -> ByteRange:
        """Bytes `start` to `end` (excluded) of a file, fewer at its end. Raises as `get` does."""

        def check(reply: HttpReply) -> ByteRange:
            if reply.status != 206:
                raise bad_status(reply)
            found = _CONTENT_RANGE.fullmatch(reply.headers.get("content-range", "").strip())
            if not found:
                raise BadReplyError("range without Content-Range")
            first, last, size = (int(number) for number in found.groups())
            if first != start or not last + 1 - first == min(end, size) - start == len(reply.body):
                raise BadReplyError("another range than requested")
            version = reply.headers.get("etag") or reply.headers.get("last-modified", "")
            return ByteRange(reply.body, size, version)

        headers = {"Range": f"bytes={start}-{end - 1}", "Accept-Encoding": "identity"}
        return self.get(url, check, headers=headers, max_bytes=end - start + 4096)

    def _refuse_status(self, reply: HttpReply) -> None:
        """Raise `BadReplyError` for a temporary status; a Retry-After holds back the host."""
        if reply.status not in RETRY_STATUS:
            return
        seconds = retry_after_s(reply.headers.get("retry-after"), self.limits)
        if seconds is not None:
            self.turns.pause(host_of(reply.url), seconds)
        raise BadReplyError(f"HTTP {reply.status}")

    def _follow(
        self, url: str, headers: dict[str, str], max_bytes: int | None, json: Any
    ) -> HttpReply:
        """One answer, redirects followed. Raises `BadReplyError`."""
        deadline_s = time.monotonic() + self.limits.total_s
        for _ in range(self.limits.max_redirects + 1):
            self.turns.wait(host_of(url))
            reply = self._send(url, headers, max_bytes or self.limits.max_bytes, json, deadline_s)
            if reply.status not in REDIRECTS:
                return reply
            location = self.redacted(reply.headers.get("location", ""))
            if not location:
                raise BadReplyError(f"HTTP {reply.status} without a Location", again=False)
            url = self._redirected(url, location)
        raise BadReplyError("too many redirects", again=False)

    def _redirected(self, url: str, location: str) -> str:
        """Target of a redirect. requests would follow with the key and to any scheme."""
        try:
            target = checked_url(urljoin(url, location))
        except FetchError as error:
            raise BadReplyError(f"invalid redirect ({error})", again=False) from None
        if url.startswith("https://") and not target.startswith("https://"):
            raise BadReplyError("redirect from https to http", again=False)
        return target

    def _send(
        self, url: str, headers: dict[str, str], max_bytes: int, json: Any, deadline_s: float
    ) -> HttpReply:
        try:
            response = self._session().request(
                "GET" if json is None else "POST",
                self._with_keys(url),
                json=json,
                headers=headers,
                stream=True,
                allow_redirects=False,
                timeout=(self.limits.connect_s, self.limits.read_s),
            )
            with closing(response):
                if "Range" in headers and response.status_code == 200:
                    raise BadReplyError("server sends whole files only, no ranges", again=False)
                packed = self._body(response, max_bytes, deadline_s)
                body = _unpacked(packed, response.headers.get("Content-Encoding", ""), max_bytes)
                plain = {name.lower(): value for name, value in response.headers.items()}
                return HttpReply(url, response.status_code, plain, body)
        except (requests.RequestException, urllib3.exceptions.HTTPError, OSError) as error:
            if isinstance(error, FetchError):
                raise
            raise BadReplyError(_kind_of_failure(error)) from None

    def _body(self, response: Any, max_bytes: int, deadline_s: float) -> bytes:
        """The body as sent, at most `max_bytes`. Raises `BadReplyError`."""
        length = response.headers.get("Content-Length", "")
        if length.isdecimal() and int(length) > max_bytes:
            raise BadReplyError(f"body of {length} bytes is over the limit", again=False)
        body = bytearray()
        while part := response.raw.read1(_CHUNK, decode_content=False):
            body += part
            with self._lock:
                self.received_bytes += len(part)
            if len(body) > max_bytes:
                raise _over(max_bytes)
            if self.turns.stop.is_set():
                raise Stopped
            if time.monotonic() > deadline_s:
                raise BadReplyError(f"took longer than {self.limits.total_s:g} s")
        return bytes(body)

    def _with_keys(self, url: str) -> str:
        """The address as sent. Raises `BadReplyError` where a key would leave its origin."""
        for secret in self._secrets:
            if secret.placeholder in url and secret.origin == origin_of(url):
                value = quote(secret.value, safe="") if secret.placeholder == KEY else secret.value
                url = url.replace(secret.placeholder, value)
        if "{" in url:
            raise BadReplyError(
                "address still holds a placeholder, or a key of another host", again=False
            )
        return url

    def _session(self) -> Any:
        session = getattr(self._local, "session", None)
        if session is None:
            session = requests.Session()
            session.headers["User-Agent"] = USER_AGENT
            session.headers["Accept-Encoding"] = "gzip"
            session.auth = _no_auth  # otherwise passwords of ~/.netrc would be sent
            self._local.session = session
            with self._lock:
                self._sessions.append(session)
        return session


def _unpacked(body: bytes, encoding: str, max_bytes: int) -> bytes:
    """The body without its gzip packing. urllib3 accepts half a packed body as a whole one."""
    encoding = encoding.strip().lower()
    if encoding in ("", "identity"):
        return body
    if encoding not in ("gzip", "x-gzip"):
        raise BadReplyError(f"body is packed with {encoding[:20]}, which was not requested")
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(body)) as stream:
            plain = stream.read(max_bytes + 1)
    except (OSError, EOFError, zlib.error):
        raise BadReplyError("gzip packing of the answer is broken or cut short") from None
    if len(plain) > max_bytes:
        raise _over(max_bytes)
    return plain


def _over(max_bytes: int) -> BadReplyError:
    return BadReplyError(f"body is over the limit of {max_bytes} bytes", again=False)


def excerpt(reply: HttpReply) -> str:
    """The beginning of an answer as text on one line, for an error; of other content its size."""
    text = reply.body[: 4 * _EXCERPT_CHARACTERS].decode("utf-8", errors="replace")
    if "\0" in text or 10 * text.count("\ufffd") > len(text):
        return f"{len(reply.body)} bytes that are not text"
    words = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return words[:_EXCERPT_CHARACTERS]


def bad_status(reply: HttpReply) -> BadReplyError:
    """The error for an HTTP status other than the expected one, with what the service wrote."""
    words = exception_text(reply) or excerpt(reply)
    text = f"HTTP {reply.status}" + (f" ({words})" if words else "")
    return BadReplyError(text, again=reply.status >= 500)


def exception_text(reply: HttpReply) -> str:
    """Code and text of an exception report of a WMS or WMTS; empty for anything else."""
    text = reply.body[:20_000].decode("utf-8", errors="replace")
    if "Exception" not in text:
        return ""
    found = _EXCEPTION_TEXT.search(text)
    words = " ".join(found.group(1).split()) if found else ""
    words = re.sub(r"<!\[CDATA\[|\]\]>|<[^>]*>", " ", words)
    code = re.search(r'(?:exceptionCode|code)="([\w.]+)"', text)
    joined = " ".join([*([code.group(1)] if code else []), *words.split()])
    return "".join(c for c in joined if c.isprintable())[:300]


def _no_auth(request: Any) -> Any:
    return request


def _kind_of_failure(error: Exception) -> str:
    """The failure by kind only, without the library's text."""
    kinds: list[tuple[tuple[type[BaseException], ...], str]] = [
        ((requests.exceptions.SSLError, urllib3.exceptions.SSLError), "no secure connection (TLS)"),
        ((requests.exceptions.ConnectTimeout,), "no connection in time"),
        (
            (requests.exceptions.Timeout, urllib3.exceptions.TimeoutError, TimeoutError),
            "no answer in time",
        ),
        ((requests.exceptions.ProxyError,), "the proxy refused"),
        ((urllib3.exceptions.ProtocolError,), "the answer was cut short"),
    ]
    for classes, words in kinds:
        if isinstance(error, classes):
            return words
    return f"connection failed ({type(error).__name__})"
