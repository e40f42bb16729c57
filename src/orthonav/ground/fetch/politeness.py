"""Request rate per host, waits that can be interrupted, and the retry policy."""

import threading
import time
from dataclasses import dataclass, field

from urllib3 import Retry
from urllib3.exceptions import InvalidHeader
from urllib3.util.retry import RequestHistory

from orthonav.core.errors import FetchError

RETRY_STATUS = frozenset({408, 425, 429, 500, 502, 503, 504})
"""Temporary by definition (RFC 9110, 6585, 8470): the same request may succeed later."""


@dataclass(frozen=True)
class RequestLimits:
    """How a service is asked. The defaults are conservative: no service asks for less in public."""

    parallel: int = 4
    """Requests at the same time."""
    per_second: float = 10.0
    """Requests per second and host."""
    attempts: int = 6
    """Requests for one address before it counts as failed."""
    backoff_s: float = 0.5
    """Pause before the first repetition; it doubles every time, plus random jitter up to this."""
    backoff_max_s: float = 30.0
    """Longest such pause."""
    wait_max_s: float = 120.0
    """Longest Retry-After that is waited for."""
    connect_s: float = 10.0
    """Timeout of a connection."""
    read_s: float = 30.0
    """Timeout between two reads of an answer."""
    total_s: float = 120.0
    """Timeout of a whole answer, redirects included."""
    max_bytes: int = 32 * 2**20
    """Largest body, unpacked."""
    max_redirects: int = 5
    """Redirects that are followed."""


class Stopped(Exception):  # noqa: N818 - not an error: the caller requested it
    """The whole run is being ended, by an interrupt or by an error in another thread."""


@dataclass
class Turns:
    """Permissions to send a request, by host, for all threads; setting `stop` ends every wait.

    Half a second's worth of requests may start together.
    """

    limits: RequestLimits
    stop: threading.Event = field(default_factory=threading.Event)
    _due_s: dict[str, float] = field(default_factory=dict)
    """When the requests of a host so far would be over at exactly its rate."""
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def wait(self, host: str) -> None:
        """Wait until a request may be sent to this host. Raises `Stopped`."""
        while (delay_s := self._take(host)) > 0:
            self.sleep(delay_s)

    def pause(self, host: str, seconds: float) -> None:
        """Send nothing to this host for so long, from any thread."""
        with self._lock:
            until_s = time.monotonic() + seconds + self._ahead_s
            self._due_s[host] = max(self._due_s.get(host, 0.0), until_s)

    def sleep(self, seconds: float) -> None:
        """Wait. Raises `Stopped` as soon as the run is ended."""
        if self.stop.wait(seconds):
            raise Stopped

    def _take(self, host: str) -> float:
        """Seconds until a request may be sent; 0 where it may now, and counts."""
        with self._lock:
            if self.stop.is_set():
                raise Stopped
            now_s = time.monotonic()
            due_s = max(self._due_s.get(host, 0.0), now_s)
            if due_s - now_s > self._ahead_s:
                return due_s - now_s - self._ahead_s
            self._due_s[host] = due_s + 1 / self.limits.per_second
            return 0.0

    @property
    def _ahead_s(self) -> float:
        """How far requests may be ahead of the rate."""
        return max(0.0, 0.5 - 1 / self.limits.per_second)


def retry_policy(limits: RequestLimits) -> Retry:
    """urllib3's policy for one address: which status, how often, after which pause.

    It counts and computes pauses; the client itself repeats and sleeps. An adapter that repeats on
    its own would bypass the rate per host, could not be interrupted, and could not repeat what
    only the body shows: an HTML page instead of an image, half a file.
    """
    # urllib3 repeats at once after the first failure. Half the factor and one entry of history
    # make it wait `backoff_s` already then.
    return Retry(
        total=max(1, limits.attempts) - 1,
        status_forcelist=RETRY_STATUS,
        backoff_factor=limits.backoff_s / 2,
        backoff_jitter=limits.backoff_s,
        backoff_max=limits.backoff_max_s,
        history=(RequestHistory("GET", None, None, None, None),),
    )


def retry_after_s(value: str | None, limits: RequestLimits) -> float | None:
    """Seconds that a Retry-After header asks for; None where there is none or it is malformed.

    Raises `FetchError` where it exceeds `limits.wait_max_s`.
    """
    try:
        seconds = retry_policy(limits).parse_retry_after(value) if value else None
    except (InvalidHeader, ValueError, OverflowError):
        return None
    if seconds is not None and seconds > limits.wait_max_s:
        raise FetchError(
            f"the service asks to come back in {seconds:.0f} s; run the command again then"
        )
    return seconds
