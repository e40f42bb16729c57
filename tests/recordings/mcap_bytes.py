"""Records of MCAP byte by byte, and data that unpack to far more than they take."""

import struct

MAGIC = b"\x89MCAP0\r\n"
MB = 2**20


def line(opcode, body):
    return bytes([opcode]) + struct.pack("<Q", len(body)) + body


def header(profile):
    return MAGIC + line(1, struct.pack("<I", len(profile)) + profile + bytes(4))


def chunk(data, size, kind=b"zstd", crc=0):
    """A chunk that states `size` bytes."""
    body = struct.pack("<QQQII", 0, 1, size, crc, len(kind)) + kind
    return line(6, body + struct.pack("<Q", len(data)) + data)


def zeros(size, compressor):
    """`size` zeros in a few kilobytes, made in pieces."""
    pieces = [compressor.compress(bytes(MB)) for _ in range(size // MB)]
    return b"".join(pieces) + compressor.flush()
