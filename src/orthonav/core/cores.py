"""How many processor cores this process may use."""

import os


def usable_cores() -> int:
    """Processor cores that this process may run on, at least 1; all of them where unknown."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
