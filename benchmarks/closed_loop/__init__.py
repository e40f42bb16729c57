"""Autopilots that fly on our positions: recorded flights located again, and a simulated loop."""
