"""Runs side by side, each in a process of its own."""

import logging
import os
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context

from experiments.paper.estimate import steps
from experiments.paper.methods import Method
from experiments.paper.runs import Workplace, run
from experiments.paper.scenes import Scene

SAID_EVERY_S, ESTIMATED_AFTER_S = 30.0, 60.0
Task = tuple[Workplace, Scene, Method]


def side_by_side(tasks: Sequence[Task], jobs: int) -> Iterator[tuple[Task, float | Exception]]:
    """Each task with its minutes or what went wrong with it, as they end.

    From the first minute of learning, the hours of all rows of a method are estimated.

    Raises `BrokenProcessPool` where a process died: memory has run out, or somebody ended it.
    """
    work: dict[str, float] = {}
    for _, scene, method in tasks:
        mine = steps(method, scene.trajectory.tiles) / jobs
        work[method.family] = work.get(method.family, 0.0) + mine
    with ProcessPoolExecutor(jobs, get_context("spawn"), _prepare, (jobs, work)) as pool:
        waiting = {pool.submit(_minutes, *task): task for task in tasks}
        try:
            for done in as_completed(waiting):
                error = done.exception()
                if isinstance(error, BrokenProcessPool) or not isinstance(error, Exception | None):
                    raise error
                yield waiting[done], done.result() if error is None else error
        except BaseException:  # interrupted: hours of work are not waited for, checkpoints stay
            pool.shutdown(wait=False, cancel_futures=True)
            for process in active_children():
                process.terminate()
            raise


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


def _minutes(place: Workplace, scene: Scene, method: Method) -> float:
    LEARNING.begin(scene, method)
    return float(run(place, scene, method)["minutes"])


class _Learning(logging.Handler):
    """Prints epoch, loss and time left of a training now and then, on a terminal or not."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.work: dict[str, float] = {}
        self._title, self._family, self._steps = "", "", 0.0
        self._first: tuple[float, float] | None = None
        self._said_s = time.monotonic()

    def begin(self, scene: Scene, method: Method) -> None:
        """Speak of this row from now on."""
        self._title, self._family = f"{scene.name} {method.key}", method.family
        self._steps, self._first = steps(method, scene.trajectory.tiles), None

    def emit(self, record: logging.LogRecord) -> None:
        """Print a message, unless one was printed lately; in the first minute, all hours."""
        now_s, share = time.monotonic(), float(getattr(record, "share", 1.0))
        self._first = self._first or (now_s, share)
        if now_s - self._said_s >= SAID_EVERY_S:
            self._said_s = now_s
            self._say(f"{self._title}: {record.getMessage()}")
        since_s, since = self._first
        if self._family in self.work and now_s - since_s >= ESTIMATED_AFTER_S and since < share < 1:
            all_s = self.work.pop(self._family) * (now_s - since_s) / (share - since) / self._steps
            self._say(f"all {self._family} rows take about {all_s / 3600:.1f} h at this speed")

    def _say(self, text: str) -> None:
        print(f"           {text}", file=sys.stderr, flush=True)


LEARNING = _Learning()


def _prepare(jobs: int, work: dict[str, float]) -> None:
    """Give a process its part of the cores; `work`: steps of all rows by method, per process."""
    import cv2

    logging.basicConfig(level=logging.ERROR, format="%(levelname)s: %(message)s")
    learning = logging.getLogger("orthonav.ground.build.encoders")
    learning.setLevel(logging.INFO)
    learning.propagate = False
    learning.addHandler(LEARNING)
    LEARNING.work = dict(work)
    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
    try:
        import torch
    except ImportError:
        return
    torch.set_num_threads(max(1, cores() // jobs))
