"""orthonav with an autopilot that flies on its positions: recorded flights, and a simulated loop."""
