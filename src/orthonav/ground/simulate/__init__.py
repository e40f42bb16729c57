"""Simulated flights over any orthophoto, and a generated landscape at several dates."""
