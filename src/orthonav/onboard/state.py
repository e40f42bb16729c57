"""Where the aircraft was last, kept over a restart.

A small JSON file, replaced whole about once a second. It is not synced to the disk, which may take
long on memory cards: it outlives the process that is killed, not always the power.
"""

import json
import math
import os
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

from orthonav.records import Prior

VERSION = 1
MAX_BYTES = 100_000
SPEED_MPS = 30.0
"""How fast an aircraft may have gone on since: one standard deviation."""
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@dataclass(frozen=True)
class Saved:
    """A position with its standard deviation, and when that was, by two clocks.

    `mono_ns` counts while `boot_id` is the same, whatever is done to the clock of the computer.
    `signing_timestamp_10us` must not go back for a key: see `orthonav.publish.mavlink.Signing`.
    """

    lat_deg: float = math.nan
    lon_deg: float = math.nan
    std_m: float = math.nan
    utc_ns: int = 0
    mono_ns: int = 0
    boot_id: str = ""
    signing_timestamp_10us: int = 0

    def age_s(self, utc_ns: int, mono_ns: int, boot_id: str) -> float:
        """Seconds since it was saved; negative where the clock was set back."""
        if boot_id and boot_id == self.boot_id:
            return (mono_ns - self.mono_ns) / 1e9
        return (utc_ns - self.utc_ns) / 1e9


def boot_id() -> str:
    """Which run of the computer this is; empty where it does not say."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return ""


def prior_of(saved: Saved, age_s: float, max_age_s: float) -> Prior | None:
    """The position as a prior, as far off as it may be by now; None where it is too old."""
    known = abs(saved.lat_deg) <= 90 and abs(saved.lon_deg) <= 180 and saved.std_m > 0
    if not known or not 0 <= age_s <= max_age_s:
        return None
    return Prior(saved.lat_deg, saved.lon_deg, math.hypot(saved.std_m, SPEED_MPS * age_s))


def save(path: Path, saved: Saved) -> None:
    """Replace the file by a whole new one. Raises `OSError`."""
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "w", encoding="ascii") as stream:
            json.dump({"version": VERSION, **asdict(saved)}, stream, allow_nan=True)
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def load(path: Path) -> Saved | None:
    """What was saved; None where there is nothing, or it is damaged: then all begins anew."""
    try:
        if path.stat().st_size > MAX_BYTES:
            return None
        plain = json.loads(path.read_text(encoding="ascii"))
        if plain.pop("version") != VERSION:
            return None
        return Saved(
            lat_deg=float(plain["lat_deg"]),
            lon_deg=float(plain["lon_deg"]),
            std_m=float(plain["std_m"]),
            utc_ns=int(plain["utc_ns"]),
            mono_ns=int(plain["mono_ns"]),
            boot_id=str(plain["boot_id"]),
            signing_timestamp_10us=int(plain["signing_timestamp_10us"]),
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
