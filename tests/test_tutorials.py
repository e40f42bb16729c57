"""Tutorials do not rot: their commands are understood, what they print is what they show."""

import importlib
import re
import shlex
import sys
from itertools import takewhile
from pathlib import Path

import numpy as np
import pytest
from console import check_page, read_steps

from helpers import textured
from orthonav.cli import _parser
from orthonav.core.tiles import represent
from orthonav.core.variants import make_variant

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
EXAMPLES = ROOT / "examples"


def words_of(line):
    """The words of the first simple command of a line of shell."""
    line = re.sub(r"\d>&\d", "", line)
    lexer = shlex.shlex(line, posix=True, punctuation_chars="|;&<>")
    lexer.whitespace_split = True
    return list(takewhile(lambda word: not set(word) <= set("|;&<>"), lexer))


def shown_commands(page):
    """Calls of orthonav, and of the experiments, in the blocks of a page."""
    text = re.sub(r"\\\n\s*", " ", page.read_text("utf-8"))
    blocks = re.findall(r"^```.*?^```|(?<=\n\n)(?:    [^\n]*\n)+", text, re.MULTILINE | re.DOTALL)
    commands = "\n".join(block for block in blocks if not block.startswith("```text"))
    for line in commands.splitlines():
        if re.match(r" *(orthonav [a-z]|python -m experiments.paper( |$))", line):
            yield words_of(line)


def test_every_command_of_every_page_is_understood_as_it_stands():
    """What follows a command is a comment of the shell, so that a line can be copied."""
    from experiments.paper.__main__ import _parser as experiments_parser

    pages = [ROOT / "README.md", ROOT / "PYPI.md", *sorted((ROOT / "docs").rglob("*.md"))]
    count = 0
    for page in pages:
        for program, *words in shown_commands(page):
            if program == "orthonav":
                assert _parser(words).parse_args(words).command == words[0], f"{page}: {words}"
            else:
                assert experiments_parser().parse_args(words[2:]), f"{page}: {words}"
            count += 1
    assert count > 50


def test_the_example_that_is_shown_is_the_example():
    """The code of the researcher's tutorial stands in the example, word for word."""
    text = (ROOT / "docs" / "tutorials" / "researcher.md").read_text("utf-8")
    shown = text.split("```python\n")[1].split("```")[0]
    assert shown.strip() in (EXAMPLES / "own_representation.py").read_text("utf-8")


def test_the_example_adds_a_representation():
    textured_grey = textured()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(represent, "TABLE", dict(represent.TABLE))
        patch.delitem(sys.modules, "own_representation", raising=False)
        importlib.import_module("own_representation")
        variant = make_variant(represent.TABLE, "laplace:sigma_px=1.5")
    valid = np.ones(textured_grey.shape, bool)
    valid[:, :20] = False
    out = variant(textured_grey, valid)
    assert out.shape == (1, *textured_grey.shape) and out.dtype == np.float32
    assert not out[:, :, :20].any() and out[:, :, 60:].any()


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_tutorial_runs_and_prints_what_it_shows(page, tmp_path):
    steps = [step for step in read_steps(page.read_text("utf-8")) if step.is_run]
    assert check_page(page, tmp_path / "tutorial", steps) == []
