"""The track of an aircraft: a filter over the measurements of single views and of odometry."""

from orthonav.core.track.filter import Model, ReportedAttitude, ReportedVelocity
from orthonav.core.track.hypothesis import State
from orthonav.core.track.mixture import Estimate, Mixture

__all__ = ["Estimate", "Mixture", "Model", "ReportedAttitude", "ReportedVelocity", "State"]
