"""The compiled part of registration, where it was compiled with the package."""

import logging
from importlib import import_module
from importlib.util import find_spec
from typing import Any

LAYOUT = 7  # of arguments and results; a kernel with another one is not used
_NAME = "orthonav.core.register._kernel"
log = logging.getLogger(__name__)


def _compiled() -> Any:
    if find_spec(_NAME) is None:
        return None
    try:
        found = import_module(_NAME)
    except ImportError as error:
        log.warning("the kernel of registration is of another machine, NumPy is used: %s", error)
        return None
    if getattr(found, "LAYOUT", None) != LAYOUT:
        log.warning("the kernel of registration is of another version, NumPy is used; reinstall")
        return None
    return found


KERNEL: Any = _compiled()
"""None where no compiler was at hand at installation: NumPy then does the same, slower."""
