"""The manifest of an atlas's index: its shards, the sheets in them, and its files.

The manifest is written last: an atlas without it has no index. The index may come from an untrusted
source, so every value is checked when it is read.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.atlas.catalog import Atlas
from orthonav.atlas.item import Sheet, StoredFile, reason
from orthonav.atlas.quantizers import VectorRecipe
from orthonav.errors import AtlasError

FOLDER = "index"
MANIFEST = f"{FOLDER}/index.json"
FORMAT = "orthonav-index"
SCHEMA = 2
"""2: shards have no manifests of their own."""
MAX_MANIFEST_BYTES = 64 * 2**20
"""A guard for memory: 10^6 sheets at some 60 bytes each."""
MAX_ROWS = 10**6
"""Rows of a sheet: as many as it may have coarse tiles (`orthonav.atlas.coarse`)."""
_NAME = re.compile(r"[a-z0-9][a-z0-9.-]{0,80}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Part:
    """The rows of one sheet in a shard, in the order of its coarse tiles.

    `sheet`: name of the sheet.
    `sha256`: digest of its coarse tiles (hex).
    `rows`: how many.
    `retired`: the sheet has changed or gone, and its rows are not found any more.
    """

    sheet: str
    sha256: str
    rows: int
    retired: bool = False


@dataclass(frozen=True)
class ShardInfo:
    """A shard: its name, the id of its first row, and the sheets in it, row after row."""

    name: str
    base: int
    parts: tuple[Part, ...]

    @property
    def rows(self) -> int:
        """Number of rows, retired ones included."""
        return sum(part.rows for part in self.parts)

    @property
    def retired_rows(self) -> NDArray[np.int64]:
        """Rows (N,) of retired parts, in order."""
        ends = np.cumsum([part.rows for part in self.parts]).tolist()
        retired = [
            np.arange(end - part.rows, end, dtype=np.int64)
            for part, end in zip(self.parts, ends, strict=True)
            if part.retired
        ]
        return np.concatenate(retired) if retired else np.empty(0, np.int64)


@dataclass(frozen=True)
class IndexManifest:
    """What an index consists of; `files` has all its files by their names in the folder."""

    recipe: VectorRecipe
    shards: tuple[ShardInfo, ...]
    files: Mapping[str, StoredFile]

    @property
    def sheets(self) -> dict[str, str]:
        """SHA-256 of the coarse tiles of each indexed sheet."""
        return {
            part.sheet: part.sha256
            for shard in self.shards
            for part in shard.parts
            if not part.retired
        }

    def to_json(self) -> bytes:
        """Canonical JSON."""
        plain = {
            "format": FORMAT,
            "schema": SCHEMA,
            "recipe": asdict(self.recipe),
            "shards": [asdict(shard) for shard in self.shards],
            "files": {name: asdict(file) for name, file in sorted(self.files.items())},
        }
        return (json.dumps(plain, sort_keys=True, separators=(",", ":")) + "\n").encode()

    @classmethod
    def from_json(cls, data: bytes) -> "IndexManifest":
        """Inverse of `to_json`; raises `AtlasError`."""
        try:
            if len(data) > MAX_MANIFEST_BYTES:
                raise ValueError(f"{len(data)} bytes")
            plain: Any = json.loads(data)
            if plain["format"] != FORMAT or plain["schema"] != SCHEMA:
                raise ValueError(
                    f"format {plain['format']!r:.40}, schema {plain['schema']!r:.20}, expected "
                    f"schema {SCHEMA}; rebuild it with 'orthonav atlas index'"
                )
            shards = tuple(_shard(shard) for shard in plain["shards"])
            files = {_checked_name(name): _file(file) for name, file in plain["files"].items()}
            first = 0
            for shard in shards:
                if shard.base != first:
                    raise ValueError(f"shard {shard.name} begins at {shard.base}, not at {first}")
                first += shard.rows
            return cls(VectorRecipe(**plain["recipe"]), shards, files)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise AtlasError(f"index of the atlas cannot be read ({reason(error)})") from error


def _shard(plain: Any) -> ShardInfo:
    parts = tuple(Part(**part) for part in plain["parts"])
    for part in parts:
        if type(part.rows) is not int or not 0 <= part.rows <= MAX_ROWS:
            raise ValueError(f"rows of a sheet are {part.rows!r:.40}")
        if type(part.sheet) is not str or type(part.retired) is not bool:
            raise ValueError(f"a part of a shard is {part!r:.80}")
    if type(plain["base"]) is not int:
        raise ValueError(f"base of a shard is {plain['base']!r:.40}")
    return ShardInfo(_checked_name(plain["name"]), plain["base"], parts)


def _file(plain: Any) -> StoredFile:
    file = StoredFile(**plain)
    if type(file.size_bytes) is not int or file.size_bytes < 0:
        raise ValueError(f"size of a file is {file.size_bytes!r:.40}")
    if type(file.sha256) is not str or not _SHA256.fullmatch(file.sha256):
        raise ValueError(f"sha256 of a file is {file.sha256!r:.80}")
    return file


def _checked_name(name: Any) -> str:
    if type(name) is not str or not _NAME.fullmatch(name):
        raise ValueError(f"invalid name of a file of an index: {name!r:.60}")
    return name


def read_manifest(atlas: Atlas) -> IndexManifest | None:
    """The manifest of the index of an atlas, None where it has no index. Raises `AtlasError`."""
    if atlas.store.size(MANIFEST) is None:
        return None
    return IndexManifest.from_json(atlas.store.read(MANIFEST))


def indexed_sheets(atlas: Atlas) -> dict[str, Sheet]:
    """The sheets of an atlas that have coarse tiles, by name."""
    return {name: each for name, each in atlas.sheets().items() if "coarse" in each.files}


def stale_sheets(atlas: Atlas, manifest: IndexManifest) -> tuple[list[str], list[str]]:
    """Names of the sheets that are new or changed since indexing, and of those that are gone."""
    there = {name: each.files["coarse"].sha256 for name, each in indexed_sheets(atlas).items()}
    known = manifest.sheets
    new = [name for name, sha256 in there.items() if known.get(name) != sha256]
    return new, [name for name in known if name not in there]
