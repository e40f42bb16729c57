"""A map that was not signed with the key, or is not what was signed, is refused in one line."""

import base64
import json
import stat
import sys
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import maps
import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ed25519, rsa
from maps import arrays, manifest, taken_apart

from orthonav.cli import localize
from orthonav.core.errors import (
    MapFileError,
    MissingExtraError,
    MissingFileError,
    OutputError,
    VariantError,
)
from orthonav.core.mapfile import open_map, signature, write_map
from orthonav.core.mapfile.reader import map_digest
from orthonav.core.mapfile.signature import (
    MAX_SERIAL,
    key_id,
    new_key,
    require_signature,
    sign_map,
    signature_path,
)
from orthonav.onboard.state import require_newest, serials_path

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
    digest = require_signature(path, keys / "ours" / "public.pem").manifest_sha256
    assert digest == map_digest(path) == taken_apart(path)[1]["manifest_sha256"]
    assert digest == open_map(path).manifest.sha256


def test_serial_numbers_increase_by_default(path, keys):
    key, public = keys / "ours" / "private.pem", keys / "ours" / "public.pem"
    before = int(time.time())
    sign_map(path, key)
    found = require_signature(path, public)
    assert before <= found.serial <= time.time()
    signed = datetime.fromisoformat(found.signed_utc).timestamp()
    assert signed == pytest.approx(found.serial, abs=1)
    sign_map(path, key, 0)
    assert require_signature(path, public).serial == 0
    for serial in (-1, MAX_SERIAL + 1):
        with pytest.raises(VariantError, match="serial number must be 0 to"):
            sign_map(path, key, serial)


def test_older_maps_are_refused(path, keys):
    public = keys / "ours" / "public.pem"
    sign_map(path, keys / "ours" / "private.pem", 41)
    now = datetime.now(UTC)
    later, earlier = now + timedelta(days=2), now - timedelta(days=2)
    for least in ("0", "41", f"{earlier:%Y-%m-%d}", f"{earlier:%Y-%m-%dT%H:%MZ}", "1969-12-31"):
        assert require_signature(path, public, least).serial == 41
    for least in ("42", str(MAX_SERIAL), f"{later:%Y-%m-%d}", f"{later:%Y-%m-%dT%H:%M:%SZ}"):
        with pytest.raises(MapFileError, match="map is too old") as caught:
            require_signature(path, public, least)
        assert least in str(caught.value) and str(path) in str(caught.value)
    for least in ("", "-1", "1e9", "2026-13-01", "yesterday", "2026-05-31T12:00+02:00", "9" * 17):
        with pytest.raises(VariantError, match="--not-before must be"):
            require_signature(path, public, least)


def test_the_newest_serial_number_is_remembered(path, keys, tmp_path, caplog):
    key, public, state = (keys / "ours" / name for name in ("private.pem", "public.pem", "state"))

    def fly(serial):
        sign_map(path, key, serial)
        require_newest(state, require_signature(path, public), path)

    for serial in (7, 7, 9, 9):
        fly(serial)
    with pytest.raises(MapFileError, match=r"serial number 8, and one with serial number 9 .*was"):
        fly(8)
    for junk in ("", "[]", "{", "[" * 100_000, '{"x": 1e400}'):
        serials_path(state).write_text(junk)
        fly(3)
        assert json.loads(serials_path(state).read_text())
    serials_path(state).unlink()
    serials_path(state).mkdir()
    fly(4)
    assert "not remembered" in caplog.text


def test_it_is_plain_ed25519(path, keys):
    """Checked without this module, as anybody might."""
    plain = json.loads(signature_path(path).read_text())
    data = (keys / "ours" / "public.pem").read_bytes()
    public = serialization.load_pem_public_key(data)
    named = f"serial {plain['serial']}, signed {plain['signed_utc']}"
    signed = f"orthonav map, schema 2, {named}, manifest sha256 {plain['manifest_sha256']}".encode()
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
    maps.altered(path, radius_m=99.0)  # with a digest that is right
    open_map(path)
    refused(path, keys, "of another map, or the map was altered")
    altered(path, manifest_sha256=map_digest(path))
    refused(path, keys, "does not verify")


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


def test_a_signature_cut_short(path, keys):
    data = signature_path(path).read_bytes().rstrip()
    for share in (0.1, 0.5, 0.9, 0.99):
        signature_path(path).write_bytes(data[: int(share * len(data))])
        refused(path, keys, "signature of the map is broken")


WRONG = {
    "broken": {
        "algorithm": ("none", None),
        "format": ("x",),
        "key_id": (7, "x\ny" * 9),
        "manifest_sha256": ("é" * 64, None),
        "schema": (1, True),
        "signature": (["a"],),
        "signed_utc": (7,),
    },
    "does not verify": {
        "serial": (1,),
        "signature": ("", "!!!!", "A" * 88),
        "signed_utc": ("2026-01-01T00:00:00Z",),
    },
    "serial number is invalid": {"serial": (-1, 1.0, 2**53)},
    "time is invalid": {"signed_utc": ("2026-1-1T00:00:00Z",)},
    "update orthonav": {"schema": (3,)},
}


@pytest.mark.parametrize(
    "name, value, message",
    [
        (name, value, message)
        for message, fields in WRONG.items()
        for name, values in fields.items()
        for value in values
    ],
)
def test_fields_of_nonsense(path, keys, name, value, message):
    altered(path, **{name: value})
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


def test_the_commands(tmp_path, run):
    path = tmp_path / "area.onav"
    write_map(path, manifest(), arrays())
    public = tmp_path / "key" / "public.pem"
    assert run("sign", path, "--new-key", tmp_path / "key").code == 0
    assert "signature and contents are valid" in run("verify", path, "--key", public).out
    signature_path(path).unlink()
    done = run("localize", path, tmp_path, "--out", tmp_path / "out", "--require-signed", public)
    assert done.code == 1 and "not signed" in done.err and done.err.count("\n") == 1
    fly = ["fly", path, tmp_path, "--recorded-telemetry", "--require-signed", public]
    done = run(*fly)
    assert done.code == 1 and "not signed" in done.err and done.err.count("\n") == 1
    assert run("sign", path, "--key", tmp_path / "key" / "private.pem").code == 0
    done = run("localize", path, tmp_path, "--out", tmp_path / "out", "--require-signed", public)
    assert "expected a flight folder" in done.err  # the next thing that is wrong
    assert "map cannot be flown" in run(*fly).err  # likewise
    signed = run("verify", path, "--key", public).out
    assert "serial " in signed and "signed " in signed
    for command in (("verify", path, "--key", public), (*fly, "--state", tmp_path / "s")):
        done = run(*command, "--not-before", "2100-01-01")
        assert done.code == 1 and "too old" in done.err and done.err.count("\n") == 1
    localize = ("localize", path, tmp_path, "--out", tmp_path / "out", "--not-before", "9" * 15)
    assert "too old" in run(*localize, "--require-signed", public).err
    assert "--not-before needs --require-signed" in run(*localize).err
    assert "--not-before needs" in run(*fly[:4], "--not-before", "5").err
    assert run("sign", path, "--key", tmp_path / "key" / "private.pem", "--serial", "x").code == 2
    assert run("sign", "--key", tmp_path / "key" / "private.pem").code == 2
    assert run("sign", path).code == 2


@pytest.mark.parametrize("command", ["verify", "localize", "fly"])
def test_a_map_that_replaces_the_checked_one_is_not_used(command, path, keys, run, monkeypatch):
    public = keys / "ours" / "public.pem"
    other = path.with_name("other.onav")
    write_map(other, replace(manifest(), radius_m=99.0), arrays())

    def check(*asked):
        found = require_signature(*asked)
        other.replace(path)
        return found

    monkeypatch.setattr(signature, "require_signature", check)
    monkeypatch.setattr(localize, "open_source", lambda *asked: None)  # read before the map
    monkeypatch.setattr(localize, "_take_flown", lambda *asked: None)
    done = run(
        *{
            "verify": ("verify", path, "--key", public),
            "localize": ("localize", path, path, "--out", other, "--require-signed", public),
            "fly": ("fly", path, path, "--recorded-telemetry", "--require-signed", public),
        }[command]
    )
    assert done.code == 1 and "map was replaced after its signature was checked" in done.err
    assert open_map(path).manifest.sha256 == map_digest(path)


def test_without_the_library(path, keys, monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography.exceptions", None)
    with pytest.raises(MissingExtraError, match=r"orthonav\[signing\]"):
        require_signature(path, keys / "ours" / "public.pem")
    assert map_digest(path)
