"""Files made to do harm: refused in one line, before they take memory or load anything."""

import itertools
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import zlib
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from orthonav.core.errors import CameraError, MapFileError
from orthonav.core.geo.camera_files import read_camera_file
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map, write_map

pytestmark = pytest.mark.long

GOLDEN = Path(__file__).parent / "data" / "golden_v1.onav"
MEMORY_BYTES = 3 * 2**29
"""Address space of a command that refuses; a picture of 2^30 pixels needs more."""


def changed(path, parts=None, **changes):
    """The golden map with other parts or other entries of its manifest, its sums right."""
    opened = open_map(GOLDEN)
    arrays = {name: np.array(part) for name, part in opened.arrays.items()} | (parts or {})
    write_map(path, replace(opened.manifest, **changes), arrays)
    return path


MANY = """
import json, sys
import orthonav.cli as cli

for arguments in json.loads(sys.argv[1]):
    print(f"ended with {cli.main(arguments)}", file=sys.stderr)
"""


def ended(*commands):
    """What commands in a process of their own with little memory say: on
    stderr each, their codes, and on stdout."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("OPENCV")}
    done = subprocess.run(
        [sys.executable, "-c", MANY, json.dumps([[*map(str, each)] for each in commands])],
        env=kept | {"OPENBLAS_NUM_THREADS": "1"},
        preexec_fn=partial(resource.setrlimit, resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES)),
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0 and "Traceback" not in done.stderr
    said = re.split(r"ended with (\d+)\n", done.stderr)
    assert len(said) == 2 * len(commands) + 1
    return said[0:-1:2], list(map(int, said[1::2])), done.stdout


def refused(*commands):
    """The line that each of these commands says when it refuses."""
    parts, codes, out = ended(*commands)
    assert set(codes) == {1} and out == ""
    errors = [
        [line for line in part.splitlines() if line.startswith("orthonav: error: ")]
        for part in parts
    ]
    assert all(len(lines) == 1 for lines in errors)
    return [lines[0] for lines in errors]


def claiming(width, height, suffix):
    """A picture of 16 x 16 px whose header claims another size."""
    data = bytearray(cv2.imencode(suffix, np.zeros((16, 16), np.uint8))[1].tobytes())
    if suffix == ".png":
        data[16:24] = width.to_bytes(4, "big") + height.to_bytes(4, "big")
        data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    else:
        at = data.index(b"\xff\xc0") + 5
        data[at : at + 4] = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    return bytes(data)


# Pictures.


def test_pictures_that_claim_gigapixels(flight_path, tmp_path):
    commands = []
    for suffix, side in itertools.product((".jpg", ".png"), (17_000, 32_000)):
        flight = shutil.copytree(flight_path, tmp_path / f"{side}{suffix}")
        (flight / "frames" / "0001.jpg").write_bytes(claiming(side, side, suffix))
        commands.append(("localize", GOLDEN, flight, "--out", tmp_path / "fixes.jsonl", "-q"))
    for message in refused(*commands):
        assert "image of the flight cannot be decoded" in message and "0001.jpg" in message


# Maps.


def test_masks_that_inflate_to_gigabytes(tmp_path, flight_path):
    bytes_, offsets = "sheet0/grey/mask_bytes", "sheet0/grey/mask_offsets"
    has_one = np.diff(open_map(GOLDEN).arrays[offsets]) > 0
    bomb = zlib.compress(bytes(100_000_000), 1)
    ends = np.cumsum([0, *(has_one * len(bomb))], dtype=np.int64)
    data = np.frombuffer(bomb * int(has_one.sum()), np.uint8)
    path = changed(tmp_path / "a.onav", {bytes_: data, offsets: ends})
    localize = ("localize", path, flight_path, "--out", tmp_path / "fixes.jsonl", "-q")
    check = ("check", path, "--agl-m", "270", "--out", tmp_path / "check", "-q")
    _, codes, _ = ended(localize, (*localize, "--track"), check, ("info", path))
    assert set(codes) <= {0, 1, 3, 4}


def test_a_preview_that_claims_gigapixels(tmp_path, run):
    for side in (400, 17_000):
        preview = np.frombuffer(claiming(side, side, ".jpg"), np.uint8)
        path = changed(tmp_path / "a.onav", {"sheet0/preview_jpeg": preview})
        fixes, truth = tmp_path / "fixes.jsonl", tmp_path / "truth.csv"
        done = run("evaluate", fixes, "--truth", truth, "--map", path)
        assert done.code == 1 and "preview cannot be decoded" in done.err
    png = np.frombuffer(cv2.imencode(".png", np.zeros((16, 16), np.uint8))[1], np.uint8)
    path = changed(tmp_path / "b.onav", {"sheet0/preview_jpeg": png})
    assert "preview" in run("evaluate", fixes, "--truth", truth, "--map", path).err


@pytest.mark.parametrize("step", [1e-9, 0.4999, 0.0, -6.0, 361.0, 1e300, None, "6", True])
def test_headings_that_are_too_many(tmp_path, step):
    view = {**open_map(GOLDEN).manifest.view, "heading_step_deg": step}
    with pytest.raises(MapFileError, match="heading_step_deg"):
        open_map(changed(tmp_path / "a.onav", view=view))


@pytest.mark.parametrize("name", ["radius_m", "position_floor_px"])
def test_numbers_whose_squares_overflow(tmp_path, name):
    registration = open_map(GOLDEN).manifest.registration | {name: 1e300}
    path = changed(tmp_path / "large.onav", registration=registration)
    with pytest.raises(MapFileError, match="impossible registration"):
        Localizer(open_map(path))


def test_a_map_of_what_does_not_fly(tmp_path, flight_path, monkeypatch):
    """Refused before anything of it is loaded, weights least of all."""
    monkeypatch.setitem(sys.modules, "orthonav.research.sam", None)
    recipe = dict(open_map(GOLDEN).manifest.recipe)
    recipe["represent"] = {"name": "sam", "weights": str(tmp_path / "weights.pth")}
    path = changed(tmp_path / "a.onav", recipe=recipe)
    for registration in (True, False):
        with pytest.raises(MapFileError, match="'sam' does not fly"):
            Localizer(open_map(path), registration=registration)
    with pytest.raises(ImportError, match="sam"):
        Localizer(open_map(path), flying=False)
    (message,) = refused(("localize", path, flight_path, "--out", tmp_path / "fixes.jsonl"))
    assert "map cannot be flown ('sam' does not fly" in message


# Camera files.


LAUGHS = "a: &a [x, x]\n" + "".join(
    f"{each}: &{each} [{', '.join(8 * [f'*{before}'])}]\n"
    for before, each in zip("abcdefgh", "bcdefghi", strict=True)
)
CAMERAS = {
    "laughs": (LAUGHS, "anchors or aliases"),
    "only an anchor": ("a: &a 1\n", "anchors or aliases"),
    "only an alias": ("a: *a\n", "anchors or aliases"),
    "deep": ("a: " + "[" * 1000, "20 levels"),
    "deep list": ("- " * 1000, "20 levels"),
    "many": ("[" + "1," * 30_000 + "1]", "20000 parts"),
    "long number": ("a: " + "1:" * 30_000 + "1", "10000 characters"),
    "large": ("#" * 1_000_001, "larger than 1 MB"),
    "deep JSON": ('{"a":' * 100_000, "recursion"),
}


@pytest.mark.parametrize("how", CAMERAS)
def test_camera_files(tmp_path, how):
    text, message = CAMERAS[how]
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(CameraError, match=message) as caught:
        read_camera_file(path)
    assert str(path) in str(caught.value)


OPENCV = {
    "lists": "%YAML:1.0\n---\na: " + "[" * 400_000,
    "mappings": "%YAML:1.0\n---\na: " + "{b:" * 200_000,
    "dashes": "%YAML:1.0\n---\na:\n   " + "- " * 400_000 + "1\n",
    "dashes close together": "%YAML:1.0\n---\na:\n   " + "-" * 900_000 + "1\n",
    "colons": "%YAML:1.0\n---\n" + "a:" * 400_000 + "1\n",
    "JSON": '{"opencv-matrix": ' + "[" * 400_000,
    "XML": '<opencv_storage type_id="opencv-matrix">' + "<a>" * 300_000,
}


def test_camera_files_that_are_too_deep_for_opencv(tmp_path, flight_path):
    """It ends the process otherwise: so in one of its own."""
    out, commands = tmp_path / "out", []
    for how, text in OPENCV.items():
        path = tmp_path / f"{how}.yaml"
        path.write_text(text)
        commands.append(("import", flight_path, "--camera", path, "--out", out))
    for how, message in zip(OPENCV, refused(*commands), strict=True):
        assert "camera file has more than 5000 parts" in message and how in message
        assert not out.exists()
