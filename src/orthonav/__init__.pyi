from orthonav.core.errors import OrthonavError as OrthonavError
from orthonav.core.flight import FlightFolder as FlightFolder
from orthonav.core.flight import open_flight as open_flight
from orthonav.core.flight import read_truth as read_truth
from orthonav.core.flight.fixes import read_results as read_results
from orthonav.core.flight.fixes import to_dataframe as to_dataframe
from orthonav.core.flight.fixes import to_geojson as to_geojson
from orthonav.core.geo.camera import Camera as Camera
from orthonav.core.localize import Localizer as Localizer
from orthonav.core.mapfile import MapFile as MapFile
from orthonav.core.mapfile import open_map as open_map
from orthonav.core.records import CONFIDENT as CONFIDENT
from orthonav.core.records import Fix as Fix
from orthonav.core.records import NoFix as NoFix
from orthonav.core.records import Prior as Prior
from orthonav.core.records import Telemetry as Telemetry
from orthonav.core.records import View as View
from orthonav.core.records import ViewResult as ViewResult
from orthonav.core.track.tracker import Tracker as Tracker
from orthonav.ground.build import BuildRequest as BuildRequest
from orthonav.ground.build import build_map as build_map
from orthonav.ground.check.run import check as check
from orthonav.ground.evaluate.metrics import evaluate as evaluate
from orthonav.ground.simulate.flight import SimulateRequest as SimulateRequest
from orthonav.ground.simulate.flight import simulate_flight as simulate_flight

__version__: str
__all__: list[str]
