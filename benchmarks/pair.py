"""`orthonav fly` in a process of its own on one core, and a fake autopilot on another."""

import contextlib
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.flight import open_flight, read_truth
from orthonav.core.geo.frames import LocalFrame

POSITION = "GLOBAL_POSITION_SENSOR"
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cores:
    """Core of the measured process and core of all others; the same on a single-core machine."""

    flying: int
    other: int

    @classmethod
    def chosen(cls) -> "Cores":
        """Of those that this process may use, the last and the first."""
        allowed = sorted(os.sched_getaffinity(0))
        return cls(allowed[-1], allowed[0])


@contextlib.contextmanager
def on_core(core: int) -> Iterator[None]:
    """This thread, and what it starts meanwhile, on one core."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def free_port() -> int:
    """A free UDP port of the loopback interface."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def utc_ahead_ns() -> int:
    """UTC minus the monotonic clock, from the fastest of several readings."""
    readings = []
    for _ in range(20):
        before_ns, utc_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        readings.append((after_ns - before_ns, utc_ns - (before_ns + after_ns) // 2))
    return min(readings)[1]


class FakeAutopilot:
    """The process of the fake autopilot, and its received messages."""

    def __init__(self, flight: Path, port: int, core: int) -> None:
        """Returns when its clock has begun."""
        self.flight = flight
        self.heard: list[dict[str, Any]] = []
        program = Path(__file__).parents[1] / "examples" / "simulated_autopilot.py"
        # 49 attitudes a second: exposures fall anywhere between two.
        options = ("--url", f"127.0.0.1:{port}", "--rate-hz", "49", "--messages", "--tail-s", "5")
        command = [sys.executable, str(program), str(flight), *options]
        with on_core(core):
            self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        out = self._process.stdout
        assert out is not None
        begun = json.loads(out.readline())
        self.begin_ns, self.utc_ahead_ns = int(begun["begin_ns"]), utc_ahead_ns()
        self._change = threading.Condition()
        self._thread = threading.Thread(target=self._read, args=(out,), daemon=True)
        self._thread.start()

    def _read(self, out: IO[str]) -> None:
        for line in out:
            with self._change:
                self.heard.append(json.loads(line))
                self._change.notify()

    def position_after(self, mono_ns: int, timeout_s: float) -> int | None:
        """When the first position came after a moment, waiting so long; None if none did."""

        def found() -> list[int]:
            return [
                m["at_ns"] for m in self.heard if m["name"] == POSITION and m["at_ns"] > mono_ns
            ]

        with self._change:
            self._change.wait_for(found, timeout_s)
            return next(iter(found()), None)

    def mono_ns(self, flight_s: float) -> int:
        """When a time of the flight is, by the monotonic clock."""
        return self.begin_ns + round(flight_s * 1e9)

    def wait_until(self, flight_s: float) -> None:
        """Sleep until a time of the flight."""
        time.sleep(max(0.0, (self.mono_ns(flight_s) - time.monotonic_ns()) / 1e9))

    def __enter__(self) -> "FakeAutopilot":
        return self

    def __exit__(self, *_: object) -> None:
        """End it; what it heard stays."""
        self._process.terminate()
        self._process.wait(10)
        self._thread.join(10)
        if self._process.stdout is not None:
            self._process.stdout.close()


@dataclass(frozen=True)
class Sample:
    """State of a process at one time.

    - `at_ns`: time on the monotonic clock, ns.
    - `rss_mb`, `peak_mb`: resident memory, current and peak.
    - `cpu_s`: processor time of the process.
    """

    at_ns: int
    rss_mb: float
    peak_mb: float
    cpu_s: float


@dataclass
class Fly:
    """`orthonav fly` with these arguments on one core."""

    arguments: Sequence[str]
    core: int
    errors: Path
    samples: list[Sample] = field(default_factory=list)

    def __post_init__(self) -> None:
        program = Path(sys.executable).with_name("orthonav")
        script = [str(program)] if program.is_file() else [sys.executable, "-m", "orthonav"]
        with on_core(self.core), self.errors.open("ab") as errors:
            self.started_ns = time.monotonic_ns()
            self.process = subprocess.Popen(
                [*script, "fly", *self.arguments], stdout=subprocess.DEVNULL, stderr=errors
            )

    def watch(self, until_ns: int) -> None:
        """Take a sample each second until it ends, or until a moment."""
        while self.process.poll() is None:
            left_s = (until_ns - time.monotonic_ns()) / 1e9
            if left_s <= 0:
                return
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(min(1.0, left_s))
            made = sample(self.process.pid)
            if made is not None:
                self.samples.append(made)

    def kill(self) -> None:
        """Kill the process, as a power failure does."""
        self.process.kill()
        self.process.wait(10)

    def __enter__(self) -> "Fly":
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.kill()


def sample(pid: int) -> Sample | None:
    """A process now; None where it has ended."""
    at_ns = time.monotonic_ns()
    try:
        status = Path(f"/proc/{pid}/status").read_text().splitlines()
        stat = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (OSError, IndexError):
        return None
    kb = {line.split(":")[0]: int(line.split()[1]) for line in status if line.startswith("Vm")}
    if "VmRSS" not in kb:
        return None
    cpu_s = (int(stat[11]) + int(stat[12])) / TICKS_PER_S
    rss_mb, peak_mb = (kb[name] * 1024 / 1e6 for name in ("VmRSS", "VmHWM"))
    return Sample(at_ns, rss_mb, peak_mb, cpu_s)


@dataclass(frozen=True, eq=False)
class Arrivals:
    """Positions that the fake autopilot received (N,).

    - `view`: index of the view.
    - `latency_ms`: from exposure to arrival, ms.
    - `error_m`: distance from the truth, m.
    """

    view: NDArray[np.intp]
    latency_ms: Array
    error_m: Array

    @classmethod
    def of(cls, fake_autopilot: FakeAutopilot) -> "Arrivals":
        """Everything heard so far; `flight` is played by the fake autopilot."""
        flight = open_flight(fake_autopilot.flight)
        times_s = np.array([view.telemetry.time_ns / 1e9 for view in flight.views])
        truth = read_truth(fake_autopilot.flight / "truth.csv")
        places = [truth[view.frame] for view in flight.views]
        rows = []
        for message in fake_autopilot.heard:
            if message["name"] != POSITION:
                continue
            # The message states its own time; the exposure is before it by its age.
            exposed_us = message["time_usec"] - message["processing_time"]
            since_ns = exposed_us * 1000 - fake_autopilot.utc_ahead_ns - fake_autopilot.begin_ns
            view = int(np.abs(times_s - since_ns / 1e9).argmin())
            exposed_ns = fake_autopilot.mono_ns(float(times_s[view]))
            off = LocalFrame(*places[view]).en_from_latlon(
                message["lat"] * 1e-7, message["lon"] * 1e-7
            )
            rows.append((view, (message["at_ns"] - exposed_ns) / 1e6, float(np.hypot(*off))))
        columns = np.array(rows, np.float64).reshape(-1, 3)
        return cls(columns[:, 0].astype(np.intp), *columns[:, 1:].T)


def views_in(lines: Path) -> int:
    """How many views the program wrote into its `--jsonl`."""
    text = lines.read_text("ascii") if lines.is_file() else ""
    return sum('"age_ms"' in line for line in text.splitlines())
