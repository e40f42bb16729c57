"""Publishes the result of each view to all outputs: MAVLink, NMEA, JSON lines, ROS 2."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol

from orthonav.core.records import CONFIDENT, ViewResult
from orthonav.onboard.link import AutopilotLink
from orthonav.onboard.messages.correlation import FilterCovariance
from orthonav.onboard.messages.estimate import Clock, NavigationEstimate, estimate_from_result
from orthonav.onboard.messages.gate import Gate
from orthonav.onboard.outputs import Messenger, NmeaOut
from orthonav.onboard.telemetry import Clocks, VehicleState

log = logging.getLogger(__name__)


class ViewOutput(Protocol):
    """Takes every view, and the health: lines of JSON, the console. Raises `OSError`."""

    def view(
        self, result: ViewResult, age_ms: float, sent: Sequence[str], withheld: str | None
    ) -> None:
        """Take one view: its age at the end, the messages sent, why none was."""

    def health(self, plain: dict[str, Any]) -> None:
        """Take the health."""

    def close(self) -> None:
        """Close the output."""


class PositionOutput(Protocol):
    """Takes estimates that passed the gate, and the health. Raises `OSError` or `ValueError`.

    `for_filter`: whether it gets covariances for a filter instead of those of the fixes.
    """

    for_filter: bool

    def position(
        self, estimate: NavigationEstimate, vehicle: VehicleState, stamp_ns: int
    ) -> tuple[str, ...]:
        """Send one position; returns the names of messages. `stamp_ns`: time of the image."""

    def health(self, plain: dict[str, Any]) -> None:
        """Send the health."""

    def close(self) -> None:
        """Close the output."""


class Publisher:
    """Publishes results to all outputs. Mutable."""

    def __init__(
        self,
        gate: Gate,
        clocks: Clocks,
        *,
        messenger: Messenger | None = None,
        link: AutopilotLink | None = None,
        nmea: Sequence[NmeaOut] = (),
        lines: Sequence[ViewOutput] = (),
        graph: PositionOutput | None = None,
        min_confidence: float = CONFIDENT,
        min_std_m: float = 0.0,
    ) -> None:
        """`min_std_m`: lower bound of the standard deviation of a fix that `graph` publishes."""
        self.gate, self._clocks = gate, clocks
        self.messenger, self._link = messenger, link
        self._nmea, self._lines, self._least = nmea, lines, min_confidence
        self._graph = [graph] if graph is not None else []
        self._covariance = FilterCovariance(min_std_m)
        self.failed = 0

    def publish(
        self,
        result: ViewResult,
        exposed_ns: int,
        vehicle: VehicleState,
        *,
        judged: bool,
        withheld: str | None = None,
    ) -> tuple[str, ...]:
        """Send the position of a view where the gate admits it; the names of the messages.

        Only views that the locator processed (`judged`) can give a position: the prediction of a
        track is not a measurement. `withheld`: reason why a view was not located, which the gate
        counts.
        """
        estimate: NavigationEstimate | None = None
        sent: tuple[str, ...] = ()
        if withheld is not None:
            self.gate.withheld[withheld] += 1
        elif judged:
            now_ns = self._clocks.mono_ns()
            by_our_clock = replace(result, time_ns=exposed_ns)
            ahead_ns = self._clocks.utc_ns() - now_ns
            made = estimate_from_result(by_our_clock, clock=Clock.BOOT, utc_minus_boot_ns=ahead_ns)
            before = self.gate.withheld.copy()
            estimate = self.gate.admit(made, now_ns)
            if estimate is not None:
                sent = self._send(estimate, exposed_ns, vehicle)
                if not estimate.dead_reckoned:  # messages of ROS cannot mark it
                    sent += self._to_graph(estimate, exposed_ns, vehicle, result.time_ns)
            withheld = None if sent else next(iter(self.gate.withheld - before), None)
        self._write_nmea(estimate)
        age_ms = (self._clocks.mono_ns() - exposed_ns) / 1e6
        self._each(self._lines, lambda out: out.view(result, age_ms, sent, withheld))
        return sent

    def health(self, plain: dict[str, Any]) -> None:
        """Send the health to the outputs that carry it."""
        self._each([*self._lines, *self._graph], lambda out: out.health(plain))

    def close(self) -> None:
        """Close all outputs."""
        self._each([*self._nmea, *self._lines, *self._graph], lambda out: out.close())

    def _send(
        self, estimate: NavigationEstimate, exposed_ns: int, vehicle: VehicleState
    ) -> tuple[str, ...]:
        if self.messenger is None or self._link is None:
            return ()
        return self.messenger.publish(
            estimate,
            vehicle,
            exposed_ns=exposed_ns,
            boot_ns=self._link.boot_ns(exposed_ns),
            target=self._link.target,
            kind=self._link.kind,
            origin=self._link.origin,
        )

    def _to_graph(
        self, estimate: NavigationEstimate, exposed_ns: int, vehicle: VehicleState, stamp_ns: int
    ) -> tuple[str, ...]:
        sent: list[str] = []
        if self._graph and self.gate.due("ROS2", self._clocks.mono_ns()):
            stated = self._covariance.prepare("ROS2", estimate, exposed_ns)
            self._each(
                self._graph,
                lambda out: sent.extend(
                    out.position(stated if out.for_filter else estimate, vehicle, stamp_ns)
                ),
            )
            self._covariance.sent("ROS2", exposed_ns)
        return tuple(sent)

    def _write_nmea(self, estimate: NavigationEstimate | None) -> None:
        if self._nmea and self.gate.due("NMEA", self._clocks.mono_ns()):
            utc_ns = self._clocks.utc_ns()
            self._each(self._nmea, lambda out: out.write(estimate, utc_ns, self._least))

    def _each(self, outs: Sequence[Any], call: Callable[[Any], None]) -> None:
        for out in outs:
            try:
                call(out)
            except Exception as error:  # one output must not end the others
                if self.failed == 0:
                    log.warning("output failed: %s", error)
                self.failed += 1
