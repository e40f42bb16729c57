"""Telemetry logs of all kinds, detected by content."""

import re
from pathlib import Path

from orthonav.core.errors import FlightError
from orthonav.core.files import require_file
from orthonav.core.flight.telemetry_track import RecordedTrack
from orthonav.core.geo.attitude import Angles
from orthonav.ground.recordings import ardupilot, ulog
from orthonav.ground.recordings.subtitles import read_srt
from orthonav.ground.recordings.table import read_table

_SRT = re.compile(rb"\d+:\d\d:\d\d[,.]\d{1,3}\s*-->")


def log_kind(path: Path) -> str:
    """`ulog`, `dataflash`, `tlog`, `srt` or `table`, by content.

    Raises `MissingFileError`, or `FlightError` for any other file.
    """
    path = require_file(path, "telemetry log")
    with path.open("rb") as stream:
        head = stream.read(4096)
    if not head:
        raise FlightError(f"telemetry log is empty: {path}")
    if head.startswith(ulog.MAGIC):
        return "ulog"
    if head.startswith(ardupilot.DATAFLASH_MAGIC):
        return "dataflash"
    if len(head) > 8 and head[0] == 0 and head[8] in ardupilot.MAVLINK_MAGICS:
        return "tlog"
    text = head.replace(b"\0", b"") if head[:2] in (b"\xff\xfe", b"\xfe\xff") else head
    if _SRT.search(text):
        return "srt"
    if b"time_s" in head.partition(b"\n")[0]:
        return "table"
    raise FlightError(
        "expected a PX4 log (.ulg), an ArduPilot log (.bin), a telemetry log (.tlog), subtitles "
        f"(.srt) or a table with a time_s column (.csv): {path}"
    )


def read_log(path: Path, mount_deg: Angles) -> RecordedTrack:
    """The track of a log. `mount_deg` applies where the log holds the attitude of the body."""
    kind = log_kind(path)
    if kind == "ulog":
        return ulog.read_ulog(path, mount_deg)
    if kind == "dataflash":
        return ardupilot.read_dataflash(path, mount_deg)
    if kind == "tlog":
        return ardupilot.read_tlog(path, mount_deg)
    return read_srt(path) if kind == "srt" else read_table(path)
