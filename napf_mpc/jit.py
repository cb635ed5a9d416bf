"""The one home of numba: a typed decorator for hot scalar loops."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """Compile a function with numba: cached on disk, without the GIL, IEEE semantics (no fast-math).

    ``error_model="numpy"`` makes a division by zero an infinity, as in NumPy, instead of an exception, so
    that the function means the same whether it is compiled or not (``function.py_func`` is the plain one).
    """
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def compiled_bare(function: F) -> F:
    """The same without reference counts, its code put into that of its callers: for what allocates nothing.

    A count for every array of every call costs more than the few sums of a small function, and so does
    handing over named tuples: field by field, seven words an array and more. What such a function calls is
    compiled so as well.
    """
    return _bare(function, inside=True)


def compiled_apart(function: F) -> F:
    """The same without reference counts, called as it is: for what is long, or called but now and then.

    Put into its callers it would be compiled again with each of them.
    """
    return _bare(function, inside=False)


def _bare(function: F, inside: bool) -> F:
    # Not among the options that numba's types know.
    bare: dict[str, Any] = {"_nrt": False, "forceinline": inside}
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy", **bare)(function))
