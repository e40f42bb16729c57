"""Experiments: published ones run again with orthonav's own code."""
