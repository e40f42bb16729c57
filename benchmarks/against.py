"""Views placed by this checkout and by another one, in turn, in one run: speed and verdicts.

`python -m benchmarks.against OTHER [--views N] [--rounds N] [--only WORDS ..] [--work DIR] [--out
DIR]`. OTHER is a checkout of an earlier commit. Both place the same views on the same maps, which
are built once by OTHER; imagery beside the checkout that is absent is left out. Times are of the
processor, so that other work on the machine counts little.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import rasterio

from benchmarks.inputs import DATA, FLIGHT_SEED, PAST, PRESENT, WIDE_ERRORS, Workplace
from benchmarks.placing import BOTH, Task
from benchmarks.record import Section, Table, git, number, provenance, save
from benchmarks.verdicts import Verdict, from_placed, percent
from orthonav.core.records import CONFIDENT
from orthonav.ground.simulate.flight import DEFAULT_CAMERA, Errors, SimulateRequest, simulate_flight

ROOT = Path(__file__).resolve().parents[1]
HERE, THERE = "here", "other"
HEADER = (
    *("map", "views", "n", "ms", "other", "times faster", "p90 ms", "other", "p99 ms", "other"),
    *("right", "other", "accepted", "other", "wrong accepted", "other", "peak MB", "other"),
)


@dataclass(frozen=True)
class Case:
    """Views over a map.

    - `map`, `views`: orthophotos below `DATA`; or a generated square, by its side in km.
    - `width_px`: shorter side of a view on the ground, pixels of the map.
    - `heading_known`; `prior_px`: standard deviation of a prior, pixels of the map; None: none.
    """

    map: str
    views: str
    width_px: int = 256
    heading_known: bool = True
    prior_px: float | None = None

    @property
    def words(self) -> str:
        """Width of its views, knowledge of heading and prior."""
        heading = "heading to 10 deg" if self.heading_known else "heading unknown"
        prior = "" if self.prior_px is None else f", prior to {self.prior_px:g} px"
        return f"{self.width_px} px, {heading}{prior}"

    @property
    def name(self) -> str:
        """Its map and its views."""
        return f"{self.map}: {self.words}"


NAIP = "naip_nd/20090818.tif", "naip_nd/20180716.tif"
MOSAIC = "airchange/szada_mosaic_a.tif", "airchange/szada_mosaic_b.tif"
SCHIPHOL = "scenes/schiphol/2004_05.tif", "scenes/schiphol/2018_04.tif"
CASES = (
    Case("2 km", "2 km"),
    Case("2 km", "2 km", heading_known=False),
    Case("2 km", "2 km", 128),
    Case("2 km", "2 km", 128, prior_px=40.0),
    Case(*NAIP),
    Case(*NAIP, heading_known=False),
    Case(*NAIP, 128),
    Case(*MOSAIC),
    Case(*MOSAIC, 128),
    Case(*SCHIPHOL),
    Case(*SCHIPHOL, 128),
    Case("4 km", "2 km"),
    Case("4 km", "2 km", heading_known=False),
    Case("10 km", "2 km"),
    Case("10 km", "2 km", heading_known=False),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Place all views, print and write; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.against", description=str(__doc__).splitlines()[0]
    )
    parser.add_argument("other", type=Path, help="checkout of another commit")
    parser.add_argument("--views", type=int, default=100, help="views per row")
    parser.add_argument("--rounds", type=int, default=2, help="times that both place them")
    parser.add_argument("--only", nargs="+", default=[], help="rows that contain one of these")
    parser.add_argument("--work", type=Path, default=Path("against_work"), metavar="DIR")
    parser.add_argument("--out", type=Path, default=Path("bench_results"), metavar="DIR")
    options = parser.parse_args(arguments)
    if not (options.other / "src" / "orthonav").is_dir():
        parser.error(f"not a checkout of orthonav: {options.other}")
    start, started = time.perf_counter(), provenance("against")
    options.work.mkdir(parents=True, exist_ok=True)
    section = Section("Against another commit")
    rows = []
    for case in _wanted(options.only):
        rows.append(_row(section, case, options))
        print(Table(section.title, HEADER, rows[-1:], ()).markdown(), file=sys.stderr, flush=True)
    commit = git("-C", str(options.other), "describe", "--always", "--dirty")
    notes = (
        f"other: commit {commit}; {options.rounds} rounds in turn, the least time "
        "of each view; processor time of one core; height known to 10 %; right: within 35 m or "
        f"10 px; accepted: of the right ones, confidence at least {CONFIDENT:g}",
    )
    section.tables = [Table("Against another commit", HEADER, rows, notes)]
    print(section.markdown())
    for path in save(
        options.out, [section], started, wall_s=time.perf_counter() - start, latest=False
    ):
        print(path, file=sys.stderr)
    return 0


def _wanted(words: Sequence[str]) -> Iterator[Case]:
    """The chosen cases whose imagery is there."""
    for case in CASES:
        if words and not any(word in case.name for word in words):
            continue
        if case.map.endswith(".tif") and not (DATA / case.map).is_file():
            print(f"{case.name}: skipped, imagery is absent", file=sys.stderr)
            continue
        yield case


def _row(section: Section, case: Case, options: argparse.Namespace) -> list[str]:
    map_path, flight, gsd_m = _inputs(case, options)
    task = Task(
        BOTH,
        str(map_path),
        str(flight),
        heading_known=case.heading_known,
        use_prior=case.prior_px is not None,
    )
    trees = {HERE: ROOT, THERE: options.other.resolve()}
    done: dict[str, list[dict[str, Any]]] = {name: [] for name in trees}
    for _ in range(options.rounds):
        for name, tree in trees.items():
            done[name].append(_placed(task, tree))
    verdicts = {name: from_placed(results[0]) for name, results in done.items()}
    times_ms = {
        name: np.min([[row[-1] for row in each["rows"]] for each in results], axis=0)
        for name, results in done.items()
    }
    for name, values in times_ms.items():
        section.add(f"{case.name}, {name}", "ms", values, data=case.map, seed=FLIGHT_SEED)
    far_m = max(35.0, 10 * gsd_m)

    def both(figure: Any) -> list[str]:
        return [figure(name) for name in trees]

    def at(share: float) -> list[str]:
        return both(lambda name: number(float(np.quantile(times_ms[name], share))))

    def wrong(verdict: Verdict) -> int:
        return int((verdict.accepted & ~verdict.within(far_m)).sum())

    faster = float(np.median(times_ms[THERE]) / np.median(times_ms[HERE]))
    return [
        *(case.map, case.words, str(len(times_ms[HERE]))),
        *(*at(0.5), f"{faster:.2f}", *at(0.9), *at(0.99)),
        *both(lambda name: percent(float(verdicts[name].within(far_m).mean()))),
        *both(lambda name: percent(verdicts[name].accepted_of_right(far_m))),
        *both(lambda name: str(wrong(verdicts[name]))),
        *both(lambda name: number(done[name][0]["peak_mb"])),
    ]


def _placed(task: Task, tree: Path) -> dict[str, Any]:
    """The views placed by the code of a checkout, in a process of its own."""
    made = _run_of(tree, "benchmarks.placing", json.dumps(asdict(task)))
    result: dict[str, Any] = json.loads(made)
    return result


def _run_of(tree: Path, module: str, *arguments: str) -> str:
    """What a module prints with the code of a checkout; raises `RuntimeError` where it fails."""
    paths = os.pathsep.join([str(tree / "src"), str(ROOT)])
    run = subprocess.run(
        [sys.executable, "-m", module, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": paths},
    )
    if run.returncode:
        raise RuntimeError(f"{tree}: {run.stderr[-2000:]}")
    return run.stdout


def _inputs(case: Case, options: argparse.Namespace) -> tuple[Path, Path, float]:
    """Map, flight and ground resolution of a case; made once."""
    work, views = options.work, options.views
    ortho, flown = (_ortho(name, work) for name in ((case.map, PAST), (case.views, PRESENT)))
    with rasterio.open(ortho) as source:
        gsd_m = float(abs(source.transform.a))
    folder = work / f"{flown.parent.name}-{flown.stem}-{case.width_px}-{case.prior_px}-{views}"
    if not folder.is_dir():
        errors = Errors(
            yaw_std_deg=WIDE_ERRORS.yaw_std_deg,
            agl_std=WIDE_ERRORS.agl_std,
            prior_std_m=None if case.prior_px is None else case.prior_px * gsd_m,
        )
        simulate_flight(
            SimulateRequest(
                [flown],
                folder,
                random=views,
                agl_m=case.width_px * gsd_m / min(DEFAULT_CAMERA.extent),
                errors=errors,
                seed=FLIGHT_SEED,
            )
        )
    built = work / f"{ortho.parent.name}-{ortho.stem}.onav"
    if not built.is_file():
        arguments = "build", "--ortho", str(ortho), "--out", str(built)
        _run_of(options.other.resolve(), "orthonav", *arguments)
    return built, folder, gsd_m


def _ortho(named: tuple[str, Any], work: Path) -> Path:
    """An orthophoto below `DATA`, or of a generated square."""
    name, date = named
    if name.endswith(".tif"):
        return DATA / name
    return Workplace(work, work / "areas", quick=False).area(
        round(1000 * float(name.split()[0])), 1.0, [date]
    )[0]


if __name__ == "__main__":
    sys.exit(main())
