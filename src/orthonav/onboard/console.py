"""Lines on stderr, written by a thread of their own.

A flight must not wait for its terminal: a closed stderr is ignored, and where nobody reads a pipe,
lines are dropped.
"""

import contextlib
import logging
import os
import queue
import sys
import threading
from collections.abc import Callable, Iterator
from typing import TextIO

from orthonav.onboard.telemetry import Clocks

MOST_LINES = 1000
"""Lines that wait for a slow reader; later ones are dropped."""
CLOSE_S = 1.0
"""Longest time that the last lines may take at the end."""


class Console:
    """Takes lines and never blocks. Thread-safe.

    `is_terminal`: whether a person may be reading. `is_open`: whether there is a stream at all.
    `quiet`: warnings only.
    """

    def __init__(self, stream: TextIO | None, clocks: Clocks, *, quiet: bool = False) -> None:
        """`stream`: usually stderr; None where it is closed."""
        self._clocks, self.quiet = clocks, quiet
        self._begun_ns = clocks.mono_ns()
        self._lines: queue.Queue[str | None] = queue.Queue(MOST_LINES)
        descriptor = _descriptor(stream)
        self.is_open = descriptor is not None
        self.is_terminal = descriptor is not None and os.isatty(descriptor)
        self._thread = threading.Thread(
            target=self._write, args=(descriptor,), name="console", daemon=True
        )
        self._thread.start()

    def say(self, text: str) -> None:
        """Write a line, unless quiet."""
        if not self.quiet:
            self.put(text)

    def warn(self, text: str) -> None:
        """Write a warning."""
        self.put(f"WARNING: {text}")

    def put(self, text: str) -> None:
        """Write a line with the time since the start."""
        seconds = (self._clocks.mono_ns() - self._begun_ns) / 1e9
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(f"{seconds:8.1f} s  {text}\n")

    def close(self) -> None:
        """Write the waiting lines, for at most `CLOSE_S`."""
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(None)
        self._thread.join(CLOSE_S)

    @contextlib.contextmanager
    def in_place_of_stderr(self) -> Iterator[None]:
        """Write log records meanwhile which otherwise go to stderr, at least warnings."""
        root = logging.getLogger()
        handlers, level = list(root.handlers), root.level
        if self.is_open:
            root.handlers = [self._in_place_of(each) for each in handlers]
            root.setLevel(min(level, logging.WARNING))
        try:
            yield
        finally:
            if self.is_open:
                root.handlers = handlers
                root.setLevel(level)

    def _in_place_of(self, handler: logging.Handler) -> logging.Handler:
        if getattr(handler, "stream", None) is not sys.stderr:
            return handler
        made = _Records(self.put)
        made.setFormatter(handler.formatter)
        return made

    def _write(self, descriptor: int | None) -> None:
        # Not by the stream: a thread that holds its lock at the end would abort the interpreter.
        while (line := self._lines.get()) is not None:
            data = line.encode("utf-8", "backslashreplace")
            with contextlib.suppress(OSError):  # nobody reads any more, or a full disk
                while descriptor is not None and data:
                    data = data[os.write(descriptor, data) :]


class _Records(logging.Handler):
    """Passes log records on as text."""

    def __init__(self, put: Callable[[str], None]) -> None:
        super().__init__()
        self._put = put

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler.emit`."""
        self._put(self.format(record))


def _descriptor(stream: TextIO | None) -> int | None:
    """Descriptor of a stream; None where it has none."""
    try:
        return None if stream is None else stream.fileno()
    except (OSError, ValueError):  # closed, or replaced by an object in memory
        return None
