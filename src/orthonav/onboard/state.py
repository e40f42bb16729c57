"""The last position of the aircraft, saved for a restart, and the serial numbers of flown maps.

Files are replaced atomically, but not synced, which is slow on memory cards: they survive a killed
process, but not always a power cut.
"""

import contextlib
import json
import logging
import math
import os
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from orthonav.core.errors import MapFileError, OutputError
from orthonav.core.files import write_text
from orthonav.core.mapfile.signature import MAX_SERIAL, Signature
from orthonav.core.records import Prior
from orthonav.onboard.gnss.biases import Biases, biases_from_plain

VERSION = 1
MAX_BYTES = 100_000
MAX_AGE_S = 300.0
"""Of a saved position from which a flight starts."""
SAVE_S = 10.0
"""A state is saved again after so long without a new position, for the signing timestamp."""
SPEED_MPS = 30.0
"""Standard deviation of the speed of the aircraft since the position was saved: assumed."""
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SavedState:
    """A position with its standard deviation, and when it was taken, by two clocks."""

    lat_deg: float = math.nan
    lon_deg: float = math.nan
    std_m: float = math.nan  # along the worst axis
    utc_ns: int = 0  # time of exposure
    mono_ns: int = 0  # the same; valid while `boot_id` is the same
    boot_id: str = ""  # that of the operating system
    signing_timestamp_10us: int = 0  # see `orthonav.onboard.messages.mavlink.Signing`

    def age_s(self, utc_ns: int, mono_ns: int, boot_id: str) -> float:
        """Age of the position in seconds; negative where the clock was set back."""
        if boot_id and boot_id == self.boot_id:
            return (mono_ns - self.mono_ns) / 1e9
        return (utc_ns - self.utc_ns) / 1e9


def boot_id() -> str:
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""


def prior_of(saved: SavedState, age_s: float) -> Prior | None:
    """Prior from a saved position, its deviation grown with age; None where it is too old."""
    known = abs(saved.lat_deg) <= 90 and abs(saved.lon_deg) <= 180 and saved.std_m > 0
    if not known or not 0 <= age_s <= MAX_AGE_S:
        return None
    return Prior(saved.lat_deg, saved.lon_deg, math.hypot(saved.std_m, SPEED_MPS * age_s))


def save(path: Path, saved: SavedState, maps: Mapping[str, Any] | None = None) -> None:
    """Replace the file atomically; `maps` None keeps what it has of them. Raises `OSError`."""
    maps = _maps_of(path) if maps is None else maps
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "w", encoding="ascii") as stream:
            latest = dict(list(maps.items())[-100:])
            json.dump({"version": VERSION, **asdict(saved), "maps": latest}, stream)
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def learnt_biases(path: Path) -> dict[str, Biases]:
    """What was learnt of maps, by their digest, the latest last; invalid entries are left out."""
    found = {}
    for digest, plain in _maps_of(path).items():
        with contextlib.suppress(KeyError, TypeError, ValueError, OverflowError):
            found[digest] = biases_from_plain(plain)
    return found


def reference_biases(path: Path, digest: str) -> Biases | None:
    """Reference of the flight that saved the file over a map; None where none is stored."""
    with contextlib.suppress(KeyError, TypeError, ValueError, OverflowError):
        return biases_from_plain(_maps_of(path)[digest]["reference"])
    return None


def _maps_of(path: Path) -> dict[str, Any]:
    maps = _plain_of(path).get("maps")
    return maps if isinstance(maps, dict) else {}


def _plain_of(path: Path) -> dict[str, Any]:
    try:
        return _object(path)
    except (OSError, ValueError, RecursionError):
        return {}


def _object(path: Path) -> dict[str, Any]:
    """Of a file of JSON. Raises `OSError`, `ValueError` or `RecursionError`."""
    with path.open("rb") as stream:
        plain = json.loads(stream.read(MAX_BYTES))  # a larger file is no JSON then
    if not isinstance(plain, dict):
        raise ValueError("not an object")
    return plain


def load(path: Path) -> SavedState | None:
    plain = _plain_of(path)
    if plain.get("version") != VERSION:
        return None
    try:
        return SavedState(
            **{name: type(value)(plain[name]) for name, value in asdict(SavedState()).items()}
        )
    except (ValueError, KeyError, TypeError, OverflowError):
        return None


def serials_path(state: Path) -> Path:
    """File of the newest serial number flown with each key; it outlives the state of a flight."""
    return state.with_name(f"{state.name}.serials")


def require_newest(state: Path, signature: Signature, map_path: Path) -> None:
    """Refuse a map older than the newest flown with its key; else remember its serial number.

    A damaged or unwritable file is a warning: it must not keep a flight from being resumed.
    """
    path = serials_path(state)
    known = _read(path)
    newest = known.get(signature.key_id)
    serial = -1 if signature.serial is None else signature.serial
    if newest is not None and serial < newest:
        has = "no serial number" if signature.serial is None else f"serial number {serial}"
        raise MapFileError(
            f"map has {has}, and one with serial number {newest} of the same key was flown; to fly "
            f"an older map, sign it again or remove {path}: {map_path}"
        )
    if signature.serial is None or serial == newest:
        return
    try:
        write_text(path, json.dumps({**known, signature.key_id: serial}) + "\n")
    except OutputError as error:
        log.warning("serial number of the map is not remembered: %s", error)


def _read(path: Path) -> dict[str, int]:
    try:
        serials = _object(path).items()
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError) as error:
        log.warning("serial numbers of flown maps cannot be read (%s): %s", error, path)
        return {}
    return {
        key: serial for key, serial in serials if type(serial) is int and 0 <= serial <= MAX_SERIAL
    }
