"""Results are written whole or not at all, whatever happens on the way."""

import errno
import os

import pytest

from orthonav.core.errors import MissingFileError, OutputError, RouteError
from orthonav.core.files import replacing, replacing_folder, require_file, write_text

INTERRUPTIONS = pytest.mark.parametrize(
    "interruption", [ValueError("bug"), KeyboardInterrupt(), SystemExit(3), RouteError("known")]
)


@pytest.fixture
def out(tmp_path):
    """A path in a folder of its own."""
    return tmp_path / "out" / "result.bin"


def names_in(folder):
    return sorted(path.name for path in folder.iterdir()) if folder.exists() else []


@pytest.mark.parametrize("old", [None, b"old"])
def test_success_puts_the_new_file_in_place(out, old):
    if old is not None:
        out.parent.mkdir()
        out.write_bytes(old)
    with replacing(out) as temporary:
        temporary.write_bytes(b"new")
        assert temporary.parent == out.parent and temporary.suffix == out.suffix
        assert (out.read_bytes() if out.exists() else None) == old
    assert out.read_bytes() == b"new" and names_in(out.parent) == ["result.bin"]


@INTERRUPTIONS
@pytest.mark.parametrize("old", [None, b"old"])
def test_what_interrupts_leaves_the_old_file_only(out, old, interruption):
    out.parent.mkdir()
    if old is not None:
        out.write_bytes(old)
    with pytest.raises(type(interruption)), replacing(out) as temporary:
        temporary.write_bytes(b"half")
        raise interruption
    assert names_in(out.parent) == ([] if old is None else ["result.bin"])
    assert old is None or out.read_bytes() == old


FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("writer", [replacing, replacing_folder])
@pytest.mark.parametrize(
    "error, message",
    [
        (FULL, "disk full; nothing was written"),
        (OSError(errno.EACCES, "Permission denied"), r"cannot write \(Permission denied\)"),
        (OSError(errno.EIO, "Input/output error"), "cannot write"),
    ],
)
def test_refusals_of_the_system_are_named_and_leave_no_folder(tmp_path, writer, error, message):
    (tmp_path / "kept").mkdir()
    out = tmp_path / "kept" / "a" / "b" / "out"
    with pytest.raises(OutputError, match=f"{message}.*: {out}$"), writer(out):
        raise error
    assert names_in(tmp_path) == ["kept"] and names_in(tmp_path / "kept") == []


def test_a_full_disk_while_a_file_of_a_folder_is_written(out):
    """The folder that was asked for is named, not the temporary one, and the old one stays."""
    with replacing_folder(out) as temporary:
        (temporary / "old").touch()
    with (
        pytest.raises(OutputError) as caught,
        replacing_folder(out, lambda _: True) as temporary,
        replacing(temporary / "figures" / "a.png"),
    ):
        raise FULL
    assert str(caught.value) == f"disk full; nothing was written: {out}"
    assert names_in(out) == ["old"] and names_in(out.parent) == ["result.bin"]


def test_a_disk_that_fills_up_when_synced(out, monkeypatch):
    out.parent.mkdir()
    out.write_text("old")

    def full(_):
        raise FULL

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match="disk full"):
        write_text(out, "new")
    assert out.read_text() == "old" and names_in(out.parent) == ["result.bin"]


@pytest.mark.parametrize("writer", [replacing, replacing_folder])
def test_a_place_that_cannot_be_written_is_refused(tmp_path, writer):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot write"), writer(tmp_path / "file" / "out"):
        pytest.fail("no work is done for a place that cannot be written")


@pytest.mark.parametrize("exists", [False, True], ids=["new", "empty"])
def test_a_folder_takes_its_place_at_the_end(out, exists):
    if exists:
        out.mkdir(parents=True)
    with replacing_folder(out) as temporary:
        (temporary / "a").write_text("a")
        assert not out.exists() or names_in(out) == []
    assert names_in(out) == ["a"] and names_in(out.parent) == ["result.bin"]


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_what_has_content_is_refused_before_any_work(out, kind):
    held = out / "held" if kind == "folder" else out
    held.parent.mkdir(parents=True)
    held.write_text("keep")
    with pytest.raises(OutputError, match="not empty"), replacing_folder(out):
        pytest.fail("no work is done for a folder that cannot be replaced")
    assert held.read_text() == "keep" and names_in(out.parent) == ["result.bin"]


def test_content_that_appears_meanwhile_is_kept(out):
    with pytest.raises(OutputError, match="cannot write"), replacing_folder(out) as temporary:
        (temporary / "mine").write_text("mine")
        out.mkdir()
        (out / "theirs").write_text("theirs")
    assert names_in(out) == ["theirs"] and names_in(out.parent) == ["result.bin"]


def test_a_required_file(tmp_path):
    path = tmp_path / "map.onav"
    with pytest.raises(MissingFileError, match=f"map does not exist: {path}"):
        require_file(path, "map")
    with pytest.raises(MissingFileError, match="map is a folder, not a file"):
        require_file(tmp_path, "map")
    path.touch()
    assert require_file(str(path), "map") == path
