"""The directive `{command} NAME`: the output of `orthonav NAME --help` as a part of a page.

Written from the argparse parsers themselves, so that it cannot differ from the program. A command
that no page describes is a warning.
"""

import argparse
from collections.abc import Iterator
from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

from orthonav.cli import COMMANDS, _parser

log = logging.getLogger(__name__)
USAGE_COLUMNS = 84
EVERYWHERE = ("--help", "--help-all", "--verbose", "--quiet")
"""Options of every command: described once, at the top of the page."""


def setup(app: Any) -> dict[str, bool]:
    """Register the directive with Sphinx."""
    app.add_directive("command", Command)
    app.connect("env-check-consistency", _all_described)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


class Command(SphinxDirective):
    """Usage, arguments and options of one command."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The nodes of the command's description."""
        name = self.arguments[0]
        if name not in COMMANDS:
            raise self.error(f"there is no command '{name}'")
        if not hasattr(self.env, "orthonav_commands"):
            self.env.orthonav_commands = set()
        self.env.orthonav_commands.add(name)
        return self.parse("\n".join(_markdown(name, command_parser(name))))

    def parse(self, text: str) -> list[nodes.Node]:
        """Nodes of Markdown."""
        holder = nodes.container()
        where = f"orthonav {self.arguments[0]}"
        self.state.nested_parse(StringList(text.splitlines(), source=where), 0, holder)
        return holder.children


def _markdown(name: str, parser: argparse.ArgumentParser) -> Iterator[str]:
    yield from ("```text", _usage(parser), "```", "")
    yield from (f":::{{program}} orthonav {name}", ":::", "")
    for group in parser._action_groups:
        actions = shown_actions(group._group_actions)
        if not actions:
            continue
        usual = group.title in ("options", "positional arguments")
        if not usual:
            yield from (f"**{(group.title or '').capitalize()}**", "")
        for action in actions:
            if isinstance(action, argparse._SubParsersAction):
                yield from _actions_of(name, action)
            else:
                yield from _option(parser, action)


def _actions_of(name: str, action: argparse._SubParsersAction) -> Iterator[str]:
    """The commands of a command, each as a command."""
    for choice in action._choices_actions:
        full = f"{name} {choice.dest}"
        yield from (f"**orthonav {full}**", "")
        text = choice.help or ""
        yield from (f"{text[0].upper()}{text[1:]}.", "")
        yield from _markdown(full, action.choices[choice.dest])


def _option(parser: argparse.ArgumentParser, action: argparse.Action) -> Iterator[str]:
    """One argument with its help."""
    formatter = parser._get_formatter()
    words = formatter._format_action_invocation(action)
    text = formatter._expand_help(action) if action.help else ""
    yield f"::::{{option}} {words}"
    yield ""
    yield _escaped(text)
    if action.choices is not None and action.metavar is None and action.option_strings:
        yield f" One of {', '.join(f'`{each}`' for each in action.choices)}."
    yield from ("::::", "")


def _usage(parser: argparse.ArgumentParser) -> str:
    formatter = argparse.HelpFormatter(parser.prog, width=USAGE_COLUMNS)
    formatter.add_usage(parser.usage, parser._actions, parser._mutually_exclusive_groups, "")
    return formatter.format_help().strip()


def _escaped(text: str) -> str:
    """A line of help as Markdown: only backticks mean anything in it."""
    pieces = text.split("`")
    for index in range(0, len(pieces), 2):
        for sign in "\\*_[]<>#|$":
            pieces[index] = pieces[index].replace(sign, "\\" + sign)
    return "`".join(pieces)


def _all_described(_app: Any, env: Any) -> None:
    missing = sorted(set(COMMANDS) - getattr(env, "orthonav_commands", set()))
    if missing:
        log.warning("commands that no page describes: %s", ", ".join(missing))


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
