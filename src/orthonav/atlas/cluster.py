"""Where work is done: in this process, or by Ray on all cores of a machine or of many.

Runners know nothing of sheets: they take a function and items, and give what came of each as it is
finished. An item that fails becomes a `Failure` and the others go on.
"""

import itertools
import logging
import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Protocol, TypeVar

from orthonav.cores import usable_cores
from orthonav.errors import OrthonavError, WorkerError
from orthonav.extras import needed

log = logging.getLogger(__name__)

Item = TypeVar("Item")
Made = TypeVar("Made")

RETRIES = 3
"""How often an item is begun again where the process or the machine that was at it has died."""
WINDOW = 2
"""Items given out at a time for each core: one being made, one waiting."""
POLL_S = 1.0
PROBE_S = 120.0
STOP_S = 15.0
"""How long processes may take to clean up before they are killed."""
OBJECTS_BYTES = 100 * 2**20
"""Shared memory of a cluster of this machine: what goes to and fro is small."""
ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OPENCV_LOG_LEVEL": "OFF",
    "OPENCV_IO_MAX_IMAGE_PIXELS": str(2**28),
}
"""Of the workers, as the command line sets it for itself."""


@dataclass(frozen=True)
class Failure:
    """What an item failed of: the name of the error and what it says; `trace` for bugs only."""

    kind: str
    text: str
    trace: str = ""


class Runner(Protocol):
    """A context manager that does work."""

    @property
    def at_once(self) -> int:
        """Items that are worked on at the same time."""
        ...

    def everywhere(self, probe: Callable[[], Made]) -> list[tuple[str, Made | Failure]]:
        """What a function gives on every machine, each with its name."""
        ...

    def run(
        self, work: Callable[[Item], Made], items: Sequence[Item], *, gpu: bool = False
    ) -> Iterator[tuple[Item, Made | Failure]]:
        """What comes of each item, as it is finished; ending early ends what is under way.

        With `gpu` each item has one to itself, where there are any.
        """
        ...

    def __enter__(self) -> "Runner": ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...


class PlainRunner:
    """Everything in this process, one after the other."""

    at_once = 1

    def everywhere(self, probe: Callable[[], Made]) -> list[tuple[str, Made | Failure]]:
        """What the function gives here."""
        return [("this machine", probe())]

    def run(
        self, work: Callable[[Item], Made], items: Sequence[Item], *, gpu: bool = False
    ) -> Iterator[tuple[Item, Made | Failure]]:
        """In the order of the items."""
        for item in items:
            yield item, attempted(work, item)

    def __enter__(self) -> "PlainRunner":
        return self

    def __exit__(self, *_: object) -> None:
        return None


class RayRunner:
    """Work on a Ray cluster: one of this machine, begun and ended here, or the one at an address.

    `workers` bounds the items at a time, None: as many as there are cores.
    """

    def __init__(self, address: str | None = None, workers: int | None = None) -> None:
        if workers is not None and workers < 1:
            raise WorkerError(f"workers must be 1 or more, got {workers}")
        self._address, self._workers = address, workers
        self._ray: Any = None
        self._was_there = False

    @property
    def at_once(self) -> int:
        """As many as the cluster has cores now; machines may come and go."""
        cores = int(self._ray.cluster_resources().get("CPU", 0))
        return max(1, cores if self._workers is None else min(cores, self._workers))

    def everywhere(self, probe: Callable[[], Made]) -> list[tuple[str, Made | Failure]]:
        """What the function gives on every machine that has cores and is there now."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        asked = []
        for node in self._ray.nodes():
            if node["Alive"] and node["Resources"].get("CPU", 0) >= 1:
                here = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
                task = self._task(num_cpus=0, scheduling_strategy=here)
                asked.append((str(node["NodeManagerHostname"]), task.remote(_called, probe)))
        return [(name, self._made(ref, PROBE_S)) for name, ref in asked]

    def run(
        self, work: Callable[[Item], Made], items: Sequence[Item], *, gpu: bool = False
    ) -> Iterator[tuple[Item, Made | Failure]]:
        """As they are finished; what died with its process is done again, `RETRIES` times."""
        has_gpu = gpu and self._ray.cluster_resources().get("GPU", 0) >= 1
        task = self._task(num_cpus=1, num_gpus=1 if has_gpu else 0)
        waiting = iter(items)
        running: dict[Any, Item] = {}
        try:
            while True:
                for item in itertools.islice(waiting, max(0, self._window - len(running))):
                    running[task.remote(work, item)] = item
                if not running:
                    return
                done, _ = self._ray.wait(list(running), num_returns=1, timeout=POLL_S)
                for ref in done:
                    made: Made | Failure = self._made(ref)
                    yield running.pop(ref), made
        finally:
            self._stop(list(running))

    @property
    def _window(self) -> int:
        return self.at_once if self._workers is not None else WINDOW * self.at_once

    def _task(self, **options: Any) -> Any:
        # What an item raises is given back as a value: Ray tries again only where a process died.
        return self._ray.remote(attempted).options(max_retries=RETRIES, **options)

    def _made(self, ref: Any, timeout_s: float | None = None) -> Any:
        try:
            return self._ray.get(ref, timeout=timeout_s)
        except self._ray.exceptions.RayError as error:
            why = (str(error).strip().splitlines() or [""])[0]
            text = f"the process that was at it ended on its own or could not begin ({why:.300})"
            return Failure(WorkerError.__name__, text, str(error))

    def _stop(self, refs: list[Any]) -> None:
        """End what is under way: asked first, so that temporary files go, then by force."""
        if not refs:
            return
        for ref in refs:
            self._ray.cancel(ref)
        _, left = self._ray.wait(refs, num_returns=len(refs), timeout=STOP_S)
        for ref in left:
            self._ray.cancel(ref, force=True)

    def __enter__(self) -> "RayRunner":
        self._ray = ray = _imported()
        self._was_there = ray.is_initialized()
        if self._was_there:
            return self
        logging.getLogger("ray").setLevel(logging.ERROR)
        options: dict[str, Any] = {
            "runtime_env": {"env_vars": ENVIRONMENT},
            "log_to_driver": False,
            "configure_logging": False,
        }
        if self._address is None:
            options |= {
                "num_cpus": self._workers or usable_cores(),
                "include_dashboard": False,
                "object_store_memory": OBJECTS_BYTES,
            }
        try:
            with _own_sigterm():
                ray.init(self._address or "local", **options)
        except (ConnectionError, OSError, RuntimeError, ValueError) as error:
            where = "on this machine" if self._address is None else f"at {self._address}"
            why = " ".join(str(error).split())
            raise WorkerError(f"no Ray cluster can be used {where}: {why:.300}") from error
        return self

    def __exit__(self, *_: object) -> None:
        if not self._was_there:
            self._ray.shutdown()


def attempted(work: Callable[[Item], Made], item: Item) -> Made | Failure:
    """What comes of an item, or of what it failed: one bad item must not end a night's work."""
    try:
        return work(item)
    except OrthonavError as error:
        return Failure(type(error).__name__, str(error))
    except MemoryError:
        return Failure(MemoryError.__name__, "out of memory")
    except Exception as error:
        return Failure(type(error).__name__, repr(error), traceback.format_exc())


@contextmanager
def _own_sigterm() -> Iterator[None]:
    """Keep what SIGTERM does: Ray would end the program at once."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may change signals
        return
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _called(probe: Callable[[], Made]) -> Made:
    return probe()


def _imported() -> Any:
    # Read when Ray is loaded: it would tell its makers that it runs.
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    return needed("ray", "cluster", "building on several cores or machines")
