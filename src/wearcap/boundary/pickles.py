"""Plain data of public data sets' pickles (HPS, OMOMO, cam_traj.pkl), without calling anything that they name.

A pickle names classes and functions to call. Here a handful of names stand for functions of this file that build
numeric arrays, scalars and bytes; every other name is refused before anything is called. joblib's files, where arrays'
bytes stand between the opcodes, are read too.
"""

import bz2
import gzip
import io
import lzma
import math
import pickle
import re
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from wearcap.boundary.limits import Budget
from wearcap.boundary.opening import counted, explained, file_size
from wearcap.errors import WearcapError

_DTYPE = re.compile(r"[<>=|]?(b1|\?|[biuf][1248]|f16|[SU]\d{1,6})")
_ADMITTED = (bool, int, float, complex, str, bytes, bytearray, type(None), np.generic)


def read_pickle(path: str | Path) -> Any:
    """The content of a pickle or joblib file (packed or not): numbers, str, bytes, lists, tuples, dicts, arrays.

    Python 2's byte strings come as str (Latin-1). Raises WearcapError naming the class or function when the file
    holds anything else, and when it is damaged.
    """
    size = file_size(path)
    with explained(path), open(path, "rb") as file:
        # joblib's files are packed; their first bytes name the compression.
        begin = file.peek(2)[:2]
        unpack = next((opener for magic, opener in _PACKERS.items() if begin.startswith(magic)), None)
        budget = Budget(path, "pickle", size if unpack else math.inf)
        with counted(unpack(file) if unpack else file, budget) as reader:
            content = reader.read()
    if not content:
        raise WearcapError("the file is empty", path)
    try:
        value = _Unpickler(content, budget).load()
        _require_plain(value, budget)
        return value
    except _RefusedError as error:
        fix = "Anything else in a pickle can run code when it is loaded, and is never read."
        raise WearcapError(str(error), path, "numbers, text, lists, dicts and NumPy arrays only", fix) from error
    except WearcapError:
        raise
    except Exception as error:  # the opcodes are the file's own program and can raise anything
        what = f"a damaged pickle ({type(error).__name__}: {error})"[:300]
        raise WearcapError(what, path, "a whole pickle file", "Fetch it again.") from error


def read_pickled_dict(path: str | Path, expected: str) -> dict[Any, Any]:
    """A pickle's dict. Raises WearcapError as `read_pickle` does, and naming `expected` for a file that holds something else."""
    content = read_pickle(path)
    if not isinstance(content, dict):
        raise WearcapError(f"it holds a {type(content).__name__}", path, expected)
    return content


class _RefusedError(Exception):
    """Raised for content that is never admitted."""


class _Inflated(io.BufferedIOBase):
    """Decompressed content of a zlib stream."""

    def __init__(self, file: io.BufferedIOBase):
        self._file, self._unpacker, self._rest = file, zlib.decompressobj(), b""

    def read(self, size: int | None = -1, /) -> bytes:
        assert size
        while not self._unpacker.eof:
            packed = self._rest or self._file.read(1 << 16)
            content = self._unpacker.decompress(packed, size)
            self._rest = self._unpacker.unconsumed_tail
            if content or not packed:
                return content
        return b""


_PACKERS: dict[bytes, Callable[[Any], Any]] = {
    b"\x1f\x8b": gzip.open,
    b"BZ": bz2.open,
    b"\xfd7": lzma.open,
    b"x": _Inflated,
}
"""What unpacks a file, by its first bytes."""


def _require_plain(value: Any, budget: Budget) -> None:
    """Raise for half-built objects, for names that were never called, and for structures that unfold without end.

    A list may be contained in many others, or in itself: it counts as often as it is reached.
    """
    level, count = [value], 0
    for _ in range(budget.limits.depth):
        inner: list[Any] = []
        for item in level:
            if isinstance(item, list | tuple | dict):
                budget.count(count := count + len(item), "items")
                inner += [*item.keys(), *item.values()] if isinstance(item, dict) else item
            elif not isinstance(item, (*_ADMITTED, np.ndarray)):
                raise _RefusedError(f"it holds a {getattr(item, '__name__', type(item).__name__)}")
        if not inner:
            return
        level = inner
    raise _RefusedError(f"it holds lists within lists, {budget.limits.depth} deep")


class _NdarrayName:
    """The name numpy.ndarray, which is only ever an argument."""


class _JoblibArray:
    """joblib's NumpyArrayWrapper: the bytes of the array follow it in the file."""


def _dtype(code: Any, align: Any = False, copy: Any = True) -> np.dtype:
    if not isinstance(code, str) or not _DTYPE.fullmatch(code):
        raise _RefusedError(f"it holds an array of type {str(code)[:40]!r}")
    return np.dtype(code, copy=True)


def _encode(text: str, encoding: str = "latin1") -> bytes:
    if encoding != "latin1":
        raise _RefusedError(f"it holds bytes encoded as {encoding!r}")
    return text.encode("latin1")


def _checked(buffer: Any, dtype: Any, shape: Any) -> tuple[bytes, tuple[int, ...]]:
    """Bytes and shape of an array, checked to fit together."""
    data = buffer.encode("latin1") if isinstance(buffer, str) else buffer
    shape = (shape,) if isinstance(shape, int) else tuple(shape)
    if not isinstance(dtype, np.dtype) or dtype.hasobject or any(length < 0 for length in shape):
        raise ValueError("an array without a numeric type and shape")
    if not isinstance(data, bytes | bytearray) or math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError(f"an array of shape {shape} from other bytes")
    return bytes(data), shape


def _array(buffer: Any, dtype: Any, shape: Any, order: str = "C") -> np.ndarray:
    data, shape = _checked(buffer, dtype, shape)
    array = np.frombuffer(data, dtype) if data else np.zeros(0, dtype)
    return array.reshape(shape, order="F" if order == "F" else "C").copy(order="C")


def _empty_array(subtype: Any, shape: Any, code: Any) -> np.ndarray:
    """numpy's _reconstruct: an empty array that a BUILD opcode fills."""
    if subtype is not _NdarrayName:
        raise _RefusedError("it holds a subclass of numpy.ndarray")
    return np.ndarray((0,), np.int8)


def _no_bytes(*arguments: Any) -> bytes:
    if arguments:
        raise _RefusedError("it calls builtins.bytes")
    return b""


_NUMPY = {"dtype": _dtype, "ndarray": _NdarrayName}
_MULTIARRAY = {"_reconstruct": _empty_array, "scalar": lambda dtype, data: _array(data, dtype, (1,))[0]}
_NAMES: dict[str, dict[str, Any]] = {
    "numpy": _NUMPY,
    "numpy.core.multiarray": _MULTIARRAY,
    "numpy._core.multiarray": _MULTIARRAY,
    "numpy.core.numeric": {"_frombuffer": _array},
    "numpy._core.numeric": {"_frombuffer": _array},
    "_codecs": {"encode": _encode},
    "builtins": {"bytes": _no_bytes},
    "__builtin__": {"bytes": _no_bytes},
    "joblib.numpy_pickle": {"NumpyArrayWrapper": _JoblibArray},
}


_PythonUnpickler: Any = getattr(pickle, "_Unpickler")  # noqa: B009
"""Unpickler in pure Python, whose opcodes can be replaced one by one."""


def _stepping(load: Callable[[Any], None]) -> Callable[[Any], None]:
    """An opcode's function that counts its calls: each may put an object of a hundred bytes into memory."""

    def step(self: Any) -> None:
        self.steps += 1
        self.budget.count(self.steps, "steps")
        load(self)

    return step


class _Unpickler(_PythonUnpickler):
    dispatch: ClassVar[dict[int, Any]] = dict(_PythonUnpickler.dispatch)

    def __init__(self, content: bytes, budget: Budget):
        self._source, self.steps, self.budget = io.BytesIO(content), 0, budget
        super().__init__(self._source, encoding="latin1")

    def find_class(self, module: str, name: str) -> Any:
        found = _NAMES.get(module, {}).get(name)
        if found is None:
            raise _RefusedError(f"it names {module}.{name}")
        return found

    def load_bytearray(self) -> None:
        """As bytes, of which no more are there than the file has: Python's own takes the memory first."""
        self.load_binbytes8()
        self.stack[-1] = bytearray(self.stack[-1])

    def persistent_load(self, pid: Any) -> Any:
        raise _RefusedError("it refers to objects outside the file")

    def load_build(self) -> None:
        """Set the state of an array or a dtype; nothing else has one here."""
        state = self.stack.pop()
        target = self.stack[-1]
        if isinstance(target, np.ndarray):
            _, shape, dtype, fortran, data = state
            data, shape = _checked(data, dtype, shape)
            target.__setstate__((1, shape, dtype, bool(fortran), data))
        elif isinstance(target, np.dtype):
            self.set_byte_order(target, state)
        elif isinstance(target, _JoblibArray):
            self.stack[-1] = self.joblib_array(state)
        else:
            raise _RefusedError(f"it gives a state to a {type(target).__name__}")

    def set_byte_order(self, dtype: np.dtype, state: tuple) -> None:
        order, parts = state[1], state[2:5]
        if order not in ("<", ">", "|", "=") or any(part is not None for part in parts) or dtype.isbuiltin == 1:
            raise _RefusedError("it holds an array of structures")
        # Sizes matter for text alone; numbers have fixed ones.
        sizes = (dtype.itemsize, dtype.alignment) if dtype.kind in "SU" else (-1, -1)
        dtype.__setstate__((3, order, None, None, None, *sizes, 0))  # pyright: ignore[reportAttributeAccessIssue]

    def joblib_array(self, state: dict[str, Any]) -> np.ndarray:
        dtype, shape = state["dtype"], tuple(state["shape"])
        if not isinstance(dtype, np.dtype) or state["subclass"] is not _NdarrayName:
            raise _RefusedError("it holds a subclass of numpy.ndarray")
        if state.get("numpy_array_alignment_bytes") is not None:
            self._source.read(self._source.read(1)[0])
        data = self._source.read(max(0, math.prod(shape) * dtype.itemsize))
        if state["order"] == "F":
            return _array(data, dtype, shape[::-1]).T.copy()
        return _array(data, dtype, shape)

    dispatch[pickle.BUILD[0]] = load_build
    dispatch[pickle.BYTEARRAY8[0]] = load_bytearray
    dispatch = {opcode: _stepping(load) for opcode, load in dispatch.items()}
