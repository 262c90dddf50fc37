"""The compiler settings that every kernel shares.

One thread on purpose: clips are rendered by processes, which beat numba's threads on a shared machine.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba as nb

F = TypeVar("F", bound=Callable[..., Any])


def jit(function: F) -> F:
    """Compile on the first call and keep the machine code on disk."""
    return cast(F, nb.njit(cache=True, fastmath={"contract", "arcp", "nsz", "afn"}, error_model="numpy")(function))
