"""Compilation of sample loops that cannot be written as array operations.

Importing Numba takes about 0.5 s: import modules that depend on this one only for batch evaluation.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Return a function that is compiled by Numba at its first call.

    The machine code is cached beside the source, or in ``NUMBA_CACHE_DIR`` or the user's cache folder; if none of these
    is writable, every process compiles the function.
    """
    for kept in (True, False):
        try:
            return cast(Function, njit(cache=kept, nogil=True)(function))
        except RuntimeError:
            continue
    return function
