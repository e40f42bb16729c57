"""Ranges of what a mission may ask for; importing this needs nothing else."""

ALERT_LIMITS_M = (1.0, 100_000.0)
RISKS = (1e-6, 0.5)
DEFAULT_RISK = 1e-3
"""Probability of an error beyond the protection level."""
CAMERA_KINDS = "colour", "other", "near-infrared", "thermal"
"""Cameras over a map of colour imagery; *other*: a sensor of another kind."""
