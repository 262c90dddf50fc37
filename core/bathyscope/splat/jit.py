"""How the kernels are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba
from numba import extending

Function = TypeVar("Function", bound=Callable[..., Any])
Build = Callable[..., Any]

# Other threads run beside a kernel. Kernels allocate nothing, so they need no reference counts, which would cost as
# much as their arithmetic. No fast-math: NaN has to stay NaN.
_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": False}
_njit: Build = numba.njit
_intrinsic: Build = extending.intrinsic


def kernel(function: Function) -> Function:
    """Compile at the first call; the machine code is kept on disk for the next process."""
    compiled: Function = _njit(**_OPTIONS)(function)
    return compiled


def inlined(function: Function) -> Function:
    """Compile into every kernel that calls it."""
    compiled: Function = _njit(forceinline=True, **_OPTIONS)(function)
    return compiled


def instruction(build: Build) -> Any:
    """Something to call from kernels that ``build`` writes out in LLVM's language."""
    return _intrinsic(build)
