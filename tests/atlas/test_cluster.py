"""The same atlas by Ray: on a cluster of this machine, with processes and the driver killed."""

import logging
import os
import pickle
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest
from test_atlas_build import SMALL, content, made

from orthonav.core.errors import MissingExtraError, WorkerError
from orthonav.ground.atlas.build import AtlasRequest, build_atlas
from orthonav.ground.atlas.catalog import Atlas
from orthonav.ground.atlas.cluster import RayRunner

LONGER = {**SMALL, "calibration_views": 96}
"""A sheet takes about a second."""
START_S, END_S = 60.0, 240.0


@pytest.fixture(scope="module")
def ray():
    """Ray, ended whatever happens; what it leaves open as it ends is its own."""
    import ray

    logging.getLogger("ray").setLevel(logging.ERROR)
    yield ray
    ray.shutdown()


class DiedError(Exception):
    """What Ray raises where the process of a task died."""


class FakeRay:
    """Runs a task in this process when its result is waited for; `end` is an item that ends it."""

    exceptions = SimpleNamespace(RayError=DiedError)

    def __init__(self):
        self.begun, self.most, self.cancelled, self.options = [], 0, [], {}

    def is_initialized(self):
        return bool(self.options)

    def init(self, address, **options):
        self.options = {"address": address, **options}
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # as Ray does

    def shutdown(self):
        self.options = {}

    def cluster_resources(self):
        return {"CPU": 2.0}

    def nodes(self):
        here = {"Alive": True, "Resources": {"CPU": 2.0}, "NodeID": "a", "NodeManagerHostname": "a"}
        return [here, {**here, "Alive": False}]

    def remote(self, function):
        def submitted(*arguments):
            self.begun.append(
                SimpleNamespace(call=(function, *pickle.loads(pickle.dumps(arguments))))
            )
            return Ref(self.begun[-1])

        task = SimpleNamespace(remote=submitted)
        task.options = lambda **_: task
        return task

    def wait(self, refs, num_returns, timeout):
        self.most = max(self.most, len(refs))
        return refs[-1:], refs[:-1]  # in no order

    def get(self, ref, timeout=None):
        function, *arguments = ref.task.call
        if "end" in arguments:
            raise DiedError("the worker died\nmore")
        return function(*arguments)

    def cancel(self, ref, force=False):
        self.cancelled.append((ref.task.call[-1], force))


@dataclass(frozen=True, eq=False)
class Ref:
    task: SimpleNamespace


@pytest.fixture
def fake_ray(monkeypatch):
    """Ray without its processes, which take half a minute to start and end."""
    made = FakeRay()
    monkeypatch.setattr("orthonav.ground.atlas.cluster._imported", lambda: made)
    strategies = SimpleNamespace(NodeAffinitySchedulingStrategy=lambda *_, **__: None)
    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "ray.util", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "ray.util.scheduling_strategies", strategies)
    return made


def test_tasks_of_ray_fail_by_themselves_and_are_stopped_at_the_end(fake_ray):
    with RayRunner(workers=2) as runner:
        assert runner.at_once == 2 and fake_ray.options["num_cpus"] == 2
        made = dict(runner.run(float, ["1", "no number", "end", "2"]))
        assert (made["1"], made["2"]) == (1.0, 2.0) and fake_ray.most == 2
        assert made["no number"].kind == "ValueError"
        assert made["end"].kind == "WorkerError" and "the worker died" in made["end"].text
        fake_ray.begun.clear()
        run = runner.run(float, ["1", "2", "3", "4"])
        assert next(run) == ("2", 2.0)
        run.close()
        assert len(fake_ray.begun) == 2  # waiting ones are never begun
        assert fake_ray.cancelled == [("1", False)]
        assert runner.everywhere(os.getpid) == [("a", os.getpid())]


def test_ray_is_required_only_where_it_is_used(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"orthonav\[cluster\]"):
        RayRunner().__enter__()
    with pytest.raises(WorkerError, match="workers must be 1 or more"):
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
        assert len(runner.everywhere(os.getpid)) == 2
    assert len(killed) >= 2
    assert shared.is_complete and shared.names("built") == alone.names("built")
    assert content(tmp_path / "shared") == content(tmp_path / "alone")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("with_", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_killed_driver_resumes_when_run_again(two_nodes, ortho, tmp_path, with_):
    place = tmp_path / "shared"
    command = [sys.executable, "-m", "orthonav", "atlas", "build", place, "--ortho", ortho]
    command += ["--sheet-km", "0.3", "--tile-px", "64", "--overlap", "0.5", "--no-index"]
    command += ["--calibration-views", "96", "--coarse-gsd-m", "4", "--coarse-tile-px", "32"]
    command += ["--coarse-overlap", "0.5", "--cluster", two_nodes.address]
    driver = subprocess.Popen(list(map(str, command)), stderr=subprocess.PIPE, text=True)
    deadline_s = time.monotonic() + START_S
    while not list(place.glob("items/*.json")) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    driver.send_signal(with_)
    _, said = driver.communicate(timeout=START_S)
    assert driver.returncode == (-signal.SIGKILL if with_ == signal.SIGKILL else 1), said
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
