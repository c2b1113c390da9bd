"""Damage for valid files: bits, bytes, lines, words, numbers, nesting, and what is packed inside."""

import gzip
import io
import lzma
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable

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


def mutated(content: bytes, other: bytes, seed: random.Random) -> bytes:
    """Damage done to a file's bytes, now and then to what is packed in it; `other` is what is spliced in."""
    if seed.random() < 0.6:
        inside = _inside(content, other, seed)
        if inside is not None:
            return inside
    for _ in range(seed.choice((1, 1, 1, 2, 3, 6))):
        content = seed.choice(_ALL)(content, seed) if seed.random() < 0.95 else _splice(content, other, seed)
    return content


def _inside(content: bytes, other: bytes, seed: random.Random) -> bytes | None:
    """The file with damaged content under sound packing; None where nothing is packed."""
    if content[:2] == b"\x1f\x8b":
        return gzip.compress(mutated(gzip.decompress(content), other, seed), 1)
    if content[:6] == b"\xfd7zXZ\0":
        return lzma.compress(mutated(lzma.decompress(content), other, seed), preset=0)
    if content[:1] == b"x" and content[1:2] in b"\x01\x5e\x9c\xda":
        return zlib.compress(mutated(zlib.decompress(content), other, seed), 1)
    if content[:4] != b"PK\3\4":
        return None
    stream = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(content)) as old,
        zipfile.ZipFile(stream, "w", seed.choice((0, 8)), compresslevel=1) as new,
    ):
        members = old.infolist()
        chosen = seed.randrange(len(members))
        for number, info in enumerate(members):
            inner = old.read(info)
            if number == chosen and seed.random() < 0.05:
                continue
            new.writestr(info.filename, mutated(inner, other, seed) if number == chosen else inner)
    return stream.getvalue()


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
