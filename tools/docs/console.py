"""The commands of a tutorial: reading them, running them, writing what they print.

    python tools/docs/console.py docs/tutorials/operator.md            run it in an empty folder
    python tools/docs/console.py --update docs/tutorials/operator.md   and write what was printed

A fence of the language `bash` holds commands, each on one line or on several that end with a
backslash, so that a reader can copy it. A fence of the language `text` right below holds what they
print. A line of `...` there stands for any lines left out, ` ...` at the end of one for the rest of
it. Blocks after `<!-- not run -->` are for the reader alone: they wait for a person, a network or
hours.
"""

import argparse
import contextlib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
STEP = re.compile(
    r"(?P<skip>^<!-- not run -->\n+)?^```bash\n(?P<run>.*?)^```$"
    r"(?:\n+^```text\n(?P<shown>.*?)^```$)?",
    re.MULTILINE | re.DOTALL,
)
COMMAND = re.compile(r"(?:.*\\\n)*.+")
ELIDED = "..."
MARK = "@@ step"
VERDICTS = (0, 3, 4)
"""Exit codes of `orthonav check` other than errors: go, marginal, no-go."""
LIMIT_S = 1800


@dataclass(frozen=True)
class Step:
    """A block of commands and the output shown below it, `at` these characters of the page."""

    commands: tuple[str, ...]
    shown: tuple[str, ...]
    at: slice
    line: int
    is_run: bool


def read_steps(text: str) -> list[Step]:
    """All steps of a page, in order."""
    steps = []
    for found in STEP.finditer(text):
        line = text.count("\n", 0, found.start("shown" if found["shown"] else "run"))
        commands = tuple(COMMAND.findall(found["run"]))
        if not commands:
            raise ValueError(f"line {line}: a block without a command")
        shown = tuple((found["shown"] or "").splitlines())
        steps.append(Step(commands, shown, slice(*found.span("shown")), line, not found["skip"]))
    return steps


def run_steps(steps: list[Step], folder: Path) -> list[tuple[str, ...]]:
    """Lines printed by each step, run in a folder as one shell session; raises `RuntimeError` where
    a command fails."""
    commands = [command for step in steps for command in step.commands]
    script = "\n".join(f"{command}\nprintf '\\n{MARK} %d\\n' $?" for command in commands) + "\n"
    done = subprocess.run(
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
    pieces = re.split(rf"\n{MARK} (\d+)\n", "\n" + done.stdout)
    outputs = []
    for command, text, code in zip(commands, pieces[0::2], pieces[1::2], strict=False):
        outputs.append(text.strip("\n").splitlines())
        allowed = VERDICTS if command.startswith("orthonav check") else (0,)
        if int(code) not in allowed:
            raise RuntimeError(f"'{command}' ended with {code}:\n{text.strip()}")
    if len(outputs) < len(commands):
        raise RuntimeError(f"'{commands[len(outputs)]}' ended the shell")
    ordered = iter(outputs)
    return [tuple(line for _ in step.commands for line in next(ordered)) for step in steps]


def _environment() -> dict[str, str]:
    """The environment of a reader who activated this interpreter's environment."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    return {**os.environ, "PATH": path, "COLUMNS": "100"}


def _link_checkout(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    parts = {name: ROOT / name for name in ("benchmarks", "examples", "experiments", "lab")}
    for name, target in {".venv": Path(sys.prefix), **parts}.items():
        link = folder.parent / name
        if not link.exists():
            link.symlink_to(target)


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
    """Run a tutorial in a folder; one message for each step whose output differs from the page.

    The folder stands for one inside the checkout: links to what a tutorial uses of the checkout
    are made beside it.
    """
    _link_checkout(folder)
    wanted = [step for step in steps or read_steps(page.read_text("utf-8")) if step.is_run]
    return [
        "\n".join((f"{page.name}:{step.line}: '{step.commands[-1]}' printed", *printed))
        for step, printed in zip(wanted, run_steps(wanted, folder), strict=True)
        if not is_as_shown(step.shown, printed)
    ]


def update_page(page: Path, folder: Path) -> None:
    """Run a tutorial and write what it printed; what is left out stays left out."""
    _link_checkout(folder)
    text = page.read_text("utf-8")
    wanted = [step for step in read_steps(text) if step.is_run]
    for step, printed in reversed(list(zip(wanted, run_steps(wanted, folder), strict=True))):
        if step.shown:
            in_part = any(line.endswith(ELIDED) for line in step.shown)
            lines = _renewed(step.shown, printed) if in_part else printed
            shown = "".join(f"{line}\n" for line in lines)
            text = text[: step.at.start] + shown + text[step.at.stop :]
    page.write_text(text, "utf-8")


def _renewed(shown: tuple[str, ...], lines: tuple[str, ...]) -> Iterator[str]:
    """Lines shown in part, with what was printed now; one that is not found stays as it is."""
    for line in shown:
        found = [each for each in lines if re.fullmatch(_pattern(line), masked(each) + "\n")]
        found.sort(key=lambda each: sum(map(str.__eq__, each.split(), line.split())))
        if line.strip() == ELIDED or not found:
            yield line
        elif line.endswith(f" {ELIDED}"):
            start = masked(line.removesuffix(f" {ELIDED}"))
            ends = [end for end in range(len(found[-1]) + 1) if masked(found[-1][:end]) == start]
            yield f"{found[-1][: ends[-1]].rstrip()} {ELIDED}"
        else:
            yield found[-1]


def main() -> int:
    """Run or update pages; 1 if the output differs from the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("page", type=Path)
    parser.add_argument("--update", action="store_true", help="write the output into the page")
    parser.add_argument("--folder", type=Path, help="default: a temporary one")
    options = parser.parse_args()
    with contextlib.ExitStack() as stack:
        folder = options.folder
        if folder is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "tutorial"
        if options.update:
            update_page(options.page, folder)
            return 0
        differences = check_page(options.page, folder)
    print("\n".join(differences) or f"{options.page}: as shown")
    return 1 if differences else 0


if __name__ == "__main__":
    sys.exit(main())
