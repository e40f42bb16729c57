"""The index of an atlas: its coarse tiles as vectors, in shards, and the manifest of its files.

Whitening and quantizers are learnt once, from tiles evenly spaced over all sheets, and shared by
all shards. New sheets become a new shard and the rows of changed or removed sheets are retired;
after many changes the whole index is rebuilt. The manifest is written last: an atlas without it has
no index. It may come from an untrusted source, so every value is checked when it is read."""

import hashlib
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file, save

from orthonav.core.errors import AtlasError
from orthonav.core.files import Progress, no_progress
from orthonav.core.tiles.whitened import Made, WhitenedEmbedder, Work, learn_in_two_passes
from orthonav.ground.atlas.catalog import Atlas
from orthonav.ground.atlas.coarse import POOLING, read_coarse, tile_count
from orthonav.ground.atlas.item import Sheet, StoredFile, canonical, parsed, reason
from orthonav.ground.atlas.store import digest_of
from orthonav.ground.atlas.vectors import (
    MAX_TRAINING_VECTORS,
    QUANTIZERS_NAME,
    Part,
    Quantizers,
    ShardInfo,
    VectorRecipe,
    train,
    write_shard,
)

FOLDER = "index"
MANIFEST = f"{FOLDER}/index.json"
FORMAT = "orthonav-index"
SCHEMA = 2  # 2: shards have no manifests of their own
MAX_ROWS = 10**6  # rows of a sheet: `orthonav.ground.atlas.coarse.MAX_TILES`
_NAME = re.compile(r"[a-z0-9][a-z0-9.-]{0,80}")


@dataclass(frozen=True)
class IndexManifest:
    recipe: VectorRecipe
    shards: tuple[ShardInfo, ...]
    files: Mapping[str, StoredFile]

    @property
    def sheets(self) -> dict[str, str]:
        return {
            part.sheet: part.sha256
            for shard in self.shards
            for part in shard.parts
            if not part.retired
        }

    def to_json(self) -> bytes:
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
    if atlas.store.size(MANIFEST) is None:
        return None
    return IndexManifest.from_json(atlas.store.read(MANIFEST))


def indexed_sheets(atlas: Atlas) -> dict[str, Sheet]:
    return {name: each for name, each in atlas.sheets().items() if "coarse" in each.files}


def stale_sheets(atlas: Atlas, manifest: IndexManifest) -> tuple[list[str], list[str]]:
    there = {name: each.files["coarse"].sha256 for name, each in indexed_sheets(atlas).items()}
    known = manifest.sheets
    new = [name for name, sha256 in there.items() if known.get(name) != sha256]
    return new, [name for name in known if name not in there]


WHITENING_NAME = "whitening.safetensors"
MAX_TRAINING_TILES = 40_000  # of the whitening: twice those of a map (`MAX_LEARNT_TILES`)
SHARD_ROWS = 10_000_000  # 1.5 GB of files (`benchmarks.atlas_search` at d63ac91)
REBUILD_SHARE = 0.3
FEW_ROWS = 200_000
"""The index is rebuilt where more than this fraction of the rows is new or gone, or where it has so
few rows that rebuilding takes seconds."""
POWER = 0.5
"""Exponent of the whitening: full whitening (1) does not recognize a place an eighth of a tile off.
On 2,500 generated km2 half whitening ranks the right tile first for 87 instead of 83 % of views of
another year."""
MANY_TILES, MANY_DIMS = 3_000_000, 64  # above so many tiles, so many components
MIN_TILES = 16  # fewer tiles than codes of a quantizer cannot train it
BATCH_TILES = 4096
LEARN_PASSES = 3  # mean and scatter of the features, sample of the vectors
Features = tuple[NDArray[np.float32], NDArray[np.float32]]
Counted = tuple[Sheet, int]  # a sheet and the number of its coarse tiles


def make_index(
    atlas: Atlas, progress: Progress = no_progress, rebuild: bool = False
) -> IndexManifest | None:
    """Bring the index of an atlas up to date; None where its sheets have no coarse tiles. The same
    sheets give the same bytes where the index is rebuilt, or built for the first time. Raises
    `AtlasError`, `StorageError`, `MissingExtraError`."""
    atlas.sheets(refresh=True)
    sheets = indexed_sheets(atlas)
    if not sheets:
        return None
    before = None
    if not rebuild:
        with suppress(AtlasError):  # a manifest that is damaged or of another schema
            before = read_manifest(atlas)
    with tempfile.TemporaryDirectory(prefix="orthonav-index-") as name:
        builder = _IndexBuilder(atlas, Path(name), progress)
        if before is None:
            return builder.build(list(sheets.values()))
        new, gone = stale_sheets(atlas, before)
        if not new and not gone:
            return before
        stale = {*new, *gone}
        parts = [part for shard in before.shards for part in shard.parts]
        lost = sum(part.rows for part in parts if part.retired or part.sheet in stale)
        total = sum(part.rows for part in parts)
        added = len(new) * total / max(1, len(parts))
        if total > FEW_ROWS and lost + added <= REBUILD_SHARE * total:
            return builder.update(before, [sheets[each] for each in new], stale)
        return builder.build(list(sheets.values()))


class _IndexBuilder:
    def __init__(self, atlas: Atlas, folder: Path, progress: Progress) -> None:
        self._atlas, self._folder, self._progress = atlas, folder, progress

    def build(self, sheets: Sequence[Sheet]) -> IndexManifest:
        counted = self._counted(sheets)
        total = sum(count for _, count in counted)
        if total < MIN_TILES:
            raise AtlasError(
                f"the atlas has {total} coarse tiles with imagery, too few for an index; build it "
                "with smaller ones (--coarse-gsd-m, --coarse-tile-px)"
            )
        embedder, quantizers = self._learnt(sheets, total)
        empty = IndexManifest(quantizers.recipe, (), {})
        return self._extended(empty, embedder, quantizers, _groups(counted))

    def _learnt(self, sheets: Sequence[Sheet], total: int) -> tuple[WhitenedEmbedder, Quantizers]:
        step = max(1, total // MAX_TRAINING_TILES)
        dims = POOLING.dims if total <= MANY_TILES else MANY_DIMS
        shares = _shares(LEARN_PASSES * len(sheets))

        def over_sheets(work: Work[Made], step: int = step) -> Iterator[Made]:
            for _, features in self._tiles(sheets, "learn index", shares, step):
                yield work(*features)

        embedder = _shortened(learn_in_two_passes(POOLING, over_sheets), dims)
        (self._folder / WHITENING_NAME).write_bytes(
            save(embedder.parts(), metadata={"orthonav": FORMAT})
        )
        step = max(1, total // MAX_TRAINING_VECTORS)
        sample = over_sheets(lambda *features: vectors_of(embedder, features), step)
        recipe = VectorRecipe.for_count(total, embedder.dims)
        quantizers = train(np.concatenate(list(sample)), recipe)
        quantizers.save(self._folder / QUANTIZERS_NAME)
        return embedder, quantizers

    def update(self, before: IndexManifest, new: Sequence[Sheet], stale: set[str]) -> IndexManifest:
        embedder = load_whitening(index_file(self._atlas, before, WHITENING_NAME))
        quantizers = Quantizers.load(index_file(self._atlas, before, QUANTIZERS_NAME))
        shards = tuple(
            replace(
                shard,
                parts=tuple(
                    replace(part, retired=part.retired or part.sheet in stale)
                    for part in shard.parts
                ),
            )
            for shard in before.shards
        )
        left = replace(before, shards=shards)
        groups = [self._counted(new)] if new else []
        return self._extended(left, embedder, quantizers, groups)

    def _extended(
        self,
        index: IndexManifest,
        embedder: WhitenedEmbedder,
        quantizers: Quantizers,
        groups: Sequence[Sequence[Counted]],
    ) -> IndexManifest:
        """The index with a further shard for each group of sheets, put into the atlas: the manifest
        after the files; then files that are not used any more are removed."""
        shards, files, store = list(index.shards), dict(index.files), self._atlas.store
        shares = _shares(sum(map(len, groups)))
        for group in groups:
            base = shards[-1].base + shards[-1].rows if shards else 0
            digests = [sheet.files["coarse"].sha256 for sheet, _ in group]
            content = hashlib.sha256("".join([quantizers.digest, *digests]).encode()).hexdigest()
            name = f"shard-{base:012d}-{content[:12]}"
            tiles = self._tiles([sheet for sheet, _ in group], "index", shares)
            rows = ((places, vectors_of(embedder, features)) for places, features in tiles)
            write_shard(self._folder, name, quantizers, rows)
            parts = [
                Part(sheet.id, digest, count)
                for (sheet, count), digest in zip(group, digests, strict=True)
            ]
            shards.append(ShardInfo(name, base, tuple(parts)))
        for path in sorted(self._folder.iterdir()):
            name = f"{FOLDER}/{path.name}"
            files[path.name] = StoredFile(name, path.stat().st_size, digest_of(path))
            store.write(name, path)
        manifest = IndexManifest(quantizers.recipe, tuple(shards), files)
        store.write(MANIFEST, manifest.to_json())
        used = {MANIFEST, *(file.name for file in files.values())}
        for name in store.names(FOLDER):
            if f"{FOLDER}/{name}" not in used:
                store.remove(f"{FOLDER}/{name}")
        return manifest

    def _counted(self, sheets: Sequence[Sheet]) -> list[Counted]:
        return [(sheet, tile_count(self._atlas.path(sheet, "coarse"))) for sheet in sheets]

    def _tiles(
        self, sheets: Sequence[Sheet], stage: str, shares: Iterator[float], step: int = 1
    ) -> Iterator[tuple[NDArray[np.float64], Features]]:
        """Places (n, 2) and features of every `step`-th tile of sheets, some at a time. `shares`:
        fraction of the stage that is done after each sheet."""
        for sheet in sheets:
            tiles = read_coarse(self._atlas.path(sheet, "coarse"))
            for start in range(0, len(tiles.valid), step * BATCH_TILES):
                part = slice(start, start + step * BATCH_TILES, step)
                yield tiles.centres_latlon_deg[part], tiles.features_of(part)
            self._progress(stage, next(shares))


def _shares(count: int) -> Iterator[float]:
    return (number / count for number in range(1, count + 1))


def _groups(counted: Sequence[Counted]) -> list[list[Counted]]:
    groups: list[list[Counted]] = [[]]
    rows = 0
    for sheet, count in counted:
        if groups[-1] and rows + count > SHARD_ROWS:
            groups.append([])
            rows = 0
        groups[-1].append((sheet, count))
        rows += count
    return groups


def _shortened(embedder: WhitenedEmbedder, dims: int) -> WhitenedEmbedder:
    dims = min(dims, embedder.dims)
    basis = np.ascontiguousarray(embedder.basis[:, : dims - dims % 2])
    return replace(embedder, basis=basis)


def vectors_of(embedder: WhitenedEmbedder, features: Features) -> NDArray[np.float32]:
    return half_whitened(embedder, embedder.features(*features))


def half_whitened(embedder: WhitenedEmbedder, embedded: NDArray[np.float32]) -> NDArray[np.float32]:
    """Embeddings (N, D) as unit vectors, whitened to the exponent `POWER` only."""
    norms = np.linalg.norm(embedder.basis.astype(np.float32), axis=0)
    weighed = embedded * (norms / norms.max()) ** (POWER - 1)
    lengths = np.linalg.norm(weighed, axis=1, keepdims=True)
    return np.asarray(weighed / np.maximum(lengths, 1e-12), dtype=np.float32)


def load_whitening(path: Path) -> WhitenedEmbedder:
    try:
        parts = load_file(path)
        mean, basis = parts["mean"], parts["basis"]
    except Exception as error:  # safetensors raises its own and the system's
        raise AtlasError(f"whitening of an index cannot be read ({error}): {path}") from error
    fits = mean.ndim == 1 and basis.ndim == 2 and len(mean) == len(basis) and basis.shape[1] > 0
    if not fits or not (np.isfinite(mean).all() and np.isfinite(basis).all()):
        raise AtlasError(f"whitening of an index is damaged: {path}")
    return WhitenedEmbedder(POOLING, mean, basis)


def index_file(atlas: Atlas, manifest: IndexManifest, name: str) -> Path:
    file = manifest.files.get(name)
    if file is None:
        raise AtlasError(f"index of the atlas names no file {name}: {atlas.url}")
    return atlas.store.fetch(file.name, file.size_bytes, file.sha256)
