"""Non-blocking ports for bytes: UDP, TCP, serial.

`pymavlink.mavutil` is not used: it blocks for 2 s where a TCP port refuses, sends to whoever sent
the last datagram, and needs pyserial.
"""

import errno
import os
import select
import socket
import termios
import time
import tty
from collections.abc import Callable

from orthonav.core.errors import VariantError

LOOPBACK = "127.0.0.1"


def retry_s(failures: int) -> float:
    """Pause before a device is opened again after so many failures."""
    return (0.5, 1.0, 2.0, 5.0)[min(failures, 3)]


class Udp:
    """UDP socket. Without `peer` it listens, and sends to the address of the autopilot heard."""

    def __init__(self, bind: tuple[str, int] | None, peer: tuple[str, int] | None) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._peer, self._candidate, self._fixed = peer, peer, peer is not None
        try:
            if bind is not None:
                self._socket.bind(bind)
        except OSError:
            self._socket.close()
            raise

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self) -> bytes:
        """Read one datagram; a peer that does not listen yet is no error."""
        try:
            data, self._candidate = self._socket.recvfrom(65_536)
        except (BlockingIOError, InterruptedError, ConnectionRefusedError):
            return b""
        return data

    def heard(self) -> None:
        if not self._fixed:
            self._peer = self._candidate

    def write(self, data: bytes) -> bool:
        try:
            return self._peer is not None and self._socket.sendto(data, self._peer) > 0
        except (BlockingIOError, ConnectionRefusedError):
            return False

    def close(self) -> None:
        self._socket.close()


class Descriptor:
    def __init__(self, fd: int) -> None:
        self._fd = fd
        os.set_blocking(fd, False)

    def fileno(self) -> int:
        return self._fd

    def read(self) -> bytes:
        """Available data; raises `OSError` at the end of the stream."""
        try:
            data = os.read(self._fd, 4096)
        except BlockingIOError:
            return b""
        if not data:
            raise ConnectionResetError(errno.ECONNRESET, "the other end closed")
        return data

    def heard(self) -> None: ...

    def write(self, data: bytes) -> bool:
        """Send all or nothing: half a message would damage the next one."""
        sent, deadline = 0, time.monotonic() + 0.1
        while sent < len(data) and time.monotonic() < deadline:
            try:
                sent += os.write(self._fd, data[sent:])
            except BlockingIOError:
                if not sent:  # the buffer is full: a delayed position is of no use
                    return False
                select.select([], [self._fd], [], 0.02)
        return sent == len(data)

    def close(self) -> None:
        os.close(self._fd)


Transport = Udp | Descriptor
"""Bytes in and out without blocking. `read` gives what is there, `write` sends one message, False
where the port does not take it; both raise `OSError` on failure."""


def open_serial(device: str, baud: int) -> Descriptor:
    """Open a serial port, raw, 8N1. Raises `VariantError` for an unsupported speed."""
    speed = _speed(device, baud)
    fd = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        tty.setraw(fd)
        settings = termios.tcgetattr(fd)
        settings[2] = (settings[2] | termios.CLOCAL | termios.CREAD) & ~termios.CRTSCTS
        settings[4] = settings[5] = speed
        termios.tcsetattr(fd, termios.TCSANOW, settings)
    except (termios.error, OSError) as error:
        os.close(fd)
        raise OSError(errno.EIO, f"not a serial port ({error})", device) from error
    return Descriptor(fd)


def _speed(device: str, baud: int) -> int:
    speed = getattr(termios, f"B{baud}", 0)
    if not speed:
        raise VariantError(f"unsupported speed of a serial port, {baud} baud: {device}")
    return int(speed)


def _open_tcp(host: str, port: int) -> Descriptor:
    with socket.create_connection((host, port), timeout=2.0) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return Descriptor(os.dup(connection.fileno()))


def transport_opener(url: str) -> Callable[[], Transport]:
    """Opener of a pymavlink connection string: `udpin:[HOST:]PORT` (default HOST: loopback),
    `udpout:HOST:PORT`, `tcp:HOST:PORT` or `[serial:]DEVICE[:BAUD]`. Raises `VariantError`."""
    kind, _, rest = url.partition(":")
    if kind in ("udpin", "udp"):
        bind = host_port(rest, url)
        return lambda: Udp(bind, None)
    if kind == "udpout":
        peer = host_port(rest, url)
        return lambda: Udp(None, peer)
    if kind == "tcp":
        there = host_port(rest, url)
        return lambda: _open_tcp(*there)
    device, baud = device_baud(rest if kind == "serial" else url, url)
    return lambda: open_serial(device, baud)


def host_port(text: str, url: str, usual: int = 14550) -> tuple[str, int]:
    """Host and port of `[HOST:]PORT`; the default host is the loopback. `usual`: port of hints."""
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdigit() and 0 <= int(port) <= 65_535):
        hint = f"{url.partition(':')[0]}:{host or text or LOOPBACK}:{usual}"
        raise VariantError(f"expected HOST:PORT, such as {hint}, got '{url}'")
    return host or LOOPBACK, int(port)


def device_baud(text: str, url: str) -> tuple[str, int]:
    """Device and speed of `DEVICE[:BAUD]`. Raises `VariantError`."""
    device, _, baud = text.replace(",", ":").partition(":")
    if not device.startswith("/") or not (baud == "" or baud.isdigit()):
        raise VariantError(
            "expected udpin:[HOST:]PORT, udpout:HOST:PORT, tcp:HOST:PORT or /dev/DEVICE:BAUD, "
            f"got '{url}'"
        )
    found = int(baud) if baud else 57_600
    _speed(device, found)
    return device, found
