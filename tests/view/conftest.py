"""The small run of `small_run.py`, made once, opened and served."""

import http.client
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1] / "localize"))  # blots.py: the known ground

from small_run import PLACES_EN_M, Small, result, serving, write_small_flight, write_small_map

from orthonav.core.flight.fixes import write_results
from orthonav.ground.view.run import Run, ViewRequest


@pytest.fixture(scope="session")
def small(made_once):
    """The run; not to be changed."""

    def make(folder):
        write_small_map(folder / "area.onav")
        write_small_flight(folder / "flight")
        write_results(folder / "fixes.jsonl", [result(i) for i in range(len(PLACES_EN_M))])

    folder = made_once("view", make)
    return Small(folder / "area.onav", folder / "flight", folder / "fixes.jsonl")


@pytest.fixture(scope="session")
def opened(small):
    """The run, opened with its flight and truth."""
    return Run(ViewRequest(small.fixes, small.map_path, flight=small.flight))


@pytest.fixture(scope="session")
def server(opened):
    with serving(opened) as started:
        yield started


@pytest.fixture(scope="session")
def ask(server):
    """Function that asks for a path: status, headers (lower case) and body."""

    def asked(path, method="GET", **headers):
        connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=120)
        try:
            fields = {key.replace("_", "-"): value for key, value in headers.items()}
            connection.request(method, path, headers=fields)
            reply = connection.getresponse()
            return reply.status, {k.lower(): v for k, v in reply.getheaders()}, reply.read()
        finally:
            connection.close()

    return asked
