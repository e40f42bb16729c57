"""An option has one meaning and one unit in all commands: one kind of value, one metavar."""

import argparse

import pytest

from orthonav.cli import COMMANDS, _parser, main

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


@pytest.mark.parametrize("command", ["build", "fetch"])
def test_bands_are_numbers(command, capsys):
    with pytest.raises(SystemExit) as ended:
        main([command, "--bands", "r,g"])
    assert ended.value.code == 2 and "expected numbers from 1" in capsys.readouterr().err
