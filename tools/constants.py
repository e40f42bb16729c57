"""`python -m tools.constants core/localize`: which constants move a golden view.

Every number of a module (a constant, a field of a record of parameters) is changed by +30 and by
-30 %, one at a time, and the golden flights are located again, one after the other until a view
moves. A number that moves none is a candidate to be deleted or derived; the gate and the faults
have to agree. Rows are appended to the output as they come, and a run that is interrupted goes on
there.
"""

import argparse
import ast
import importlib.machinery
import importlib.util
import json
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import CodeType
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "src" / "orthonav"
GOLDEN = ROOT / "tests" / "golden"
FACTORS = (1.3, 0.7)
MAX_S = 900
"""A changed constant may make the search endless; such a run counts as moved."""


@dataclass(frozen=True)
class Number:
    """A number in a source file: module, dotted name, and lines and columns of its literals."""

    path: Path
    name: str
    spots: tuple[tuple[int, int], ...]

    @property
    def title(self) -> str:
        return f"{self.path.relative_to(SOURCES)}:{self.name}"


def numbers_of(path: Path) -> Iterator[Number]:
    """Constants at the top of a module and defaults of the fields of its classes."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for prefix, body in [("", tree.body)] + [
        (f"{node.name}.", node.body) for node in tree.body if isinstance(node, ast.ClassDef)
    ]:
        for node in body:
            if isinstance(node, ast.Assign):
                names = ", ".join(ast.unparse(target) for target in node.targets)
            elif isinstance(node, ast.AnnAssign) and node.value is not None:
                names = ast.unparse(node.target)
            else:
                continue
            spots = tuple((each.lineno, each.col_offset) for each in _literals(node.value))
            if spots:
                yield Number(path, prefix + names, spots)


def _literals(node: ast.AST | None) -> list[ast.Constant]:
    """Numbers below a node that a factor changes: of a product or a power only one, and no 0."""
    if isinstance(node, ast.Constant):
        return [node] if type(node.value) in (int, float) and node.value else []
    if node is None or isinstance(node, ast.JoinedStr | ast.Lambda):
        return []
    if isinstance(node, ast.BinOp) and not isinstance(node.op, ast.Add | ast.Sub):
        return _literals(node.left) or _literals(node.right)
    return [found for each in ast.iter_child_nodes(node) for found in _literals(each)]


class _Scaled(ast.NodeTransformer):
    """Multiplies the literals at some places; whole numbers change by one at least."""

    def __init__(self, spots: Sequence[tuple[int, int]], factor: float) -> None:
        self.spots, self.factor = set(spots), factor

    def visit_Constant(self, node: ast.Constant) -> ast.Constant:
        value = node.value
        if (node.lineno, node.col_offset) not in self.spots or not isinstance(value, int | float):
            return node
        changed = value * self.factor
        if isinstance(value, int):
            changed = round(changed)
            if changed == value:
                changed += 1 if self.factor > 1 else -1
        return ast.copy_location(ast.Constant(changed), node)


class _Loader(importlib.machinery.SourceFileLoader):
    """Loads one module with a changed number."""

    number: Number
    factor: float

    def get_code(self, fullname: str) -> CodeType:
        tree = ast.parse(self.number.path.read_text(encoding="utf-8"))
        changed = _Scaled(self.number.spots, self.factor).visit(tree)
        return compile(ast.fix_missing_locations(changed), str(self.number.path), "exec")


class _Finder:
    """Finds the module of a changed number before all other finders."""

    def __init__(self, number: Number, factor: float) -> None:
        parts = number.path.relative_to(SOURCES.parent).with_suffix("").parts
        self.package = parts[-1] == "__init__"
        self.module = ".".join(parts[:-1] if self.package else parts)
        self.number, self.factor = number, factor

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        if name != self.module:
            return None
        loader = _Loader(name, str(self.number.path))
        loader.number, loader.factor = self.number, self.factor
        return importlib.util.spec_from_file_location(
            name,
            self.number.path,
            loader=loader,
            submodule_search_locations=[str(self.number.path.parent)] if self.package else None,
        )


def _in_child(function: Callable[[], Any]) -> Any:
    """What a function returns in a process of its own, for this one must not import the package;
    an error or a late end as text."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read)
        signal.alarm(MAX_S)
        try:
            found = function()
        except Exception as error:
            found = f"{type(error).__name__}: {error}"
        with os.fdopen(write, "w", encoding="utf-8") as stream:
            json.dump(found, stream)
        os._exit(0)
    os.close(write)
    with os.fdopen(read, encoding="utf-8") as stream:
        text = stream.read()
    os.waitpid(child, 0)
    return json.loads(text) if text else "ended without a result"


def _located(number: Number | None, factor: float, flight: str, work: Path) -> Any:
    """Rows of a flight with a changed number."""
    if number is not None:
        sys.meta_path.insert(0, _Finder(number, factor))
    golden_views = importlib.import_module("golden_views")  # imports the changed module
    return golden_views.locate(flight, work)


def _prepared(flights: Sequence[str] | None, work: Path) -> list[str]:
    """Write maps and flights, all by default; their names."""
    golden_views = importlib.import_module("golden_views")
    names = list(flights or golden_views.FLIGHTS)
    for name in names:
        golden_views.prepare(name, work)
    return names


def moved(before: Any, after: Any) -> tuple[int, float]:
    """How many views differ at all, and the largest move, m; all of them where it fails."""
    if isinstance(after, str):
        return len(before), math.inf
    differ, farthest = 0, 0.0
    for was, now in zip(before, after, strict=True):
        differ += was != now
        if "east_m" in was and "east_m" in now:
            away = math.hypot(was["east_m"] - now["east_m"], was["north_m"] - now["north_m"])
            farthest = max(farthest, away)
    return differ, farthest


def main() -> None:
    """Change all numbers below the given folders and print what moves."""
    parser = argparse.ArgumentParser(prog="python -m tools.constants", description=__doc__)
    add = parser.add_argument
    add("folders", nargs="+", metavar="FOLDER", help="folders or modules below src/orthonav")
    add("--flights", nargs="+", help="golden flights that are located, all by default")
    add("--work", type=Path, default=Path("constants"), metavar="DIR", help="results and maps")
    add("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    options = parser.parse_args()
    sys.path[:0] = [str(GOLDEN), str(ROOT)]
    # Loaded once, before the forks; nothing of the package.
    for heavy in ("numpy", "cv2", "rasterio"):
        importlib.import_module(heavy)
    work = options.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    flights = _checked(_in_child(partial(_prepared, options.flights, work)))
    unchanged = {
        name: _checked(_in_child(partial(_located, None, 1.0, name, work))) for name in flights
    }
    out = work / "rows.jsonl"
    rows = (
        [json.loads(line) for line in out.read_text("utf-8").splitlines()] if out.exists() else []
    )
    done = {row["number"] for row in rows}
    sources = sorted({each for folder in options.folders for each in _modules(SOURCES / folder)})
    numbers = [each for path in sources for each in numbers_of(path) if each.title not in done]

    def tried(number: Number) -> dict[str, Any]:
        for name, before in unchanged.items():
            changed = [partial(_located, number, factor, name, work) for factor in FACTORS]
            found = [moved(before, _in_child(each)) for each in changed]
            views, metres = (max(each) for each in zip(*found, strict=True))
            if views:
                far_m = round(min(metres, 1e9), 3)
                return {"number": number.title, "flight": name, "views": views, "metres": far_m}
        return {"number": number.title, "views": 0}

    start = time.perf_counter()
    with ThreadPoolExecutor(options.jobs) as pool, out.open("a", encoding="utf-8") as stream:
        for count, row in enumerate(pool.map(tried, numbers), 1):
            rows.append(row)
            stream.write(json.dumps(row) + "\n")
            stream.flush()
            left_min = (time.perf_counter() - start) / count * (len(numbers) - count) / 60
            print(f"{count} of {len(numbers)}, {left_min:.0f} min left: {row}", flush=True)
    still = [row["number"] for row in rows if not row["views"]]
    print(f"{len(still)} of {len(rows)} numbers move no view:")
    print("\n".join(f"  {name}" for name in sorted(still)))


def _checked(found: Any) -> Any:
    if isinstance(found, str):
        raise SystemExit(f"error: {found}")
    return found


def _modules(place: Path) -> list[Path]:
    found = sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]
    if not found or not found[0].is_file():
        raise SystemExit(f"error: {place} holds no modules")
    return found


if __name__ == "__main__":
    main()
