"""An option has one meaning and one unit in all commands: one kind of value, one metavar."""

import argparse
import subprocess
import sys

import pytest

from orthonav.cli import COMMANDS, _parser, main, parse
from orthonav.cli.flying import _gps_id, _kinds

DIFFERENT_METAVARS = {"--out"}
"""The metavar of an output names what each command writes."""


def commands(parser, name):
    """Parsers of a command and of its actions, by name."""
    yield name, parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for sub_name, sub in action.choices.items():
                yield from commands(sub, f"{name} {sub_name}")


def parser_of(command):
    actions = _parser([command, "--help-all"])._actions
    return next(a for a in actions if isinstance(a, argparse._SubParsersAction)).choices[command]


ALL = [each for command in COMMANDS for each in commands(parser_of(command), command)]
OPTIONS = {}
for command, parser in ALL:
    for action in parser._actions:
        for option in action.option_strings:
            OPTIONS.setdefault(option, []).append((command, action))


def value_of(option, action):
    """What an option takes: none or one or several values, of which type, named how."""
    takes = {0: "no value", "?": "perhaps a value"}.get(action.nargs, "values")
    metavar = None if option in DIFFERENT_METAVARS or takes == "no value" else action.metavar
    choices = None if action.choices is None else tuple(action.choices)
    return takes, getattr(action.type, "__name__", None), metavar, choices


SHARED = [option for option, uses in sorted(OPTIONS.items()) if len(uses) > 1]


def test_an_option_takes_the_same_value_in_all_commands():
    for option in SHARED:
        values = {}
        for command, action in OPTIONS[option]:
            values.setdefault(value_of(option, action), []).append(command)
        assert len(values) == 1, (option, values)


@pytest.mark.parametrize("line", ["info", "demo", "atlas", "atlas info", "sign", "fly"])
def test_every_command_has_help_all(line, capsys):
    with pytest.raises(SystemExit) as ended:
        main([*line.split(), "--help-all"])
    assert ended.value.code == 0 and f"usage: orthonav {line}" in capsys.readouterr().out


def test_bands_are_numbers(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["build", "--bands", "r,g"])
    assert ended.value.code == 2 and "expected numbers from 1" in capsys.readouterr().err


@pytest.mark.parametrize("sent", ["vision:1", "gps-input:256", "gps-input:", "all"])
def test_only_the_gps_message_has_an_id(sent, capsys):
    asked = ["--send", "gps-input:1", "--send", "vision", "--send", "gps-input"]
    options = parse(["fly", "a.onav", *asked])
    assert _kinds(options) == ("gps-input", "vision") and _gps_id(options) == 1
    with pytest.raises(SystemExit) as ended:
        main(["fly", "a.onav", "--send", sent])
    assert ended.value.code == 2 and "gps-input:0 to gps-input:255" in capsys.readouterr().err


@pytest.mark.parametrize("given", ["--log-max-mb=0", "--log-max-mb=nan", "--min-std-m=nan"])
def test_numbers_of_a_flight_have_ranges(given, capsys):
    """A log of at most 0 MB would delete all earlier ones."""
    with pytest.raises(SystemExit) as ended:
        main(["fly", "a.onav", "video.mp4", given])
    assert ended.value.code == 2 and "expected " in capsys.readouterr().err


@pytest.mark.parametrize("first", ["gps-input:1", "gps-input:0"])
def test_messages_have_one_gps_id(first, run):
    asked = ["--send", first, "--send", "gps-input:2"]
    done = run("fly", "a.onav", "video.mp4", "--autopilot", "udpin:14550", *asked)
    assert done.code == 2 and f"several receivers: {first} and gps-input:2" in done.err


@pytest.mark.parametrize("gnss", [[], ["--gnss", "watch"]])
def test_a_flight_needs_telemetry(gnss, run):
    done = run("fly", "a.onav", "video.mp4", *gnss)
    assert done.code == 2 and "give --autopilot URL, or --recorded-telemetry" in done.err


@pytest.mark.parametrize("values", ["-33.9,18.4,-33.8,18.5", "-.5,1,2,3", "-1e-3,1,2,3"])
def test_a_value_may_begin_with_a_minus(values):
    area = parse(["build", "--ortho", "a.tif", "--out", "a.onav", "--bounds", values]).bounds
    assert area == tuple(map(float, values.split(",")))
    turned = parse(["localize", "a.onav", "f", "--mount-deg", "-90", "-1e1", "-.5"]).mount_deg
    assert turned == [-90.0, -10.0, -0.5]


@pytest.mark.parametrize(
    ("line", "meant"),
    [
        ("bild", "build, not bild"),
        ("atlas biuld", "build, not biuld"),
        ("localize a.onav f --hedding unknown", "--heading, not --hedding"),
        ("localize a.onav f --heading=unknwon", "unknown, not unknwon"),
        ("check a.onav --uot c", "--out, not --uot"),
        ("info a.onav --completely-different", None),
    ],
)
def test_wrong_words_are_answered_in_two_lines_with_what_was_probably_meant(line, meant, capsys):
    with pytest.raises(SystemExit) as ended:
        main(line.split())
    usage, error = capsys.readouterr().err.splitlines()
    assert ended.value.code == 2 and usage.startswith("usage: orthonav ") and "error: " in error
    assert error.endswith(f"; did you mean {meant}?") if meant else "did you mean" not in error


@pytest.mark.parametrize(
    ("typed", "words"),
    [
        ("orthonav loc", {"localize", "locate-pixel"}),
        ("orthonav localize --looks", {"--looks-down"}),
        ("orthonav atlas cu", {"cut"}),
    ],
)
def test_a_shell_completes_words(typed, words, tmp_path, monkeypatch):
    """As bash asks after `register-python-argcomplete orthonav`; options beyond --help too."""
    pytest.importorskip("argcomplete")
    asked = {"COMP_LINE": typed, "COMP_POINT": str(len(typed)), "_ARGCOMPLETE_IFS": "\n"}
    asked |= {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "words")}
    for name, value in asked.items():
        monkeypatch.setenv(name, value)
    subprocess.run([sys.executable, "-m", "orthonav"], check=True)
    assert {each.strip() for each in (tmp_path / "words").read_text().split("\n")} == words
