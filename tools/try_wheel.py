"""Build sdist and wheel, check them, and try the wheel in empty environments, one per extra.

    python tools/try_wheel.py                      # the core and every extra of some 300 MB at most
    python tools/try_wheel.py --extras             # the core, and geo, which makes the map
    python tools/try_wheel.py --extras fetch web   # these too
    python tools/try_wheel.py --all                # PyTorch and Ray too: gigabytes
    python tools/try_wheel.py --dist DIR           # keep sdist and wheel there

The sdist is built from a copy of what git tracks, and the wheel from the sdist. The core runs in an
environment without any extra. Each extra is installed into an environment of its own and runs one
command. Versions are those of constraints.txt. Needs a package index and git.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import venv
import zipfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CONSTRAINTS = ROOT / "constraints.txt"
LARGE = ("train", "cluster")
"""Extras that bring gigabytes (PyTorch) or hundreds of MB (Ray): only with --all."""
KERNEL = "orthonav/core/register/_kernel.abi3.so"
"""Compiled from `_kernel.c` and the files beside it; needs a C compiler and Python's headers."""
MADE_BY_BUILD = ("PKG-INFO", "setup.cfg", "src/orthonav.egg-info/")

ORTHO, MAP, FLIGHT, FIXES = "land/2016-07.tif", "area.onav", "flight", "fixes.jsonl"
BUILD = f"build --ortho {ORTHO} --tile-px 128 --overlap 0.75"
ATLAS = f"--ortho {ORTHO} --tile-px 128 --coarse-gsd-m 1"
COMMANDS: dict[str, Sequence[str]] = {
    "geo": (
        f"{BUILD} --out {MAP}",
        "simulate --ortho land/2021-10.tif --random 5 --agl-m 150 --out flight",
    ),
    "": (
        f"info {MAP}",
        f"localize {MAP} {FLIGHT} --out {FIXES}",
        f"evaluate {FIXES} --truth {FLIGHT}/truth.csv --json",
    ),
    "report": (f"evaluate {FIXES} --truth {FLIGHT}/truth.csv --report report",),
    "autopilot": (f"fly {MAP} {FLIGHT} --recorded-telemetry --pace 100 --jsonl - --log run.mcap",),
    "flights": ("import run_0001.mcap --out imported",),
    "signing": (f"sign {MAP} --new-key keys", f"verify {MAP} --key keys/public.pem"),
    "fetch": ("fetch --list",),
    "segments": (f"{BUILD} --edges segments --out segments.onav",),
    "atlas": (f"atlas build atlas {ATLAS}", "atlas check atlas --deep"),
    "cluster": (f"atlas build cluster {ATLAS} --cluster local",),
    "train": (f"{BUILD} --method bovw --out words.onav",),
}
"""Commands tried with an extra, in this order; later ones use what earlier ones made."""
SCRIPTS = {
    "completion": "import argcomplete; assert argcomplete.autocomplete",
    "ros2": "import rclpy, rosbags.typesys; rclpy.init(); rclpy.create_node('a')",
    "web": "from orthonav.ground.view.server import load_assets; assert '/' in load_assets()",
    "neural": "import onnxruntime; assert onnxruntime.get_available_providers()",
}
"""Where a command would serve until it is stopped, or would need a map of gigabytes."""
BESIDE = {"segments": ("geo",), "train": ("geo",)}
"""Extras that the commands above need too."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Build, check, install and run; returns the exit code, 1 where something is amiss."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    tried = [extra for extra in COMMANDS | SCRIPTS if extra not in ("", "geo")]
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--extras",
        nargs="*",
        choices=tried,
        default=[extra for extra in tried if extra not in LARGE],
        help=f"beside geo, which makes the map (default: all but {' and '.join(LARGE)})",
    )
    which.add_argument("--all", dest="extras", action="store_const", const=tried, help="all extras")
    parser.add_argument("--dist", type=Path, help="folder for sdist and wheel, new or empty")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="orthonav-wheel-") as name:
        folder = Path(name)
        dist = (options.dist or folder / "dist").resolve()
        sdist, wheel = build(folder, dist)
        faults = [*faults_of_sdist(sdist), *faults_of_wheel(wheel)]
        for fault in faults:
            print(f"FAULT {fault}", file=sys.stderr)
        if faults:
            return 1
        work = folder / "work"
        work.mkdir()
        shutil.copytree(ROOT / "src" / "orthonav" / "ground" / "demo_data", work / "land")
        try_extra("geo", wheel, folder, work)
        try_core(wheel, folder, work)
        for extra in tried:  # in the order of the table
            if extra in options.extras:
                try_extra(extra, wheel, folder, work)
    return 0


def build(folder: Path, dist: Path) -> tuple[Path, Path]:
    """Sdist and the wheel built from it, both checked by twine."""
    if dist.is_dir() and any(dist.iterdir()):
        raise SystemExit(f"--dist must be new or empty: {dist}")
    python = environment(folder / "tools", "build", "twine")
    source = folder / "source"
    for name in tracked_files():  # nothing is written into the checkout
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, source / name)
    step("build", python, "-m", "build", "--outdir", dist, source, cwd=folder)
    made = sorted(dist.iterdir())
    step("twine check", python, "-m", "twine", "check", "--strict", *made, cwd=folder)
    (sdist,) = (path for path in made if path.name.endswith(".tar.gz"))
    (wheel,) = (path for path in made if path.suffix == ".whl")
    return sdist, wheel


def faults_of_sdist(sdist: Path) -> list[str]:
    """Files of the repository that the sdist lacks, and files that it has and should not."""
    with tarfile.open(sdist) as archive:
        found = {each.name.partition("/")[2] for each in archive.getmembers() if each.isfile()}
    tracked = set(tracked_files())
    extra = {name for name in found - tracked if not name.startswith(MADE_BY_BUILD)}
    return [
        *(f"sdist lacks {name}" for name in sorted(tracked - found)),
        *(f"sdist has {name}, which git does not track" for name in sorted(extra)),
    ]


def faults_of_wheel(wheel: Path) -> list[str]:
    """Files under src/orthonav that the wheel lacks, and files that it has and should not."""
    with zipfile.ZipFile(wheel) as archive:
        found = {name for name in archive.namelist() if ".dist-info/" not in name}
        if not any(name.endswith(".dist-info/licenses/LICENSE") for name in archive.namelist()):
            return ["wheel lacks the licence"]
    wanted = {
        name.removeprefix("src/") for name in tracked_files() if name.startswith("src/orthonav/")
    }
    wanted.add(KERNEL)
    return [
        *(f"wheel lacks {name}" for name in sorted(wanted - found)),
        *(f"wheel has {name}, which is not in src" for name in sorted(found - wanted)),
    ]


def tracked_files() -> list[str]:
    """Paths of the files that git tracks and that are there."""
    listed = subprocess.check_output(["git", "ls-files", "-z"], cwd=ROOT, text=True)
    return [name for name in listed.split("\0") if name and (ROOT / name).is_file()]


def try_core(wheel: Path, folder: Path, work: Path) -> None:
    """Without extras a flight is localized, and a command that lacks one answers in one line."""
    python = environment(folder / "core", str(wheel))
    about = report(python, work)
    if not about["missing"] or any(about["extras"]["geo"].values()):
        raise SystemExit(f"this environment is not of the core only: {about}")
    for command in COMMANDS[""]:
        orthonav(python, command, work)
    done = subprocess.run(
        [python, "-m", "orthonav", "demo", "--out", "demo"],
        cwd=work,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 1 or done.stderr.count("\n") != 1 or "pip install" not in done.stderr:
        raise SystemExit(f"demo without extras should end in one line, got:\n{done.stderr}")


def try_extra(extra: str, wheel: Path, folder: Path, work: Path) -> None:
    """The wheel with an extra, alone in an environment, has all that it asks for and runs."""
    names = ",".join((extra, *BESIDE.get(extra, ())))
    python = environment(folder / f"extra-{extra}", f"{wheel}[{names}]")
    lacking = [
        name for name, version in report(python, work)["extras"][extra].items() if not version
    ]
    if lacking:
        raise SystemExit(f"extra {extra} does not bring {lacking}")
    for command in COMMANDS.get(extra, ()):
        orthonav(python, command, work)
    if extra in SCRIPTS:
        step(f"{extra}: a script", python, "-c", SCRIPTS[extra], cwd=work)


def environment(path: Path, *requirements: str) -> Path:
    """Python of a new virtual environment with these installed and nothing else but pip."""
    venv.create(path, with_pip=True)
    python = path / "bin" / "python"
    pip = ("-m", "pip", "--quiet", "--disable-pip-version-check", "install", "-c", CONSTRAINTS)
    names = " ".join(each.rpartition("/")[2] for each in requirements)
    step(f"install {names}", python, *pip, *requirements, cwd=path)
    return python


def report(python: Path, work: Path) -> dict[str, dict[str, dict[str, str]]]:
    """What `orthonav --version --json` says."""
    command = [python, "-m", "orthonav", "--version", "--json"]
    found: dict[str, dict[str, dict[str, str]]] = json.loads(
        subprocess.check_output(command, cwd=work, text=True)
    )
    return found


def orthonav(python: Path, command: str, work: Path) -> None:
    """Run a command line of the program."""
    step(f"orthonav {command}", python, "-m", "orthonav", *command.split(), cwd=work)


def step(name: str, *command: object, cwd: Path) -> None:
    """Run a command and print how long it took; end with its output where it fails."""
    start = time.perf_counter()
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        check=False,
    )
    print(f"{time.perf_counter() - start:6.1f} s  {name}", flush=True)
    if done.returncode != 0:
        raise SystemExit(f"{name} ended with {done.returncode}:\n{done.stdout[-4000:]}")


if __name__ == "__main__":
    sys.exit(main())
