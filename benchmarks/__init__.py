"""Benchmarks: what a map costs to build and to carry, what a view costs, and what others cost."""
