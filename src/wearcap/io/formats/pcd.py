"""PCD point clouds (ASCII, binary, binary_compressed): x y z and, where there are any, colours."""

import io
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from wearcap.boundary.limits import LIMITS
from wearcap.boundary.opening import read_bytes, understood
from wearcap.errors import WearcapError
from wearcap.io.formats.csv_table import load_rows
from wearcap.io.formats.ply import Ply

_HEADER = LIMITS["header"]
_TYPES = {("F", 4): "<f4", ("F", 8): "<f8"} | {
    (kind, size): f"<{letter}{size}" for kind, letter in (("I", "i"), ("U", "u")) for size in (1, 2, 4, 8)
}


def read_pcd(path: str | Path, origin: Sequence[float] = (0.0, 0.0, 0.0)) -> Ply:
    """Points of a PCD file (in the file's unit and axes); points that are NaN, PCL's "no return", are left out.

    `origin` is taken off before they become float32. Raises WearcapError when it is no PCD, is cut short, has no x y z, or its compressed data is damaged.
    """
    data = read_bytes(path)
    header, body = _parse_header(data, path)
    counts = header.get("COUNT", ["1"] * len(header["FIELDS"]))
    fields = []
    with understood("its header cannot be understood", path, "a SIZE, TYPE and COUNT for every field"):
        for i, name in enumerate(header["FIELDS"]):
            letter = _TYPES.get((header["TYPE"][i], int(header["SIZE"][i])))
            if letter is None:
                raise ValueError(f"TYPE {header['TYPE'][i]} of SIZE {header['SIZE'][i]}"[:60])
            if not 0 < int(counts[i]) <= _HEADER.items or (name in ("x", "y", "z") and int(counts[i]) != 1):
                raise ValueError(f"COUNT {counts[i]} of {name}"[:60])
            shape = (int(counts[i]),) if int(counts[i]) != 1 else ()
            fields.append((f"_padding{i}" if name == "_" else name, letter, shape))
        if not {"x", "y", "z"} <= {name for name, _, _ in fields}:
            raise WearcapError("no fields x, y, z", path, "a point cloud")
        dtype = np.dtype(fields)
    count = int(header["POINTS"][0])
    encoding = header["DATA"][0]
    if encoding == "ascii":
        text = io.TextIOWrapper(io.BytesIO(memoryview(data)[body:]), "ascii", errors="replace", newline="\n")
        lines = islice((line for line in text if line.strip()), count)
        with np.errstate(over="ignore", invalid="ignore"):
            rows = load_rows(lines, "a row does not match the header", path, dtype=dtype, ndmin=1, comments=None)
        _require(len(rows) == count, path)
    elif encoding == "binary":
        _require(len(data) - body >= count * dtype.itemsize, path)
        rows = np.frombuffer(data, dtype, count, body)
    elif encoding == "binary_compressed":
        packed = memoryview(data)[body:]
        _require(len(packed) >= 8, path)
        compressed, size = (int(v) for v in np.frombuffer(packed, "<u4", 2))
        _require(len(packed) >= 8 + compressed and size == count * dtype.itemsize, path)
        with understood("its compressed data is damaged", path, fix="Copy the file again.", errors=ValueError):
            plain = _lzf_decompressed(packed[8 : 8 + compressed], size)
        rows, start = np.empty(count, dtype), 0  # decompressed, each field's values are contiguous
        for name in dtype.names or ():
            rows[name] = np.frombuffer(plain, dtype[name], count, start)
            start += count * dtype[name].itemsize
    else:
        raise WearcapError(f"DATA {encoding}", path, "ascii, binary or binary_compressed")
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite and is dropped
        points = np.stack([(rows[axis] - off).astype(np.float32) for axis, off in zip("xyz", origin)], 1)
    valid = np.isfinite(points).all(1)
    colors = None
    for name in ("rgba", "rgb"):
        if name in (dtype.names or ()) and dtype[name].itemsize == 4:
            bits = np.ascontiguousarray(rows[name]).view("<u4")  # PCL packs 0x00RRGGBB into a float or whole number
            colors = (np.stack([bits >> 16, bits >> 8, bits], 1) & 255).astype(np.uint8)[valid]
    return Ply(points[valid], colors)


def _parse_header(data: bytes, path: str | Path) -> tuple[dict[str, list[str]], int]:
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        stop = data.find(b"\n", start, _HEADER.bytes)
        if stop < 0:
            raise WearcapError("not a PCD file, or its header is cut short", path, "lines up to `DATA`")
        words = data[start:stop].decode("ascii", errors="replace").split("#")[0].split()
        if words:
            header[words[0]] = words[1:] or [""]
        start = stop + 1
    missing = {"FIELDS", "SIZE", "TYPE", "POINTS"} - set(header)
    if missing or not (header["POINTS"][0].isdecimal() and len(header["POINTS"][0]) < 15):
        what = f"its header lacks {', '.join(sorted(missing)) or 'a count of points'}"
        raise WearcapError(what, path, "a PCD 0.7 header")
    return header, start


def _require(complete: bool, path: str | Path) -> None:
    if not complete:
        what = "it holds fewer points than its header states"
        raise WearcapError(what, path, fix="The file was cut short: copy it again.")


def _lzf_decompressed(data: bytes | memoryview, size: int) -> bytes:
    """Undo LZF: literal runs and back references. Raises ValueError when the data does not give `size` bytes."""
    out = bytearray()
    i = 0
    try:
        while i < len(data) and len(out) <= size:
            control = data[i]
            i += 1
            if control < 32:
                out += data[i : i + control + 1]
                i += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[i]
                i += 1
            start = len(out) - ((control & 31) << 8) - data[i] - 1
            i += 1
            if start < 0:
                raise ValueError("a reference before the beginning")
            length += 2
            chunk = out[start : start + length]
            out += (chunk * (length // len(chunk) + 1))[:length]  # a reference may run into what it writes
    except IndexError as error:
        raise ValueError("cut short") from error
    if len(out) != size:
        raise ValueError(f"{len(out)} bytes instead of {size}")
    return bytes(out)
