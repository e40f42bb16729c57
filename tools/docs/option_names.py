"""The names of all arguments below each command in docs/reference/commands.md, for readers of the
repository: the site shows the help of each instead.

    python tools/docs/option_names.py    write them into the page
"""

import argparse
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

from orthonav.cli import _parser

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "commands.md"
EVERYWHERE = ("--help", "--help-all", "--verbose", "--quiet")
"""Options of every command: described once, at the top of the page."""
_BELOW = re.compile(r"(?<=^### orthonav )(\w[\w-]*)\n\n(?:(?:`.*\n)+\n)*", re.MULTILINE)


def command_parser(name: str) -> argparse.ArgumentParser:
    """The parser of one command, with all its arguments."""
    for action in _parser([name, "--help-all"])._actions:
        if isinstance(action, argparse._SubParsersAction):
            parser: argparse.ArgumentParser = action.choices[name]
            return parser
    raise LookupError(name)


def shown_actions(actions: list[argparse.Action]) -> list[argparse.Action]:
    """Arguments that are described with their command."""
    shown = [each for each in actions if each.help != argparse.SUPPRESS]
    return [each for each in shown if not set(each.option_strings) & set(EVERYWHERE)]


def with_options(page: str) -> str:
    """The page with the present names."""
    return _BELOW.sub(lambda found: f"{found[1]}\n\n{''.join(_names(found[1]))}", page)


def _names(name: str) -> Iterator[str]:
    actions = shown_actions(command_parser(name)._actions)
    own = [each for each in actions if not isinstance(each, argparse._SubParsersAction)]
    if own:
        yield _line(own)
    for action in actions:
        if isinstance(action, argparse._SubParsersAction):
            for key, parser in action.choices.items():
                yield _line(shown_actions(parser._actions), f"`{name} {key}`: ")


def _line(actions: list[argparse.Action], start: str = "") -> str:
    text = start + ", ".join(f"`{_name_of(each)}`" for each in actions)
    return textwrap.fill(text, 118, break_on_hyphens=False) + "\n\n"


def _name_of(action: argparse.Action) -> str:
    metavar = action.metavar if isinstance(action.metavar, str) else action.dest
    return action.option_strings[-1] if action.option_strings else metavar.upper()


if __name__ == "__main__":
    PAGE.write_text(with_options(PAGE.read_text("utf-8")), "utf-8")
