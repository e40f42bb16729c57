"""No fault of a service may become a wrong pixel: each ends in an error, a mask, or both."""

import os
import signal
import subprocess
import sys
import time
import traceback

import numpy as np
import pytest
import rasterio
import servers
import terrain

from orthonav.core.errors import FetchError, OutputError, UsageError
from orthonav.ground.planning.area import Area

NOISE = np.random.default_rng(1).integers(1, 255, (256, 256, 3), dtype=np.uint8)
PLACEHOLDER = terrain.encoded(NOISE)
FAULTS = {
    "a page": servers.Answer(b"<html>Log in</html>", kind="text/html"),
    "an error in XML": servers.Answer(
        b"<ServiceExceptionReport><ServiceException>down</ServiceException></ServiceExceptionReport>"
    ),
    "another size": servers.Answer(terrain.encoded(NOISE[:128, :128])),
    "half a picture": servers.Answer(terrain.encoded(NOISE, "JPEG")[:5000]),
    "cut short": servers.Answer(PLACEHOLDER, cut=900),
    "500": servers.Answer(b"oops", 500),
    "403": servers.Answer(b"no", 403),
    "429": servers.Answer(b"", 429),
    "reset": servers.Answer(reset=True),
    "a picture of another kind": servers.Answer(terrain.encoded(NOISE, "PPM")[:5000]),
    "nothing": servers.Answer(b""),
}
ABSENT = {
    "404": servers.Answer(b"not found", 404),
    "204": servers.Answer(b"", 204),
    "white": servers.Answer(terrain.encoded(np.full((256, 256, 3), 255, np.uint8))),
    "black": servers.Answer(terrain.encoded(np.zeros((256, 256, 3), np.uint8), "JPEG")),
    "clear": servers.Answer(terrain.encoded(np.zeros((256, 256, 4), np.uint8))),
    "placeholder": servers.Answer(PLACEHOLDER),
}


def tiles_but(fault, *, among=2, lasting=True):
    """Tiles of the ground, but for every so manieth, which is that fault, always or only once."""

    def answer(asked):
        number = sum(int(part) for part in asked.path.rpartition(".")[0].split("/")[-2:])
        if number % among == 0 and (lasting or not asked.before):
            return fault
        return servers.tiles(asked)

    return answer


REASONS = {
    "a page": "not an image: 2",
    "an error in XML": "an error of the service (down)",
    "another size": "image of 128 x 128 px instead of 256 x 256",
    "403": "HTTP 403",
    "nothing": "empty answer",
}
TEMPORARY = ["a page", "half a picture", "cut short", "500", "429", "reset"]


@pytest.mark.parametrize("name", ["a page", *sorted(FAULTS.keys() - TEMPORARY)])
def test_a_lasting_fault_writes_nothing_and_can_be_resumed(take, tmp_path, name):
    with servers.serving(tiles_but(FAULTS[name])) as server:
        with pytest.raises(FetchError, match=r"\d of \d+ tiles failed .*--allow-holes") as raised:
            take(server.tiles)
        assert not (tmp_path / "ortho.tif").exists()
        assert "ortho.tif.tiles" in str(raised.value) and "127.0.0.1" in str(raised.value)
        assert name not in REASONS or REASONS[name] in str(raised.value)
        before = len(server.log)
        server.answer = servers.tiles
        result, path = take(server.tiles)  # the same command resumes
        asked_again = {asked.path for asked in server.log[before:]}
    assert 0 < len(asked_again) < result.estimate.tiles
    shift, worst, valid = terrain.offset_px(path)
    assert np.abs(shift).max() < 0.05 and worst <= 1 and valid == 1.0
    assert not (tmp_path / "ortho.tif.tiles").exists()


@pytest.mark.parametrize("name", TEMPORARY)
def test_a_temporary_fault_is_overcome(take, name):
    with servers.serving(tiles_but(FAULTS[name], lasting=False)) as server:
        result, path = take(server.tiles)
    assert not result.failed and terrain.offset_px(path)[1] <= 1
    assert terrain.offset_px(path)[2] == 1.0


@pytest.mark.parametrize("name", ["a page", "another size", "500"])
def test_allowed_holes_are_masked(take, name, caplog):
    with servers.serving(tiles_but(FAULTS[name])) as server:
        result, path = take(server.tiles, allow_holes=True)
        area = Area.from_bounds((10.0, 85.04, 10.02, 85.06))
        take(server.tiles, area=area, gsd_m=5.0, allow_holes=True, out="north.tif")
    failed = result.failed.total()
    assert failed > 0 and f"{failed} failed" in caplog.text
    assert "outside what the service covers" in caplog.text
    shift, worst, valid = terrain.offset_px(path)
    assert np.abs(shift).max() < 0.05 and worst <= 1
    assert valid == pytest.approx(1 - failed / result.estimate.tiles) == result.valid_share


@pytest.mark.parametrize("name", ABSENT)
def test_missing_imagery_is_masked_and_counted(take, name, caplog):
    with servers.serving(tiles_but(ABSENT[name])) as server:
        result, path = take(server.tiles)
    plain = result.describe()
    missing = plain["not_covered"] + plain["blank"] + plain["placeholders"]
    assert 0 < missing < plain["tiles"] and not plain["failed"]
    assert plain["valid_share"] == pytest.approx(1 - missing / plain["tiles"], abs=1e-4)
    assert terrain.offset_px(path)[1] <= 1 and "masked" in caplog.text


@pytest.mark.parametrize("name", ["404", "white", "placeholder"])
def test_no_imagery_at_all_is_an_error(take, tmp_path, name):
    words = "no imagery of this area"
    with servers.serving(lambda _: ABSENT[name]) as server, pytest.raises(FetchError, match=words):
        take(server.tiles)
    assert not (tmp_path / "ortho.tif").exists()


def test_a_service_that_is_down_ends_the_fetch(take):
    with servers.serving(lambda _: servers.Answer(b"no", 401)) as server:
        with pytest.raises(FetchError, match=r"20 requests in a row failed.*HTTP 401"):
            take(server.tiles, half_m=900)
        assert len(server.log) < 60


@pytest.mark.parametrize("protocol", ["xyz", "wmts", "cog"])
def test_an_error_of_a_service_that_quotes_the_key_does_not_show_it(take, protocol, monkeypatch):
    monkeypatch.setenv("MY_KEY", "s3cr3t-v4lue")
    report = (
        b"<ExceptionReport><ExceptionText>bad key s3cr3t-v4lue</ExceptionText></ExceptionReport>"
    )
    with servers.serving(lambda asked: servers.Answer(report)) as server:
        address = f"{protocol}:{server.url}/{{z}}/{{x}}/{{y}}.png?token={{key}}"
        if protocol != "xyz":
            address = f"{protocol}:{server.url}/a?token={{key}}"
        with pytest.raises(FetchError) as raised:
            take(address, terms={"key_env": "MY_KEY"})
        assert server.log[0].query["TOKEN"] == "s3cr3t-v4lue"
    assert "s3cr3t" not in "".join(traceback.format_exception(raised.value))
    assert protocol != "wmts" or "bad key {key}" in str(raised.value)


@pytest.mark.parametrize(
    "options, words",
    [
        ({"max_mb": 0.1}, r"would fetch \d+ tiles.*--max-mb 0.1"),
        ({"out": "ortho.jpg"}, "must be a .tif file"),
        ({"out": "folder.tif"}, "folder or a device"),
    ],
)
def test_limits_end_a_fetch_before_it_starts(take, tmp_path, names_in, options, words):
    (tmp_path / "folder.tif").mkdir()
    with servers.serving(servers.tiles) as server:
        with pytest.raises((FetchError, OutputError, UsageError), match=words):
            take(server.tiles, **options)
        assert not server.log
    assert names_in(tmp_path) == ["folder.tif"]


def test_a_broken_entry_of_the_cache_is_fetched_again(take, tmp_path):
    with servers.serving(tiles_but(FAULTS["403"])) as server:
        with pytest.raises(FetchError, match="rerun the command to resume"):
            take(server.tiles, half_m=200)
        cells = [p for p in (tmp_path / "ortho.tif.tiles").rglob("*") if p.is_file()]
        cells[0].write_bytes(cells[0].read_bytes()[:-5])
        cells[1].write_bytes(b"")
        flipped = bytearray(cells[2].read_bytes())
        flipped[900] ^= 1
        cells[2].write_bytes(flipped)
        before, server.answer = len(server.log), servers.tiles
        result, path = take(server.tiles, half_m=200)
        assert len(server.log) - before == result.estimate.tiles - len(cells) + 3
    assert terrain.offset_px(path)[1] <= 1


def command_for(server, bounds, out):
    area = [f"--bounds={bounds}", "--gsd-m", "1"]
    command = [sys.executable, "-m", "orthonav", "fetch", "--heights", "none"]
    return [*command, *area, "--source", server.tiles, "--out", out]


@pytest.mark.long
def test_a_killed_fetch_resumes(take, tmp_path, names_in):
    """SIGKILL after some tiles; the same fetch then asks only for the rest."""
    out = tmp_path / "ortho.tif"

    def slowly(asked):
        return servers.Answer(servers.tiles(asked).body, slow_s=0.02)

    with servers.serving(slowly) as server:
        command = command_for(server, ",".join(map(str, terrain.bounds(200))), out)
        with subprocess.Popen([*command, "-q"]) as process:
            while len(server.log) < 12 and process.poll() is None:
                time.sleep(0.005)
            process.send_signal(signal.SIGKILL)
        assert process.returncode == -signal.SIGKILL and not out.exists()
        before = 0
        while before != len(server.log):  # requests of the killed process may still arrive
            before = len(server.log)
            time.sleep(0.1)
        result, _ = take(server.tiles, half_m=200, margin_m=200.0)
        asked = len(server.log) - before
    assert 0 < asked <= result.estimate.tiles - 4
    shift, worst, valid = terrain.offset_px(out)
    assert np.abs(shift).max() < 0.05 and worst <= 1 and valid == 1.0
    assert names_in(tmp_path) == ["ortho.tif"]


def test_an_interrupt_leaves_no_half_file(tmp_path):
    bounds = ",".join(map(str, terrain.bounds(200)))
    with servers.serving(lambda _: servers.Answer(PLACEHOLDER, slow_s=5)) as server:
        command = command_for(server, bounds, tmp_path / "o.tif")
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
            while not server.log and process.poll() is None:
                time.sleep(0.005)
            os.kill(process.pid, signal.SIGTERM)
            assert process.stderr is not None
            message = process.stderr.read()
    assert process.returncode == 143 and "interrupted" in message and "Traceback" not in message
    assert not (tmp_path / "o.tif").exists()


@pytest.mark.parametrize("colour, level", [("black", 0), ("white", 255)])
def test_large_patches_of_the_colour_of_nothing_are_masked(take, colour, level):
    scene = NOISE.copy()
    scene[:, :100] = level  # the edge of the coverage
    scene[200:210, 200:210] = level  # a roof, or a shadow
    with servers.serving(lambda asked: servers.Answer(terrain.encoded(scene))) as server:
        _, path = take(server.tiles, half_m=5, empty=colour)
    with rasterio.open(path) as data:
        valid = data.dataset_mask() > 0
    assert not valid[:, :100].any() and valid[:, 100:].all()
