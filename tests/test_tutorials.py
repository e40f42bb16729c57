"""Tutorials do not rot: their commands are understood, what they print is what they show."""

import importlib
import re
import shlex
import sys
from pathlib import Path

import pytest
from console import check_page, read_steps, update_page

from orthonav.cli import _parser

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
EXAMPLES = ROOT / "examples"


def calls(command):
    """The simple commands of a line of shell, as words: split at pipes, `;`, `&&` and `&`."""
    line = re.sub(r"\d>&\d", "", command.replace("\\\n", " "))
    lexer = shlex.shlex(line, posix=True, punctuation_chars="|;&<>")
    lexer.whitespace_split = True
    words: list[str] = []
    skipped = False
    for word in lexer:
        if word and set(word) <= set("|;&"):
            if words:
                yield words
            words = []
        elif word and set(word) <= set("<>&"):
            skipped = True  # the name of a file comes next
        elif skipped:
            skipped = False
        else:
            words.append(word)
    if words:
        yield words


def called(page):
    return [
        (step, words)
        for step in read_steps(page.read_text("utf-8"))
        for command in step.commands
        for words in calls(command)
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_is_understood(page, monkeypatch):
    count = 0
    for _, words in called(page):
        if words[0] == "orthonav":
            arguments = words[1:]
        elif words[1:2] == ["../examples/own_representation.py"]:
            arguments = words[2:]
        else:
            continue
        count += 1
        assert _parser(arguments).parse_args(arguments).command == arguments[0]
    assert count > 5


def shown_commands(page):
    """Calls of orthonav in the blocks of a page."""
    text = re.sub(r"\\\n\s*", " ", page.read_text("utf-8"))
    blocks = re.findall(r"^```.*?^```|(?<=\n\n)(?:    [^\n]*\n)+", text, re.MULTILINE | re.DOTALL)
    commands = "\n".join(block for block in blocks if not block.startswith("```text"))
    for line in commands.splitlines():
        if re.match(r" *orthonav [a-z]", line):
            yield from (words[1:] for words in calls(line) if words[0] == "orthonav")


def test_every_command_of_every_page_is_understood_as_it_stands():
    """What follows a command is a comment of the shell, so that a line can be copied."""
    pages = [ROOT / "README.md", ROOT / "PYPI.md", *sorted((ROOT / "docs").rglob("*.md"))]
    count = 0
    for page in pages:
        for words in shown_commands(page):
            assert _parser(words).parse_args(words).command == words[0], f"{page}: {words}"
            count += 1
    assert count > 60


def test_commands_of_experiments_are_understood():
    from experiments.paper.__main__ import _parser as experiments_parser

    found = [
        words[words.index("experiments.paper") + 1 :]
        for page in PAGES
        for _, words in called(page)
        if "experiments.paper" in words
    ]
    assert len(found) == 2
    for arguments in found:
        assert experiments_parser().parse_args(arguments).out == Path("paper")


def test_numbers_of_output_that_is_shown_in_part_are_renewed_too(tmp_path):
    """Otherwise two outputs of one run do not fit together."""
    page = tmp_path / "page.md"
    command = "printf 'head\\n40 found, 3 not\\nmean 1.5 m; of all\\nend\\n'"
    shown = f"```bash\n{command}\n```\n\n```text\n{{}}\n```\n"
    page.write_text(shown.format("...\n39 found, 4 not\nmean 22 m ...\n..."))
    update_page(page, tmp_path / "run")
    assert page.read_text() == shown.format("...\n40 found, 3 not\nmean 1.5 m ...\n...")


def test_one_run_gives_the_same_counts_wherever_the_operator_sees_it():
    text = (ROOT / "docs" / "tutorials" / "operator.md").read_text("utf-8")
    localized = re.search(r"views: (\d+) confident .* (\d+) of low confidence", text)
    evaluated = re.search(r"^fixes +\d+ +(\d+) +\d+ +(\d+)", text, re.MULTILINE)
    assert localized and evaluated and localized.groups() == evaluated.groups()
    assert f"none of {localized[1]} " in text and f"No error in {localized[1]} fixes" in text


def test_the_example_that_is_shown_is_the_example():
    """The code of the researcher's tutorial stands in the example, word for word."""
    text = (ROOT / "docs" / "tutorials" / "researcher.md").read_text("utf-8")
    shown = text.split("```python\n")[1].split("```")[0]
    assert shown.strip() in (EXAMPLES / "own_representation.py").read_text("utf-8")


def test_the_example_adds_a_representation(textured_grey):
    import numpy as np

    from orthonav.core.tiles import represent
    from orthonav.core.variants import make_variant

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


@pytest.fixture
def textured_grey():
    from helpers import textured

    return textured()


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_tutorial_runs_and_prints_what_it_shows(page, tmp_path):
    steps = [step for step in read_steps(page.read_text("utf-8")) if step.is_run]
    assert check_page(page, tmp_path / "tutorial", steps) == []
