"""The track of an aircraft: a filter over the measurements of single views and of odometry."""

from orthonav.core.track.mixture import Estimate, Mixture
from orthonav.core.track.model import Model, ReportedAttitude, Sighting
from orthonav.core.track.motion import CameraDisplacement, ReportedVelocity
from orthonav.core.track.trust import State

__all__ = [
    "CameraDisplacement",
    "Estimate",
    "Mixture",
    "Model",
    "ReportedAttitude",
    "ReportedVelocity",
    "Sighting",
    "State",
]
