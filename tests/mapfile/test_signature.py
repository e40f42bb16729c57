"""A map that was not signed with the key, or is not what was signed, is refused in one line."""

import base64
import json
import stat
import sys

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ed25519, rsa
from maps import arrays, manifest, put_together, taken_apart

from orthonav.errors import MapFileError, MissingExtraError, MissingFileError, OutputError
from orthonav.mapfile import open_map, write_map
from orthonav.mapfile.signature import (
    key_id,
    map_digest,
    map_info,
    new_key,
    require_signature,
    sign_map,
    signature_path,
)

NAMES = ("private", "public")


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    """Folders with two pairs of keys."""
    folder = tmp_path_factory.mktemp("keys")
    for name in ("ours", "other"):
        new_key(folder / name)
    return folder


@pytest.fixture
def path(tmp_path, keys):
    """A signed map."""
    path = tmp_path / "area.onav"
    write_map(path, manifest(), arrays())
    sign_map(path, keys / "ours" / "private.pem")
    return path


def refused(path, keys, message, error=MapFileError):
    with pytest.raises(error, match=message) as caught:
        require_signature(path, keys / "ours" / "public.pem")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def altered(path, **changes):
    plain = json.loads(signature_path(path).read_text())
    signature_path(path).write_text(json.dumps({**plain, **changes}))


def test_a_signed_map(path, keys):
    digest = require_signature(path, keys / "ours" / "public.pem")
    assert digest == map_digest(path) == taken_apart(path)[1]["manifest_sha256"]
    assert map_info(path) == {"name": "area.onav", "manifest_sha256": digest}
    before = signature_path(path).read_bytes()
    sign_map(path, keys / "ours" / "private.pem")
    assert signature_path(path).read_bytes() == before  # Ed25519 draws nothing


def test_it_is_plain_ed25519(path, keys):
    """Checked without this module, as anybody might."""
    plain = json.loads(signature_path(path).read_text())
    data = (keys / "ours" / "public.pem").read_bytes()
    public = serialization.load_pem_public_key(data)
    signed = b"orthonav map, schema 1, manifest sha256 " + plain["manifest_sha256"].encode()
    public.verify(base64.b64decode(plain["signature"]), signed)
    assert plain["key_id"] == key_id(public) and plain["algorithm"] == "ed25519"


def test_the_key_is_its_owners_and_stays(keys):
    mode = stat.S_IMODE((keys / "ours" / "private.pem").stat().st_mode)
    assert mode == 0o600
    before = (keys / "ours" / "private.pem").read_bytes()
    with pytest.raises(OutputError, match="holds a key already"):
        new_key(keys / "ours")
    assert (keys / "ours" / "private.pem").read_bytes() == before


def test_an_altered_manifest(path, keys):
    header, plain, data = taken_apart(path)
    header.pop("__metadata__")
    put_together(path, header, {**plain, "radius_m": 99.0}, data)  # with a digest that is right
    open_map(path)
    refused(path, keys, "of another map, or the map was altered")
    altered(path, manifest_sha256=map_digest(path))
    refused(path, keys, "does not verify")


def test_a_manifest_whose_digest_is_wrong(path, keys):
    header, plain, data = taken_apart(path)
    digest = plain["manifest_sha256"]
    header.pop("__metadata__")
    changed = json.dumps({**plain, "radius_m": 99.0, "manifest_sha256": digest})
    put_together(path, header, changed, data)
    refused(path, keys, "altered")


def test_an_altered_part(path, keys, run):
    """The signature holds, opening does not: both are asked by every command."""
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    require_signature(path, keys / "ours" / "public.pem")
    with pytest.raises(MapFileError, match="altered"):
        open_map(path)
    done = run("verify", path, "--public-key", keys / "ours" / "public.pem")
    assert done.code == 1 and done.out == "" and "altered" in done.err


def test_the_signature_of_another_map(path, keys):
    other = path.with_name("other.onav")
    write_map(other, manifest(), arrays(seed=1))
    sign_map(other, keys / "ours" / "private.pem")
    signature_path(path).write_bytes(signature_path(other).read_bytes())
    refused(path, keys, "another map")


def test_another_key(path, keys):
    sign_map(path, keys / "other" / "private.pem")
    refused(path, keys, "is signed with key")
    plain = json.loads(signature_path(path).read_text())
    sign_map(path, keys / "ours" / "private.pem")
    altered(path, signature=plain["signature"])
    refused(path, keys, "does not verify")


def test_a_missing_signature_or_map(path, keys):
    signature_path(path).unlink()
    refused(path, keys, "not signed")
    path.unlink()
    refused(path, keys, "does not exist", MissingFileError)


@pytest.mark.parametrize("share", [0, 0.1, 0.5, 0.9, 0.99])
def test_a_signature_cut_short(path, keys, share):
    data = signature_path(path).read_bytes().rstrip()
    signature_path(path).write_bytes(data[: int(share * len(data))])
    refused(path, keys, "signature of the map is broken")


def test_no_bit_of_the_signature_may_differ(path, keys):
    plain = json.loads(signature_path(path).read_text())
    raw = base64.b64decode(plain["signature"])
    for at in range(0, 64, 7):
        broken = bytearray(raw)
        broken[at] ^= 1
        altered(path, signature=base64.b64encode(broken).decode())
        refused(path, keys, "does not verify")


@pytest.mark.parametrize(
    "junk",
    [b"", b"[]", b"{}", b"null", b"[" * 4000, b"\xff", b"{" * 10, b"9" * 4000, b"x" * 10_000_000],
)
def test_junk(path, keys, junk):
    signature_path(path).write_bytes(junk)
    refused(path, keys, "signature of the map is broken")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema": 2}, "update orthonav"),
        ({"algorithm": "none"}, "broken"),
        ({"algorithm": None}, "broken"),
        ({"format": "x"}, "broken"),
        ({"schema": True}, "broken"),
        ({"key_id": 7}, "broken"),
        ({"key_id": "x\ny" * 9}, "broken"),
        ({"manifest_sha256": "é" * 64}, "broken"),
        ({"manifest_sha256": None}, "broken"),
        ({"signature": ""}, "does not verify"),
        ({"signature": "!!!!"}, "does not verify"),
        ({"signature": ["a"]}, "broken"),
        ({"signature": "A" * 88}, "does not verify"),
    ],
)
def test_fields_of_nonsense(path, keys, changes, message):
    altered(path, **changes)
    refused(path, keys, message)


def test_keys_that_are_none(path, keys, tmp_path):
    def pem(key):
        return key.public_bytes(
            serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
        )

    other = tmp_path / "key.pem"
    private, public = ((keys / "ours" / f"{name}.pem").read_bytes() for name in NAMES)
    strange = pem(rsa.generate_private_key(65537, 2048).public_key())
    for data in (b"", b"junk", strange, b"A" * 10**6):
        other.write_bytes(data)
        with pytest.raises(MapFileError, match=r"public key.*key\.pem"):
            require_signature(path, other)
        with pytest.raises(MapFileError, match=r"private key.*key\.pem"):
            sign_map(path, other)
    other.write_bytes(private)
    with pytest.raises(MapFileError, match="not a public key"):
        require_signature(path, other)
    other.write_bytes(public)
    with pytest.raises(MapFileError, match="not a private key"):
        sign_map(path, other)
    locked = ed25519.Ed25519PrivateKey.generate().private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.BestAvailableEncryption(b"word"),
    )
    other.write_bytes(locked)
    with pytest.raises(MapFileError, match="passphrase"):
        sign_map(path, other)
    with pytest.raises(MissingFileError):
        require_signature(path, tmp_path / "none.pem")


def test_a_broken_map_is_not_signed(path, keys):
    signature_path(path).unlink()
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(MapFileError, match="altered"):
        sign_map(path, keys / "ours" / "private.pem")
    assert not signature_path(path).exists()


@pytest.mark.parametrize("junk", [b"", b"\xff" * 40, b"\x08" + bytes(7) + b"[[[[[[[[" * 9])
def test_a_digest_of_what_is_no_map(tmp_path, junk):
    (tmp_path / "a.onav").write_bytes(junk)
    with pytest.raises(MapFileError, match=r"a\.onav"):
        map_digest(tmp_path / "a.onav")


def test_the_commands(tmp_path, run):
    path = tmp_path / "area.onav"
    write_map(path, manifest(), arrays())
    public = tmp_path / "key" / "public.pem"
    assert run("sign", path, "--new-key", tmp_path / "key").code == 0
    assert "signature and contents are valid" in run("verify", path, "--public-key", public).out
    signature_path(path).unlink()
    done = run("localize", path, tmp_path, "--out", tmp_path / "out", "--require-signed", public)
    assert done.code == 1 and "not signed" in done.err and done.err.count("\n") == 1
    fly = ["fly", path, tmp_path, "--recorded-telemetry", "--require-signed", public]
    done = run(*fly)
    assert done.code == 1 and "not signed" in done.err and done.err.count("\n") == 1
    assert run("sign", path, "--key", tmp_path / "key" / "private.pem").code == 0
    done = run("localize", path, tmp_path, "--out", tmp_path / "out", "--require-signed", public)
    assert "expected a flight folder" in done.err  # the next thing that is wrong
    assert "no camera calibration: give --camera FILE" in run(*fly).err  # likewise
    assert run("sign", "--key", tmp_path / "key" / "private.pem").code == 1
    assert run("sign", path).code == 2


def test_without_the_library(path, keys, monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography.exceptions", None)
    with pytest.raises(MissingExtraError, match=r"orthonav\[signing\]"):
        require_signature(path, keys / "ours" / "public.pem")
    assert map_digest(path)
