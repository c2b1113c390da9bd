"""Damage for valid files: bits, bytes, lines, words, numbers, nesting, and the parts of formats that have a structure."""

import ast
import copy
import gzip
import io
import json
import lzma
import pickle
import pickletools
import random
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress

import yaml

NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
VALUES = [
    b"0",
    b"-1",
    b"1",
    b"1e308",
    b"-1e308",
    b"nan",
    b"inf",
    b"-inf",
    b"2147483648",
    b"9223372036854775808",
    b"1000000000000",
    b"1e-320",
    b"0.5",
    b"9" * 400,
    b"",
    b"null",
    b'"a"',
    b"[]",
    b"{}",
    b"true",
]
WHOLE = [0, 1, -1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 10**12, 255, 65536]
FLOATS = [float("nan"), float("inf"), 1e308, -1.0, 0.0, 1e-320]
JUNK = [
    b"\0",
    b"\xff\xfe",
    b"{",
    b"}",
    b"[" * 100_000,
    b'{"a":' * 100_000,
    b"<a>" * 20_000,
    b"A" * 200_000,
    b"- " * 3000,
    b"&a;",
    b"\n",
    b",",
    b'"',
    b"#",
    b"(" * 5000,
    b"end\n",
    b" 7" * 5000,
]


JSON_VALUES = [
    *(None, True, False, 0, -1, 1, 0.5, -0.0, 1e308, 1e-320, float("nan"), float("inf"), float("-inf")),
    *(2**31, -(2**31) - 1, 2**53 + 1, 2**63, -(2**63), 2**64, 10**30, 10**400, "", "a", "nan", "1e999", "0", "\0", "é" * 300),
    *("\ud800", "../a", "/etc/passwd", "A" * 200_000, "a/" * 2000, "__proto__", "_target_", "F64", "BF16", "F8_E4M3", "I8"),
    *([], {}, [0], [0] * 3, [[0.0] * 3] * 3, [None] * 5, ["a", "b"], [1] * 20_000, {"a": 1}, {"": []}, [{}], [[], [1]]),
]  # fmt: skip
"""Values that a reader of JSON may meet where it expects another."""
_TWICE = "\0twice"
"""Ends a key that is written without it: JSON texts may have the same key twice."""
YAML_LINES = [
    *("a: &a [*a]", "b: &b {x: 1}\nc: *b", "<<: {a: 1}", "!!python/object/apply:os.system [true]", "? [a]\n: b", "---"),
    *("!!binary x", "d: !!binary eA==", "e: 2001-01-01", "f: !!set {a, b}", "g: !!float x", "h: 1e400", "i: .nan", "j: 0b1"),
    *("k: 1_000", "l: 190:20:30", "m: |\n  x\n y", "n: 'x", "o: [1, 2", "%TAG ! tag:x,2000:", "p: !x y", "\tq: 1", "1: 2", "~: 1"),
    *("null", "- a", "r: !!timestamp 9999-99-99", "[a]: 1", "{a: 1}: 2", "s: " + "[" * 300, "t: ${u}", "u: !!omap [a: 1, a: 2]"),
]  # fmt: skip
"""Lines of YAML with what plain settings lack: references, tags, other types, keys that are no names, wrong indents."""
DTYPES = ["<f8", ">f4", "<f2", "<i8", "<u1", "|b1", "<c16", "|O", "|V8", "<M8[ns]", "<U3", "|S0", "<U999999999", "", "f4,i4", "x"]  # fmt: skip
SHAPES = ["()", "(0,)", "(-1,)", "(1,)", "(1 << 40,)", "(1099511627776,)", "(3, 4)", "(1,) * 40", "(2.0,)", "None", "(0, 99999999999)"]  # fmt: skip
TENSORS = ["F64", "F32", "F16", "BF16", "I64", "I32", "I8", "U8", "BOOL", "F8_E4M3", "F4", "C64", "f32", ""]  # fmt: skip
OPCODES = [code.code.encode("latin-1") for code in pickletools.opcodes]


def mutated(content: bytes, other: bytes, seed: random.Random) -> bytes:
    """Damage done to a file's parts, where they are known, or to its bytes, or both; `other` is what is spliced in."""
    if seed.random() < 0.7:
        found = None
        with suppress(*_NO_SUCH):
            found = _structured(content, other, seed)
        if found is not None and seed.random() < 0.9:
            return found
        content = content if found is None else found
    for _ in range(seed.choice((1, 1, 1, 2, 3, 6))):
        content = seed.choice(_ALL)(content, seed) if seed.random() < 0.95 else _splice(content, other, seed)
    return content


_NO_SUCH = (
    ValueError,
    LookupError,
    EOFError,
    RecursionError,
    struct.error,
    zlib.error,
    lzma.LZMAError,
    zipfile.BadZipFile,
)
_NO_SUCH += (OSError, yaml.YAMLError, TypeError, AttributeError, SyntaxError, OverflowError, NotImplementedError)
"""Exceptions of taking apart what is not of the format that it begins like."""


def _structured(content: bytes, other: bytes, seed: random.Random) -> bytes | None:
    """The file with another structure, or damaged content in a sound one; None where none is known."""
    begin = content[:8]
    if begin[:2] == b"\x1f\x8b":
        return gzip.compress(mutated(gzip.decompress(content), other, seed), 1, mtime=0)
    if begin[:6] == b"\xfd7zXZ\0":
        return lzma.compress(mutated(lzma.decompress(content), other, seed), preset=0)
    if begin[:1] == b"x" and begin[1:2] in b"\x01\x5e\x9c\xda":
        return zlib.compress(mutated(zlib.decompress(content), other, seed), 1)
    if begin[:4] == b"PK\3\4":
        return _zip(content, other, seed)
    if begin[:4] == b"glTF":
        return _glb(content, other, seed)
    if begin[:6] == b"\x93NUMPY":
        return _npy(content, other, seed)
    if begin[4:] == b"ftyp":
        return _boxes(content, seed)
    if begin[:1] == b"\x80" and begin[1:2] in b"\2\3\4\5":
        return _pickle(content, seed)
    if content[8:9] == b"{" and int.from_bytes(begin, "little") < len(content):
        return _safetensors(content, other, seed)
    if content.lstrip()[:1] in (b"{", b"["):
        return _json(content, seed)
    if len(content) < 20_000 and re.match(rb"(#.*\n|---\n|\s)*[\w.-]+:( |\n)", content):
        return _yaml(content, seed)
    return None


# --- formats --------------------------------------------------------------------------------------------------------


def _zip(content: bytes, other: bytes, seed: random.Random) -> bytes:
    """An archive whose entries are damaged, renamed, twice there, left out, swapped or packed otherwise, or whose records are."""
    kind = seed.random()
    if kind < 0.15:
        return _zip_records(content, seed)
    if kind < 0.2:  # two archives, or two end records
        end = content[content.rindex(b"PK\5\6") :]
        return content + seed.choice((content, end, end[:10] + bytes(12)))
    stream = io.BytesIO()
    packing = seed.choice((0, 8)) if seed.random() < 0.9 else seed.choice((12, 14))
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(stream, "w") as new:
        entries = [[info.filename, old.read(info)] for info in old.infolist()]
        entry, second = seed.choice(entries), seed.choice(entries)
        match seed.randrange(12):
            case 0:
                entry[0] = seed.choice(
                    ("", "../a", "/a", "a\0b", "é" * 200, entry[0] + "/", entry[0].upper(), second[0])
                )
            case 1:
                entries.remove(entry)
            case 2:
                entries.append([entry[0], mutated(entry[1], second[1], seed)])
            case 3:
                entry[1], second[1] = second[1], entry[1]
            case 4:
                entries += [[f"{entry[0]}{k}", b""] for k in range(seed.choice((1, 300)))]
            case 5:
                entry[1] = bytes(1 << seed.choice((0, *[16] * 8, 20, 25)))  # packs to a thousandth
            case _:
                entry[1] = mutated(entry[1], second[1] if seed.random() < 0.5 else other, seed)
        with warnings.catch_warnings(action="ignore"):
            for name, inner in entries:
                new.writestr(zipfile.ZipInfo(name), inner, packing, 1)
    return stream.getvalue()


def _zip_records(content: bytes, seed: random.Random) -> bytes:
    """A field of one of the records changed: of an entry, of the directory, or of its end."""
    record, fields = seed.choice(((b"PK\3\4", 26), (b"PK\1\2", 42), (b"PK\5\6", 18)))
    places = [found.start() for found in re.finditer(re.escape(record), content)]
    place, size = seed.choice(places) + 4 + 2 * seed.randrange(fields // 2), seed.choice((2, 4))
    old = int.from_bytes(content[place : place + size], "little")
    value = seed.choice((*WHOLE, old + 1, old - 1, 2 * old, old ^ 1, old ^ 8)) % (1 << 8 * size)
    return content[:place] + value.to_bytes(size, "little") + content[place + size :]


def _safetensors(content: bytes, other: bytes, seed: random.Random) -> bytes:
    """Another header length, header, description in its metadata, entry, or other numbers."""
    length = int.from_bytes(content[:8], "little")
    header, data = json.loads(content[8 : 8 + length]), content[8 + length :]
    names = [name for name in header if name != "__metadata__"]
    entry = header[seed.choice(names)] if names else {}
    match seed.randrange(8):
        case 0:
            length = seed.choice((*WHOLE, length + 1, length - 1, len(content) - 8, len(content))) % (1 << 64)
            return length.to_bytes(8, "little") + content[8:]
        case 1 | 2 | 3 if header.get("__metadata__"):
            about = header["__metadata__"]
            key = seed.choice(list(about))
            with suppress(ValueError):
                about[key] = _json(about[key].encode(), seed).decode("utf-8", "surrogatepass")
        case 4:
            text = _json(json.dumps(header).encode(), seed)
            return len(text).to_bytes(8, "little") + text + data
        case 5:
            width = {"8": 8, "4": 4, "2": 2}.get(entry["dtype"][-2:-1], 1)
            same = [name for name in TENSORS if {"6": 8, "3": 4, "1": 2}.get(name[1:2], 1) == width]
            entry["dtype"] = seed.choice(same if same and seed.random() < 0.7 else TENSORS)
        case 6:  # the same numbers laid out otherwise, or not
            shapes = (
                entry["shape"][::-1],
                [1, *entry["shape"]],
                [*entry["shape"], 1],
                entry["shape"][1:],
                [0],
                [],
                [1 << 62, 4],
            )
            entry["shape"] = seed.choice(shapes)
        case 7 if seed.random() < 0.3:
            first, second = (header[seed.choice(names)] for _ in range(2))
            first["data_offsets"], second["data_offsets"] = second["data_offsets"], first["data_offsets"]
        case _:
            place = seed.randrange(len(data) // 8 + 1) * 8
            value = (
                struct.pack(seed.choice(("<d", "<ff"))[:2], seed.choice(FLOATS[:2])) if seed.random() < 0.5 else None
            )
            value = value or (seed.choice(WHOLE) % (1 << 64)).to_bytes(8, "little")
            data = data[:place] + value + data[place + len(value) :]
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


def _json(content: bytes, seed: random.Random) -> bytes:
    """JSON with other values, keys and nesting."""
    tree = [json.loads(content)]
    for _ in range(seed.choice((1, 1, 1, 2, 4))):
        _change(tree, seed)
    text = json.dumps(tree[0], default=str, separators=seed.choice(((",", ":"), (", ", ": "))))
    return text.replace(json.dumps(_TWICE)[1:], '"').encode()


def _change(tree: list, seed: random.Random) -> None:
    """Change one value of a tree of lists and dictionaries, below its root (the one value of the outermost list)."""
    box, at = tree, 0
    while isinstance(box[at], list | dict) and box[at] and seed.random() < 0.85:
        box = box[at]
        at = seed.choice(list(box)) if isinstance(box, dict) else seed.randrange(len(box))
    value, other = box[at], copy.deepcopy(seed.choice(JSON_VALUES))
    if isinstance(value, str) and value[:1] in ("{", "["):  # JSON in JSON
        with suppress(ValueError):
            box[at] = _json(value.encode(), seed).decode()
            return
    match seed.randrange(9):
        case 0 if box is not tree:
            del box[at]
        case 1 if isinstance(box, dict):
            box[str(at) + _TWICE] = seed.choice((value, other))
        case 1 | 2 if isinstance(box, list) and box is not tree:
            box[at:at] = [value] * seed.choice((1, 1, 50))
        case 2 if isinstance(box, dict):
            box[seed.choice(("", "a", "_target_", "name", str(at) + " ", "A" * 3000))] = other
        case 3:
            for _ in range(seed.choice((1, 2, 70, 900))):
                value = [value] if seed.random() < 0.5 else {"a": value}
            box[at] = value
        case 4:
            box[at] = box[seed.choice(list(box))] if isinstance(box, dict) else seed.choice(box)
        case 5 if isinstance(value, int | float):
            box[at] = seed.choice((-value, value + 1, 2 * value, value * 1e6, value / 1e9, str(value), float(value)))
        case 5 if isinstance(value, list | dict):
            box[at] = list(value) if isinstance(value, dict) else {str(k): one for k, one in enumerate(value)}
        case _:
            box[at] = other


def _yaml(content: bytes, seed: random.Random) -> bytes:
    """YAML with other values, or with lines that plain settings lack."""
    if seed.random() < 0.5:
        tree = [yaml.safe_load(content)]
        _change(tree, seed)
        return json.dumps(tree[0], default=str).encode() if seed.random() < 0.5 else yaml.safe_dump(tree[0]).encode()
    lines = content.decode().split("\n")
    at = seed.randrange(len(lines))
    indent = lines[at][: len(lines[at]) - len(lines[at].lstrip())]
    new = seed.choice(YAML_LINES)
    if seed.random() < 0.5:
        lines.insert(at, indent + new)
    else:
        lines[at] = lines[at].partition(":")[0] + ": " + new.partition(": ")[2]
    return "\n".join(lines).encode()


def _glb(content: bytes, other: bytes, seed: random.Random) -> bytes:
    """A binary glTF with another description, other lengths, or chunks twice or not there."""
    chunks, place = [], 12
    while place < len(content):
        length, kind = struct.unpack_from("<I4s", content, place)
        chunks.append([length, kind, content[place + 8 : place + 8 + length]])
        place += 8 + length
    chunk = seed.choice(chunks)
    match seed.randrange(8):
        case 0:
            chunk[0] = seed.choice((*WHOLE, chunk[0] + 1, chunk[0] - 4)) % (1 << 32)
        case 1:
            chunks.insert(0, chunk)
        case 2:
            chunks.remove(chunk)
        case _:
            chunk[2] = _json(chunk[2], seed) if chunk[1] == b"JSON" else mutated(chunk[2], other, seed)
            chunk[2] += b" " * (-len(chunk[2]) % 4)
            chunk[0] = len(chunk[2])
    body = b"".join(struct.pack("<I4s", length, kind) + data for length, kind, data in chunks)
    return struct.pack("<4sII", b"glTF", seed.choice((2, 2, 2, 2, 1)), 12 + len(body)) + body


def _npy(content: bytes, other: bytes, seed: random.Random) -> bytes:
    """An array of another type, shape or order, or with other bytes."""
    length = int.from_bytes(content[8:10], "little")
    header, data = ast.literal_eval(content[10 : 10 + length].decode("latin-1")), content[10 + length :]
    if (kind := seed.randrange(6)) == 0:
        place = seed.randrange(len(data) // 8 + 1) * 8
        data = data[:place] + struct.pack("<d", seed.choice(FLOATS)) + data[place + 8 :]
    shape = header["shape"]
    turned = (shape[::-1], (1, *shape), (*shape, 1), (*shape[1:], *shape[:1]), shape[1:], (0, *shape[1:]))
    new_shape = str(seed.choice(turned)) if seed.random() < 0.7 else seed.choice(SHAPES)
    descr = "<" + seed.choice("fiuc") + str(header["descr"])[2:] if seed.random() < 0.5 else seed.choice(DTYPES)
    parts = {
        "descr": repr(descr if kind == 1 else header["descr"]),
        "fortran_order": str(header["fortran_order"] ^ (kind == 2)),
        "shape": new_shape if kind in (3, 4) else str(shape),
    }
    text = "{" + ", ".join(f"'{key}': {value}" for key, value in parts.items()) + "}"
    if kind == 5:
        text = mutated(text.encode(), other, seed).decode("latin-1")[:60_000]
    head = text.encode("latin-1").ljust(117) + b"\n"
    return content[:8] + len(head).to_bytes(2, "little") + head + data


def _pickle(content: bytes, seed: random.Random) -> bytes:
    """A pickle with instructions twice, left out, moved, of another kind or with another argument."""
    places = [place for _, _, place in pickletools.genops(content)]
    codes = [content[a:b] for a, b in zip(places, [*places[1:], None])]
    for _ in range(seed.choice((1, 1, 2))):
        at, second = seed.randrange(len(codes)), seed.randrange(len(codes))
        match seed.randrange(7):
            case 0:
                del codes[at]
            case 1:
                codes.insert(at, codes[second])
            case 2:
                codes[at], codes[second] = codes[second], codes[at]
            case 3:
                codes.insert(at, seed.choice(OPCODES) + seed.choice((b"", b"\0", b"\1\0\0\0", b"\xff" * 4)))
            case 4:
                codes[at] = pickle.dumps(seed.choice(JSON_VALUES), seed.choice((0, 2, 4)))[:-1].removeprefix(b"\x80\4")
            case 5:
                codes.insert(
                    at, seed.choice((b"cos\nsystem\n", b"cnumpy\nndarray\n", b"cbuiltins\neval\n", b"R", b"b", b"\x93"))
                )
            case _:
                codes[at] = codes[at][:1] + _whole(codes[at][1:], seed)
        codes = codes or [b"."]
    return b"".join(codes)


def _boxes(content: bytes, seed: random.Random) -> bytes:
    """An MP4 with a box of another size, kind or content, twice or not there."""
    found, waiting = [], [(0, len(content))]
    while waiting:
        place, end = waiting.pop()
        while place + 8 <= end:
            size = int.from_bytes(content[place : place + 4], "big")
            if not 8 <= size <= end - place:
                break
            found.append((place, size))
            if content[place + 4 : place + 8] in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"udta"):
                waiting.append((place + 8, place + size))
            place += size
    place, size = seed.choice(found)
    box, after = content[place : place + size], content[place + size :]
    number = seed.choice((*WHOLE, size + 1, size - 1, 7)) % (1 << 32)
    match seed.randrange(6):
        case 0:
            box = number.to_bytes(4, "big") + box[4:]
        case 1:
            box = box[:4] + seed.choice((b"free", b"moov", b"stsz", b"uuid", b"mdat", b"\0\0\0\0")) + box[8:]
        case 2:
            box = b""
        case 3:
            box = box * 2
        case _:  # counts and times are whole numbers of four bytes
            at = 8 + 4 * seed.randrange(max(1, min(size - 8, 80) // 4))
            box = box[:at] + number.to_bytes(4, "big") + box[at + 4 :]
    return content[:place] + box + after


# --- bytes ----------------------------------------------------------------------------------------------------------


def _flip(content: bytes, seed: random.Random) -> bytes:
    damaged = bytearray(content)
    for _ in range(seed.choice((1, 2, 8))):
        if damaged:
            damaged[_place(content, seed)] ^= 1 << seed.randrange(8)
    return bytes(damaged)


def _place(content: bytes, seed: random.Random) -> int:
    """Anywhere, in half of the cases near the beginning, where headers stand."""
    last = max(len(content) - 1, 0)
    return seed.randint(0, min(last, 400) if seed.random() < 0.5 else last)


def _run(content: bytes, seed: random.Random) -> bytes:
    place, length = _place(content, seed), seed.choice((1, 4, 16, 300))
    new = seed.choice((bytes(length), b"\xff" * length, seed.randbytes(length)))
    return content[:place] + new + content[place + length :]


def _cut(content: bytes, seed: random.Random) -> bytes:
    return content[: _place(content, seed)]


def _drop(content: bytes, seed: random.Random) -> bytes:
    place = _place(content, seed)
    return content[:place] + content[place + seed.choice((1, 2, 8, 500)) :]


def _again(content: bytes, seed: random.Random) -> bytes:
    a, b = sorted((_place(content, seed), _place(content, seed)))
    return content[:b] + content[a : min(b, a + 5000)] * seed.choice((1, 1, 20)) + content[b:]


def _junk(content: bytes, seed: random.Random) -> bytes:
    place = _place(content, seed)
    return content[:place] + seed.choice(JUNK) + content[place:]


def _whole(content: bytes, seed: random.Random) -> bytes:
    """A binary number replaced."""
    form = seed.choice("<>") + seed.choice("bhiqfd")
    if form[1] in "fd":
        value = seed.choice(FLOATS)
        packed = struct.pack(form, value if form[1] == "d" or abs(value) < 1e30 else float("inf"))
    else:
        size = struct.calcsize(form)
        packed = (seed.choice(WHOLE) % (1 << 8 * size)).to_bytes(size, "little" if form[0] == "<" else "big")
    place = _place(content, seed)
    return content[:place] + packed + content[place + len(packed) :]


def _number(content: bytes, seed: random.Random) -> bytes:
    """A number written in text replaced: the next one from some place on."""
    found = NUMBER.search(content, _place(content, seed)) or NUMBER.search(content)
    if found is None:
        return _whole(content, seed)
    return content[: found.start()] + seed.choice(VALUES) + content[found.end() :]


def _parts(separators: bytes) -> Callable[[bytes, random.Random], bytes]:
    """Parts between separators deleted, doubled or swapped."""

    def damage(content: bytes, seed: random.Random) -> bytes:
        separator = separators[seed.randrange(len(separators)) :][:1]
        parts = content.split(separator)
        a, b = seed.randrange(min(len(parts), 40)), seed.randrange(len(parts))
        match seed.randrange(4):
            case 0:
                del parts[b]
            case 1:
                parts.insert(a, parts[b])
            case 2:
                parts[a], parts[b] = parts[b], parts[a]
            case _:
                parts[a : a + 2] = [b"".join(parts[a : a + 2])]
        return separator.join(parts)

    return damage


def _splice(content: bytes, other: bytes, seed: random.Random) -> bytes:
    return content[: _place(content, seed)] + other[_place(other, seed) :]


_ALL = (_flip, _run, _cut, _drop, _again, _junk, _whole, _number, _number, _number, _parts(b"\n"), _parts(b" ,:<"))
