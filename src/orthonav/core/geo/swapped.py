"""Detection of swapped latitude and longitude, for errors of all that reads positions."""

from collections.abc import Callable

HINT = "latitude and longitude seem to be swapped"


def swapped_bounds_hint(bounds_deg: tuple[float, float, float, float]) -> str:
    """`swapped_hint` of the corner of west, south, east, north that is farthest from 0, 0."""
    west, south, east, north = bounds_deg
    return swapped_hint(max(south, north, key=abs), max(west, east, key=abs))


def swapped_hint(
    lat_deg: float, lon_deg: float, contains: Callable[[float, float], bool] | None = None
) -> str:
    """`HINT` after a semicolon where swapping explains an invalid position, else nothing.

    `contains` says whether a position (latitude, longitude in degrees) lies in the expected area;
    without it only the range of a latitude, -90 to 90, is considered.
    """

    def fits(lat: float, lon: float) -> bool:
        in_range = abs(lat) <= 90 and abs(lon) <= 360
        return in_range and (contains is None or contains(lat, lon))

    swapped = not fits(lat_deg, lon_deg) and fits(lon_deg, lat_deg)
    return f"; {HINT}" if swapped else ""
