"""Reading untrusted tables line by line: lengths and counts are bounded, and errors name lines."""

import csv
import re
from collections.abc import Iterator
from typing import IO

MAX_LINE_CHARS = 65_536  # A thousand columns of the longest numbers
MAX_ROWS = 5_000_000  # seven hours at 200 Hz


class TableError(ValueError):
    pass


def bounded_lines(stream: IO[str], most_chars: int = MAX_LINE_CHARS) -> Iterator[str]:
    """Raises `TableError` at a line longer than `most_chars`."""
    number = 0
    while line := stream.readline(most_chars + 1):
        number += 1
        if len(line) > most_chars:
            raise TableError(f"line {number} is longer than {most_chars:,} characters")
        yield line


def _is_number(text: str) -> bool:
    return re.fullmatch(r"[-+]?\d+(\.\d+)?", text.strip()[:40]) is not None


class TableRows:
    """Rows as of `csv.DictReader`, with `columns` of the header; raises `TableError`, there too."""

    def __init__(self, stream: IO[str], *, delimiter: str = ",", most_rows: int = MAX_ROWS) -> None:
        self._reader = csv.DictReader(
            bounded_lines(stream), delimiter=delimiter, skipinitialspace=True
        )
        self._most_rows, self._commas = most_rows, delimiter == ","
        try:
            self.columns = list(self._reader.fieldnames or ())
        except (UnicodeDecodeError, csv.Error) as error:
            raise TableError(f"not a CSV file in UTF-8 ({error})") from error

    @property
    def line(self) -> int:
        return self._reader.line_num

    def __iter__(self) -> Iterator[dict[str, str | None]]:
        try:
            for count, row in enumerate(self._reader, start=1):
                if count > self._most_rows:
                    raise TableError(
                        f"line {self.line}: table has more than {self._most_rows:,} rows; divide it"
                    )
                unnamed = row.pop(None, None) or ()
                last = next(reversed(row.values()), None) or ""
                if self._commas and _is_number(last) and any(map(_is_number, unnamed)):
                    raise TableError(
                        f"line {self.line} has more numbers than the header has columns; where "
                        "commas separate fields, numbers need a point"
                    )
                yield row
        except (UnicodeDecodeError, csv.Error) as error:
            raise TableError(f"not a CSV file in UTF-8 ({error})") from error
