"""The index of an atlas: its coarse tiles as vectors, in shards that come and go with the sheets.

What is learnt (whitening, quantizers) is learnt once of tiles taken evenly from all sheets, and
shared by all shards. Sheets that are new make a new shard, those that are gone are masked; where
much has changed, all of it is made anew. `index/index.json` names the files of the index with their
checksums and is written last: without it there is no index.
"""

import hashlib
import json
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file, save

from orthonav.atlas.catalog import Atlas
from orthonav.atlas.coarse import POOLING, CoarseTiles, read_coarse
from orthonav.atlas.item import Asset, Sheet
from orthonav.atlas.shards import TRAINED_NAME, ShardWriter, retire_rows
from orthonav.atlas.store import digest_of
from orthonav.atlas.vectors import MAX_LEARNT, Trained, VectorRecipe, train
from orthonav.embed.whitened import Made, WhitenedEmbedder, Work, learn_in_two_passes
from orthonav.errors import AtlasError
from orthonav.files import Progress, replacing

FOLDER = "index"
MANIFEST = f"{FOLDER}/index.json"
FORMAT = "orthonav-index"
SCHEMA = 1
WHITENING_NAME = "whitening.safetensors"
LEARNT_FEATURES = 40_000
SHARD_ROWS = 10_000_000
ANEW_SHARE = 0.3
FEW_ROWS = 200_000
"""Where more of the rows than this are new or gone, or there are few at all, all is made anew."""
POWER = 0.5
"""Of the whitening: full whitening forgets a place an eighth of a tile away. On 2,500 generated km2
half of it finds 87 instead of 83 % of views of another year first."""
MANY_TILES, MANY_DIMS = 3_000_000, 64
"""Of more tiles than this so many components are kept: half the time and memory of a search."""
MIN_TILES = 16
MAX_MANIFEST_BYTES = 64 * 2**20
MAX_ROWS = 10**6
"""Of a sheet."""
_NAME = re.compile(r"[a-z0-9][a-z0-9.-]{0,80}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Part:
    """Rows of a shard that are one sheet's, in the order of its coarse tiles."""

    sheet: str
    sha256: str
    rows: int
    retired: bool = False


@dataclass(frozen=True)
class ShardInfo:
    """A shard: its name, first id, and the sheets in it; ids follow each other."""

    name: str
    base: int
    parts: tuple[Part, ...]

    @property
    def rows(self) -> int:
        """How many there are, retired ones too."""
        return sum(part.rows for part in self.parts)


@dataclass(frozen=True)
class IndexManifest:
    """What an index is made of; `files` of all of it by name."""

    recipe: VectorRecipe
    shards: tuple[ShardInfo, ...]
    files: Mapping[str, Asset]

    @property
    def sheets(self) -> dict[str, str]:
        """SHA-256 of the coarse tiles of each sheet that counts."""
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
            "files": {name: asdict(asset) for name, asset in sorted(self.files.items())},
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
                raise ValueError(f"format {plain['format']!r:.40}, schema {plain['schema']!r:.20}")
            shards = tuple(_shard_info(shard) for shard in plain["shards"])
            files = {_safe(name): _file(asset) for name, asset in plain["files"].items()}
            first = 0
            for shard in shards:
                if shard.base != first:
                    raise ValueError(f"shard {shard.name} begins at {shard.base}, not at {first}")
                first += shard.rows
            return cls(VectorRecipe(**plain["recipe"]), shards, files)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise AtlasError(f"index of the atlas cannot be read ({error})") from error


def _shard_info(plain: Any) -> ShardInfo:
    parts = tuple(Part(**part) for part in plain["parts"])
    for part in parts:
        if type(part.rows) is not int or not 0 <= part.rows <= MAX_ROWS:
            raise ValueError(f"rows of a sheet are {part.rows!r:.40}")
        if type(part.sheet) is not str or type(part.retired) is not bool:
            raise ValueError(f"a part of a shard is {part!r:.80}")
    if type(plain["base"]) is not int:
        raise ValueError(f"base of a shard is {plain['base']!r:.40}")
    return ShardInfo(_safe(plain["name"]), plain["base"], parts)


def _file(plain: Any) -> Asset:
    asset = Asset(**plain)
    if type(asset.size_bytes) is not int or asset.size_bytes < 0:
        raise ValueError(f"size of a file is {asset.size_bytes!r:.40}")
    if type(asset.sha256) is not str or not _SHA256.fullmatch(asset.sha256):
        raise ValueError(f"sha256 of a file is {asset.sha256!r:.80}")
    return asset


def _safe(name: Any) -> str:
    if type(name) is not str or not _NAME.fullmatch(name):
        raise ValueError(f"no name of a file of an index: {name!r:.60}")
    return name


def read_manifest(atlas: Atlas) -> IndexManifest | None:
    """What the index of an atlas is made of, None where there is none. Raises `AtlasError`."""
    if atlas.store.size(MANIFEST) is None:
        return None
    return IndexManifest.from_json(atlas.store.read(MANIFEST))


def stale_sheets(atlas: Atlas, manifest: IndexManifest) -> tuple[list[str], list[str]]:
    """Names of sheets that the index does not know as they are, and of those that are gone."""
    there = {name: each.assets["coarse"].sha256 for name, each in _indexed(atlas).items()}
    known = manifest.sheets
    new = [name for name, sha256 in there.items() if known.get(name) != sha256]
    return new, [name for name in known if name not in there]


def make_index(
    atlas: Atlas, progress: Progress | None = None, anew: bool = False
) -> IndexManifest | None:
    """Bring the index of an atlas up to date; None where its sheets have no coarse tiles.

    The same sheets make the same bytes where it is made `anew`, or for the first time. Raises
    `AtlasError`, `StorageError`, `MissingExtraError`.
    """
    report = progress or (lambda stage, share: None)
    atlas.sheets(refresh=True)
    sheets = _indexed(atlas)
    if not sheets:
        return None
    before = None if anew else _usable(atlas)
    with tempfile.TemporaryDirectory(prefix="orthonav-index-") as name:
        work = _Work(atlas, Path(name), report)
        if before is not None:
            new, gone = stale_sheets(atlas, before)
            if not new and not gone:
                return before
            changed = [part for shard in before.shards for part in shard.parts]
            stale = {*new, *gone}
            lost = sum(part.rows for part in changed if part.retired or part.sheet in stale)
            total = sum(part.rows for part in changed)
            some = lost + len(new) * _mean_rows(changed) <= ANEW_SHARE * total
            if some and total > FEW_ROWS:
                return work.updated(before, [sheets[each] for each in new], stale)
        return work.anew(list(sheets.values()))


def _mean_rows(parts: Sequence[Part]) -> float:
    return sum(part.rows for part in parts) / max(1, len(parts))


def _indexed(atlas: Atlas) -> dict[str, Sheet]:
    return {name: each for name, each in atlas.sheets().items() if "coarse" in each.assets}


def _usable(atlas: Atlas) -> IndexManifest | None:
    """The manifest there is; None for one that is damaged or of another schema: made anew."""
    try:
        return read_manifest(atlas)
    except AtlasError:
        return None


class _Work:
    """Making an index in a folder of this machine, and putting it into the atlas."""

    def __init__(self, atlas: Atlas, folder: Path, report: Progress) -> None:
        self._atlas, self._folder, self._report = atlas, folder, report

    def anew(self, sheets: Sequence[Sheet]) -> IndexManifest:
        """The index of these sheets."""
        counts = [len(self._tiles(sheet).valid) for sheet in sheets]
        total = sum(counts)
        if total < MIN_TILES:
            raise AtlasError(
                f"the atlas has {total} coarse tiles with imagery, too few for an index; build it "
                "with smaller ones (--coarse-gsd-m, --coarse-tile-px)"
            )
        step = max(1, total // LEARNT_FEATURES)
        dims = POOLING.dims if total <= MANY_TILES else MANY_DIMS
        embedder = _learnt(lambda: self._features(sheets, step), dims)
        self._save_whitening(embedder)
        sample = max(1, total // MAX_LEARNT)
        vectors = np.concatenate(
            [
                vectors_of(embedder, features, weights)
                for features, weights in self._features(sheets, sample)
            ]
        )
        trained = train(vectors, VectorRecipe.for_count(total, embedder.dims))
        trained.save(self._folder / TRAINED_NAME)
        shards: list[ShardInfo] = []
        for group in _groups(sheets, counts):
            base = shards[-1].base + shards[-1].rows if shards else 0
            shards.append(self._shard(group, base, embedder, trained))
        return self._put(trained.recipe, shards, {})

    def updated(
        self, before: IndexManifest, new: Sequence[Sheet], stale: set[str]
    ) -> IndexManifest:
        """`before` with a shard of the new sheets, the rows of stale ones masked."""
        fetch_files(self._atlas, before, self._folder, copy=True)
        embedder = load_whitening(self._folder / WHITENING_NAME)
        trained = Trained.load(self._folder / TRAINED_NAME)
        shards = [self._masked(shard, stale) for shard in before.shards]
        base = shards[-1].base + shards[-1].rows
        if new:
            shards.append(self._shard(new, base, embedder, trained))
        return self._put(trained.recipe, shards, before.files)

    def _masked(self, shard: ShardInfo, stale: set[str]) -> ShardInfo:
        parts, first, rows = [], 0, []
        for part in shard.parts:
            if part.sheet in stale and not part.retired:
                rows.append(np.arange(first, first + part.rows, dtype=np.int64))
                part = replace(part, retired=True)
            parts.append(part)
            first += part.rows
        if rows:
            retire_rows(self._folder, shard.name, np.concatenate(rows))
        return replace(shard, parts=tuple(parts))

    def _shard(
        self, sheets: Sequence[Sheet], base: int, embedder: WhitenedEmbedder, trained: Trained
    ) -> ShardInfo:
        shas = [sheet.assets["coarse"].sha256 for sheet in sheets]
        named = hashlib.sha256("".join([trained.digest, *shas]).encode()).hexdigest()[:12]
        name = f"shard-{base:012d}-{named}"
        parts, places = [], []
        with ShardWriter(self._folder, name, trained, base) as writer:
            for number, sheet in enumerate(sheets):
                tiles = self._tiles(sheet)
                for features, weights in _batches(tiles, 1):
                    writer.add(vectors_of(embedder, features, weights))
                parts.append(Part(sheet.id, sheet.assets["coarse"].sha256, len(tiles.valid)))
                places.append(tiles.centres_latlon_deg)
                self._report("index", (number + 1) / len(sheets))
        with replacing(self._folder / f"{name}.places.npy") as path:
            np.save(path, np.concatenate(places))
        return ShardInfo(name, base, tuple(parts))

    def _tiles(self, sheet: Sheet) -> CoarseTiles:
        return read_coarse(self._atlas.path(sheet, "coarse"))

    def _features(self, sheets: Sequence[Sheet], step: int) -> Iterator["_Batch"]:
        """Features of every `step`-th tile of all sheets."""
        for number, sheet in enumerate(sheets):
            yield from _batches(self._tiles(sheet), step)
            self._report("learn index", (number + 1) / len(sheets))

    def _save_whitening(self, embedder: WhitenedEmbedder) -> None:
        with replacing(self._folder / WHITENING_NAME) as path:
            path.write_bytes(save(embedder.parts(), metadata={"orthonav": FORMAT}))

    def _put(
        self, recipe: VectorRecipe, shards: Sequence[ShardInfo], before: Mapping[str, Asset]
    ) -> IndexManifest:
        """Put all files that are new into the atlas, then the manifest; remove what it left."""
        files = {
            path.name: _asset(path)
            for path in sorted(self._folder.iterdir())
            if not path.name.startswith(".")
        }
        for name, asset in files.items():
            if self._atlas.store.size(asset.name) != asset.size_bytes or name not in before:
                self._atlas.store.put(self._folder / name, asset.name)
        manifest = IndexManifest(recipe, tuple(shards), files)
        self._atlas.store.write(MANIFEST, manifest.to_json())
        kept = {MANIFEST, *(asset.name for asset in files.values())}
        for name in self._atlas.store.names(FOLDER):
            if f"{FOLDER}/{name}" not in kept:
                self._atlas.store.remove(f"{FOLDER}/{name}")
        return manifest


_Batch = tuple[NDArray[np.float32], NDArray[np.float32]]
_BATCH_TILES = 4096


def _batches(tiles: CoarseTiles, step: int) -> Iterator[_Batch]:
    weights = tiles.weights
    for start in range(0, len(tiles.valid), step * _BATCH_TILES):
        part = slice(start, start + step * _BATCH_TILES, step)
        yield tiles.features[part].astype(np.float32), weights[part]


def _groups(sheets: Sequence[Sheet], counts: Sequence[int]) -> list[list[Sheet]]:
    """Sheets of one shard each, of at most about `SHARD_ROWS` rows."""
    groups: list[list[Sheet]] = [[]]
    rows = 0
    for sheet, count in zip(sheets, counts, strict=True):
        if groups[-1] and rows + count > SHARD_ROWS:
            groups.append([])
            rows = 0
        groups[-1].append(sheet)
        rows += count
    return groups


def _learnt(batches: Callable[[], Iterator[_Batch]], dims: int) -> WhitenedEmbedder:
    """Whitening of features to at most `dims` components."""

    def over_batches(work: Work[Made]) -> Iterator[Made]:
        return (work(features, weights) for features, weights in batches())

    embedder = learn_in_two_passes(POOLING, over_batches)
    dims = min(dims, embedder.dims)
    dims -= dims % 2  # quantizers look at either half
    return replace(embedder, basis=np.ascontiguousarray(embedder.basis[:, :dims]))


def vectors_of(
    embedder: WhitenedEmbedder, features: NDArray[np.float32], weights: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Unit vectors (N, D) of features and weights (N, F)."""
    return half_whitened(embedder, embedder.features(features, weights))


def half_whitened(embedder: WhitenedEmbedder, embedded: NDArray[np.float32]) -> NDArray[np.float32]:
    """Embeddings (N, D) with what whitening to `POWER` leaves of the components' variance."""
    norms = np.linalg.norm(embedder.basis.astype(np.float32), axis=0)
    weighed = embedded * (norms / norms.max()) ** (POWER - 1)
    lengths = np.linalg.norm(weighed, axis=1, keepdims=True)
    return np.asarray(weighed / np.maximum(lengths, 1e-12), dtype=np.float32)


def load_whitening(path: Path) -> WhitenedEmbedder:
    """The whitening of an index; raises `AtlasError`."""
    try:
        parts = load_file(path)
        mean, basis = parts["mean"], parts["basis"]
    except Exception as error:  # safetensors raises its own and the system's
        raise AtlasError(f"whitening of an index cannot be read ({error}): {path}") from error
    fits = mean.ndim == 1 and basis.ndim == 2 and len(mean) == len(basis) and basis.shape[1] > 0
    if not fits or not (np.isfinite(mean).all() and np.isfinite(basis).all()):
        raise AtlasError(f"whitening of an index is damaged: {path}")
    return WhitenedEmbedder(POOLING, mean, basis)


def fetch_files(atlas: Atlas, manifest: IndexManifest, folder: Path, *, copy: bool = False) -> None:
    """The files of an index under their names in a folder, by link or as copies, verified."""
    for name, asset in manifest.files.items():
        if asset.name != f"{FOLDER}/{name}":
            raise AtlasError(f"index of the atlas names a file elsewhere: {asset.name!r:.80}")
        found = atlas.store.fetch(asset.name, asset.size_bytes, asset.sha256)
        if copy and name.endswith("retired.npy"):
            (folder / name).write_bytes(found.read_bytes())
        else:
            (folder / name).symlink_to(found.absolute())


def _asset(path: Path) -> Asset:
    return Asset(f"{FOLDER}/{path.name}", path.stat().st_size, digest_of(path))
