"""Detection of swapped latitude and longitude, for errors of all that reads positions."""

from collections.abc import Callable

HINT = "latitude and longitude seem to be swapped"


def swapped_bounds_hint(bounds_deg: tuple[float, float, float, float]) -> str:
    """Of the corner that is farthest from 0, 0."""
    west, south, east, north = bounds_deg
    return swapped_hint(max(south, north, key=abs), max(west, east, key=abs))


def swapped_hint(
    lat_deg: float, lon_deg: float, contains: Callable[[float, float], bool] | None = None
) -> str:
    """`HINT` where swapping explains an invalid position, one outside `contains`, else nothing."""

    def fits(lat: float, lon: float) -> bool:
        in_range = abs(lat) <= 90 and abs(lon) <= 360
        return in_range and (contains is None or contains(lat, lon))

    swapped = not fits(lat_deg, lon_deg) and fits(lon_deg, lat_deg)
    return f"; {HINT}" if swapped else ""
