"""Date and imaging conditions of one generated orthophoto: season, light, air and camera."""

from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType

from lab.landscape.looks import Look


class Season(Enum):
    """State of crops and leaves; the value is the column in the colour tables."""

    SPRING = 0
    SUMMER = 1
    AUTUMN = 2


_MONTH_DAY = MappingProxyType({Season.SPRING: 15, Season.SUMMER: 12, Season.AUTUMN: 20})


@dataclass(frozen=True)
class Epoch:
    """One photographic campaign over a generated landscape.

    year, month: calendar date; earlier changes (built, felled, merged) are visible.
    season: column of the crop and leaf colours.
    sun_azimuth_deg: direction to the sun, degrees clockwise from north.
    sun_elevation_deg: elevation of the sun above the horizon, degrees, 15..90.
    haze: fraction of scattered light, 0..1.
    exposure, contrast: factors on brightness and on its spread; 1 is neutral.
    white_balance: factors on red, green and blue; 1 is neutral.
    noise: standard deviation of the sensor noise, grey levels.
    water_level_m: outward displacement of every shore from its mean line, metres.
    look: what the picture shows, colour in daylight or another light.
    """

    year: int
    month: int
    season: Season
    sun_azimuth_deg: float
    sun_elevation_deg: float
    haze: float = 0.05
    exposure: float = 1.0
    contrast: float = 1.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    noise: float = 2.0
    water_level_m: float = 0.0
    look: Look = Look.COLOUR

    @property
    def name(self) -> str:
        """File stem of the orthophoto, such as "2016-07" or "2021-01-snow"."""
        look = "" if self.look is Look.COLOUR else f"-{self.look.value.replace(' ', '-')}"
        return f"{self.year}-{self.month:02d}{look}"

    @property
    def time_years(self) -> float:
        """Time of the photograph in years, middle of the month."""
        return self.year + (self.month - 0.5) / 12.0

    @property
    def tiff_datetime(self) -> str:
        """The date at noon in the format of TIFFTAG_DATETIME."""
        return f"{self.year:04d}:{self.month:02d}:{_MONTH_DAY[self.season]:02d} 12:00:00"


_MAP_DATE = Epoch(2016, 7, Season.SUMMER, 152.0, 57.0, 0.05, 1.02, white_balance=(1.02, 1.0, 0.96))
_FLIGHT_DATE = Epoch(
    2021, 10, Season.AUTUMN, 207.0, 31.0, 0.12, 0.97, 0.95, (0.98, 1.0, 1.05), 2.5, 1.0
)
_OLDER_DATE = Epoch(
    2012, 5, Season.SPRING, 118.0, 46.0, 0.08, 1.0, 1.05, (0.98, 1.02, 0.99), 3.0, 2.0
)
DEFAULT_DATES = _MAP_DATE, _FLIGHT_DATE, _OLDER_DATE
"""Dates of the demo area: the first for the map, the second for the flight, the third older."""
OTHER_LIGHT = tuple(
    Epoch(2021, month, season, 205.0, elevation_deg, noise=noise, look=look)
    for look, month, season, elevation_deg, noise in (
        (Look.SNOW, 1, Season.AUTUMN, 18.0, 3.0),
        (Look.FLOOD, 11, Season.AUTUMN, 24.0, 3.0),
        (Look.BARE, 2, Season.SPRING, 22.0, 3.0),
        (Look.NEAR_INFRARED, 6, Season.SUMMER, 55.0, 3.0),
        (Look.NIGHT, 10, Season.AUTUMN, 31.0, 8.0),
        (Look.THERMAL, 7, Season.SUMMER, 58.0, 4.0),
        (Look.DAWN, 8, Season.SUMMER, 50.0, 4.0),
    )
)
"""The same ground as of `DEFAULT_DATES`, five years after the first, in other light."""
