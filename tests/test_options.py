"""An option has one meaning and one unit in all commands: one kind of value, one metavar."""

import argparse
import re

import pytest

from orthonav.cli import COMMANDS, UNITS, _parser, main

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


MEANING = {
    "--accept": "criterion of a confident fix and its threshold",
    "--agl-m": "height above ground",
    "--agl-std": "standard deviation of the reported height, as a fraction of it",
    "--allow-holes": "even if",
    "--band-m": "width of the search band for legs without a width of their own",
    "--camera": "camera file: flight.json, or of OpenCV, ROS or Kalibr (YAML, JSON)",
    "--dem": "terrain model (any raster that GDAL reads)",
    "--dry-run": "nothing",
    "--flight": "flight folder",
    "--gsd-m": "ground resolution, metres per pixel",
    "--heading": "unknown: all headings are tried",
    "--jpeg-quality": "quality of JPEG images",
    "--json": "print .*JSON|print .*json",
    "--map": "map of the flight",
    "--mount": "calibration by `orthonav calibrate`",
    "--no-registration": "a map without the registration layer|omit the registration layer",
    "--not-before": "refuse a map signed before this date (2026-05-31, UTC) or with a lower serial",
    "--ortho": "or a folder of them, where newer files take precedence",
    "--other-date": "orthophoto of .*(another|second) date",
    "--prior": "telemetry: search around .* prior position.*; none: search the whole map",
    "--prior-std-m": "standard deviation of the prior position, per axis",
    "--rate-hz": "views per second taken from a recording",
    "--replace": "(rebuild|replace) sheets that",
    "--seed": "seed of",
    "--speed-mps": "ground speed",
    "--tile-px": "width of a tile",
    "--tilt-std-deg": "standard deviation of the error of the reported pitch and roll",
    "--truth": "true positions",
    "--workers": "number of parallel workers",
    "--yaw-std-deg": "standard deviation of the reported heading",
}
"""What the help of an option says in every command, where its help is not the same in all."""
SHARED = [option for option, uses in sorted(OPTIONS.items()) if len(uses) > 1]


def test_an_option_takes_the_same_value_in_all_commands():
    for option in SHARED:
        values = {}
        for command, action in OPTIONS[option]:
            values.setdefault(value_of(option, action), []).append(command)
        assert len(values) == 1, (option, values)


def test_an_option_means_the_same_in_all_commands():
    for option in set(SHARED) - DIFFERENT_METAVARS:
        helps = {" ".join(action.help.split()) for _, action in OPTIONS[option]}
        helps.discard(argparse.SUPPRESS)
        if len(helps) > 1:
            assert option in MEANING, (option, helps)
            meaning = MEANING[option]
            if not re.search(r"\.\*|\|", meaning):
                meaning = re.escape(meaning)
            assert all(re.search(meaning, text) for text in helps), (option, helps)


def test_a_unit_in_the_name_is_the_metavar():
    for option, uses in OPTIONS.items():
        unit = option.rpartition("-")[2]
        for command, action in uses:
            if unit in UNITS and action.nargs is None and action.type in (int, float):
                assert action.metavar == unit.upper(), (option, command)


def test_an_option_has_help_and_a_number_says_of_what():
    for option, uses in OPTIONS.items():
        for command, action in uses:
            assert action.type is not float or action.metavar, (option, command)
            assert action.help, (option, command)


@pytest.mark.parametrize("command, parser", ALL, ids=[name for name, _ in ALL])
def test_commands_with_many_options_show_the_everyday_ones_first(command, parser):
    own = [action for action in parser._actions if action.option_strings]
    help_all = next(action for action in own if "--help-all" in action.option_strings)
    assert len(own) <= 16 or help_all.help != argparse.SUPPRESS


@pytest.mark.parametrize("command", ["build", "check", "fetch", "fly", "localize"])
def test_the_everyday_options_stand_in_groups(command):
    actions = _parser([command])._actions
    parsers = next(a for a in actions if isinstance(a, argparse._SubParsersAction)).choices
    shown = [
        group.title
        for group in parsers[command]._action_groups
        if any(action.help != argparse.SUPPRESS for action in group._group_actions)
    ]
    assert len(shown) >= 5, shown


@pytest.mark.parametrize("line", ["info", "demo", "atlas", "atlas info", "sign", "fly"])
def test_every_command_has_help_all(line, capsys):
    with pytest.raises(SystemExit) as ended:
        main([*line.split(), "--help-all"])
    assert ended.value.code == 0 and f"usage: orthonav {line}" in capsys.readouterr().out
