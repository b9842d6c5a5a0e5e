"""How kernels are compiled: cached, without the interpreter lock, dividing by zero as numpy does."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

from numba import njit

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def compiled(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """The function, compiled at its first call; it keeps its types. Python may call it as well as other kernels."""
    return cast("Callable[Arguments, Result]", njit(cache=True, nogil=True, error_model="numpy")(function))
