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

    name: file stem of the orthophoto, such as "2016-07".
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

    name: str
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
    def time_years(self) -> float:
        """Time of the photograph in years, middle of the month."""
        return self.year + (self.month - 0.5) / 12.0

    @property
    def tiff_datetime(self) -> str:
        """The date at noon in the format of TIFFTAG_DATETIME."""
        return f"{self.year:04d}:{self.month:02d}:{_MONTH_DAY[self.season]:02d} 12:00:00"


DEFAULT_DATES: tuple[Epoch, ...] = (
    Epoch(
        name="2016-07",
        year=2016,
        month=7,
        season=Season.SUMMER,
        sun_azimuth_deg=152.0,
        sun_elevation_deg=57.0,
        haze=0.05,
        exposure=1.02,
        white_balance=(1.02, 1.0, 0.96),
    ),
    Epoch(
        name="2021-10",
        year=2021,
        month=10,
        season=Season.AUTUMN,
        sun_azimuth_deg=207.0,
        sun_elevation_deg=31.0,
        haze=0.12,
        exposure=0.97,
        contrast=0.95,
        white_balance=(0.98, 1.0, 1.05),
        noise=2.5,
        water_level_m=1.0,
    ),
    Epoch(
        name="2012-05",
        year=2012,
        month=5,
        season=Season.SPRING,
        sun_azimuth_deg=118.0,
        sun_elevation_deg=46.0,
        haze=0.08,
        exposure=1.0,
        contrast=1.05,
        white_balance=(0.98, 1.02, 0.99),
        noise=3.0,
        water_level_m=2.0,
    ),
)
"""Dates of the demo area: the first for the map, the second for the flight, the third older."""


def _other(
    look: Look, month: int, season: Season, elevation_deg: float, noise: float = 3.0
) -> Epoch:
    name = f"2021-{month:02d}-{look.value.replace(' ', '-')}"
    return Epoch(
        name=name,
        year=2021,
        month=month,
        season=season,
        sun_azimuth_deg=205.0,
        sun_elevation_deg=elevation_deg,
        noise=noise,
        look=look,
    )


OTHER_LIGHT: tuple[Epoch, ...] = (
    _other(Look.SNOW, 1, Season.AUTUMN, 18.0),
    _other(Look.FLOOD, 11, Season.AUTUMN, 24.0),
    _other(Look.BARE, 2, Season.SPRING, 22.0),
    _other(Look.NEAR_INFRARED, 6, Season.SUMMER, 55.0),
    _other(Look.NIGHT, 10, Season.AUTUMN, 31.0, noise=8.0),
    _other(Look.THERMAL, 7, Season.SUMMER, 58.0, noise=4.0),
    _other(Look.DAWN, 8, Season.SUMMER, 50.0, noise=4.0),
)
"""The same ground as of `DEFAULT_DATES`, five years after the first, in other light."""
