"""The compiled part of registration, where it was compiled with the package."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

_NAME = "orthonav.register._kernel"
KERNEL: Any = import_module(_NAME) if find_spec(_NAME) else None
"""Module of the functions in `_kernel.c`; None where no compiler was at hand at installation. NumPy
then does the same, several times slower."""
