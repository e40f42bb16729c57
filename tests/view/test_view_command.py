"""`orthonav view` as it is typed."""

import signal
import subprocess
import sys
import urllib.request
from dataclasses import replace

import pytest
from small_run import NO_FIX, WRONG, result

from helpers import refused
from orthonav.core.flight.fixes import Identity, write_results
from orthonav.ground.view.run import Run, ViewRequest


@pytest.fixture
def served(monkeypatch):
    """The command ends where it would begin to serve."""

    def stop(self, poll_interval):
        raise KeyboardInterrupt

    monkeypatch.setattr("orthonav.ground.view.server.Server.serve_forever", stop)


def test_a_second_run_is_compared_by_frame(small, run, served, tmp_path):
    """Its errors are beside those of the first; views that it lacks have none."""
    second = tmp_path / "tracked.jsonl"
    write_results(second, [result(0), result(NO_FIX), result(WRONG)])
    request = ViewRequest(small.fixes, small.map_path, second=second, flight=small.flight)
    opened = Run(request)
    columns = opened.views()["columns"]
    known = [columns["err"][i] if i in (0, WRONG) else None for i in range(len(columns["err"]))]
    assert columns["err2"] == known and columns["confident2"][0] == columns["confident"][0]
    assert opened.summary()["second"] == "tracked.jsonl"
    assert "second_lat_deg" in opened.detail(0) and "second_lat_deg" not in opened.detail(1)
    refused(run("view", small.fixes, tmp_path / "no.jsonl", "--map", small.map_path), "no.jsonl")
    another = Identity("0" * 64)
    write_results(second, [replace(result(0), frame="other.png")], another)
    done = run("view", small.fixes, second, "--map", small.map_path)
    assert done.code == 0 and "no view has a position in the second run" in done.err
    assert "fixes are of another map (00000000)" in done.err


def test_missing_and_damaged_files_are_reported_at_start(run, small, served, tmp_path):
    fixes, area = small.fixes, small.map_path
    refused(run("view", tmp_path / "none.jsonl", "--map", area), "none.jsonl")
    refused(run("view", tmp_path / "none.mcap", "--map", area), "flight log does not exist")
    refused(run("view", fixes, "--map", tmp_path / "none.onav"), "none.onav")
    refused(run("view", fixes, "--map", fixes), "not an orthonav map")
    refused(run("view", tmp_path, "--map", area), "got a folder without one")
    refused(run("view", fixes, "--map", area, "--flight", tmp_path / "none"), "flight does not")
    refused(run("view", fixes, "--map", area, "--flight", area), "expected photographs")
    refused(run("view", fixes, "--map", area, "--truth", tmp_path / "none.csv"), "truth does not")
    refused(run("view", fixes, "--map", area, "--mount", fixes), "not a mount file")
    refused(run("view", fixes, "--map", area, "--radius-m", "-1"), "--radius-m must be", code=2)
    empty = tmp_path / "empty.jsonl"
    empty.write_text("{}\n")
    refused(run("view", empty, "--map", area), "run has no views", "line 1")
    assert run("view", fixes, "--map", area, "--port", "99999").code == 2
    assert run("view", fixes, "--map", area, "--port", "x").code == 2


def test_what_is_probably_a_mistake_is_warned_about(run, small, served, tmp_path):
    truth = tmp_path / "truth.csv"
    truth.write_text("frame,lat_deg,lon_deg\nother.png,46.5,2.5\n")
    done = run("view", small.fixes, "--map", small.map_path, "--truth", truth)
    assert done.code == 0 and "no view of the run has a true position" in done.err


def test_a_real_one_serves_until_it_is_ended(small):
    script = "import sys, orthonav.cli as cli; sys.exit(cli.main())"
    command = [sys.executable, "-c", script, "view", small.fixes, "--map", small.map_path]
    popen = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        address = popen.stdout.readline().split()[0]
        with urllib.request.urlopen(address + "api/run", timeout=120) as reply:
            assert reply.status == 200
        popen.send_signal(signal.SIGTERM)
        out, err = popen.communicate(timeout=120)
    finally:
        popen.kill()
    assert (popen.returncode, out, err) == (0, "ended\n", "")
