"""Signatures of maps: authenticity and integrity.

A detached Ed25519 signature, `MAP.onav.sig`, of the digest of the manifest, which holds the
SHA-256 of every part. `open_map` checks all of them whenever it opens a map, so signing the
manifest's digest covers every byte that is used, and verifying reads the header of the file only.
See `docs/map-format.md`.
"""

import base64
import binascii
import contextlib
import hashlib
import json
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthonav.errors import MapFileError, MissingFileError, OutputError
from orthonav.extras import missing_extra
from orthonav.files import replacing, require_file, write_text
from orthonav.mapfile.manifest import MAX_MANIFEST_BYTES, Manifest
from orthonav.mapfile.reader import MAX_HEADER_BYTES, MIN_FILE_BYTES
from orthonav.mapfile.writer import METADATA_KEY

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import (
        Ed25519PrivateKey,
        Ed25519PublicKey,
    )

SCHEMA = 1
FORMAT = "orthonav-signature"
ALGORITHM = "ed25519"
MAX_SIGNATURE_BYTES = 4096
MAX_KEY_BYTES = 4096
PRIVATE_NAME, PUBLIC_NAME = "private.pem", "public.pem"
_SIGNED = b"orthonav map, schema 1, manifest sha256 "
"""Prefix of the signed digest; domain separation from other signatures."""
_DIGEST = re.compile(r"[0-9a-f]{64}")


def signature_path(path: Path) -> Path:
    """Path of the signature of a map: the same folder, with `.sig` appended."""
    return Path(path).with_name(Path(path).name + ".sig")


def map_digest(path: Path) -> str:
    """SHA-256 (hex) of the manifest of a map; identifies a map by reading its header only.

    Raises `MissingFileError`, `MapFileError` or `MapVersionError`.
    """
    path = require_file(path, "map")
    try:
        with path.open("rb") as stream:
            head = stream.read(8)
            length = int.from_bytes(head, "little")
            if len(head) < 8 or length > MAX_HEADER_BYTES or length + 8 < MIN_FILE_BYTES:
                raise MapFileError(f"not an orthonav map: {path}")
            text = json.loads(stream.read(length))["__metadata__"][METADATA_KEY]
            if not isinstance(text, str) or len(text) > MAX_MANIFEST_BYTES:
                raise ValueError("manifest")
            Manifest.from_json(text)  # its digest is right
            digest = json.loads(text)["manifest_sha256"]
    except MapFileError as error:
        raise type(error)(str(error) if str(path) in str(error) else f"{error}: {path}") from error
    except OSError as error:
        raise MissingFileError(f"map cannot be read ({error.strerror}): {path}") from error
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError) as error:
        raise MapFileError(f"not an orthonav map, or damaged: {path}") from error
    return str(digest)


def map_info(path: Path) -> dict[str, Any]:
    """Identification of a map in a flight log: `name` and `manifest_sha256`."""
    return {"name": Path(path).name, "manifest_sha256": map_digest(path)}


def new_key(folder: Path) -> str:
    """Write a new key pair, `private.pem` (mode 0600) and `public.pem`; returns its id.

    Raises `OutputError` if either file exists, and `MissingExtraError`.
    """
    _, serialization, ed25519 = _crypto()
    folder = Path(folder)
    private_path, public_path = folder / PRIVATE_NAME, folder / PUBLIC_NAME
    if private_path.exists() or public_path.exists():
        raise OutputError(f"folder holds a key already; name another folder: {folder}")
    private = ed25519.Ed25519PrivateKey.generate()
    pem = private.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
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
    """Short id of a key: the first 16 hexadecimal digits of the SHA-256 of its 32 bytes."""
    return hashlib.sha256(public.public_bytes_raw()).hexdigest()[:16]


def sign_map(path: Path, key: Path) -> Path:
    """Sign a map with a private key (PEM); returns the path of the signature.

    The map is fully checked first. Raises `MissingFileError`, `MapFileError`, `OutputError` or
    `MissingExtraError`.
    """
    from orthonav.mapfile.reader import open_map

    private = _private_key(key)
    open_map(path)
    digest = map_digest(path)
    plain = {
        "format": FORMAT,
        "schema": SCHEMA,
        "algorithm": ALGORITHM,
        "key_id": key_id(private.public_key()),
        "manifest_sha256": digest,
        "signature": base64.b64encode(private.sign(_SIGNED + digest.encode("ascii"))).decode(),
    }
    out = signature_path(path)
    with replacing(out) as temporary:
        temporary.write_text(json.dumps(plain, indent=1) + "\n", encoding="ascii")
    return out


def require_signature(path: Path, public_key: Path) -> str:
    """Check that a map was signed with a key (PEM); returns the digest of its manifest.

    `open_map` then compares the parts with that manifest. Raises `MapFileError` if the signature is
    missing, broken, by another key or of another map, `MissingFileError` if the map or the key is
    missing, and `MissingExtraError`.
    """
    invalid, _, _ = _crypto()
    public = _public_key(public_key)
    digest = map_digest(path)
    plain = _signature(path)
    stated, known = plain["key_id"], key_id(public)
    if stated != known:
        raise MapFileError(f"map is signed with key {stated}, expected key {known}: {path}")
    if plain["manifest_sha256"] != digest:
        raise MapFileError(f"signature is of another map, or the map was altered: {path}")
    try:
        signature = base64.b64decode(plain["signature"], validate=True)
        public.verify(signature, _SIGNED + digest.encode("ascii"))
    except (invalid, binascii.Error, ValueError) as error:
        raise MapFileError(f"signature of the map does not verify: {path}") from error
    return digest


def _signature(path: Path) -> dict[str, str]:
    """The validated fields of a signature file."""
    file = signature_path(path)
    if not file.is_file():
        raise MapFileError(f"map is not signed, there is no {file.name}: {path}")
    try:
        with file.open("rb") as stream:
            data = stream.read(MAX_SIGNATURE_BYTES + 1)
        if len(data) > MAX_SIGNATURE_BYTES:
            raise ValueError(f"it is larger than {MAX_SIGNATURE_BYTES} bytes")
        plain = json.loads(data)
        schema = plain["schema"]
        if plain["format"] != FORMAT or type(schema) is not int or schema < 1:
            raise ValueError("not an orthonav signature")
        if schema > SCHEMA or plain["algorithm"] != ALGORITHM:
            raise ValueError(
                f"schema {schema}, algorithm {plain['algorithm']!r:.20}; update orthonav"
            )
        found = {name: plain[name] for name in ("key_id", "manifest_sha256", "signature")}
        texts = all(isinstance(value, str) and value.isascii() for value in found.values())
        if not texts or not re.fullmatch(r"[0-9a-f]{16}", found["key_id"]):
            raise ValueError("a field is invalid")
        if not _DIGEST.fullmatch(found["manifest_sha256"]):
            raise ValueError("its digest is invalid")
    except (ValueError, KeyError, TypeError, RecursionError, OSError) as error:
        reason = " ".join(str(error).split())[:120]
        raise MapFileError(f"signature of the map is broken ({reason}): {file}") from error
    return found


def _private_key(path: Path) -> "Ed25519PrivateKey":
    _, serialization, ed25519 = _crypto()
    data = _key_bytes(path, "private key")
    try:
        key = serialization.load_pem_private_key(data, password=None)
    except TypeError as error:  # raised for a key with a passphrase
        raise MapFileError(f"private key has a passphrase; give one without: {path}") from error
    except Exception as error:
        raise MapFileError(f"not a private key in PEM: {path}") from error
    if not isinstance(key, ed25519.Ed25519PrivateKey):
        raise MapFileError(f"expected an Ed25519 private key, got another kind: {path}")
    found: Ed25519PrivateKey = key
    return found


def _public_key(path: Path) -> "Ed25519PublicKey":
    _, serialization, ed25519 = _crypto()
    data = _key_bytes(path, "public key")
    try:
        key = serialization.load_pem_public_key(data)
    except Exception as error:
        raise MapFileError(f"not a public key in PEM: {path}") from error
    if not isinstance(key, ed25519.Ed25519PublicKey):
        raise MapFileError(f"expected an Ed25519 public key, got another kind: {path}")
    found: Ed25519PublicKey = key
    return found


def _key_bytes(path: Path, what: str) -> bytes:
    path = require_file(path, what)
    try:
        with path.open("rb") as stream:
            return stream.read(MAX_KEY_BYTES)
    except OSError as error:
        raise MissingFileError(f"{what} cannot be read ({error.strerror}): {path}") from error


def _crypto() -> tuple[Any, Any, Any]:
    """`InvalidSignature`, `serialization` and `ed25519` of the library."""
    try:
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError as error:
        raise missing_extra("a signature", "signing", "cryptography", error) from error
    return InvalidSignature, serialization, ed25519
