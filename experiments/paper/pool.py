"""Runs side by side, each in a process of its own."""

import logging
import os
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context

from experiments.paper.methods import Method
from experiments.paper.runs import Workplace, run
from experiments.paper.scenes import Scene

SAID_EVERY_S = 30.0
Task = tuple[Workplace, Scene, Method]


def side_by_side(tasks: Sequence[Task], jobs: int) -> Iterator[tuple[Task, float | Exception]]:
    """Each task with its minutes or what went wrong with it, as they end.

    Raises `BrokenProcessPool` where a process died: memory has run out, or somebody ended it.
    """
    with ProcessPoolExecutor(jobs, get_context("spawn"), _prepare, (jobs,)) as pool:
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
    LEARNING.title = f"{scene.name} {method.key}"
    return float(run(place, scene, method)["minutes"])


class _Learning(logging.Handler):
    """Prints epoch, loss and time left of a training now and then, on a terminal or not."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.title, self._said_s = "", time.monotonic()

    def emit(self, record: logging.LogRecord) -> None:
        """Print a message, unless one was printed lately."""
        if time.monotonic() - self._said_s >= SAID_EVERY_S:
            self._said_s = time.monotonic()
            print(f"           {self.title}: {record.getMessage()}", file=sys.stderr, flush=True)


LEARNING = _Learning()


def _prepare(jobs: int) -> None:
    """Give a process its part of the cores."""
    import cv2

    logging.basicConfig(level=logging.ERROR, format="%(levelname)s: %(message)s")
    learning = logging.getLogger("orthonav.prepare.encoders")
    learning.setLevel(logging.INFO)
    learning.propagate = False
    learning.addHandler(LEARNING)
    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
    try:
        import torch
    except ImportError:
        return
    torch.set_num_threads(max(1, cores() // jobs))
