"""The storage of an atlas: whole files or none, nothing outside it, failures with their cause."""

import errno
import hashlib
import os
import sys
from typing import ClassVar

import fsspec
import pytest
from fsspec.implementations.local import LocalFileSystem

from orthonav.core.errors import MissingExtraError, StorageError
from orthonav.ground.atlas.store import Store, cache_folder


class Trouble(LocalFileSystem):
    """A remote file system that fails as `fails` says."""

    protocol = "trouble"
    fails: ClassVar = {}

    @classmethod
    def _strip_protocol(cls, path):
        return super()._strip_protocol(str(path).removeprefix("trouble://"))

    def __getattribute__(self, name):
        if name in Trouble.fails:
            raise Trouble.fails[name]
        return super().__getattribute__(name)

    def pipe_file(self, path, value, **kwargs):
        self.makedirs(self._parent(path), exist_ok=True)
        super().pipe_file(path, value, **kwargs)

    def put_file(self, lpath, rpath, **kwargs):
        self.makedirs(self._parent(rpath), exist_ok=True)
        super().put_file(lpath, rpath, **kwargs)


@pytest.fixture(autouse=True)
def trouble(monkeypatch):
    monkeypatch.setattr(Trouble, "fails", {})
    fsspec.register_implementation("trouble", Trouble, clobber=True)
    return Trouble.fails


@pytest.fixture(params=["folder", "memory", "trouble"])
def store(request, tmp_path):
    root = tmp_path / "atlas"
    url = {"folder": str(root), "memory": "memory://test/atlas", "trouble": f"trouble://{root}"}
    return Store(url[request.param])


def sha256(data):
    return hashlib.sha256(data).hexdigest()


def test_files_that_are_put_are_there(store, tmp_path):
    (tmp_path / "file").write_bytes(b"some map")
    store.write("sheets/a.onav", tmp_path / "file")
    store.write("items/b.1.json", b"{}")
    store.write("items/c.1.json", b"[1]")
    store.write("items/c.1.json", b"[1, 2]")
    store.write("atlas.json", b"")
    assert store.names() == {"atlas.json": 0}
    assert list(store.names("items").items()) == [("b.1.json", 2), ("c.1.json", 6)]
    assert store.names("coarse") == {}
    assert store.size("sheets/a.onav") == 8
    assert store.size("sheets") is None is store.size("sheets/b.onav")
    assert store.read("items/c.1.json") == b"[1, 2]"
    both = store.read_many(["items/c.1.json", "sheets/a.onav"])
    assert both == {"items/c.1.json": b"[1, 2]", "sheets/a.onav": b"some map"}
    assert store.read_many([]) == {}
    assert 0 <= store.age_s("atlas.json") + 1 < 60
    store.remove("items/c.1.json")
    store.remove("items/c.1.json")
    assert store.names("items") == {"b.1.json": 2}


def test_reading_has_a_limit_and_names_missing_files(store):
    store.write("items.geojson", b"12345")
    with pytest.raises(StorageError, match="at most 4 are allowed"):
        store.read("items.geojson", limit_bytes=4)
    with pytest.raises(StorageError, match=r"no such file: .*items/none\.json"):
        store.read("items/none.json")
    some = store.read_many(["items.geojson", "items/none.json"])
    assert some == {"items.geojson": b"12345"}, "one that was removed meanwhile is left out"


@pytest.mark.parametrize(
    "name",
    [
        *("../x", "/etc/passwd", "items/../../x", "a//b", "items/", "", ".", "..", "a\\b", "a\0"),
        *("s3://other/x", "a b", "ü", "x" * 300),
    ],
)
def test_names_outside_the_atlas_are_refused(store, name, tmp_path):
    (tmp_path / "file").touch()
    for act in (
        lambda: store.read(name),
        lambda: store.read_many([name, "items/a"]),
        lambda: store.size(name),
        lambda: store.age_s(name),
        lambda: store.fetch(name, 1, "0" * 64),
        lambda: store.download(name, tmp_path / "out"),
        lambda: store.write(name, tmp_path / "file"),
        lambda: store.write(name, b""),
        lambda: store.remove(name),
    ):
        with pytest.raises(StorageError, match="invalid name of a file in an atlas"):
            act()


def test_links_that_lead_out_are_refused(tmp_path):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "x").write_bytes(b"mine")
    store = Store(str(tmp_path / "atlas"))
    store.write("coarse/x", b"1")
    (tmp_path / "atlas" / "sheets").symlink_to(outside)
    (tmp_path / "atlas" / "coarse" / "y").symlink_to(outside / "x")
    for act in (
        lambda: store.names("sheets"),
        lambda: store.read("sheets/x"),
        lambda: store.write("sheets/x", b""),
        lambda: store.remove("sheets/x"),
        lambda: store.read("coarse/y"),
        lambda: store.fetch("coarse/y", 4, sha256(b"mine")),
    ):
        with pytest.raises(StorageError, match="leads out of the atlas"):
            act()
    assert (outside / "x").read_bytes() == b"mine"


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(errno.ENOSPC, "full")])
def test_local_files_are_whole_or_absent(tmp_path, monkeypatch, error):
    store = Store(str(tmp_path / "atlas"))
    store.write("items/a", b"old")

    def half(source, to):
        to.write_bytes(b"ne")
        raise error

    monkeypatch.setattr("orthonav.ground.atlas.store.shutil.copyfile", half)
    with pytest.raises((KeyboardInterrupt, StorageError)) as caught:
        store.write("items/a", tmp_path)
    assert "full" in str(caught.value) or isinstance(error, KeyboardInterrupt)
    assert store.names("items") == {"a": 3} and store.read("items/a") == b"old"


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (PermissionError("Access Denied"), "PermissionError: Access Denied"),
        (TimeoutError(), "TimeoutError"),
        (OSError(errno.ENOSPC, "full"), "OSError: [Errno 28] full"),
        (RuntimeError("odd\nthing"), "RuntimeError: odd thing"),
    ],
)
def test_failures_are_reported_with_their_cause(trouble, tmp_path, error, words):
    store = Store(f"trouble://{tmp_path}/atlas")
    store.write("items/a", b"12")
    trouble.update(dict.fromkeys(("ls", "info", "get_file", "pipe_file"), error))
    for act in (
        lambda: store.names("items"),
        lambda: store.size("items/a"),
        lambda: store.read("items/a"),
        lambda: store.fetch("items/a", 2, sha256(b"12")),
        lambda: store.write("items/a", b"13"),
    ):
        with pytest.raises(StorageError) as caught:
            act()
        assert words in str(caught.value) and "trouble://" in str(caught.value)
    assert not [path for path in (tmp_path / "cache").rglob("*") if path.is_file()]


def test_missing_packages_are_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "adlfs", None)
    with pytest.raises(MissingExtraError, match=r"abfs:// needs a package .*Install adlfs"):
        Store("abfs://container/atlas")
    with pytest.raises(StorageError, match=r"invalid address .*nosuch"):
        Store("nosuch://bucket/atlas")
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(MissingExtraError, match=r"orthonav\[atlas\]"):
        Store("s3://bucket/atlas")
    Store("file:///folders/need/nothing")


def test_passwords_are_not_shown(monkeypatch):
    store = Store("memory://me:secret@host/atlas")
    assert str(store) == "memory://me@host/atlas"
    with pytest.raises(StorageError) as caught:
        store.read("items/a")
    assert "secret" not in str(caught.value)


def test_remote_files_are_copied_once_and_again_if_incomplete(tmp_path, monkeypatch):
    far = Store("memory://test/atlas")
    far.write("sheets/a.onav", b"map of a")
    wanted = "sheets/a.onav", 8, sha256(b"map of a")
    path = far.fetch(*wanted)
    assert path.read_bytes() == b"map of a" and path.suffix == ".onav"
    assert path.is_relative_to(tmp_path / "cache")
    path.write_bytes(b"map")
    assert far.fetch(*wanted).read_bytes() == b"map of a"
    monkeypatch.setattr(Store, "download", lambda *_: pytest.fail("was there already"))
    assert far.fetch(*wanted) == path


def test_files_that_differ_from_the_catalogue_are_refused(store, cache):
    store.write("sheets/a.onav", b"map of a")
    with pytest.raises(StorageError, match=r"incomplete or altered: 8 bytes, the catalogue has 9"):
        store.fetch("sheets/a.onav", 9, sha256(b"map of a"))
    with pytest.raises(StorageError, match="damaged or altered"):
        store.fetch("sheets/a.onav", 8, sha256(b"map of b"))
    with pytest.raises(StorageError, match=r"no such file|FileNotFound"):
        store.fetch("sheets/b.onav", 8, sha256(b"map of b"))
    assert not [path for path in cache.rglob("*") if path.is_file()]


def test_local_files_are_not_copied(tmp_path):
    store = Store(str(tmp_path))
    store.write("sheets/a.onav", b"map of a")
    path = store.fetch("sheets/a.onav", 8, sha256(b"map of a"))
    assert path == tmp_path / "sheets" / "a.onav"
    path.write_bytes(b"map of b")
    os.utime(path, (1, 1))
    with pytest.raises(StorageError, match="damaged or altered"):
        store.fetch("sheets/a.onav", 8, sha256(b"map of a"))


def test_the_folder_of_the_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("ORTHONAV_CACHE", str(tmp_path / "own"))
    assert cache_folder() == tmp_path / "own"
    monkeypatch.delenv("ORTHONAV_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "orthonav" / "atlas"
