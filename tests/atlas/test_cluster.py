"""The same atlas by Ray: on a cluster of this machine, with processes and the driver killed."""

import logging
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from test_atlas_build import RECIPE, SMALL, made

from helpers import content
from orthonav.core.errors import MissingExtraError, UsageError
from orthonav.ground.atlas.build import AtlasRequest, build_atlas
from orthonav.ground.atlas.catalog import Atlas
from orthonav.ground.atlas.cluster import RayRunner
from orthonav.ground.build.calibrate import CROPS

LONGER = {**SMALL, "calibration_views": 96}
"""A sheet takes about a second."""
START_S, END_S = 120.0, 240.0


@pytest.fixture(scope="module")
def crops():
    """As many as usual: what is patched here does not reach the processes of Ray."""
    return CROPS


@pytest.fixture(scope="module")
def ray():
    """Ray, ended whatever happens; what it leaves open as it ends is its own."""
    import ray

    logging.getLogger("ray").setLevel(logging.ERROR)
    yield ray
    ray.shutdown()


def test_ray_is_required_only_where_it_is_used(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"orthonav\[cluster\]"):
        RayRunner().__enter__()
    with pytest.raises(UsageError, match="workers must be 1 or more"):
        RayRunner(workers=0)


@pytest.fixture
def two_nodes(ray):
    from ray.cluster_utils import Cluster

    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "object_store_memory": 100 * 2**20}
    )
    cluster.add_node(num_cpus=1, object_store_memory=100 * 2**20)
    cluster.wait_for_nodes()
    yield cluster
    ray.shutdown()
    cluster.shutdown()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_sheets_of_killed_workers_are_built_again(two_nodes, ortho, tmp_path):
    alone = made(tmp_path / "alone", ortho, recipe=LONGER)
    killed = []

    def progress(stage, share):
        """Kill what is at a sheet, after the first and after the third sheet."""
        if share > 2 * len(killed) / 8:
            for pid in at_work()[:1]:
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)

    with RayRunner(two_nodes.address) as runner:
        assert runner.at_once == 2
        request = AtlasRequest(str(tmp_path / "shared"), [ortho], LONGER, index=False)
        shared = build_atlas(request, runner, progress)
    assert len(killed) >= 2
    assert shared.is_complete and sorted(shared.built) == sorted(alone.built)
    assert content(tmp_path / "shared") == content(tmp_path / "alone")


WITHOUT_INDEX = """
import sys
from orthonav.cli import main
from orthonav.ground.atlas import index

index.make_index = lambda *_, **__: None  # of few tiles there is none
sys.exit(main())
"""


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("with_", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_killed_driver_resumes_when_run_again(two_nodes, ortho, tmp_path, with_):
    place = tmp_path / "shared"
    Atlas.open_or_create(place, replace(RECIPE, calibration_views=96))
    command = [sys.executable, "-c", WITHOUT_INDEX, "atlas", "build", place, "--ortho", ortho]
    command += ["--cluster", two_nodes.address]
    driver = subprocess.Popen(list(map(str, command)), stderr=subprocess.PIPE, text=True)
    deadline_s = time.monotonic() + START_S
    while not list(place.glob("items/*.json")) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    driver.send_signal(with_)
    _, said = driver.communicate(timeout=START_S)
    codes = {signal.SIGKILL: -signal.SIGKILL, signal.SIGTERM: 143, signal.SIGINT: 130}
    assert driver.returncode == codes[with_], said
    assert with_ == signal.SIGKILL or "rerun to resume" in said
    there = len(Atlas.open(place).sheets())
    assert 1 <= there < 8
    again = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, timeout=END_S, check=False
    )
    assert again.returncode == 0, again.stderr
    assert re.search(rf"built +{8 - there}\nunchanged +{there}\n", again.stdout) or there < 7
    made(tmp_path / "alone", ortho, recipe=LONGER)
    assert content(place) == content(tmp_path / "alone")


def at_work():
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes()
        except OSError:
            continue
        if words.startswith(b"ray::attempted"):
            found.append(int(path.parent.name))
    return sorted(found)
