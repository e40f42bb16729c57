"""`orthonav --version`: the version and, with `--verbose`, what is installed on which machine."""

import argparse
import contextlib
import json
import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from orthonav import __version__
from orthonav.cli.needs import NEEDS
from orthonav.core.cores import usable_cores
from orthonav.core.extras import missing, packages, pip_line

_CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


def show_version(arguments: Sequence[str]) -> int:
    """Print what `--version`, with `--verbose` or `--json` beside it, asks for."""
    parser = argparse.ArgumentParser(prog="orthonav", add_help=False)
    parser.add_argument("--version", action="store_true")
    parser.add_argument("-v", "--verbose", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    if options.json:
        print(json.dumps(about(), indent=1))
    elif options.verbose:
        print(_text(about()))
    else:
        print(f"orthonav {__version__}")
    return 0


def about() -> dict[str, Any]:
    """Plain values: versions, extras with what they lack, commands that lack one, the machine."""
    names = sorted({extra for needed in NEEDS.values() for extra in needed})
    return {
        "orthonav": __version__,
        "python": f"{platform.python_version()} ({platform.python_implementation()})",
        "platform": platform.platform(),
        "processor": _processor(),
        "core": {package.name: package.version or None for package in packages()},
        "extras": {
            name: {package.name: package.version or None for package in packages(name)}
            for name in names
        },
        "unavailable": _unavailable(names),
        "missing": {
            command: _answer(lacking)
            for command, needed in NEEDS.items()
            if (lacking := [name for name in needed if missing(name)])
        },
    }


def _unavailable(extras: Sequence[str]) -> list[str]:
    """Packages of extras that are not installed and not made for this machine and Python."""
    of_all = (package for name in extras for package in packages(name))
    return sorted({each.name for each in of_all if not (each.available or each.version)})


def _answer(extras: Sequence[str]) -> str:
    """What to type for these extras, or which of their packages this machine cannot install."""
    if never := _unavailable(extras):
        return f"{', '.join(never)}: no wheel for this machine and Python; build it from source"
    return pip_line(*extras)


def _processor() -> dict[str, Any]:
    """Architecture, cores that may be used, memory, what OpenCV uses of the instruction set, and
    whether the kernel of registration was compiled."""
    return {
        "machine": platform.machine(),
        "cores": usable_cores(),
        "memory_mb": _memory_mb(),
        "features": _features(),
        "kernel": _has_kernel(),
    }


def _has_kernel() -> bool:
    """Whether registration uses its compiled kernel; false without NumPy or OpenCV."""
    try:
        from orthonav.core.register.kernel import KERNEL
    except ImportError:
        return False
    return KERNEL is not None


def _features() -> list[str] | None:
    """Instruction sets that OpenCV was built for and the processor has; None without OpenCV."""
    try:
        import cv2
    except ImportError:
        return None
    line = cv2.getCPUFeaturesLine().split()
    # OpenCV marks with * what is chosen at run time, with ? what this processor lacks.
    return [name.lstrip("*") for name in line if not name.endswith("?")]


def _memory_mb() -> int | None:
    """Memory of the machine, or of the container where that is less; None where not known."""
    try:
        whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return None
    with contextlib.suppress(OSError, ValueError):  # no container, or one without a limit ("max")
        whole = min(whole, int(_CGROUP_LIMIT.read_text()))
    return whole // 10**6


def _text(plain: dict[str, Any]) -> str:
    processor = plain["processor"]
    features = ", ".join(processor["features"] or ["OpenCV cannot be loaded"])
    lines = [
        f"orthonav    {plain['orthonav']}",
        f"Python      {plain['python']}",
        f"platform    {plain['platform']}",
        f"processor   {processor['machine']}, {processor['cores']} cores, "
        f"{processor['memory_mb'] or '?'} MB of memory; {features}",
        f"kernel      {'compiled' if processor['kernel'] else 'absent: registration is slower'}",
        "",
        f"{'core':<12}{_versions(plain['core'], [])}",
        *(
            f"{name:<12}{_versions(found, plain['unavailable'])}"
            for name, found in plain["extras"].items()
        ),
    ]
    if plain["missing"]:
        width = max(map(len, plain["missing"]))
        rows = (f"  {command:<{width}}  {line}" for command, line in plain["missing"].items())
        lines += ["", "cannot run, and what to type for it:", *rows]
    return "\n".join(lines)


def _versions(found: dict[str, str | None], unavailable: Sequence[str]) -> str:
    return ", ".join(
        f"{name} {version or ('not made for this machine' if name in unavailable else 'MISSING')}"
        for name, version in found.items()
    )
