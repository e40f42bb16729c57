"""`python -m benchmarks.install`: what flies, installed afresh; can a small board have it?

Installs `orthonav[autopilot]` from this checkout into an environment of its own, which is removed
afterwards, says what that takes and proves that nothing heavy came along. Then asks the package
index for wheels of the same versions for 64-bit ARM: nothing would have to be compiled there. Needs
the index, so no test runs it.
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
TOLD = """
import importlib, importlib.util, json, sys
from importlib import metadata
size = lambda d: sum(p.stat().st_size for f in d.files or () if (p := f.locate()).is_file())
found = [[d.metadata["Name"], d.version, size(d)] for d in metadata.distributions()]
for name in sys.argv[1].split(","):
    importlib.import_module(name)
absent = {name: importlib.util.find_spec(name) is None for name in sys.argv[2].split(",")}
print(json.dumps({"found": found, "absent": absent}))
"""


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
        told = _installed(Path(folder))
    packages = sorted(
        ((name, version, size / 1e6) for name, version, size in told["found"]),
        key=lambda package: -package[2],
    )
    wheels = {
        (name, python): _wheel(name, version, python)
        for name, version, _ in packages
        for python in options.python
        if _plain(name) != "orthonav"
    }
    present = [name for name, absent in told["absent"].items() if not absent]
    section.tables = [_table(section, packages, wheels, options.python, present)]
    print(section.markdown())
    wall_s = time.perf_counter() - start
    for path in save(options.out, [section], started, wall_s=wall_s, latest=False):
        print(path, file=sys.stderr)
    return int(bool(present) or None in wheels.values())


def _installed(folder: Path) -> dict[str, Any]:
    """Packages with their sizes and what is absent, of a fresh environment."""
    source, environment = folder / "source", folder / "environment"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copyfile(ROOT / name, source / name)
    shutil.copytree(ROOT / "src" / "orthonav", source / "src" / "orthonav")  # nothing is built here
    _run(sys.executable, "-m", "venv", "--without-pip", str(environment))
    python = environment / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "--disable-pip-version-check"]
    constraints = ["-c", str(ROOT / "constraints.txt")]
    _run(*pip, "install", "--quiet", *constraints, f"{source}[{EXTRA}]")
    _run(str(environment / "bin" / "orthonav"), "fly", "--help")
    told: dict[str, Any] = json.loads(
        _run(str(python), "-c", TOLD, ",".join(LOADED), ",".join(ABSENT))
    )
    return told


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
    packages: Sequence[tuple[str, str, float]],
    wheels: dict[tuple[str, str], str | None],
    pythons: Sequence[str],
    present: Sequence[str],
) -> Table:
    rows = []
    for name, version, size_mb in packages:
        section.add(f"{name} {version}", "MB", [size_mb], data="site-packages")
        found = [wheels.get((name, python), "this checkout") for python in pythons]
        rows.append([name, version, number(size_mb), *(_kind(wheel) for wheel in found)])
    total_mb = sum(size_mb for *_, size_mb in packages)
    section.add("all", "MB", [total_mb], data="site-packages")
    section.facts = {"install_mb": total_mb}
    rows.append(["**all**", str(len(packages)), number(total_mb), *("" for _ in pythons)])
    header = ("package", "version", "MB", *(f"ARM, Python {python}" for python in pythons))
    missing = sorted({name for (name, _), wheel in wheels.items() if wheel is None})
    heavy = f"PRESENT: {', '.join(present)}" if present else f"absent: {', '.join(ABSENT)}"
    notes = (
        f"`pip install orthonav[{EXTRA}]` from this checkout into an empty environment, versions "
        "of constraints.txt, compiled .pyc included; no pip, no setuptools",
        f"{heavy}; {', '.join(LOADED)} load without them",
        "ARM: the wheel of the same version that pip takes on aarch64 Linux with glibc 2.28; "
        + (f"NONE for {', '.join(missing)}" if missing else "every package has one"),
    )
    return Table("Installing what flies", header, rows, notes)


def _kind(wheel: str | None) -> str:
    """In a word, what a wheel is for."""
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
    """What a package asks for; this one by its project file, for what is installed may be old."""
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
