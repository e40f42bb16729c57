"""The command line. Each command is one module with `add` (its arguments) and `run`.

A module with many options names the everyday ones in `EVERYDAY`, by action where the command has
actions; `--help` shows those, and `--help-all` shows every option of any command.
"""

import argparse
import importlib
import io
import logging
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from itertools import chain
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any, NoReturn

from orthonav.cli.version import require_extras, show_version
from orthonav.core.errors import OrthonavError, OutputError, UsageError
from orthonav.core.files import is_stdout, require_writable

GROUPS = {
    "prepare a map": {
        "plan": "recommend a map for a route, a camera and a height",
        "fetch": "download orthophotos of an area from open services",
        "build": "build a map from orthophotos",
        "check": "predict before the flight where views will be localized",
        "info": "print the contents of a map",
        "sign": "sign a map, or create a signing key",
        "verify": "check the signature and the contents of a map",
        "atlas": "build, inspect, check and cut an atlas of many sheets",
    },
    "fly": {
        "fly": "send position fixes from a live camera to an autopilot",
    },
    "analyse a recorded flight": {
        "run": "localize a recording on an orthophoto and show the result: all in one",
        "import": "convert photographs, a video or a ROS recording to a flight folder",
        "localize": "find the positions of the views of a flight",
        "evaluate": "compare fixes with the ground truth",
        "view": "show a run in the browser: track, views beside the map, health",
        "locate-pixel": "find the coordinates of a pixel of a localized view",
        "calibrate": "estimate constant errors of mount, compass and height from a flight",
    },
    "try it without data": {
        "demo": "build a map, simulate a flight over other imagery, localize it and report",
        "simulate": "simulate a flight over an orthophoto of another year",
    },
}
"""What the commands do, by group."""
COMMANDS = {name: text for group in GROUPS.values() for name, text in group.items()}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0 done, 1 a known error, 2 wrong usage, 130 and
    143 ended by Ctrl-C and SIGTERM.

    Commands that judge return others, see their help.
    """
    # Matrices here are small: more BLAS threads only wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")  # this program reports errors, once
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    # Read once, when OpenCV is loaded: a few bytes must not become a picture of gigabytes.
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**28))
    arguments = list(sys.argv[1:] if argv is None else argv)
    verbose, options, started_s = False, argparse.Namespace(), time.time()
    try:
        if "--version" in arguments and COMMANDS.keys().isdisjoint(arguments):
            return show_version(arguments)
        options = parse(arguments)
        verbose = options.verbose
        level = logging.DEBUG if verbose else logging.ERROR if options.quiet else logging.WARNING
        logging.basicConfig(level=level, format="%(levelname)s: %(message)s", stream=sys.stderr)
        logging.getLogger("rasterio").setLevel(logging.CRITICAL)
        logging.getLogger("PIL").setLevel(logging.WARNING)  # else every tag of every photograph
        # Where the home cannot be written it keeps its fonts elsewhere: nothing to be done.
        logging.getLogger("matplotlib").setLevel(logging.ERROR)
        _print_any_letter()
        with _terminable():
            require_extras(options.command)
            _require_outputs(options)
            status: int | None = module_of(options.command).run(options)
            sys.stdout.flush()
    except OrthonavError as error:
        code = 2 if isinstance(error, UsageError) else 1
        return _failed(_with_options(_one_line(error), options), verbose, code)
    except KeyboardInterrupt as error:
        said = f"interrupted; {str(error) or _written(options, started_s)}"
        return _failed(said, False, code=143 if isinstance(error, _Terminated) else 130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except UnicodeEncodeError as error:
        letters = f"{error.object[error.start : error.end]!a:.40}"
        said = f"a name has letters ({letters}) that the locale cannot express: set PYTHONUTF8=1"
        return _failed(said, verbose)
    except OSError as error:  # a disk or a device that fails where nobody expected it
        return _failed(_one_line(error), verbose)
    except MemoryError:
        return _failed("out of memory", verbose)
    return status or 0


def _require_outputs(options: argparse.Namespace) -> None:
    """Raise `OutputError` where a result could not be written, or would replace an input or another
    result, before the work for it."""
    out_is_folder = options.command in ("check", "demo", "import", "run", "simulate")
    folders = {"out": out_is_folder, "report": True, "work": True}
    named = {name: getattr(options, name, None) for name in folders}
    outputs = [(path, folders[name]) for name, path in named.items() if isinstance(path, Path)]
    outputs += [(path, False) for path in _exported(options) if path.name]
    taken = _inputs(options, folders.keys())
    for path, is_folder in outputs:
        if is_stdout(path):
            continue
        require_writable(path, folder=is_folder)
        real = os.path.realpath(path)
        if not is_folder and real in taken:
            raise OutputError(f"would replace an input or another output; name another: {path}")
        taken.add(real)


def _inputs(options: argparse.Namespace, outputs: Collection[str]) -> set[str]:
    """Real paths among the options, other than `outputs`; a map may be text, as it may be a URL."""
    named = {**vars(options), "map": Path(getattr(options, "map", None) or "-")}
    values = [value for name, value in named.items() if name not in outputs]
    several = chain(*(value if isinstance(value, list) else [value] for value in values))
    return {os.path.realpath(path) for path in several if isinstance(path, Path)}


def _exported(options: argparse.Namespace) -> list[Path]:
    return [Path(each.partition("=")[2]) for each in getattr(options, "export", ())]


def _written(options: argparse.Namespace, since_s: float) -> str:
    """Which of the paths among the options were written since a time; outputs appear when whole."""
    paths = [value for value in vars(options).values() if isinstance(value, Path)]
    paths += [Path(f"{path}.tiles") for path in paths]
    paths += _exported(options)
    since_s -= 0.01  # times of files lag behind the clock
    new = [path for path in paths if path.exists() and path.stat().st_mtime > since_s]
    return f"written: {', '.join(map(str, new))}" if new else "nothing was written"


def _print_any_letter() -> None:
    """Names with letters that the locale lacks are printed escaped, as on stderr."""
    out = sys.stdout
    if isinstance(out, io.TextIOWrapper) and out.encoding.lower() not in ("utf-8", "utf8"):
        out.reconfigure(errors="backslashreplace")


class _Terminated(KeyboardInterrupt):
    """The interrupt by SIGTERM."""


def _terminate(number: int, frame: FrameType | None) -> None:
    raise _Terminated


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM ends like Ctrl-C meanwhile, so that it leaves no temporary files either."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may change signals
        return
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def parse(arguments: list[str]) -> argparse.Namespace:
    """The options; without a command it prints the help, and wrong ones end with exit code 2."""
    if "_ARGCOMPLETE" in os.environ:  # a shell asks how the line may go on
        with suppress(ImportError):
            words = [*os.environ["COMP_LINE"].split(), "--help-all"]
            importlib.import_module("argcomplete").autocomplete(_parser(words))
    parser = _parser(arguments)
    options, unknown = parser.parse_known_args(arguments or ["--help"])
    if unknown:  # with the usage of the command, not of the whole program
        options.command_error(f"unrecognized arguments: {' '.join(unknown)}")
    return options


class Parser(argparse.ArgumentParser):
    """Says in one line of usage what a command needs, and how a word was probably meant."""

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named | {"allow_abbrev": False})
        # Values such as -33.9,18.4,50 are no options either, as in Python 3.14.
        self._negative_number_matcher = re.compile(r"-\.?\d")
        self._given: Sequence[str] = ()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        self._given = tuple(args or ())
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        needed = [each for each in self._actions if each.required or not each.option_strings]
        usage = argparse.HelpFormatter(self.prog, width=1000)
        usage.add_usage(None, needed, [])
        line = f"{usage.format_help().strip()} [options]  (see {self.prog} --help)"
        self.exit(2, f"{line}\n{self.prog}: error: {self._corrected(message)}\n")

    def _corrected(self, message: str) -> str:
        from difflib import get_close_matches

        choice = re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)", message)
        asked = [(choice[1], re.findall(r"[\w-]+", choice[2]))] if choice else []
        given = (word.partition("=")[0] for word in self._given)
        known = list(self._option_string_actions)
        asked += [(word, known) for word in given if word.startswith("--") and word not in known]
        for word, names in asked:
            bare = word.strip("-")
            plain = {name.strip("-"): name for name in names}
            alike = [x for x in plain if x[:1] == bare[:1] or sorted(x) == sorted(bare)]
            if close := get_close_matches(bare, alike, 1):
                meant = plain[close[0]]
                return f"{message.partition(' (choose')[0]}; did you mean {meant}, not {word}?"
        return message


def _overview() -> str:
    lines = []
    for group, commands in GROUPS.items():
        lines += [f"{group}:", *(f"  {name:<13} {text}" for name, text in commands.items()), ""]
    return "\n".join([*lines, "options and an example of a command: orthonav COMMAND --help"])


def _parser(arguments: list[str]) -> argparse.ArgumentParser:
    """The parser; only the command asked for loads its own arguments."""
    parser = Parser(
        prog="orthonav",
        description="Position fixes for aircraft without GNSS, from a downward camera and an "
        "orthophoto of another year.",
        epilog=_overview(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--version",
        action="store_true",
        help="print the version; with --verbose (or --json) also the installed packages, the "
        "extras that commands lack, and the abilities of the processor",
    )
    common = verbosity(default=False)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, text in COMMANDS.items():
        command = commands.add_parser(name, description=text, parents=[common])
        command.set_defaults(command_error=command.error)
        if name in arguments:
            module = module_of(name)
            module.add(command)
            notes = (command.epilog, f"example: orthonav {name} {module.EXAMPLE}".rstrip())
            command.epilog = "; ".join(filter(None, notes))
            everyday = getattr(module, "EVERYDAY", ())
            by_action = everyday if isinstance(everyday, dict) else {"": everyday}
            for action, part in {"": command, **_actions(command)}.items():
                _name_units(part)
                options = by_action.get(action, ())
                _add_help_all(part, options, show_all="--help-all" in arguments)
    return parser


def verbosity(default: bool | str) -> Parser:
    """Parent parser of commands and of their actions."""
    parser = Parser(add_help=False)
    add = partial(parser.add_argument, action="store_true", default=default)
    add("-v", "--verbose", help="say more, on stderr")
    add("-q", "--quiet", help="errors only, no progress")
    return parser


def _actions(command: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The parsers of the actions of a command, such as those of `atlas`, by name."""
    parts = (each for each in command._actions if isinstance(each, argparse._SubParsersAction))
    return {name: part for action in parts for name, part in action.choices.items()}


def _name_units(command: argparse.ArgumentParser) -> None:
    """Name numbers in the help by the unit that ends their option: `--agl-m M`; integers N."""
    units = ("m", "mps", "px", "deg", "s", "ms", "mb", "km", "hz")
    for action in command._actions:
        if action.type in (int, float) and action.metavar is None:
            unit = action.option_strings[0].rpartition("-")[2] if action.option_strings else ""
            if unit in units:
                action.metavar = unit.upper()
            elif action.type is int:
                action.metavar = "N"


def _add_help_all(
    command: argparse.ArgumentParser, everyday: Sequence[str], *, show_all: bool
) -> None:
    """Add `--help-all`; without it, hide the options that are neither required nor everyday.

    A command without everyday options shows all of them with `--help` too.
    """
    help_all = "show all options and exit" if everyday else argparse.SUPPRESS
    command.add_argument("--help-all", action="help", help=help_all)
    if not everyday or show_all:
        return
    shown = {*everyday, "--help", "--help-all", "--verbose", "--quiet"}
    optional = [each for each in command._actions if each.option_strings and not each.required]
    hidden = [each for each in optional if shown.isdisjoint(each.option_strings)]
    for each in hidden:
        each.help = argparse.SUPPRESS
    more = f"{len(hidden)} more options: {command.prog} --help-all"
    command.epilog = "; ".join(filter(None, (command.epilog, more)))


def module_of(command: str) -> ModuleType:
    # "import" is a word of Python's own.
    name = "import_" if command == "import" else command.replace("-", "_")
    return importlib.import_module(f"orthonav.cli.{name}")


def _with_options(message: str, options: argparse.Namespace) -> str:
    """The message with the option that a value came from, where it begins with a field's name."""
    name, must, rest = message.partition(" must be ")
    if not (must and name in vars(options)):
        return message
    return f"--{name.replace('_', '-')}{must}{rest}"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _failed(message: str, verbose: bool, code: int = 1) -> int:
    if verbose:
        logging.getLogger(__name__).debug("", exc_info=True)
    print(f"orthonav: error: {message}", file=sys.stderr)
    return code
