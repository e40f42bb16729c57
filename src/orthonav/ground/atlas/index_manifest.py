"""The manifest of an atlas's index: its shards, the sheets in them, and its files.

The manifest is written last: an atlas without it has no index. The index may come from an untrusted
source, so every value is checked when it is read.
"""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AtlasError
from orthonav.ground.atlas.catalog import Atlas
from orthonav.ground.atlas.item import Sheet, StoredFile, canonical, parsed, reason
from orthonav.ground.atlas.quantizers import VectorRecipe

FOLDER = "index"
MANIFEST = f"{FOLDER}/index.json"
FORMAT = "orthonav-index"
SCHEMA = 2
"""2: shards have no manifests of their own."""
MAX_ROWS = 10**6
"""Rows of a sheet: as many as it may have coarse tiles (`orthonav.ground.atlas.coarse`)."""
_NAME = re.compile(r"[a-z0-9][a-z0-9.-]{0,80}")


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
        return canonical({"format": FORMAT, "schema": SCHEMA, **asdict(self)}) + b"\n"

    @classmethod
    def from_json(cls, data: bytes) -> "IndexManifest":
        """Inverse of `to_json`; raises `AtlasError` unless writing it again gives `data`."""
        try:
            plain: Any = parsed(data, MANIFEST)
            if (plain["format"], plain["schema"]) != (FORMAT, SCHEMA):
                raise ValueError(
                    f"format {plain['format']!r:.40}, schema {plain['schema']!r:.20}, expected "
                    f"schema {SCHEMA}; rebuild it with 'orthonav atlas index'"
                )
            shards = tuple(map(_shard, plain["shards"]))
            files = {name: StoredFile(**file) for name, file in plain["files"].items()}
            made = cls(VectorRecipe(**plain["recipe"]), shards, files)
            possible = (
                all(map(_NAME.fullmatch, [*files, *(shard.name for shard in shards)]))
                and all(file.name == f"{FOLDER}/{name}" for name, file in files.items())
                and all(0 <= part.rows <= MAX_ROWS for shard in shards for part in shard.parts)
                and list(accumulate((shard.rows for shard in shards), initial=0))[:-1]
                == [shard.base for shard in shards]
                and made.to_json() == data
            )
            if not possible:
                raise ValueError("damaged or altered")
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            raise AtlasError(f"index of the atlas cannot be read ({reason(error)})") from error
        return made


def _shard(plain: Any) -> ShardInfo:
    """A shard; values of another type are converted, and differ when they are written again."""
    parts = tuple(
        Part(str(part["sheet"]), str(part["sha256"]), int(part["rows"]), bool(part["retired"]))
        for part in plain["parts"]
    )
    return ShardInfo(str(plain["name"]), int(plain["base"]), parts)


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
