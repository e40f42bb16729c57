"""Benchmarks of the checkout: `python -m benchmarks.NAME`."""

import os

# BLAS reads it once, when NumPy is loaded, and in the processes that are started.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
