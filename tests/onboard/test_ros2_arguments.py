"""Names, remapping rules and parameters as a ROS 2 node resolves them."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orthonav.core.errors import MissingFileError, VariantError
from orthonav.onboard.ros2.arguments import RosArguments, ros_arguments


def parsed(*words, **environment):
    return ros_arguments(words, environment)


@pytest.mark.parametrize(
    ("words", "name", "expected"),
    [  # as the design document of static remapping and rcl's tests have it
        ((), "image", "/image"),
        ((), "~/fix", "/orthonav/fix"),
        ((), "/clock", "/clock"),
        (("-r", "__ns:=/uav1"), "image", "/uav1/image"),
        (("-r", "__ns:=/uav1"), "~/fix", "/uav1/orthonav/fix"),
        (("-r", "__node:=down", "-r", "__ns:=/a/b"), "~/fix", "/a/b/down/fix"),
        (("-r", "__name:=down"), "~/fix", "/down/fix"),
        (("--remap", "image:=/cam/image_raw"), "image", "/cam/image_raw"),
        (("-r", "image:=front/image", "-r", "__ns:=/u"), "image", "/u/front/image"),
        (("-r", "/u/image:=/x", "-r", "__ns:=/u"), "image", "/x"),
        (("-r", "~/fix:=/gps/fix"), "~/fix", "/gps/fix"),
        (("-r", "/orthonav/fix:=/gps/fix"), "~/fix", "/gps/fix"),
        (("-r", "image:=/a", "-r", "image:=/b"), "image", "/a"),  # the first that matches
        (("-r", "orthonav:image:=/a"), "image", "/a"),
        (("-r", "other:image:=/a"), "image", "/image"),
        (("--ros-args", "-r", "image:=/a", "--"), "image", "/a"),
    ],
)
def test_names_are_resolved(words, name, expected):
    assert parsed(*words).resolved(name) == expected


def test_parameters_and_environment():
    made = parsed("-p", "use_sim_time:=true", "-p", "map_frame:=earth", ROS_DISTRO="humble")
    assert made.parameters.use_sim_time is True and made.parameters.map_frame == "earth"
    assert made.distro == "humble"
    assert parsed(ROS_NAMESPACE="/uav").resolved("image") == "/uav/image"
    assert parsed("-r", "__ns:=/b", ROS_NAMESPACE="a").resolved("image") == "/b/image"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("-r", "image"), "-r image"),
        (("-r",), "-r FROM:=TO"),
        (("--params-file", "x.yaml"), "x.yaml"),
        (("--params-files", "x.yaml"), "--params-files"),
        (("-p", "altitude:=high"), "'high'"),
        (("-p", "covariance:=mine"), "filter or fix"),
        (("-r", "image:=a//b"), "'a//b'"),
        (("-r", "image:=2nd"), "'2nd'"),
        (("-r", "ima ge:=a"), "'ima ge'"),
        (("-r", "__ns:=/a/"), "'/a/'"),
        (("-r", "__node:=a/b"), "'a/b'"),
        (("-p", "use_sim_time:=maybe"), "'maybe'"),
        (("-p", "image_transport:=theora"), "raw or compressed"),
    ],
)
def test_invalid_arguments_are_named(words, said):
    with pytest.raises((VariantError, MissingFileError)) as error:
        parsed(*words)
    assert said in str(error.value)


def test_parameters_of_files_are_those_of_the_node(tmp_path, caplog):
    """As `ros2 launch` passes them: tables by node, names and patterns, the last one counts."""
    path = tmp_path / "params.yaml"
    path.write_text(
        "/**:\n  ros__parameters: {use_sim_time: true, map_frame: all, qos: {depth: 3}}\n"
        "/uav1/orthonav:\n  ros__parameters: {map_frame: mine, altitude: 12.5}\n"
        "uav1:\n  orthonav:\n    ros__parameters: {base_frame: drone}\n"
        "/uav2/orthonav:\n  ros__parameters: {use_sim_time: false}\n"
    )
    made = parsed("-r", "__ns:=/uav1", "--params-file", str(path)).parameters
    assert (made.use_sim_time, made.altitude) == (True, "12.5")
    assert (made.map_frame, made.base_frame) == ("mine", "drone")
    assert "qos.depth is ignored" in caplog.text
    before = parsed("-p", "map_frame:=x", "--params-file", str(path)).parameters
    after = parsed("--params-file", str(path), "-p", "orthonav:map_frame:=x").parameters
    assert (before.map_frame, after.map_frame) == ("all", "x")
    assert parsed("-p", "other:map_frame:=x").parameters.map_frame == "map"


@pytest.mark.parametrize(
    "text", ["[1, 2", "- a", "orthonav: {map_frame: x}", "", "\x00", "[" * 1500, "a:\n  b: c: d"]
)
def test_a_file_without_parameters_is_refused(tmp_path, text):
    path = tmp_path / "params.yaml"
    path.write_text(text)
    with pytest.raises(VariantError, match="parameter file") as caught:
        parsed("--params-file", str(path))
    assert "\n" not in str(caught.value)


def test_other_arguments_of_ros_are_taken():
    made = parsed("--ros-args", "--log-level", "warn", "--disable-rosout-logs", "-e", "/enclave")
    assert made.passed == ("--log-level", "warn", "--disable-rosout-logs", "-e", "/enclave")


token = st.from_regex(r"[a-z_][a-z0-9_]{0,8}", fullmatch=True)


@settings(max_examples=20)
@given(st.lists(token, max_size=3), st.lists(token, min_size=1, max_size=3), token)
def test_expansion_is_absolute_and_idempotent(space, name, node):
    made = RosArguments(node=node, namespace="/" + "/".join(space))
    for start in ("", "~/", "/"):
        full = made.expanded(start + "/".join(name))
        assert full.startswith("/") and "//" not in full and full.endswith("/".join(name))
        assert made.expanded(full) == full == made.resolved(full)
