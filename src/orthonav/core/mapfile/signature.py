"""Signatures of maps (`docs/map-format.md`): `MAP.onav.sig`, Ed25519 over the manifest's digest.

The manifest holds the SHA-256 of every part, and `open_map` checks them all, so verifying reads the
header only. Serial number and time are signed too, so that older maps can be refused."""

import base64
import binascii
import contextlib
import hashlib
import json
import os
import re
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthonav.core.errors import (
    MapFileError,
    MissingFileError,
    OutputError,
    VariantError,
    described,
)
from orthonav.core.extras import missing_extra
from orthonav.core.files import require_file, write_text
from orthonav.core.mapfile.reader import map_digest, open_map

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

KIND = {"format": "orthonav-signature", "schema": 2, "algorithm": "ed25519"}
MAX_BYTES = 4096  # of a signature, and of a key
PRIVATE_NAME, PUBLIC_NAME = "private.pem", "public.pem"
MAX_SERIAL = 2**53 - 1  # largest integer that every JSON reader keeps exact
_TIME = "%Y-%m-%dT%H:%M:%SZ"


@dataclass(frozen=True)
class Signature:
    """A verified signature; `signed_utc` by the clock of the signer."""

    key_id: str
    manifest_sha256: str
    serial: int
    signed_utc: str

    @property
    def message(self) -> bytes:
        """The signed bytes; their beginning separates them from other uses of the key."""
        text = (
            f"orthonav map, schema {KIND['schema']}, serial {self.serial}, "
            f"signed {self.signed_utc}, manifest sha256 {self.manifest_sha256}"
        )
        return text.encode("ascii")


def signature_path(path: Path) -> Path:
    return Path(path).with_name(Path(path).name + ".sig")


def new_key(folder: Path) -> str:
    """Write `private.pem` (mode 0600) and `public.pem`; returns the key's id.

    Raises `OutputError` if either file exists, and `MissingExtraError`."""
    _, serialization, ed25519 = _crypto()
    folder = Path(folder)
    private_path, public_path = folder / PRIVATE_NAME, folder / PUBLIC_NAME
    if private_path.exists() or public_path.exists():
        raise OutputError(f"folder holds a key already; name another folder: {folder}")
    private = ed25519.Ed25519PrivateKey.generate()
    pem = private.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    public = private.public_key()
    public_pem = public.public_bytes(
        serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(private_path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "wb") as out:
            out.write(pem)
            out.flush()
            os.fsync(out.fileno())
        write_text(public_path, public_pem.decode("ascii"))
    except OSError as error:
        with contextlib.suppress(OSError):
            private_path.unlink()
        raise OutputError(f"key cannot be written ({error.strerror or error}): {folder}") from error
    return key_id(public)


def key_id(public: "Ed25519PublicKey") -> str:
    """First 16 hexadecimal digits of the SHA-256 of its 32 bytes."""
    return hashlib.sha256(public.public_bytes_raw()).hexdigest()[:16]


def sign_map(path: Path, key: Path, serial: int | None = None) -> Path:
    """Sign a map, fully checked first, with a private key (PEM); `serial`: 0 to `MAX_SERIAL`, by
    default seconds since 1970. Raises `OrthonavError` of the kind that fits."""
    now = datetime.now(UTC)
    serial = int(now.timestamp()) if serial is None else serial
    if not 0 <= serial <= MAX_SERIAL:
        raise VariantError(f"serial number must be 0 to {MAX_SERIAL}, got {serial}")
    private = _key("private", key)
    digest = open_map(path).manifest.sha256
    made = Signature(key_id(private.public_key()), digest, serial, now.strftime(_TIME))
    encoded = base64.b64encode(private.sign(made.message)).decode()
    plain = {**KIND, **asdict(made), "signature": encoded}
    out = signature_path(path)
    write_text(out, json.dumps(plain, indent=1) + "\n")
    return out


def require_signature(path: Path, public_key: Path, not_before: str | None = None) -> Signature:
    """The signature of a map, checked with a key (PEM).

    `not_before`: serial number, or date or time in UTC. Its digest is then given to `open_map`.
    Raises `MapFileError` for a signature missing, broken, by another key, of another map or too
    old, `MissingFileError`, `VariantError` (`not_before`) and `MissingExtraError`."""
    invalid, _, _ = _crypto()
    least = None if not_before is None else _least(not_before)
    public = _key("public", public_key)
    digest = map_digest(path)
    found, encoded = _signature(path)
    known = key_id(public)
    if found.key_id != known:
        raise MapFileError(f"map is signed with key {found.key_id}, expected key {known}: {path}")
    if found.manifest_sha256 != digest:
        raise MapFileError(f"signature is of another map, or the map was altered: {path}")
    try:
        public.verify(base64.b64decode(encoded, validate=True), found.message)
    except (invalid, binascii.Error, ValueError) as error:
        raise MapFileError(f"signature of the map does not verify: {path}") from error
    if least is not None:
        _require_not_older(found, least, str(not_before), path)
    return found


def _least(text: str) -> int | datetime:
    if re.fullmatch(r"[0-9]{1,16}", text):
        return int(text)
    if re.fullmatch(r"[0-9]{4}-[0-9]{2}-[0-9]{2}(T[0-9]{2}:[0-9]{2}(:[0-9]{2})?Z?)?", text):
        with contextlib.suppress(ValueError):
            return datetime.fromisoformat(text.removesuffix("Z")).replace(tzinfo=UTC)
    raise VariantError(
        "--not-before must be a serial number, or a date or time in UTC as 2026-05-31 or "
        f"2026-05-31T12:00:00Z, got {text!r:.60}"
    )


def _require_not_older(found: Signature, least: int | datetime, text: str, path: Path) -> None:
    if isinstance(least, int):
        is_older, said = found.serial < least, f"serial number {found.serial}"
    else:
        signed = datetime.strptime(found.signed_utc, _TIME).replace(tzinfo=UTC)
        is_older, said = signed < least, f"signed {found.signed_utc}"
    if is_older:
        raise MapFileError(f"map is too old: {said}, --not-before {text}: {path}")


def _signature(path: Path) -> tuple[Signature, str]:
    """Not yet verified."""
    file = signature_path(path)
    if not file.is_file():
        raise MapFileError(f"map is not signed, there is no {file.name}: {path}")
    try:
        with file.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise ValueError(f"it is larger than {MAX_BYTES} bytes")
        plain = json.loads(data)
        schema, algorithm = plain["schema"], plain["algorithm"]
        if plain["format"] != KIND["format"] or type(schema) is not int:
            raise ValueError("not an orthonav signature")
        if (schema, algorithm) != (KIND["schema"], KIND["algorithm"]):
            raise ValueError(f"schema {schema}, algorithm {algorithm!r:.20}; update orthonav")
        texts = plain["key_id"], plain["manifest_sha256"], plain["signature"]
        if not all(isinstance(text, str) and text.isascii() for text in texts):
            raise ValueError("a field is invalid")
        hexadecimal = zip(texts, (16, 64), strict=False)
        if not all(re.fullmatch(rf"[0-9a-f]{{{count}}}", text) for text, count in hexadecimal):
            raise ValueError("its key or digest is invalid")
        serial, signed_utc = plain["serial"], plain["signed_utc"]
        if type(serial) is not int or not 0 <= serial <= MAX_SERIAL:
            raise ValueError("its serial number is invalid")
        if datetime.strptime(signed_utc, _TIME).strftime(_TIME) != signed_utc:
            raise ValueError("its time is invalid")
    except (ValueError, KeyError, TypeError, RecursionError, OSError) as error:
        raise MapFileError(
            f"signature of the map is broken ({described(error)}): {file}"
        ) from error
    return Signature(texts[0], texts[1], serial, signed_utc), texts[2]


def _key(name: str, path: Path) -> Any:
    """The "public" or "private" key in a file."""
    _, serialization, ed25519 = _crypto()
    private = name == "private"
    kind = ed25519.Ed25519PrivateKey if private else ed25519.Ed25519PublicKey
    try:
        with require_file(path, f"{name} key").open("rb") as stream:
            data = stream.read(MAX_BYTES)
    except MissingFileError:
        raise
    except OSError as error:
        raise MissingFileError(f"{name} key cannot be read ({error.strerror}): {path}") from error
    try:
        if private:
            key = serialization.load_pem_private_key(data, password=None)
        else:
            key = serialization.load_pem_public_key(data)
    except TypeError as error:  # raised for a key with a passphrase
        raise MapFileError(f"{name} key has a passphrase; give one without: {path}") from error
    except Exception as error:
        raise MapFileError(f"not a {name} key in PEM: {path}") from error
    if not isinstance(key, kind):
        raise MapFileError(f"expected an Ed25519 {name} key, got another kind: {path}")
    return key


def _crypto() -> tuple[Any, Any, Any]:
    try:
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError as error:
        raise missing_extra("a signature", "signing", "cryptography", error) from error
    return InvalidSignature, serialization, ed25519
