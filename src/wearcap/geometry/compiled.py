"""Compiling loops over pixels and cells with numba."""

import inspect
from collections.abc import Callable

import numba


def compiled(function: Callable, inline: str = "never") -> Callable:
    """Compile a function of arrays and numbers; it releases the GIL and is cached on disk where possible. With `inline`
    "always" its callers contain it: a call costs some ns for each array.

    Kernels that call one another belong in one file: numba invalidates its cache when that file changes. Their
    arguments are not annotated: a shape checker's wrapper cannot be compiled and is removed here.
    """
    plain = inspect.unwrap(function)
    try:
        return numba.njit(cache=True, nogil=True, inline=inline, error_model="numpy")(plain)
    except RuntimeError:  # no folder for the cache: installed read-only, no home
        return numba.njit(nogil=True, inline=inline, error_model="numpy")(plain)
