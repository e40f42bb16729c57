"""The index of an atlas: its coarse tiles as vectors, in shards, and the manifest of its files.

Whitening and quantizers are learnt from tiles evenly spaced over all sheets, and shared by all
shards. The index is made anew where sheets have changed. The manifest is written last: an atlas
without it has no index. It may come from an untrusted source, so every value is checked when it is
read."""

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
from orthonav.core.tiles.whitened import Made, WhitenedEmbedder
from orthonav.ground.atlas.catalog import Atlas, Sheet, StoredFile, canonical, parsed, reason
from orthonav.ground.atlas.coarse import MAX_TILES, POOLING, read_coarse, tile_count
from orthonav.ground.atlas.store import digest_of
from orthonav.ground.atlas.vectors import (
    CODE_BITS,
    MAX_TRAINING_VECTORS,
    Part,
    Quantizers,
    ShardInfo,
    VectorRecipe,
    train,
    write_shard,
)
from orthonav.ground.build.whitening import Work, learn_in_two_passes

FOLDER = "index"
MANIFEST = f"{FOLDER}/index.json"
FORMAT = "orthonav-index"
SCHEMA = 3
_NAME = re.compile(r"[a-z0-9][a-z0-9.-]{0,80}")


@dataclass(frozen=True)
class IndexManifest:
    recipe: VectorRecipe
    shards: tuple[ShardInfo, ...]
    files: Mapping[str, StoredFile]

    @property
    def sheets(self) -> dict[str, str]:
        return {part.sheet: part.sha256 for shard in self.shards for part in shard.parts}

    def to_json(self) -> bytes:
        return canonical({"format": FORMAT, "schema": SCHEMA, **asdict(self)}) + b"\n"

    @classmethod
    def from_json(cls, data: bytes) -> "IndexManifest":
        """Inverse of `to_json`; raises `AtlasError` unless writing it again gives `data`."""
        try:
            plain: Any = parsed(data)
            shards = tuple(map(_shard, plain["shards"]))
            files = {name: StoredFile(**file) for name, file in plain["files"].items()}
            parts = [part for shard in shards for part in shard.parts]
            made = cls(VectorRecipe(**plain["recipe"]), shards, files)
            possible = (
                len(shards) > 0
                and all(map(_NAME.fullmatch, [*files, *(shard.name for shard in shards)]))
                and all(file.name == f"{FOLDER}/{name}" for name, file in files.items())
                and all(0 <= part.rows <= MAX_TILES for part in parts)
                and list(accumulate((shard.rows for shard in shards), initial=0))[:-1]
                == [shard.base for shard in shards]
                and made.to_json() == data
            )
            if not possible:
                raise ValueError("damaged or altered")
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            raise AtlasError(
                f"index of the atlas cannot be read ({reason(error)}); rebuild it with 'orthonav "
                "atlas index'"
            ) from error
        return made


def _shard(plain: Any) -> ShardInfo:
    parts = tuple(
        Part(str(part["sheet"]), str(part["sha256"]), int(part["rows"])) for part in plain["parts"]
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


LEARNT = "learnt.safetensors"  # what embeds, assigns and codes tiles
Features = tuple[NDArray[np.float32], NDArray[np.float32]]


def make_index(
    atlas: Atlas, progress: Progress = no_progress, rebuild: bool = False
) -> IndexManifest | None:
    """Bring the index of an atlas up to date; None where its sheets have no coarse tiles. The same
    sheets give the same bytes. Raises `AtlasError`, `StorageError`, `MissingExtraError`."""
    atlas.sheets(refresh=True)
    sheets = list(indexed_sheets(atlas).values())
    if not sheets:
        return None
    if not rebuild:
        with suppress(AtlasError):  # a manifest that is damaged or of another schema
            before = read_manifest(atlas)
            if before is not None and stale_sheets(atlas, before) == ([], []):
                return before
    counts = [tile_count(atlas.path(sheet, "coarse")) for sheet in sheets]
    if sum(counts) < 2**CODE_BITS:  # the codes of a quantizer
        raise AtlasError(
            f"the atlas has {sum(counts)} coarse tiles with imagery, too few for an index; build "
            "it with smaller ones (--coarse-gsd-m)"
        )
    with tempfile.TemporaryDirectory(prefix="orthonav-index-") as name:
        folder = Path(name)
        progress("learn index", 0.0)
        embedder, quantizers = _learnt(atlas, sheets, sum(counts), folder)
        shards: list[ShardInfo] = []
        for group in _groups(sheets, counts):
            base = sum(shard.rows for shard in shards)
            progress("index", base / sum(counts))
            parts = [Part(each.id, each.files["coarse"].sha256, count) for each, count in group]
            shards.append(ShardInfo(f"shard-{base:012d}", base, tuple(parts)))
            tiles = _tiles(atlas, [each for each, _ in group])
            rows = (vectors_of(embedder, features) for features in tiles)
            write_shard(folder, shards[-1], quantizers, rows)
        progress("index", 1.0)
        return _stored(atlas, IndexManifest(quantizers.recipe, tuple(shards), {}), folder)


def _learnt(
    atlas: Atlas, sheets: Sequence[Sheet], total: int, folder: Path
) -> tuple[WhitenedEmbedder, Quantizers]:
    # The whitening is learnt from twice the tiles of that of a map.
    def over_sheets(work: Work[Made], most: int = 40_000) -> Iterator[Made]:
        for features in _tiles(atlas, sheets, max(1, total // most)):
            yield work(*features)

    embedder = learn_in_two_passes(POOLING, over_sheets)
    dims = min(embedder.dims, POOLING.dims if total <= 3_000_000 else 64)
    basis = np.ascontiguousarray(embedder.basis[:, : dims - dims % 2])
    embedder = replace(embedder, basis=basis)
    sample = over_sheets(lambda *features: vectors_of(embedder, features), MAX_TRAINING_VECTORS)
    recipe = VectorRecipe.for_count(total, embedder.dims)
    quantizers = train(np.concatenate(list(sample)), recipe)
    (folder / LEARNT).write_bytes(save({**embedder.parts(), **quantizers.parts}))
    return embedder, quantizers


def _stored(atlas: Atlas, index: IndexManifest, folder: Path) -> IndexManifest:
    """Put the files into the atlas, then the manifest; then remove those of the index before."""
    files, store = {}, atlas.store
    for path in sorted(folder.iterdir()):
        name = f"{FOLDER}/{path.name}"
        files[path.name] = StoredFile(name, path.stat().st_size, digest_of(path))
        store.write(name, path)
    manifest = replace(index, files=files)
    store.write(MANIFEST, manifest.to_json())
    for name in store.names(FOLDER).keys() - files:
        if f"{FOLDER}/{name}" != MANIFEST:
            store.remove(f"{FOLDER}/{name}")
    return manifest


def _tiles(atlas: Atlas, sheets: Sequence[Sheet], step: int = 1) -> Iterator[Features]:
    """Features of every `step`-th tile of sheets, 4096 at a time."""
    for sheet in sheets:
        tiles = read_coarse(atlas.path(sheet, "coarse"))
        for start in range(0, len(tiles.valid), step * 4096):
            yield tiles.features_of(slice(start, start + step * 4096, step))


def _groups(
    sheets: Sequence[Sheet], counts: Sequence[int], max_rows: int = 10_000_000
) -> list[list[tuple[Sheet, int]]]:
    """Sheets of a shard, with their counts of tiles; 10 million rows are 1.5 GB of files."""
    groups: list[list[tuple[Sheet, int]]] = [[]]
    for sheet, count in zip(sheets, counts, strict=True):
        if groups[-1] and sum(rows for _, rows in groups[-1]) + count > max_rows:
            groups.append([])
        groups[-1].append((sheet, count))
    return groups


def vectors_of(embedder: WhitenedEmbedder, features: Features) -> NDArray[np.float32]:
    return half_whitened(embedder, embedder.features(*features))


def half_whitened(embedder: WhitenedEmbedder, embedded: NDArray[np.float32]) -> NDArray[np.float32]:
    """Whitened to the power 0.5: fully whitened vectors do not recognize a place an eighth of a
    tile off (docs/atlas.md)."""
    norms = np.linalg.norm(embedder.basis.astype(np.float32), axis=0)
    weighed = embedded * (norms / norms.max()) ** -0.5
    lengths = np.linalg.norm(weighed, axis=1, keepdims=True)
    return np.asarray(weighed / np.maximum(lengths, 1e-12), dtype=np.float32)


def load_learnt(path: Path, recipe: VectorRecipe) -> tuple[WhitenedEmbedder, Quantizers]:
    """Raises `AtlasError` for a file that is damaged or does not fit the recipe."""
    try:
        parts = load_file(path)
        mean, basis = parts["mean"], parts["basis"]
        fits = mean.ndim == 1 and basis.shape == (len(mean), recipe.dims)
        if not fits or not (np.isfinite(mean).all() and np.isfinite(basis).all()):
            raise AtlasError("whitening does not fit")
        return WhitenedEmbedder(POOLING, mean, basis), Quantizers.of(recipe, parts)
    except Exception as error:  # safetensors raises its own and the system's
        raise AtlasError(f"index of the atlas is damaged ({error}): {path}") from error


def index_file(atlas: Atlas, manifest: IndexManifest, name: str) -> Path:
    file = manifest.files.get(name)
    if file is None:
        raise AtlasError(f"index of the atlas names no file {name}: {atlas.url}")
    return atlas.store.fetch(file.name, file.size_bytes, file.sha256)
