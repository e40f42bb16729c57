"""What the boxes of an MP4 or MOV say and OpenCV does not (ISO/IEC 14496-12, QuickTime)."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

_PARENTS = (b"moov", b"trak", b"edts", b"mdia", b"minf", b"stbl")
_READ = (b"mvhd", b"mdhd", b"hdlr", b"elst", b"stsd")
MAX_BOXES, MAX_BOX_BYTES = 10_000, 100_000


class Movie(NamedTuple):
    whole: bool  # whether the file has all bytes that its boxes announce
    hides: bool  # whether edits hide frames at the begin or the end
    shown_s: float  # duration without hidden frames
    formats: bytes  # formats of its tracks, one a line, such as b"tx3g", subtitles


def read_movie(path: Path) -> Movie | None:
    """None where the file is of another format, or its boxes cannot be read."""
    tracks: list[dict[bytes, bytes]] = [{}]
    try:
        for kind, content in _boxes(path):
            tracks += [{}] if kind == b"trak" else []
            tracks[-1].setdefault(kind, content)
        scale, _ = _clock(tracks[0][b"mvhd"])
        pictures = [each for each in tracks[1:] if each[b"hdlr"][8:12] == b"vide"]
        longest = max(pictures, key=lambda track: _seconds(track[b"mdhd"]))
        media_s, edits = _seconds(longest[b"mdhd"]), longest.get(b"elst")
        shown_s = media_s if edits is None else _shown(edits) / scale
    except (struct.error, KeyError, ValueError, ZeroDivisionError):
        return None
    formats = b"\n".join(each.get(b"stsd", b"")[12:16] for each in tracks)
    return Movie(not any(b"" in each for each in tracks), 0 < shown_s < media_s, shown_s, formats)


def _boxes(path: Path) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of the boxes, parents before their children; kind b"" for one cut short."""
    start, end = 0, path.stat().st_size
    with path.open("rb") as stream:
        for _ in range(MAX_BOXES):
            stream.seek(start)
            head = stream.read(16)
            if len(head) < 8:
                return
            size, kind = struct.unpack_from(">I4s", head)
            body = start + (16 if size == 1 else 8)
            size = struct.unpack_from(">Q", head, 8)[0] if size == 1 else size or end - start
            if start + size < body:
                raise ValueError("box is shorter than its head")
            stream.seek(body)
            yield kind, stream.read(min(size, MAX_BOX_BYTES)) if kind in _READ else b""
            if start + size > end:
                yield b"", b""
            start = body if kind in _PARENTS else start + size


def _clock(box: bytes) -> tuple[int, int]:
    """Ticks in a second, and the duration in ticks."""
    late = box[:1] == b"\1"
    scale, ticks = struct.unpack_from(">IQ" if late else ">II", box, 20 if late else 12)
    return scale, ticks


def _seconds(box: bytes) -> float:
    scale, ticks = _clock(box)
    return ticks / scale


def _shown(edits: bytes) -> int:
    """Duration of a list of edits without those that show nothing, in ticks of the movie."""
    entry = struct.Struct(">Qqi" if edits[:1] == b"\1" else ">Iii")
    count = min(*struct.unpack_from(">I", edits, 4), (len(edits) - 8) // entry.size)
    shown = entry.iter_unpack(edits[8 : 8 + count * entry.size])
    return sum(ticks for ticks, media_time, _ in shown if media_time != -1)
