"""Benchmarks: cost and accuracy of maps and views, compared with other methods."""
