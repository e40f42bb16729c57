"""`python -m benchmarks`: run all, print the tables, write them to `bench_results/`."""

import os
import sys

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> int:
    """One thread is set before anything loads NumPy: BLAS reads it once."""
    for name in THREADS:
        os.environ[name] = "1"
    from benchmarks.suite import run_suite

    return run_suite(sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
