"""Reading untrusted tables line by line: lengths and counts are bounded, and errors name lines."""

import csv
from collections.abc import Iterator
from typing import IO

MAX_LINE_CHARS = 65_536
"""Limit of a line of a table: a thousand columns of the longest numbers."""
MAX_ROWS = 5_000_000
"""Limit of rows that callers do not set: seven hours at 200 Hz."""


class TableError(ValueError):
    """A table has a line that is too long, too many lines, or is not text in UTF-8."""


def bounded_lines(stream: IO[str], most_chars: int = MAX_LINE_CHARS) -> Iterator[str]:
    """The lines of a text; raises `TableError` at one longer than `most_chars`."""
    number = 0
    while line := stream.readline(most_chars + 1):
        number += 1
        if len(line) > most_chars:
            raise TableError(f"line {number} is longer than {most_chars:,} characters")
        yield line


class TableRows:
    """Rows of a CSV with a header, as `csv.DictReader` gives them; read as they are asked for.

    `columns`: names in the header. `line`: number of the line last read. Raises `TableError`, at
    the header too.
    """

    def __init__(self, stream: IO[str], *, delimiter: str = ",", most_rows: int = MAX_ROWS) -> None:
        self._reader = csv.DictReader(
            bounded_lines(stream), delimiter=delimiter, skipinitialspace=True
        )
        self._most_rows = most_rows
        try:
            self.columns = list(self._reader.fieldnames or ())
        except (UnicodeDecodeError, csv.Error) as error:
            raise TableError(f"not a CSV file in UTF-8 ({error})") from error

    @property
    def line(self) -> int:
        """Number of the line last read, from 1."""
        return self._reader.line_num

    def __iter__(self) -> Iterator[dict[str, str | None]]:
        try:
            for count, row in enumerate(self._reader, start=1):
                if count > self._most_rows:
                    raise TableError(
                        f"line {self.line}: table has more than {self._most_rows:,} rows; divide it"
                    )
                yield row
        except (UnicodeDecodeError, csv.Error) as error:
            raise TableError(f"not a CSV file in UTF-8 ({error})") from error
