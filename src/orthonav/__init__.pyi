from orthonav.errors import OrthonavError as OrthonavError
from orthonav.flight import FlightFolder as FlightFolder
from orthonav.flight import open_flight as open_flight
from orthonav.flight import read_truth as read_truth
from orthonav.flight.fixes import read_results as read_results
from orthonav.geo.camera import Camera as Camera
from orthonav.ground.check.run import check as check
from orthonav.ground.evaluate.metrics import evaluate as evaluate
from orthonav.localizer import Localizer as Localizer
from orthonav.localizer import Tracker as Tracker
from orthonav.mapfile import MapFile as MapFile
from orthonav.mapfile import open_map as open_map
from orthonav.prepare import BuildRequest as BuildRequest
from orthonav.prepare import build_map as build_map
from orthonav.records import CONFIDENT as CONFIDENT
from orthonav.records import Fix as Fix
from orthonav.records import NoFix as NoFix
from orthonav.records import Prior as Prior
from orthonav.records import Telemetry as Telemetry
from orthonav.records import View as View
from orthonav.records import ViewResult as ViewResult
from orthonav.simulate.flight import SimulateRequest as SimulateRequest
from orthonav.simulate.flight import simulate_flight as simulate_flight

__version__: str
__all__: list[str]
