"""The start position of `orthonav fly`, from `--start` and `--state`."""

import argparse
import logging
from collections.abc import Callable

from orthonav.cli.source import FAR_M, distance_from_map, far_text
from orthonav.core.errors import UsageError
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.localize import Localizer
from orthonav.core.records import Prior
from orthonav.onboard.state import boot_id, load, prior_of
from orthonav.onboard.telemetry import Clocks

log = logging.getLogger(__name__)
START_OFF_M, START_SIGMAS = 3000.0, 3.0
"""A start farther off the map than this distance and so many of its deviations ends the program: a
flight that comes from there gives the place where it reaches the map, or a larger deviation."""


def start_of(
    options: argparse.Namespace, clocks: Clocks, localizer: Localizer
) -> Callable[[], Prior | None]:
    """Function that gives the prior of the first view.

    It is the saved position if that is recent, but once only, else `--start`, else None.
    """
    given = given_start(options, localizer)
    saved = [load(options.state)] if options.state else []

    def prior() -> Prior | None:
        last = saved.pop() if saved else None
        if last is None:
            return given
        age_s = last.age_s(clocks.utc_ns(), clocks.mono_ns(), boot_id())
        return prior_of(last, age_s, options.state_max_age_s) or given

    return prior


def given_start(options: argparse.Namespace, localizer: Localizer) -> Prior | None:
    """The position of `--start`; a warning where it is off the map. Raises `UsageError` where it is
    none, or where the aircraft cannot be over the map by it."""
    if not options.start:
        return None
    start = Prior(*options.start)
    place = start.lat_deg, start.lon_deg
    if not (abs(place[0]) <= 90 and abs(place[1]) <= 180 and start.std_m > 0):
        raise UsageError(
            "--start needs a latitude of -90 to 90, a longitude of -180 to 180 and a standard "
            f"deviation above 0 m, got {','.join(f'{value:g}' for value in options.start)}"
            f"{swapped_hint(*place)}"
        )
    far_m, hint = distance_from_map(place, localizer)
    most_m = START_OFF_M + START_SIGMAS * start.std_m
    if far_m > most_m:
        raise UsageError(
            f"--start is {far_m / 1000:,.1f} km from the map, more than {START_OFF_M / 1000:g} "
            f"km and {START_SIGMAS:g} times its deviation; check the map and the position{hint}"
        )
    if far_m > FAR_M:
        log.warning("%s", far_text("--start is", far_m, hint))
    return start
