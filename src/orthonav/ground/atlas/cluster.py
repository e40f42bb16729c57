"""Runners of tasks: in this process, or by Ray on all cores of one or many machines.

A runner takes a function and items and yields the result of each item when it is finished. An item
that fails gives a `Failure`, and the others continue."""

import itertools
import logging
import os
import signal
import traceback
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from orthonav.core.cores import usable_cores
from orthonav.core.errors import OrthonavError, UsageError, WorkerError
from orthonav.core.extras import needed

Item = TypeVar("Item")
Made = TypeVar("Made")

ENVIRONMENT = {  # environment of the workers, as the command line sets it for itself
    "OPENBLAS_NUM_THREADS": "1",
    "OPENCV_LOG_LEVEL": "OFF",
    "OPENCV_IO_MAX_IMAGE_PIXELS": str(2**28),
}


@dataclass(frozen=True)
class Failure:
    kind: str
    text: str
    trace: str = ""


class SerialRunner:
    def run(
        self, work: Callable[[Item], Made], items: Sequence[Item]
    ) -> Generator[tuple[Item, Made | Failure]]:
        for item in items:
            yield item, attempted(work, item)

    def __enter__(self) -> "SerialRunner":
        return self

    def __exit__(self, *_: object) -> None:
        return None


class RayRunner:
    """Runs items on a Ray cluster: a local one, started and stopped here, or one at an address.
    `workers`: greatest number of items at a time, None: the number of cores."""

    def __init__(self, address: str | None = None, workers: int | None = None) -> None:
        if workers is not None and workers < 1:
            raise UsageError(f"workers must be 1 or more, got {workers}")
        self._address, self._workers = address, workers
        self._ray: Any = None

    @property
    def at_once(self) -> int:
        cores = int(self._ray.cluster_resources().get("CPU", 0))
        return max(1, cores if self._workers is None else min(cores, self._workers))

    def run(
        self, work: Callable[[Item], Made], items: Sequence[Item]
    ) -> Generator[tuple[Item, Made | Failure]]:
        """Each item with its result, when it is finished; closing the iterator stops the others, by
        request, so that they remove temporary files. Items whose process died are tried again three
        times."""
        ray = self._ray
        # Errors of an item are returned as values: Ray tries again only where a process died.
        task = ray.remote(attempted).options(max_retries=3, num_cpus=1)
        waiting = iter(items)
        running: dict[Any, Item] = {}
        try:
            while True:
                # With one running and one waiting on each core.
                most = self.at_once * (2 if self._workers is None else 1)
                for item in itertools.islice(waiting, max(0, most - len(running))):
                    running[task.remote(work, item)] = item
                if not running:
                    return
                # A second later the free cores are counted again.
                done, _ = ray.wait(list(running), num_returns=1, timeout=1.0)
                for ref in done:
                    made: Made | Failure = self._made(ref)
                    yield running.pop(ref), made
        finally:
            for ref in running:
                ray.cancel(ref)
            if running:
                ray.wait(list(running), num_returns=len(running), timeout=15.0)

    def _made(self, ref: Any) -> Any:
        try:
            return self._ray.get(ref)
        except self._ray.exceptions.RayError as error:
            why = (str(error).strip().splitlines() or [""])[0]
            text = f"its process died or could not be started ({why:.300})"
            return Failure("RayError", text, str(error))

    def __enter__(self) -> "RayRunner":
        self._ray = ray = _imported()
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
                "object_store_memory": 100 * 2**20,  # items and results are small
            }
        at_sigterm = signal.getsignal(signal.SIGTERM)
        try:
            ray.init(self._address or "local", **options)
        except (ConnectionError, OSError, RuntimeError, ValueError) as error:
            where = "on this machine" if self._address is None else f"at {self._address}"
            why = " ".join(str(error).split())
            raise WorkerError(f"no Ray cluster can be used {where}: {why:.300}") from error
        finally:
            signal.signal(signal.SIGTERM, at_sigterm)  # Ray's own would end the program at once
        return self

    def __exit__(self, *_: object) -> None:
        self._ray.shutdown()


TaskRunner = SerialRunner | RayRunner  # a context manager that runs tasks


def attempted(work: Callable[[Item], Made], item: Item) -> Made | Failure:
    """The result of an item, or its failure: one bad item must not stop the others."""
    try:
        return work(item)
    except OrthonavError as error:
        return Failure(type(error).__name__, str(error))
    except Exception as error:
        return Failure(type(error).__name__, str(error) or "no text", traceback.format_exc())


def _imported() -> Any:
    # Read when Ray is imported: it turns Ray's usage reports off.
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    return needed("ray", "cluster", "building on several cores or machines")
