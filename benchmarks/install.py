"""`python -m benchmarks.install`: what flies, installed afresh; can a small board have it?

Installs `orthonav[autopilot]` from this checkout into an environment of its own, which is removed
afterwards, lists what each package takes on disk and to download, and proves that nothing heavy
came along. Then asks the package index for wheels of the same versions for 64-bit ARM: nothing
would have to be compiled there. Needs the index, so no test runs it.
"""

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

import orthonav
from benchmarks.record import Section, Table, number, provenance, save

ROOT = Path(__file__).resolve().parents[1]
EXTRA = "autopilot"
PYTHONS = ("3.11", "3.12", "3.13")
GLIBC_MINORS = range(17, 29)
"""Up to 2.28, which Debian 10, Ubuntu 20.04 and what came after them have."""
ABSENT = ("torch", "rasterio", "pyproj", "shapely", "matplotlib", "transformers", "onnxruntime")
LOADED = ("orthonav.cli.flying", "orthonav.onboard.fly", "orthonav.onboard.log")
REPORT_SCRIPT = """
import importlib, importlib.util, json, sys
from importlib import metadata
def size(d, end=""):
    files = [f.locate() for f in d.files or () if str(f).endswith(end)]
    return sum(p.stat().st_size for p in files if p.is_file())
found = [
    {"name": d.metadata["Name"], "version": d.version, "bytes": size(d), "pyc": size(d, ".pyc")}
    for d in metadata.distributions()
]
for name in sys.argv[1].split(","):
    importlib.import_module(name)
absent = {name: importlib.util.find_spec(name) is None for name in sys.argv[2].split(",")}
print(json.dumps({"found": found, "absent": absent}))
"""


@dataclass(frozen=True)
class Package:
    """An installed package: `bytes` on disk, `pyc` of them compiled bytecode, `wheel` to download.

    `pyc` is not installed by `pip install --no-compile`.
    """

    name: str
    version: str
    bytes: int
    pyc: int
    wheel: int


def main(arguments: Sequence[str] | None = None) -> int:
    """Install, look, ask, print and write; returns the exit code: 1 where something is amiss."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.install", description=str(__doc__).splitlines()[0]
    )
    parser.add_argument("--python", nargs="+", default=PYTHONS, help="versions to ask wheels for")
    parser.add_argument("--out", type=Path, default=Path("bench_results"))
    options = parser.parse_args(arguments)
    start, started = time.perf_counter(), provenance("install")
    section = Section("Installing what flies")
    with tempfile.TemporaryDirectory(prefix="orthonav-install-") as folder:
        result = _installed(Path(folder))
    packages = sorted((Package(**found) for found in result["found"]), key=lambda one: -one.bytes)
    wheels = {
        (package.name, python): _wheel(package.name, package.version, python)
        for package in packages
        for python in options.python
        if _plain(package.name) != "orthonav"
    }
    present = [name for name, absent in result["absent"].items() if not absent]
    section.tables = [_table(section, packages, wheels, options.python, present)]
    print(section.markdown())
    wall_s = time.perf_counter() - start
    for path in save(options.out, [section], started, wall_s=wall_s, latest=False):
        print(path, file=sys.stderr)
    return int(bool(present) or None in wheels.values())


def _installed(folder: Path) -> dict[str, Any]:
    """Fields of `Package`, and the absent modules, of a fresh environment."""
    source, environment = folder / "source", folder / "environment"
    source.mkdir()
    for name in ("pyproject.toml", "PYPI.md", "LICENSE"):
        shutil.copyfile(ROOT / name, source / name)
    shutil.copytree(ROOT / "src" / "orthonav", source / "src" / "orthonav")  # nothing is built here
    _run(sys.executable, "-m", "venv", "--without-pip", str(environment))
    python = environment / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "--disable-pip-version-check"]
    wheels = ["--find-links", str(folder / "wheels")]
    constraints = ["-c", str(ROOT / "constraints.txt")]
    _run(*pip, "wheel", "--quiet", *constraints, "-w", wheels[1], f"{source}[{EXTRA}]")
    _run(*pip, "install", "--quiet", "--no-index", *wheels, f"orthonav[{EXTRA}]")
    _run(str(environment / "bin" / "orthonav"), "fly", "--help")
    result: dict[str, Any] = json.loads(
        _run(str(python), "-c", REPORT_SCRIPT, ",".join(LOADED), ",".join(ABSENT))
    )
    downloads = {
        _plain(path.name.split("-")[0]): path.stat().st_size
        for path in (folder / "wheels").iterdir()
    }
    for found in result["found"]:
        found["wheel"] = downloads[_plain(found["name"])]
    return result


def _wheel(name: str, version: str, python: str) -> str | None:
    """Name of the wheel that pip takes on 64-bit ARM, None where there is none."""
    platforms = [f"manylinux_2_{minor}_aarch64" for minor in GLIBC_MINORS]
    tag = "cp" + python.replace(".", "")
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    command += ["--dry-run", "--ignore-installed", "--no-deps", "--only-binary=:all:"]
    command += ["--target", "nowhere", "--report", "-", "--implementation", "cp"]
    command += ["--python-version", python]
    for platform in ("manylinux2014_aarch64", *platforms):
        command += ["--platform", platform]
    for abi in (tag, "abi3", "none"):
        command += ["--abi", abi]
    done = subprocess.run(
        [*command, f"{name}=={version}"], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        if "No matching distribution" not in done.stderr:
            raise RuntimeError(f"{name}: {done.stderr[-1000:]}")
        return None
    url = str(json.loads(done.stdout)["install"][0]["download_info"]["url"])
    return url.rpartition("/")[2].partition("#")[0]


def _table(
    section: Section,
    packages: Sequence[Package],
    wheels: dict[tuple[str, str], str | None],
    pythons: Sequence[str],
    present: Sequence[str],
) -> Table:
    core = {_plain(name) for name in closure(["orthonav"])}
    rows = []
    for package in packages:
        section.add(
            f"{package.name} {package.version}", "MB", [package.bytes / 1e6], data="site-packages"
        )
        found = [wheels.get((package.name, python), "this checkout") for python in pythons]
        of = "core" if _plain(package.name) in core else EXTRA
        kinds = (_kind(wheel) for wheel in found)
        rows.append([package.name, package.version, of, *_sizes([package]), *kinds])
    own = [package for package in packages if _plain(package.name) in core]
    for name, some in (("core", own), ("all", list(packages))):
        section.add(name, "MB", [sum(each.bytes for each in some) / 1e6], data="site-packages")
        rows.append([f"**{name}**", str(len(some)), "", *_sizes(some), *("" for _ in pythons)])
    section.facts = {
        "install_mb": sum(each.bytes for each in packages) / 1e6,
        "core_mb": sum(each.bytes for each in own) / 1e6,
        "bytecode_mb": sum(each.pyc for each in packages) / 1e6,
    }
    arm = (f"ARM, Python {python}" for python in pythons)
    header = ("package", "version", "part", "MB", "bytecode, MB", "wheel, MB", *arm)
    return Table("Installing what flies", header, rows, _notes(wheels, present))


def _sizes(packages: Sequence[Package]) -> list[str]:
    """On disk, of that bytecode, and to download, in MB."""
    totals = (
        sum(each.bytes for each in packages),
        sum(each.pyc for each in packages),
        sum(each.wheel for each in packages),
    )
    return [number(total / 1e6) for total in totals]


def _notes(
    wheels: dict[tuple[str, str], str | None], present: Sequence[str]
) -> tuple[str, str, str]:
    missing = sorted({name for (name, _), wheel in wheels.items() if wheel is None})
    heavy = f"PRESENT: {', '.join(present)}" if present else f"absent: {', '.join(ABSENT)}"
    return (
        f"`pip install orthonav[{EXTRA}]` from this checkout into an empty environment, versions "
        "of constraints.txt; bytecode is compiled by pip, not with `--no-compile`; no pip",
        f"{heavy}; {', '.join(LOADED)} load without them",
        "ARM: the wheel of the same version that pip takes on aarch64 Linux with glibc 2.28; "
        + (f"NONE for {', '.join(missing)}" if missing else "every package has one"),
    )


def _kind(wheel: str | None) -> str:
    """Python and platform tag of a wheel, in short."""
    if wheel is None:
        return "NONE"
    if not wheel.endswith(".whl"):
        return wheel
    abi, platform = wheel.removesuffix(".whl").split("-")[-2:]
    return "pure" if platform == "any" else f"{abi}, {platform.split('.')[-1].split('_aarch')[0]}"


def installed_mb(requirements: Sequence[str]) -> float:
    """What these take in this environment with all that they need, in MB."""
    return sum(_size(name) for name in closure(requirements)) / 1e6


def closure(requirements: Sequence[str]) -> set[str]:
    """Names of the packages that these need here, themselves included."""
    seen: set[tuple[str, str]] = set()
    waiting = [Requirement(text) for text in requirements]
    while waiting:
        one = waiting.pop()
        for extra in ("", *one.extras):
            key = _plain(one.name), extra
            if key in seen:
                continue
            seen.add(key)
            for needed in map(Requirement, _required(one.name, extra)):
                if needed.marker is None or needed.marker.evaluate({"extra": extra}):
                    waiting.append(needed)
    return {name for name, _ in seen}


def _required(name: str, extra: str) -> Sequence[str]:
    """Requirements of a package; those of orthonav come from pyproject.toml."""
    if _plain(name) != "orthonav":
        return metadata.requires(name) or ()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    asked = project["optional-dependencies"][extra] if extra else project["dependencies"]
    return [str(text) for text in asked]


def _size(name: str) -> int:
    """Bytes of an installed package; of this one those of its sources, as it may be a link."""
    if name == "orthonav":
        paths = list(Path(orthonav.__file__).parent.rglob("*"))
    else:
        paths = [Path(str(each.locate())) for each in metadata.files(name) or ()]
    return sum(path.stat().st_size for path in paths if path.is_file())


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _run(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
