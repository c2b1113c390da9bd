"""Compiling loops over pixels and cells with numba."""

import inspect
from collections.abc import Callable

import numba


def compiled(function: Callable) -> Callable:
    """Compile a function of arrays and numbers; it releases the GIL, and is kept on disk where a cache can be.

    Kernels that call one another belong in one file: numba renews its cache when that file changes. Their
    arguments are not annotated: a shape checker's wrapper cannot be compiled and is taken off here.
    """
    plain = inspect.unwrap(function)
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(plain)
    except RuntimeError:  # no folder for the cache: installed read-only, no home
        return numba.njit(nogil=True, error_model="numpy")(plain)
