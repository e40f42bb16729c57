"""Feeds damaged files to every reader, in a process with limits of memory and time.

    python -m tools.fuzz --minutes 40 [--only NAME ..] [--out FOLDER]

A reader gives a result or an `OrthonavError` of one line, and leaves no file. Anything else is a
fault, whose input and traceback are written to FOLDER. Prints a line of counts per reader.
"""

import argparse
import faulthandler
import json
import os
import random
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

from tools.fuzz_readers import READERS

from orthonav.core.errors import OrthonavError

HANG_S, MEMORY_BYTES = 20, 2**30
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?")
VALUES = [*b"nan inf -1 0 1e308 -1e-320 1e5 -400 18446744073709551616 null [] {} true".split(), b""]
VALUES += [b"9" * 400, b"[" * 3000, b"\xff\xfe", b"\x00", b"\n", b'"', b"<", b",", b";"]
EXTREMES = [b"\xff", b"\x00", b"\x7f", b"\x80", b"\xff\x7f", b"\0\0\xc0\x7f", b"\0\0\x80\xff"]


def mutated(data: bytes, rng: random.Random) -> bytes:
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        at = rng.randrange(len(data) + 1)
        end = min(len(data), at + rng.choice((1, 2, 4, 8, 16, 100, len(data) // 4)))
        how = rng.randrange(7)
        numbers = list(NUMBER.finditer(data[:200_000])) if how < 2 else []
        if numbers:
            found = rng.choice(numbers)
            data = data[: found.start()] + rng.choice(VALUES) + data[found.end() :]
        elif how == 2:
            data = data[:at] + (b"" if rng.random() < 0.3 else data[end:])
        elif how == 3:
            data = data[:at] + data[at:end] * rng.choice((2, 2, 3, 50)) + data[end:]
        elif how == 4:
            data = data[:at] + (rng.choice(VALUES) or rng.randbytes(8)) + data[at:]
        elif how == 5:
            value = rng.choice(EXTREMES) * rng.choice((1, 2, 4, 8))
            data = data[:at] + value + data[at + len(value) :]
        elif data:
            data = data[: at - 1] + bytes([data[at - 1] ^ 1 << rng.randrange(8)]) + data[at:]
    return data


def below(folder: Path) -> set[Path]:
    return {each for each in folder.rglob("*") if each.is_file()}


def peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def fault_of(path: Path, name: str, counts: Counter[str]) -> str:
    """What is wrong with how a reader takes a file; "" where nothing is."""
    before = peak_bytes()
    faulthandler.dump_traceback_later(HANG_S, exit=True)
    try:
        READERS[name][1](path)
        counts["results"] += 1
    except OrthonavError as error:
        counts["errors"] += 1
        if "\n" in str(error):
            return f"error of several lines: {error!r}"
    except (Exception, SystemExit):
        return traceback.format_exc()
    finally:
        faulthandler.cancel_dump_traceback_later()
    more = peak_bytes() - before
    return f"memory: {more} bytes more" if more > MEMORY_BYTES else ""


def work(name: str, out: Path, seed: int, seconds: float) -> None:
    """Trials of one reader in the working folder."""
    warnings.simplefilter("ignore")
    root, rng, counts = Path.cwd(), random.Random(seed), Counter[str]()
    until = time.monotonic() + seconds
    files = READERS[name][0](root)
    for path in files:
        READERS[name][1](path)  # the whole one is read
    whole = below(root)
    resource.setrlimit(resource.RLIMIT_AS, (8 * MEMORY_BYTES,) * 2)
    while time.monotonic() < until:
        path = rng.choice(files)
        data = path.read_bytes()
        path.write_bytes(mutated(data, rng))
        fault = fault_of(path, name, counts)
        left = below(root) - whole
        if fault := fault or (f"left behind: {left}" if left else ""):
            places = re.findall(r'src/(orthonav\S+)", line (\d+)', fault)
            key = "-".join(places[-1]).replace("/", ".") if places else fault.partition(":")[0]
            shutil.copy(path, out / f"{name}-{key}{path.suffix}")
            (out / f"{name}-{key}.why").write_text(fault)
        counts.update(tried=1, faults=bool(fault))
        for each in left:
            each.unlink()
        path.write_bytes(data)
        (out / f"{name}.counts").write_text(json.dumps(counts))


def run(name: str, out: Path, seed: int, seconds: float) -> Counter[str]:
    """Counts of a process; one that died is a fault, and its folder is copied to `out`."""
    found = out / f"{name}.counts"
    found.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory() as folder, (out / f"{name}.err").open("w") as errors:
        called = f"work({name!r}, Path({str(out)!r}), {seed}, {seconds})"
        done = subprocess.run(
            [sys.executable, "-c", f"from tools.fuzz import Path, work; {called}"],
            cwd=folder,
            env={**os.environ, "TMPDIR": folder, "PYTHONPATH": os.pathsep.join(sys.path)},
            stdout=errors,
            stderr=errors,
        )
        counts = Counter[str](json.loads(found.read_text()) if found.exists() else {})
        if done.returncode:
            counts["faults"] += 1
            shutil.copytree(folder, out / f"{name}-died-{seed}", dirs_exist_ok=True)
            shutil.copy(errors.name, out / f"{name}-died-{seed}.why")
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--only", nargs="+", default=list(READERS), choices=READERS)
    parser.add_argument("--out", type=Path, default=Path("fuzz_results"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        until, counts = time.monotonic() + 60 * options.minutes / len(options.only), Counter[str]()
        while (left_s := until - time.monotonic()) > 0 and counts["faults"] < 20:
            counts += run(name, options.out.resolve(), time.time_ns(), left_s)
        print(name, *(f"{key} {counts[key]}" for key in ("tried", "errors", "results", "faults")))


if __name__ == "__main__":
    main()
