"""The newest serial number flown with each signing key, in a file next to that of `--state`.

An older map of the same key is refused without being asked for, so that a copy left on a memory
card is not flown by mistake. The file is separate from the state because it outlives flights.
"""

import json
import logging
from pathlib import Path

from orthonav.core.errors import MapFileError, OutputError
from orthonav.core.files import write_text
from orthonav.core.mapfile.signature import MAX_SERIAL, Signature

MAX_BYTES = 100_000
log = logging.getLogger(__name__)


def serials_path(state: Path) -> Path:
    """The file that belongs to a state file."""
    return state.with_name(f"{state.name}.serials")


def require_newest(state: Path, signature: Signature, map_path: Path) -> None:
    """Refuse a map older than the newest flown with its key; else remember its serial number.

    A file that is damaged or cannot be written is a warning: it must not keep a flight from being
    resumed. Raises `MapFileError`.
    """
    path = serials_path(state)
    known = _read(path)
    newest = known.get(signature.key_id)
    if newest is not None and signature.serial < newest:
        raise MapFileError(
            f"map has serial number {signature.serial}, and one with serial number {newest} of the "
            f"same key was flown; to fly an older map, sign it again or remove {path}: {map_path}"
        )
    if signature.serial == newest:
        return
    try:
        write_text(path, json.dumps({**known, signature.key_id: signature.serial}) + "\n")
    except OutputError as error:
        log.warning("serial number of the map is not remembered: %s", error)


def _read(path: Path) -> dict[str, int]:
    try:
        with path.open("rb") as stream:
            plain = json.loads(stream.read(MAX_BYTES))
        known = {
            str(key): serial
            for key, serial in plain.items()
            if type(serial) is int and 0 <= serial <= MAX_SERIAL
        }
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, AttributeError, RecursionError) as error:
        log.warning("serial numbers of flown maps cannot be read (%s): %s", error, path)
        return {}
    return known
