"""Following the aircraft over time: from what single views say to one consistent track."""

from orthonav.track.mixture import Estimate, Mixture, State
from orthonav.track.model import Displacement, Model, Sighting, Told

__all__ = ["Displacement", "Estimate", "Mixture", "Model", "Sighting", "State", "Told"]
