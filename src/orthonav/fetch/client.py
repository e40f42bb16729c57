"""Asking over HTTP: politely, with limits, with keys put in only when sending.

An error never holds what a library says, for libraries quote whole addresses, keys included.
"""

import logging
import threading
import time
import zlib
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Any, TypeVar
from urllib.parse import quote, urljoin

from orthonav import __version__
from orthonav.errors import FetchError
from orthonav.extras import missing_extra
from orthonav.fetch.politeness import Limits, Stopped, Turns, backoff_s, retry_after_s
from orthonav.fetch.urls import KEY, Secret, checked_url, host_of, origin_of, shown

try:
    import requests
    import urllib3
except ImportError as error:  # pragma: no cover - depends on the installation
    raise missing_extra("fetching imagery", "fetch", "requests", error) from error

USER_AGENT = f"orthonav/{__version__} (fetches orthophotos for one area; +orthonav fetch)"
AGAIN = frozenset({408, 425, 429, 500, 502, 503, 504})
REDIRECTS = frozenset({301, 302, 303, 307, 308})
_CHUNK = 64 * 1024
_GZIP = 16 + zlib.MAX_WBITS
_TOLD_CHARACTERS = 300
log = logging.getLogger(__name__)
Judged = TypeVar("Judged")


@dataclass(frozen=True, eq=False)
class Reply:
    """An answer: `status`, `headers` by lower-case name, `body` unpacked, `url` without keys."""

    url: str
    status: int
    headers: Mapping[str, str]
    body: bytes

    @property
    def kind(self) -> str:
        """Media type that the answer claims, such as `image/jpeg`; empty where it claims none."""
        return self.headers.get("content-type", "").partition(";")[0].strip().lower()


class BadReplyError(FetchError):
    """An answer that is not what was asked for; asked again where `again`."""

    def __init__(self, message: str, *, again: bool = True) -> None:
        super().__init__(message)
        self.again = again


class Client:
    """Asks services for all threads of a run; close it when done.

    `secrets` are keys by placeholder, each for one origin. `received_bytes` and `requests` count.
    """

    def __init__(self, limits: Limits | None = None, secrets: tuple[Secret, ...] = ()) -> None:
        # Its debug lines hold whole addresses.
        logging.getLogger("urllib3").setLevel(logging.WARNING)
        self.limits = limits or Limits()
        self.turns = Turns(self.limits)
        self.received_bytes = 0
        self.requests = 0
        self._secrets = list(secrets)
        self._local = threading.local()
        self._sessions: list[Any] = []
        self._lock = threading.Lock()

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """End every wait and every connection."""
        self.turns.stop.set()
        with self._lock:
            for session in self._sessions:
                session.close()
            self._sessions.clear()

    def add_secret(self, secret: Secret) -> None:
        """A key that became known on the way, such as a signature that a service gave."""
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

    def get(
        self,
        url: str,
        judge: Callable[[Reply], Judged],
        *,
        headers: Mapping[str, str] | None = None,
        max_bytes: int | None = None,
        json: Any = None,
    ) -> Judged:
        """What `judge` makes of the answer. With `json` that is sent (POST).

        Asks again, with growing pauses, after answers that may pass (429, 5xx), broken
        connections, and where `judge` raises `BadReplyError` that may be asked again. Raises
        `FetchError` in the end, and `Stopped` when the run is ended.
        """
        checked_url(url)
        last = FetchError("never asked")
        for attempt in range(max(1, self.limits.attempts)):
            if attempt:
                log.info("asked again (%s): %s", last, self.redacted(shown(url)))
                self.turns.sleep(backoff_s(self.limits, attempt))
            try:
                reply = self._ask(url, dict(headers or {}), max_bytes, json)
                self._refuse_status(reply)
                return judge(reply)
            except BadReplyError as error:
                last = error
                if not error.again:
                    break
        raise FetchError(f"{self.redacted(str(last))}: {self.redacted(shown(url))}") from None

    def _refuse_status(self, reply: Reply) -> None:
        """Raise `BadReplyError` where the answer asks to come again; note when."""
        if reply.status not in AGAIN:
            return
        seconds = retry_after_s(reply.headers.get("retry-after"), self.limits)
        if seconds is not None:
            self.turns.pause(host_of(reply.url), seconds)
        raise BadReplyError(f"HTTP {reply.status}")

    def _ask(self, url: str, headers: dict[str, str], max_bytes: int | None, json: Any) -> Reply:
        """One answer, redirects followed. Raises `BadReplyError`."""
        deadline_s = time.monotonic() + self.limits.total_s
        for _ in range(self.limits.max_redirects + 1):
            self.turns.wait(host_of(url))
            with self._lock:
                self.requests += 1
            reply = self._once(url, headers, max_bytes or self.limits.max_bytes, json, deadline_s)
            if reply.status not in REDIRECTS:
                return reply
            where = self.redacted(reply.headers.get("location", ""))
            if not where:
                raise BadReplyError(f"HTTP {reply.status} without a place", again=False)
            url = self._moved(url, where)
        raise BadReplyError("too many redirects", again=False)

    def _moved(self, url: str, where: str) -> str:
        """Where a redirect leads. Raises `BadReplyError` where it would lose safety or a key."""
        try:
            moved = checked_url(urljoin(url, where))
        except FetchError as error:
            raise BadReplyError(
                f"redirected to what is not fetched ({error})", again=False
            ) from None
        if url.startswith("https://") and not moved.startswith("https://"):
            raise BadReplyError("redirected from https to http", again=False)
        return moved

    def _once(
        self, url: str, headers: dict[str, str], max_bytes: int, json: Any, deadline_s: float
    ) -> Reply:
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
                body = self._body(response, max_bytes, deadline_s)
                plain = {name.lower(): value for name, value in response.headers.items()}
                return Reply(url, response.status_code, plain, body)
        except (requests.RequestException, urllib3.exceptions.HTTPError, OSError) as error:
            if isinstance(error, FetchError):
                raise
            raise BadReplyError(_broken(error)) from None

    def _body(self, response: Any, max_bytes: int, deadline_s: float) -> bytes:
        """The body, unpacked, at most `max_bytes`. Raises `BadReplyError`."""
        claimed = response.headers.get("Content-Length", "")
        if claimed.isdecimal() and int(claimed) > max_bytes:
            raise BadReplyError(f"body of {claimed} bytes is over the limit", again=False)
        unpacker = _Unpacker(response.headers.get("Content-Encoding", ""), max_bytes)
        while True:
            if self.turns.stop.is_set():
                raise Stopped
            if time.monotonic() > deadline_s:
                raise BadReplyError(f"took longer than {self.limits.total_s:g} s")
            part = response.raw.read1(_CHUNK, decode_content=False)
            if not part:
                break
            with self._lock:
                self.received_bytes += len(part)
            unpacker.add(part)
        return unpacker.whole()

    def _with_keys(self, url: str) -> str:
        """The address as it is sent. Raises `FetchError` where a key would leave its origin."""
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
            session.auth = _no_auth  # else keys of ~/.netrc would be sent
            session.mount("https://", requests.adapters.HTTPAdapter(max_retries=0))
            session.mount("http://", requests.adapters.HTTPAdapter(max_retries=0))
            self._local.session = session
            with self._lock:
                self._sessions.append(session)
        return session


class _Unpacker:
    """A body as it comes, unpacked where it is packed with gzip, up to a limit.

    urllib3 takes half a packed body for a whole one, so it is done here.
    """

    def __init__(self, packing: str, max_bytes: int) -> None:
        packing = packing.strip().lower()
        if packing not in ("", "identity", "gzip", "x-gzip"):
            raise BadReplyError(f"body is packed otherwise than asked for ({packing[:20]})")
        self._gzip = zlib.decompressobj(_GZIP) if "gzip" in packing else None
        self._max_bytes = max_bytes
        self._size = 0
        self._parts: list[bytes] = []

    def add(self, part: bytes) -> None:
        """Take the next part as it came. Raises `BadReplyError`."""
        while part:
            if self._gzip is None:
                self._keep(part)
                return
            if self._gzip.eof:  # another member, which gzip allows
                self._gzip = zlib.decompressobj(_GZIP)
            try:
                self._keep(self._gzip.decompress(part, self._max_bytes - self._size + 1))
            except zlib.error:
                raise BadReplyError("the answer's packing is broken") from None
            part = self._gzip.unconsumed_tail or self._gzip.unused_data

    def whole(self) -> bytes:
        """The body. Raises `BadReplyError` where it ended too early."""
        if self._gzip is not None and not self._gzip.eof:
            raise BadReplyError("the answer was cut short")
        return b"".join(self._parts)

    def _keep(self, part: bytes) -> None:
        self._size += len(part)
        if self._size > self._max_bytes:
            raise BadReplyError(f"body is over the limit of {self._max_bytes} bytes", again=False)
        self._parts.append(part)


def told(reply: Reply) -> str:
    """The beginning of what a service says in words, on one line, for an error."""
    text = reply.body[: 4 * _TOLD_CHARACTERS].decode("utf-8", errors="replace")
    words = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return words[:_TOLD_CHARACTERS]


def _no_auth(request: Any) -> Any:
    return request


def _broken(error: Exception) -> str:
    """What broke, by kind only."""
    kinds: list[tuple[tuple[type[BaseException], ...], str]] = [
        ((requests.exceptions.SSLError, urllib3.exceptions.SSLError), "no safe connection (TLS)"),
        ((requests.exceptions.ConnectTimeout,), "no connection in time"),
        (
            (requests.exceptions.Timeout, urllib3.exceptions.TimeoutError, TimeoutError),
            "no answer in time",
        ),
        ((requests.exceptions.ProxyError,), "the proxy refused"),
        ((urllib3.exceptions.IncompleteRead,), "the answer was cut short"),
        ((urllib3.exceptions.ProtocolError,), "the answer was cut short"),
    ]
    for classes, words in kinds:
        if isinstance(error, classes):
            return words
    return f"connection failed ({type(error).__name__})"
