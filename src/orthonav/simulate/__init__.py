"""Simulated flights over any orthophoto, and a generated landscape of several dates to fly over."""
