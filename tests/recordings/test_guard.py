"""Libraries that are not there or fail are one line that says what to do."""

import ctypes
import sys
from pathlib import Path

import pytest

from orthonav.core.errors import CameraError, FlightError, MissingExtraError
from orthonav.core.guard import needed, reading


def test_a_library_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyulog.core", None)
    with pytest.raises(MissingExtraError, match=r"PX4 logs needs pyulog: pip install 'orthonav\[f"):
        needed("pyulog.core", "PX4 logs")


@pytest.mark.parametrize(
    "raised, caught, words",
    [
        (KeyError("one\ntwo"), FlightError, r"^log cannot be read \(KeyError: 'one\\ntwo'\): /x$"),
        (MemoryError(), FlightError, "MemoryError: no details"),
        (CameraError("ours"), CameraError, "^ours$"),
        (KeyboardInterrupt(), KeyboardInterrupt, "^$"),
    ],
)
def test_exceptions_of_libraries_become_one_line(raised, caught, words):
    with pytest.raises(caught, match=words), reading("log", Path("/x")):
        raise raised


def test_silence_ends_where_it_began(tmp_path, capfd):
    with reading("log", tmp_path, silent=True):
        print("unheard")
        print("unheard", file=sys.stderr)
        ctypes.CDLL(None).dprintf(2, b"unheard\n")
    print("heard")
    print("heard", file=sys.stderr)
    assert capfd.readouterr() == ("heard\n", "heard\n")
