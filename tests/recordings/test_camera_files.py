"""Camera files of other programs, as those programs write them."""

import json
import sys
from copy import deepcopy

import cv2
import numpy as np
import pytest
import yaml

from orthonav.core.errors import CameraError, MissingExtraError
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.camera_files import read_camera_file

MATRIX = np.array([[500.25, 0, 319.5], [0, 501.5, 239.5], [0, 0, 1]])
BROWN = [-0.25, 0.08, 1e-3, -5e-4, -0.01]
FISHEYE = [0.02, -0.01, 0.003, -0.001]
HALF = {"width_px": 640, "height_px": 480, "fx_px": 500.25, "fy_px": 501.5}
MIDDLE = {"cx_px": 320.0, "cy_px": 240.0}


def expected(distortion, model="brown"):
    """Theirs: the middle of 640 x 480 is 319.5, 239.5; ours: 320, 240."""
    return Camera(**HALF, **MIDDLE, distortion=tuple(distortion), model=model)


def opencv(path, distortion=BROWN, names=("camera_matrix", "distortion_coefficients"), **more):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write(names[0], MATRIX)
    storage.write(names[1], np.array(distortion, dtype=float).reshape(-1, 1))
    for name, value in more.items():
        storage.write(name, value)
    storage.release()
    return path


def ros(path, model="plumb_bob", distortion=BROWN, **changes):
    plain = {
        "image_width": 640,
        "image_height": 480,
        "camera_name": "down",
        "camera_matrix": {"rows": 3, "cols": 3, "data": MATRIX.ravel().tolist()},
        "distortion_model": model,
        "distortion_coefficients": {"rows": 1, "cols": len(distortion), "data": list(distortion)},
    }
    path.write_text(yaml.safe_dump(plain | changes))
    return path


def kalibr(path, model="radtan", distortion=BROWN[:4], names=("cam0",), **changes):
    one = {
        "camera_model": "pinhole",
        "distortion_model": model,
        "distortion_coeffs": list(distortion),
        "intrinsics": [500.25, 501.5, 319.5, 239.5],
        "resolution": [640, 480],
        "rostopic": "/cam0/image_raw",
    }
    path.write_text(yaml.safe_dump({name: deepcopy(one | changes) for name in names}))
    return path


def test_the_principal_point_is_counted_from_the_corner(tmp_path):
    """A point that OpenCV projects to the centre of the first pixel, (0, 0), is ours at 0.5."""
    camera = read_camera_file(opencv(tmp_path / "c.yaml", np.zeros(5)))
    ray = np.linalg.inv(MATRIX) @ [0, 0, 1]
    theirs, _ = cv2.projectPoints(ray[None], np.zeros(3), np.zeros(3), MATRIX, None)
    assert theirs.ravel() == pytest.approx([0, 0], abs=1e-9)
    assert (camera.matrix @ ray)[:2] == pytest.approx([0.5, 0.5])


@pytest.mark.parametrize("name", ["camera.yaml", "camera.yml", "camera.json"])
def test_opencv(tmp_path, name):
    assert read_camera_file(opencv(tmp_path / name)) == expected(BROWN)
    fish = opencv(tmp_path / f"fish_{name}", FISHEYE, fisheye_model=1)
    assert read_camera_file(fish) == expected(FISHEYE, "fisheye")
    other = opencv(tmp_path / f"other_{name}", BROWN, ("cameraMatrix", "distCoeffs"))
    assert read_camera_file(other) == expected(BROWN)
    long = opencv(tmp_path / f"long_{name}", [*BROWN, 0, 0, 0])
    assert read_camera_file(long) == expected(BROWN)


def test_opencv_as_xml(tmp_path):
    """As Metashape exports it."""
    names = "Camera_Matrix", "Distortion_Coefficients"
    text = opencv(tmp_path / "camera.xml", BROWN, names).read_text()
    (tmp_path / "camera.xml").write_text(text.replace("image_w", "image_W").replace("_h", "_H"))
    assert read_camera_file(tmp_path / "camera.xml") == expected(BROWN)


@pytest.mark.parametrize("write", [ros, kalibr])
def test_without_pyyaml_opencv_reads(tmp_path, monkeypatch, write):
    path = write(tmp_path / "a.yaml")
    plain = yaml.safe_load(path.read_text())
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(MissingExtraError, match="PyYAML"):  # sequences that are not indented
        read_camera_file(path)
    indented = "\n".join(f"{name}: {json.dumps(each)}" for name, each in plain.items())
    path.write_text(indented.replace('"', ""))
    assert read_camera_file(path).distortion == tuple(BROWN[: 5 if write is ros else 4])


@pytest.mark.parametrize(
    "write, model, given, expects",
    [
        (ros, "plumb_bob", BROWN, expected(BROWN)),
        (ros, "rational_polynomial", [*BROWN, 0, 0, 0], expected(BROWN)),
        (ros, "equidistant", FISHEYE, expected(FISHEYE, "fisheye")),
        (kalibr, "radtan", BROWN[:4], expected(BROWN[:4])),
        (kalibr, "equidistant", FISHEYE, expected(FISHEYE, "fisheye")),
        (kalibr, "none", [], expected(())),
    ],
)
def test_ros_and_kalibr(tmp_path, write, model, given, expects):
    assert read_camera_file(write(tmp_path / "a.yaml", model, given)) == expects
    if write is ros:
        with pytest.raises(CameraError, match="not a Kalibr chain; give it without #cam1"):
            read_camera_file(tmp_path / "a.yaml#cam1")


def test_a_chain_of_kalibr_with_the_header_of_opencv(tmp_path):
    path = kalibr(tmp_path / "a.yaml", names=("cam0", "cam1"))
    chain = path.read_text()
    second = chain.index("cam1:")
    chain = chain[:second] + chain[second:].replace("500.25", "501.25")
    path.write_text("%YAML:1.0\n\n" + chain)
    assert read_camera_file(tmp_path / "a.yaml#cam0") == expected(BROWN[:4])
    assert read_camera_file(tmp_path / "a.yaml#cam1").fx_px == 501.25
    with pytest.raises(CameraError, match="holds cam0, cam1; select one as FILE#cam0"):
        read_camera_file(path)
    with pytest.raises(CameraError, match="no camera 'cam7', it holds cam0, cam1"):
        read_camera_file(tmp_path / "a.yaml#cam7")


def written(text):
    def write(path):
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


REFUSED = {
    "rational": (lambda p: ros(p, "rational_polynomial", [*BROWN, 0.1, 0, 0]), "more than k1"),
    "unknown model": (lambda p: ros(p, "thin_prism"), "'thin_prism' is not supported"),
    "omni": (lambda p: kalibr(p, camera_model="omni"), "'omni' is not supported"),
    "two cameras": (lambda p: kalibr(p, names=("cam0", "cam1")), "holds cam0, cam1"),
    "short matrix": (lambda p: ros(p, camera_matrix={"data": [1, 2]}), "9 numbers"),
    "no size": (written("%YAML:1.0\n---\nfx: 1\n"), "key .image_width. is missing"),
    "not YAML": (written("a: [1, 2"), "not YAML"),
    "code": (written("!!python/object/apply:os.system ['true']"), "not YAML"),
    "a list": (written("- 1\n- 2\n"), "mapping was expected"),
    "nothing": (written(""), "mapping was expected"),
    "other JSON": (written(json.dumps({"a": 1})), "key .image_width. is missing"),
    "bytes": (written(b"\xff\xfe\x00\x80"), "not UTF-8 text"),
    "broken OpenCV": (written("%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n  rows: x"), "."),
    "rows of nothing": (
        lambda p: p.write_text(opencv(p).read_text().replace("rows: 5", "rows: 0")) and p,
        "rows, columns and data of a matrix disagree",
    ),
    "negative": (lambda p: kalibr(p, intrinsics=[-1, 1, 1, 1]), "focal length"),
}


REFUSED |= {
    "transposed": (
        lambda p: ros(p, camera_matrix={"data": MATRIX.T.ravel().tolist()}),
        "transposed .its last row is 319.5, 239.5, 1., as MATLAB",
    ),
    "no centre": (lambda p: kalibr(p, intrinsics=[500, 500, 0, 0]), "principal point 0.5, 0.5 px"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_invalid_camera_files_are_rejected(tmp_path, name, capfd):
    write, message = REFUSED[name]
    path = write(tmp_path / "camera.yaml")
    with pytest.raises(CameraError, match=message) as caught:
        read_camera_file(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
