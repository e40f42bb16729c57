"""Optional dependencies, by the extras in the metadata of the installed orthonav."""

import importlib
import platform
import re
from dataclasses import dataclass
from functools import lru_cache
from importlib import util
from typing import Any

from orthonav.core.errors import MissingExtraError

NAME = "orthonav"
_REQUIREMENT = re.compile(r"\s*([\w.-]+)\s*(?:\[([^\]]*)\])?[^;]*(?:;(.*))?")
_OF_EXTRA = re.compile(r"""extra\s*==\s*["']([^"']+)["']""")
_CONDITION = re.compile(r"""(python_version|platform_machine)\s*(==|<)\s*["']([^"']+)["']""")
"""What pyproject.toml uses of environment markers, joined by `and`."""
_MODULES = {
    "faiss-cpu": "faiss",
    "opencv-python-headless": "cv2",
    "pillow": "PIL",
    "pyyaml": "yaml",
    "scikit-image": "skimage",
    "xstatic-leaflet": "xstatic.pkg.leaflet",
}


@dataclass(frozen=True)
class RequiredPackage:
    """`version`: "" where its module is not found. `available`: its marker allows this machine."""

    name: str
    version: str
    available: bool


@lru_cache(maxsize=1)
def _requirements() -> tuple[str, ...]:
    """Requirements of the installed orthonav; none where it is run from its sources."""
    from importlib import metadata  # takes as long as the rest of the command line to import

    try:
        return tuple(metadata.requires(NAME) or ())
    except metadata.PackageNotFoundError:
        return ()


def _holds(marker: str) -> bool:
    here = {"python_version": platform.python_version(), "platform_machine": platform.machine()}
    for name, comparison, value in _CONDITION.findall(marker):
        if comparison == "==" and here[name] != value:
            return False
        if comparison == "<" and _numbers(here[name]) >= _numbers(value):
            return False
    return True


def _numbers(version: str) -> list[int]:
    return [int(part) for part in version.split(".")[:2]]


def packages(extra: str = "") -> tuple[RequiredPackage, ...]:
    """Packages of an extra, those of the extras that it includes too, each once; "" is the core."""
    found: dict[str, RequiredPackage] = {}
    for line in _requirements():
        match = _REQUIREMENT.match(line)
        assert match is not None, line
        name, included, marker = (part or "" for part in match.groups())
        of = _OF_EXTRA.search(marker)
        if (of[1] if of else "") != extra:
            continue
        if name == NAME:
            for each in included.split(","):
                found.update({package.name: package for package in packages(each.strip())})
        else:
            found[name] = RequiredPackage(name, _version(name), _holds(marker))
    return tuple(found.values())


def missing(extra: str) -> tuple[str, ...]:
    return tuple(package.name for package in packages(extra) if not package.version)


def pip_line(*names: str) -> str:
    return f"pip install '{NAME}[{','.join(names)}]'"


def require(what: str, *names: str) -> None:
    """Raise `MissingExtraError` that names all missing packages and one line to install them."""
    absent = {name: missing(name) for name in names}
    wanted = [name for name, gone in absent.items() if gone]
    if wanted:
        gone = ", ".join(dict.fromkeys(sum(absent.values(), ())))
        raise MissingExtraError(f"{what} needs {gone}: {pip_line(*wanted)}")


def needed(module: str, extra: str, what: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise missing_extra(what, extra, module, error) from error


def missing_extra(what: str, extra: str, module: str, error: Exception) -> MissingExtraError:
    top = module.partition(".")[0]
    names = (package.name for package in packages(extra))
    package = next((name for name in names if module_of(name).partition(".")[0] == top), top)
    return MissingExtraError(f"{what} needs {package}: {pip_line(extra)} ({error})")


def module_of(package: str) -> str:
    plain = re.sub(r"[-_.]+", "-", package).lower().removeprefix("ros-jazzy-")
    return _MODULES.get(plain, plain.replace("-", "_"))


def _version(package: str) -> str:
    from importlib import metadata

    try:
        if util.find_spec(module_of(package)) is None:
            return ""
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"  # there, but not installed by pip
    except (ImportError, ValueError):
        return ""
