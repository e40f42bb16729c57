"""What a run leaves behind: measurements for programs, tables for people, and the machine."""

import datetime
import hashlib
import json
import math
import os
import platform
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

import orthonav

PACKAGES = (
    "orthonav",
    "numpy",
    "scipy",
    "opencv-python-headless",
    "safetensors",
    "pymavlink",
    "mcap",
    "rasterio",
    "torch",
    "onnx",
    "onnxruntime",
    "faiss-cpu",
    "scikit-image",
    "transformers",
    "playwright",
    "XStatic-Leaflet",
)
WILSON_Z = 1.2816
"""For 80 % intervals of shares, so that their p10 and p90 mean what those of timings mean."""


@dataclass(frozen=True)
class Measurement:
    """One measured quantity.

    - `section`, `name`: section of the report, and name of the quantity.
    - `unit`: its unit; "1" for a share.
    - `median`, `p10`, `p90`, `p99`: quantiles of the samples. For a share, `median` is the
      share, and p10 to p90 is its Wilson interval.
    - `n`: number of samples.
    - `data`, `seed`: input data, and the seed it was generated with.
    """

    section: str
    name: str
    unit: str
    median: float
    p10: float
    p90: float
    p99: float | None
    n: int
    data: str
    seed: int | None


@dataclass(frozen=True)
class Table:
    """Rows of text under a header, the first column left-aligned, with notes below."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()

    def markdown(self, level: int = 3) -> str:
        """The table in Markdown, its columns aligned for the terminal."""
        lines = [self.header, *self.rows]
        widths = [max(len(line[col]) for line in lines) for col in range(len(self.header))]
        rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
        text = [f"{'#' * level} {self.title}", ""]
        for line in (self.header, rule, *self.rows):
            first, *rest = line
            cells = [first.ljust(widths[0])]
            cells += [cell.rjust(width) for cell, width in zip(rest, widths[1:], strict=True)]
            text.append(f"| {' | '.join(cells)} |")
        notes = [f"- {note}" for note in self.notes]
        return "\n".join([*text, "", *notes, ""] if notes else [*text, ""])


@dataclass
class Section:
    """Everything one part of the suite found. `facts` are figures that targets ask for."""

    title: str
    tables: list[Table] = field(default_factory=list)
    measurements: list[Measurement] = field(default_factory=list)
    facts: dict[str, float] = field(default_factory=dict)

    def add(
        self, name: str, unit: str, samples: ArrayLike, *, data: str, seed: int | None = None
    ) -> Measurement:
        """Keep the median and the spread of samples (N,)."""
        values = np.asarray(samples, dtype=np.float64).reshape(-1)
        p10, median, p90, p99 = (float(v) for v in np.percentile(values, [10, 50, 90, 99]))
        tail = p99 if len(values) >= 50 else None
        made = Measurement(self.title, name, unit, median, p10, p90, tail, len(values), data, seed)
        self.measurements.append(made)
        return made

    def add_share(self, name: str, hits: ArrayLike, *, data: str, seed: int) -> Measurement:
        """Keep the share of true values among (N,) and the interval it is known to."""
        values = np.asarray(hits, dtype=bool).reshape(-1)
        low, high = _wilson(int(values.sum()), len(values))
        share = float(values.mean())
        made = Measurement(self.title, name, "1", share, low, high, None, len(values), data, seed)
        self.measurements.append(made)
        return made

    def markdown(self) -> str:
        """Title and tables in Markdown."""
        if len(self.tables) == 1:
            return self.tables[0].markdown(level=2)
        return "\n".join([f"## {self.title}", "", *(table.markdown() for table in self.tables)])


def _wilson(hits: int, count: int) -> tuple[float, float]:
    """Wilson interval of a share (Wilson 1927)."""
    share, z2 = hits / count, WILSON_Z**2
    centre = (share + z2 / (2 * count)) / (1 + z2 / count)
    half = WILSON_Z * math.sqrt(share * (1 - share) / count + z2 / (4 * count**2))
    half /= 1 + z2 / count
    return max(0.0, centre - half), min(1.0, centre + half)


def number(value: float) -> str:
    """Three digits that count, never an exponent."""
    if not math.isfinite(value):
        return "-"
    digits = 2 - math.floor(math.log10(abs(value))) if value else 0
    return f"{value:,.{min(6, max(0, digits))}f}"


def timing_cells(timing: Measurement) -> list[str]:
    """Median, p10, p90 and p99 as cells of a table."""
    tail = "-" if timing.p99 is None else number(timing.p99)
    return [number(timing.median), number(timing.p10), number(timing.p90), tail]


TARGETS = (
    ("naip_build_s", "NAIP map (17 km2 at 5 m, 256 px tiles) built in, s", 10.0),
    ("view_ms", "one view, embedding only, 3 headings, one core, ms", 10.0),
    ("search_100k_ms", "3 queries on 100,000 tiles, one core, ms", 10.0),
    (
        "map_mb_per_km2",
        "map at 1 m, 256 px tiles, 87.5 % overlap, less registration layer, MB per km2",
        0.3,
    ),
    ("onboard_p99_ms", "exposure to message at 5 Hz, 1280 x 960 px, one core, p99 ms", 60.0),
    ("onboard_peak_mb", "resident memory in flight, largest, MB", 350.0),
)


def targets_table(done: Sequence[Section]) -> Section:
    """Each target with its measured value."""
    facts = {key: value for section in done for key, value in section.facts.items()}
    rows = []
    for key, text, limit in TARGETS:
        found = facts.get(key)
        verdict = "not measured" if found is None else "yes" if found < limit else "NO"
        rows.append([text, f"< {number(limit)}", "-" if found is None else number(found), verdict])
    header = ("target", "limit", "measured", "met")
    return Section("Targets", [Table("Targets", header, rows)], facts=facts)


def save(
    out: Path, done: Sequence[Section], started: dict[str, Any], *, wall_s: float, latest: bool
) -> list[Path]:
    """Write JSON and Markdown named by date and commit; also `latest.md` after a full run.

    `started` is the `provenance` taken before anything was measured.
    """
    same = started["sources"] == sources_digest()
    about = {
        **started,
        "wall_s": round(wall_s),
        "load_1_5_15_min": " ".join(f"{load:.2f}" for load in os.getloadavg()),
        "sources": started["sources"] if same else "CHANGED DURING THE RUN: figures are mixed",
    }
    plain = {
        **about,
        "measurements": [asdict(one) for section in done for one in section.measurements],
        "facts": done[-1].facts,
    }
    commit = str(about["commit"])[:10]
    stem = f"{about['date'][:19].replace(':', '')}-{commit}-{about['run']}"
    head = "\n".join(f"- {key}: {_said(value)}" for key, value in about.items())
    text = "\n".join([head, "", *(section.markdown() for section in done)])
    contents = {f"{stem}.json": json.dumps(plain, indent=1) + "\n", f"{stem}.md": text}
    if latest:
        contents["latest.md"] = text
    out.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        (out / name).write_text(content, encoding="utf-8")
    return [out / name for name in contents]


def _said(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {item}" for key, item in value.items())
    return str(value)


def provenance(run: str) -> dict[str, Any]:
    """Commit, date, machine and versions; `run` names the run."""
    with Path("/proc/meminfo").open() as stream:
        memory_gb = int(stream.readline().split()[1]) / 2**20
    return {
        "commit": git("rev-parse", "HEAD") or "unknown",
        "dirty": bool(git("status", "--porcelain")),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "sources": sources_digest(),
        "run": run,
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "memory_gb": round(memory_gb, 1),
        "system": platform.platform(),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "threads": {
            "BLAS": os.environ.get("OPENBLAS_NUM_THREADS", "unset"),
            "OpenCV": f"{cv2.getNumThreads()} (map builds: all cores)",
        },
    }


def sources_digest() -> str:
    """Short digest of the package's sources, to detect changes during a run."""
    digest = hashlib.sha256()
    for path in sorted(Path(orthonav.__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"


def git(*arguments: str) -> str:
    """What git prints, without its end of line; empty where it fails."""
    try:
        found = subprocess.run(("git", *arguments), capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return found.stdout.strip()


def _cpu() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or "unknown"
