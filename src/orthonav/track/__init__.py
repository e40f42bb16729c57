"""Following the aircraft over time: from what single views say to one consistent track."""

from orthonav.track.mixture import Estimate, Mixture, State
from orthonav.track.model import Model, Sighting, Told
from orthonav.track.motion import CameraDisplacement, ReportedVelocity

__all__ = [
    "CameraDisplacement",
    "Estimate",
    "Mixture",
    "Model",
    "ReportedVelocity",
    "Sighting",
    "State",
    "Told",
]
