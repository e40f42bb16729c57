"""Maps built by several threads, and builds that were killed: the same bytes every time."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import numpy as np
import pytest

from helpers import textured
from orthonav.core.errors import ImageryError, OutputError
from orthonav.core.localize.confidence import DEFAULT_CONFIDENCE
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.build.calibrate import RegistrationCalibration
from orthonav.ground.build.sheet import AHEAD, Block, BlockCache, in_order

BLOCKS = 9
SMALL = {"tile_px": 64, "overlap": 0.75, "calibration_views": 2}


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    """Many small blocks, few crops, registration as if it was calibrated."""
    learnt = RegistrationCalibration(DEFAULT_CONFIDENCE, 0.5)
    monkeypatch.setattr("orthonav.ground.build.build.calibrate_registration", lambda *_: learnt)
    monkeypatch.setattr("orthonav.ground.build.sheet.BLOCK_PX", 128)
    monkeypatch.setattr("orthonav.ground.build.sheet.MIN_CACHED_BLOCKS", 4)
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 16)


@pytest.fixture(scope="module")
def ortho(make_ortho, tmp_path_factory):
    grey = textured((300, 300))
    grey[75:172, 98:142] = 0
    return make_ortho(tmp_path_factory.mktemp("ortho") / "2019.tif", grey, nodata=0)


@pytest.fixture
def reads(monkeypatch):
    """Blocks that were read from imagery rather than taken from the cache."""
    made, counted = BlockCache.store, []

    def counting(cache, block, parts):
        counted.append((block.row, block.col))
        made(cache, block, parts)

    monkeypatch.setattr(BlockCache, "store", counting)
    return counted


def built(ortho, out, progress=None, **request):
    build_map(BuildRequest([ortho], out, **SMALL | request), progress)
    return out.read_bytes()


@pytest.fixture
def whole(ortho, made_once, reads):
    """The map of a build that was not interrupted."""

    def make(folder):
        built(ortho, folder / "whole.onav", workers=1)

    path = made_once("kept-whole", make) / "whole.onav"
    reads.clear()
    return path.read_bytes()


def stopped(ortho, out, after=0.5, error=KeyboardInterrupt, **request):
    """A build that ends when so much of the imagery was read."""

    def progress(stage, share):
        if stage == "imagery" and share >= after:
            raise error

    with pytest.raises(error):
        built(ortho, out, progress, **request)


@pytest.mark.parametrize(
    "request_", [{}, {"tile_px": 96}], ids=["chunks in one block", "chunks over blocks"]
)
def test_any_number_of_workers_gives_the_same_bytes(ortho, tmp_path, request_):
    maps = [
        built(ortho, tmp_path / f"{workers}.onav", workers=workers, **request_)
        for workers in (1, 3)
    ]
    assert maps[0] == maps[1]


@pytest.mark.parametrize("workers", [1, 3])
def test_an_interrupted_build_resumes(ortho, tmp_path, reads, names_in, workers, whole):
    out = tmp_path / "out" / "map.onav"
    stopped(ortho, out, workers=workers)
    first = len(reads)
    assert BLOCKS / 2 <= first <= BLOCKS / 2 + workers + AHEAD + 1
    assert set(names_in(out.parent)) > {"map.onav.work"} and not out.exists()
    assert built(ortho, out, workers=workers) == whole
    assert len(reads) == len(set(reads)) == BLOCKS  # each once, before or after
    assert names_in(out.parent) == ["map.onav"]


KILLED = """
    import os, signal, sys
    from pathlib import Path
    from orthonav.ground.build import BuildRequest, build_map, calibrate, sheet

    sheet.BLOCK_PX, sheet.MIN_CACHED_BLOCKS, calibrate.CROPS = 128, 4, 16

    def progress(stage, share):
        if stage == "imagery" and share > 0.6:
            os.kill(os.getpid(), signal.SIGKILL)

    small = {"tile_px": 64, "overlap": 0.75, "calibration_views": 2}
    build_map(BuildRequest([Path(sys.argv[1])], Path(sys.argv[2]), workers=2, **small), progress)
"""


@pytest.mark.long
def test_a_killed_build_resumes(ortho, tmp_path, reads, names_in, whole):
    out = tmp_path / "killed.onav"
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(KILLED), ortho, out], check=False)
    assert done.returncode == -signal.SIGKILL and not out.exists()
    assert built(ortho, out) == whole
    assert 0 < len(reads) < 0.5 * BLOCKS
    assert names_in(tmp_path) == ["killed.onav"]


@pytest.mark.parametrize(
    "change",
    [
        {"seed": 1},
        pytest.param({"edges": "gray", "registration": False}, marks=pytest.mark.slow),
        pytest.param({"tile_px": 96}, marks=pytest.mark.slow),
    ],
)
def test_another_request_uses_nothing(ortho, tmp_path, reads, names_in, change):
    whole = built(ortho, tmp_path / "whole.onav", **change)
    blocks, out = len(reads), tmp_path / "out" / "map.onav"
    stopped(ortho, out)
    reads.clear()
    assert built(ortho, out, **change) == whole
    assert len(reads) == blocks
    assert names_in(out.parent) == ["map.onav"]


def test_changed_imagery_is_read_again(make_ortho, tmp_path, reads):
    path, out = tmp_path / "a.tif", tmp_path / "map.onav"
    make_ortho(path, textured((300, 300)))
    stopped(path, out)
    make_ortho(path, textured((300, 300), 5))
    reads.clear()
    again = built(path, out)
    assert len(reads) == BLOCKS and again == built(path, tmp_path / "fresh.onav")


def test_damaged_blocks_are_recomputed(ortho, tmp_path, reads, caplog, whole):
    out = tmp_path / "map.onav"
    stopped(ortho, out, after=1.0)
    kept = sorted(Path(f"{out}.work").glob("*/*"))
    kept[0].write_bytes(kept[0].read_bytes()[:1000])
    content = bytearray(kept[1].read_bytes())
    content[len(content) // 2] ^= 0xFF
    kept[1].write_bytes(content)
    kept[2].write_bytes(b"")
    reads.clear()
    assert built(ortho, out) == whole
    assert len(reads) == 3 and caplog.text.count("recomputed") == 3


def test_a_work_folder_that_was_named(ortho, tmp_path, names_in, monkeypatch, reads):
    monkeypatch.setattr("orthonav.ground.build.sheet.MIN_CACHED_BLOCKS", 1000)
    out, work = tmp_path / "map.onav", tmp_path / "work"
    stopped(ortho, out, work=work)
    assert all(name.startswith("work") for name in names_in(tmp_path))
    (work / "mine.txt").write_text("kept")
    reads.clear()
    built(ortho, out, work=work)
    assert len(reads) <= BLOCKS / 2
    assert names_in(tmp_path) == ["map.onav", "work", "work/mine.txt"]


def test_a_full_disk_is_an_error_and_leaves_no_partial_block(
    ortho, tmp_path, monkeypatch, reads, whole
):
    out, sync, count = tmp_path / "map.onav", os.fsync, []

    def full(handle):
        count.append(handle)
        if len(count) > 5:
            raise OSError(28, "No space left on device")
        sync(handle)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match="disk full"):
        built(ortho, out, workers=1)
    monkeypatch.setattr(os, "fsync", sync)
    kept = [path.name for path in Path(f"{out}.work").glob("*/*")]
    assert len(kept) == 5 and not any(name.startswith(".") for name in kept)
    reads.clear()
    assert built(ortho, out) == whole and (0, 0) not in reads


@pytest.mark.parametrize("workers", [1, 3])
def test_the_first_error_is_raised_and_no_thread_stays(workers):
    before = threading.active_count()

    def failing(item):
        if item in (7, 8):
            raise ImageryError(f"item {item}")
        return item

    found = []
    with pytest.raises(ImageryError, match="item 7"):
        for item in in_order(failing, range(20), workers):
            found.append(item)
    assert found == list(range(7)) and threading.active_count() == before


def test_what_others_keep_in_the_folder_stays(tmp_path):
    folder = tmp_path / "map.onav.work"
    cache = BlockCache(folder, "ab12" * 6)
    cache.store(Block(0, 0, 4, 4), {"grey": np.zeros(3)})
    for name in ("checkpoints", "blocks-of-wood"):
        (folder / name).mkdir()
    (folder / "mine.npz").write_bytes(b"mine")
    later = BlockCache(folder, "cd34" * 6)
    assert later.load(Block(0, 0, 4, 4)) is None and not list(folder.rglob("r0*"))
    later.store(Block(0, 0, 4, 4), {"grey": np.zeros(3)})
    later.discard()
    assert sorted(each.name for each in folder.iterdir()) == [
        *("blocks-of-wood", "checkpoints", "mine.npz")
    ]
