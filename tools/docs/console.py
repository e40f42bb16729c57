"""The console blocks of a tutorial: reading them, running them, writing what they print.

    python tools/docs/console.py docs/tutorials/operator.md            run it in an empty folder
    python tools/docs/console.py --update docs/tutorials/operator.md   and write what was printed

A block is a fence of the language `console`: a command after `$ `, on further lines while they end
with a backslash, and below it what it prints. A line of `...` stands for any lines left out, ` ...`
at the end of one for the rest of it. Blocks after `<!-- not run -->` are for the reader alone: they
wait for a person, a network or hours.
"""

import argparse
import contextlib
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
NOT_RUN = "<!-- not run -->"
ELIDED = "..."
MARK = "@@ step"
VERDICTS = (0, 3, 4)
"""What `orthonav check` ends with, beside errors: go, marginal, no-go."""
LIMIT_S = 1800


@dataclass(frozen=True)
class Step:
    """One command of a tutorial, what is shown below it, and where it stands (lines from 0)."""

    command: str
    shown: tuple[str, ...]
    first: int
    end: int
    is_run: bool


@dataclass(frozen=True)
class Printed:
    """What a step printed, stdout and stderr together, and the code it ended with."""

    lines: tuple[str, ...]
    code: int


def read_steps(text: str) -> list[Step]:
    """All steps of a page, in order."""
    lines = text.splitlines()
    steps: list[Step] = []
    for begin, end in _blocks(lines):
        is_run = NOT_RUN not in [line for line in lines[max(0, begin - 3) : begin - 1] if line]
        row = begin
        while row < end:
            if not lines[row].startswith("$ "):
                raise ValueError(f"line {row + 1}: expected a command after '$ '")
            last = row
            while lines[last].endswith("\\"):
                last += 1
            after = last + 1
            while after < end and not lines[after].startswith("$ "):
                after += 1
            command = "\n".join([lines[row][2:], *lines[row + 1 : last + 1]])
            steps.append(Step(command, tuple(lines[last + 1 : after]), last + 1, after, is_run))
            row = after
    return steps


def _blocks(lines: list[str]) -> Iterator[tuple[int, int]]:
    """First line after the opening fence, and the closing fence, of each console block."""
    begin = None
    for row, line in enumerate(lines):
        if line == "```console":
            begin = row + 1
        elif line.startswith("```") and begin is not None:
            yield begin, row
            begin = None


def calls(command: str) -> Iterator[list[str]]:
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


def run_steps(steps: list[Step], folder: Path) -> list[Printed]:
    """Run steps in a folder as one shell session; raises `RuntimeError` where one fails."""
    script = "\n".join(f"{step.command}\nprintf '\\n{MARK} %d\\n' $?" for step in steps) + "\n"
    told = subprocess.run(
        ["bash", "-c", script],
        cwd=folder,
        env=_environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        timeout=LIMIT_S,
        check=False,
    )
    pieces = re.split(rf"\n{MARK} (\d+)\n", "\n" + told.stdout)
    printed = []
    for step, text, code in zip(steps, pieces[0::2], pieces[1::2], strict=False):
        printed.append(Printed(tuple(text.strip("\n").splitlines()), int(code)))
        allowed = VERDICTS if step.command.startswith("orthonav check") else (0,)
        if int(code) not in allowed:
            raise RuntimeError(f"'{step.command}' ended with {code}:\n{text.strip()}")
    if len(printed) < len(steps):
        raise RuntimeError(f"'{steps[len(printed)].command}' ended the shell")
    return printed


def _environment() -> dict[str, str]:
    """The environment of a reader who activated this interpreter's environment."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    return {**os.environ, "PATH": path, "COLUMNS": "100", "checkout": str(ROOT)}


def is_as_shown(shown: tuple[str, ...], lines: tuple[str, ...]) -> bool:
    """Whether lines were printed as shown: numbers may differ, `...` stands for any lines."""
    pattern = "".join(map(_pattern, shown))
    return re.fullmatch(pattern, "".join(masked(line) + "\n" for line in lines)) is not None


def _pattern(line: str) -> str:
    if line.strip() == ELIDED:
        return r"(?:.*\n)*?"
    start = line.removesuffix(f" {ELIDED}")
    return re.escape(masked(start)) + (r".*\n" if start != line else r"\n")


def masked(line: str) -> str:
    """A line without its numbers and the width of its gaps."""
    return re.sub(r"\s+", " ", re.sub(r"[-+]?\d[\d.,]*\d|[-+]?\d", "#", line)).strip()


def check_page(page: Path, folder: Path, steps: list[Step] | None = None) -> list[str]:
    """Run a tutorial in a folder; what was printed otherwise than shown, a line for each step."""
    wanted = [step for step in steps or read_steps(page.read_text("utf-8")) if step.is_run]
    return [
        f"{page.name}:{step.first + 1}: '{step.command}' printed\n" + "\n".join(told.lines)
        for step, told in zip(wanted, run_steps(wanted, folder), strict=True)
        if not is_as_shown(step.shown, told.lines)
    ]


def update_page(page: Path, folder: Path) -> None:
    """Run a tutorial and write what it printed; what is shown in part stays as it is."""
    lines = page.read_text("utf-8").splitlines()
    wanted = [step for step in read_steps(page.read_text("utf-8")) if step.is_run]
    for step, told in reversed(list(zip(wanted, run_steps(wanted, folder), strict=True))):
        if not any(line.endswith(ELIDED) for line in step.shown):
            lines[step.first : step.end] = told.lines
    page.write_text("\n".join(lines) + "\n", "utf-8")


def main() -> int:
    """Run or update pages; 1 where something is printed otherwise than shown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("page", type=Path)
    parser.add_argument("--update", action="store_true", help="write what is printed into the page")
    parser.add_argument("--folder", type=Path, help="default: a temporary one")
    options = parser.parse_args()
    with contextlib.ExitStack() as stack:
        folder = options.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        if options.update:
            update_page(options.page, folder)
            return 0
        differences = check_page(options.page, folder)
    print("\n".join(differences) or f"{options.page}: as shown")
    return 1 if differences else 0


if __name__ == "__main__":
    sys.exit(main())
