"""The track of an aircraft: a filter over the measurements of single views and of odometry."""

from orthonav.core.track.mixture import Estimate, Mixture
from orthonav.core.track.model import Model, ReportedAttitude
from orthonav.core.track.motion import ReportedVelocity
from orthonav.core.track.trust import State

__all__ = ["Estimate", "Mixture", "Model", "ReportedAttitude", "ReportedVelocity", "State"]
