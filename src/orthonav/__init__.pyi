from .core.errors import OrthonavError as OrthonavError
from .core.flight import FlightFolder as FlightFolder
from .core.flight import open_flight as open_flight
from .core.flight import read_truth as read_truth
from .core.flight.fixes import read_results as read_results
from .core.flight.fixes import to_dataframe as to_dataframe
from .core.flight.fixes import to_geojson as to_geojson
from .core.geo.camera import Camera as Camera
from .core.localize import Localizer as Localizer
from .core.mapfile import MapFile as MapFile
from .core.mapfile import open_map as open_map
from .core.records import CONFIDENT as CONFIDENT
from .core.records import Fix as Fix
from .core.records import NoFix as NoFix
from .core.records import Prior as Prior
from .core.records import Telemetry as Telemetry
from .core.records import View as View
from .core.records import ViewResult as ViewResult
from .core.track.tracker import Tracker as Tracker
from .ground.build import BuildRequest as BuildRequest
from .ground.build import build_map as build_map
from .ground.check.run import check as check
from .ground.evaluate.metrics import evaluate as evaluate
from .ground.simulate.flight import SimulateRequest as SimulateRequest
from .ground.simulate.flight import simulate_flight as simulate_flight

__version__: str
__all__: list[str]
