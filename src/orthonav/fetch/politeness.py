"""How often a host is asked: a token bucket per host, and waiting that can be stopped."""

import random
import threading
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime

from orthonav.errors import FetchError


@dataclass(frozen=True)
class Limits:
    """How a service is asked. Times in seconds; `per_second` requests per host, `parallel` at once.

    `attempts` is how often one address is asked before it counts as failed; `total_s` the longest
    one answer may take; `max_bytes` the largest body; `wait_max_s` the longest wait that a service
    may ask for (Retry-After) before it counts as failed.
    """

    parallel: int = 4
    per_second: float = 10.0
    attempts: int = 6
    backoff_s: float = 0.5
    backoff_max_s: float = 30.0
    wait_max_s: float = 120.0
    connect_s: float = 10.0
    read_s: float = 30.0
    total_s: float = 120.0
    max_bytes: int = 32 * 2**20
    max_redirects: int = 5


class Stopped(Exception):  # noqa: N818 - no error: the caller asked for it
    """The whole run is being ended, by an interrupt or an error elsewhere."""


@dataclass
class _Bucket:
    per_second: float
    tokens: float
    filled_s: float
    paused_until_s: float = 0.0


@dataclass
class Turns:
    """Turns to ask, by host; `stop` ends every wait. One of them serves all threads."""

    limits: Limits
    stop: threading.Event = field(default_factory=threading.Event)
    _buckets: dict[str, _Bucket] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def wait(self, host: str) -> None:
        """Wait for a turn. Raises `Stopped`."""
        while True:
            delay_s = self._take(host)
            if delay_s <= 0:
                return
            self.sleep(delay_s)

    def pause(self, host: str, seconds: float) -> None:
        """Let nobody ask this host for so long: it said so."""
        with self._lock:
            bucket = self._bucket(host)
            bucket.paused_until_s = max(bucket.paused_until_s, time.monotonic() + seconds)

    def sleep(self, seconds: float) -> None:
        """Wait. Raises `Stopped`, at once, when the run is ended meanwhile."""
        if self.stop.wait(seconds):
            raise Stopped

    def _take(self, host: str) -> float:
        """Seconds to wait before asking again for a turn; 0 where the turn was given."""
        with self._lock:
            if self.stop.is_set():
                raise Stopped
            bucket, now_s = self._bucket(host), time.monotonic()
            if now_s < bucket.paused_until_s:
                return bucket.paused_until_s - now_s
            # Half a second's worth may come at once, so that parallel requests start together.
            most = max(1.0, bucket.per_second / 2)
            bucket.tokens = min(most, bucket.tokens + (now_s - bucket.filled_s) * bucket.per_second)
            bucket.filled_s = now_s
            if bucket.tokens >= 1:
                bucket.tokens -= 1
                return 0.0
            return (1 - bucket.tokens) / bucket.per_second

    def _bucket(self, host: str) -> _Bucket:
        if host not in self._buckets:
            rate = self.limits.per_second
            self._buckets[host] = _Bucket(rate, max(1.0, rate / 2), time.monotonic())
        return self._buckets[host]


def backoff_s(limits: Limits, attempt: int) -> float:
    """Seconds before attempt `attempt` (1 is the second): doubling, with jitter of a half."""
    longest = min(limits.backoff_max_s, limits.backoff_s * 2.0 ** (attempt - 1))
    return longest * random.uniform(0.5, 1.0)


def retry_after_s(value: str | None, limits: Limits) -> float | None:
    """Seconds that a Retry-After header asks for (RFC 9110, 10.2.3); None where it says nothing.

    Raises `FetchError` where it is more than `limits.wait_max_s`.
    """
    if not value:
        return None
    text = value.strip()
    if text.isdecimal() and len(text) < 10:
        seconds = float(text)
    else:
        try:
            then = parsedate_to_datetime(text)
        except (ValueError, TypeError, OverflowError):
            return None
        if then.tzinfo is None:
            then = then.replace(tzinfo=UTC)
        seconds = max(0.0, (then - datetime.now(UTC)).total_seconds())
    if seconds > limits.wait_max_s:
        raise FetchError(
            f"the service asks to come back in {seconds:.0f} s; run the command again then"
        )
    return seconds
