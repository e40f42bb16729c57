"""`python -m benchmarks [--quick] [--only NAME ..]`: the suite, each question with its defaults.

Each question is a module, `python -m benchmarks.NAME --help`.
"""

import argparse
import importlib
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.record import options_of, provenance, save, say

SUITE = ("build", "comparison", "growth", "onboard")


def main(arguments: Sequence[str]) -> int:
    """Run the chosen questions, print their tables, write them; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description=str(__doc__).splitlines()[0]
    )
    parser.add_argument("--quick", action="store_true", help="smaller areas, fewer views")
    parser.add_argument("--only", nargs="+", choices=SUITE, help="only these questions")
    parser.add_argument("--out", type=Path, default=Path("bench_results"), metavar="DIR")
    options = parser.parse_args(arguments)
    start, started = time.perf_counter(), provenance("suite-quick" if options.quick else "suite")
    done = []
    for name in options.only or SUITE:
        say(f"{time.perf_counter() - start:5.0f} s  {name} ..")
        module = importlib.import_module(f"benchmarks.{name}")
        chosen = ["--out", str(options.out), *(["--quick"] if options.quick else [])]
        done.append(
            module.measure(
                options_of(module.NAME, module.__doc__, getattr(module, "add", None), chosen)
            )
        )
        print(done[-1].markdown(), flush=True)
    save(options.out, done, started, time.perf_counter() - start)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
