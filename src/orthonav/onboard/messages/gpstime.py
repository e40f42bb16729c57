"""GPS week and time of week of a UTC time.

GPS time equalled UTC on 1980-01-06 and has no leap seconds, so it is ahead by those inserted since.
Source of the dates: IERS Bulletin C. The last leap second here is that before 2017-01-01; a new one
must be added to `_LEAPS`.
"""

from bisect import bisect_right
from datetime import UTC, datetime

_LEAPS = (
    *("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01"),
    *("1991-01-01", "1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01"),
    *("1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
)
"""Days that began after a leap second."""


def _unix_s(day: str) -> int:
    return int(datetime.fromisoformat(day).replace(tzinfo=UTC).timestamp())


_LEAPS_UNIX_S = tuple(_unix_s(day) for day in _LEAPS)
_EPOCH_UNIX_S = _unix_s("1980-01-06")
_WEEK_MS = 7 * 86_400_000


def gps_time(utc_ns: int) -> tuple[int, int]:
    """GPS week (without rollover at 1024) and time of week in ms, of a UTC time in ns since 1970.

    (0, 0), which receivers read as "not known", before 1980-01-06.
    """
    utc_ms = utc_ns // 1_000_000
    leaps = bisect_right(_LEAPS_UNIX_S, utc_ms // 1000)
    since_epoch_ms = utc_ms - _EPOCH_UNIX_S * 1000 + leaps * 1000
    if since_epoch_ms < 0:
        return 0, 0
    return divmod(since_epoch_ms, _WEEK_MS)
