"""Files about the project agree with each other."""

import re
import shlex
import tomllib
from pathlib import Path

import try_wheel
import yaml

from orthonav import __version__
from orthonav.cli import _parser

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))


def test_the_version_is_one():
    assert PROJECT["version"] == CITATION["version"] == __version__


def test_the_page_of_the_package_index_has_no_relative_link():
    text = (ROOT / PROJECT["readme"]).read_text("utf-8")
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert links and all(link.startswith("https://") for link in links)


def test_commands_of_the_wheel_script_are_understood():
    lines = [line for lines in try_wheel.COMMANDS.values() for line in lines]
    assert len(lines) > 10
    extras = set(PROJECT["optional-dependencies"]) - {"dev", "docs", "matchers", "test"}
    assert extras <= set(try_wheel.COMMANDS | try_wheel.SCRIPTS)
    for words in map(shlex.split, lines):
        assert _parser(words).parse_args(words).command == words[0]
