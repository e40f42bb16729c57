"""What every learnt embedding gives that flies."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


class ViewEmbedder(Protocol):
    """A learnt embedding: a view's representation becomes a vector for scalar products."""

    @property
    def recipe(self) -> Any:
        """Its parameters: a frozen dataclass of the table of methods."""
        ...

    @property
    def dims(self) -> int:
        """Numbers per embedding."""
        ...

    def view(self, maps: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Embedding (D,) of a representation (C, S, S); `valid` (S, S) is what was seen."""
        ...

    def parts(self) -> dict[str, NDArray[Any]]:
        """Arrays to be stored in the map."""
        ...
