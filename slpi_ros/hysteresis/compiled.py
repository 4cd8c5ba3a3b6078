"""Functions in machine code, for loops over samples that no array operation expresses.

Numba takes a good half second to load: modules that use this one are imported only where a whole path is worked on.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Return a function that is compiled at its first call.

    The machine code is kept beside the source, else in ``NUMBA_CACHE_DIR`` or the user's cache folder; where none of
    these can be written to, every process compiles it anew.
    """
    for kept in (True, False):
        try:
            return cast(Function, njit(cache=kept, nogil=True)(function))
        except RuntimeError:
            continue
    return function
