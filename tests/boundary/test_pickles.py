"""The restricted unpickler: what it admits, in every protocol and in joblib's files, and that nothing else runs."""

import collections
import io
import os
import pickle
import struct
import tracemalloc
from fractions import Fraction

import joblib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hostile import fuzz, mutated_bytes
from wearcap.boundary.pickles import read_pickle
from wearcap.errors import WearcapError

VALUE = {
    "seq_name": "sub1_largebox_000",
    "poses": np.arange(24, dtype=np.float64).reshape(4, 6),
    "transes": np.asfortranarray(np.arange(12, dtype=np.float32).reshape(4, 3)),
    "contacts": np.array([True, False]),
    "names": np.array(["a", "béta"]),
    "big": np.arange(3, dtype=">i4"),
    "empty": np.zeros((0, 3)),
    "scale": np.float32(1.5),
    "list": [1, 2.5, None, True, b"raw", b"", (3, "x"), 10**30],
}


def save(path, content: bytes):
    path.write_bytes(content)
    return path


def same(a, b) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.shape == b.shape and bool((a == b).all())
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    return type(a) is type(b) and a == b


@pytest.mark.parametrize("protocol", range(6))
def test_plain_data_comes_back(tmp_path, protocol):
    back = read_pickle(save(tmp_path / "v.pkl", pickle.dumps(VALUE, protocol)))
    assert same(VALUE, back)
    back["poses"][0, 0] = 7  # one's own array, not a view of the file


def test_bytes_that_are_not_there_take_no_memory(tmp_path):
    path = save(tmp_path / "v.pkl", pickle.PROTO + b"\5" + pickle.BYTEARRAY8 + struct.pack("<Q", 1 << 30) + b"1.")
    tracemalloc.start()
    with pytest.raises(WearcapError):
        read_pickle(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 24


@pytest.mark.parametrize("compress", [0, 3, ("gzip", 3), ("bz2", 3), ("xz", 3)])
def test_joblib_files_come_back(tmp_path, compress):
    value = {0: {"trans": VALUE["poses"], "rot": VALUE["transes"], "name": "a"}, 1: {"trans": np.ones((2, 2))}}
    joblib.dump(value, tmp_path / "v.p", compress=compress)
    back = read_pickle(tmp_path / "v.p")
    assert same(value[0], back[0])
    assert same(value[1], back[1])


def test_python_2_strings_and_arrays_come_back(tmp_path):
    array = (
        b"cnumpy.core.multiarray\n_reconstruct\np0\n(cnumpy\nndarray\np1\n(I0\ntS'b'\ntR(I1\n(I2\ntcnumpy\ndtype\n(S'f8'\n"
        b"I0\nI1\ntR(I3\nS'<'\nNNNI-1\nI-1\nI0\ntbI00\nS'\\x00\\x00\\x00\\x00\\x00\\x00\\xf0?\\x00\\x00\\x00\\x00\\x00\\x00\\x00@'\ntb"
    )
    back = read_pickle(save(tmp_path / "v.pkl", b"(dS'gt'\n" + array + b"sS'seq'\nS'caf\\xe9'\ns."))
    np.testing.assert_array_equal(back["gt"], [1.0, 2.0])
    assert back["seq"] == "café"


class Evil:
    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return os.mkdir, (self.target,)


REFUSED = {
    "class": (pickle.dumps(Fraction(1, 3)), "fractions.Fraction"),
    "ordered dict": (pickle.dumps(collections.OrderedDict(a=1)), "collections.OrderedDict"),
    "set": (pickle.dumps({1, 2}, 4), "set"),
    "set, old": (pickle.dumps({1, 2}, 2), "builtins.set|__builtin__.set"),
    "eval": (b"cbuiltins\neval\n(S'1+1'\ntR.", "builtins.eval"),
    "dotted": (b"\x80\x04\x8c\x05numpy\x8c\x0ef2py.os.system\x93.", "numpy.f2py.os.system"),
    "object array": (pickle.dumps(np.array([{}, None], dtype=object)), "'O8'"),
    "structured": (pickle.dumps(np.zeros(2, dtype=[("a", "f4")])), "'V4'"),
    "matrix": (pickle.dumps(np.ma.masked_array([1.0])), "numpy.ma"),
    "name alone": (b"cnumpy\nndarray\n.", "_NdarrayName"),
    "huge array": (b"cnumpy\nndarray\n(I99999999999\ntR.", "damaged"),
    "persistent": (b"Pthing\n.", "outside the file"),
    "extension": (b"\x80\x02\x82\x01.", "damaged"),
    "codec": (b"c_codecs\nencode\n(Vabc\nVzip\ntR.", "'zip'"),
    "huge bytearray": (b"\x80\x05\x96\xff\xff\xff\xff\xff\xff\xff\x0f.", "damaged"),
    "state on a list": (b"](V1\nt](b.", "list|damaged"),
    "empty": (b"", "empty"),
    "text": (b"hello world", "damaged"),
    "truncated": (pickle.dumps(VALUE)[:200], "damaged"),
    "packed, truncated": (b"\x1f\x8b\x08\x00abc", "packed"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_everything_else_is_refused_by_name(tmp_path, what):
    content, message = REFUSED[what]
    with pytest.raises(WearcapError, match=message) as caught:
        read_pickle(save(tmp_path / "v.pkl", content))
    assert "v.pkl" in str(caught.value)


def test_nothing_runs(tmp_path):
    target = tmp_path / "made"
    for protocol in range(6):
        with pytest.raises(WearcapError, match="mkdir"):
            read_pickle(save(tmp_path / "v.pkl", pickle.dumps({"poses": Evil(str(target))}, protocol)))
    packed = io.BytesIO()
    joblib.dump([np.ones(3), Evil(str(target))], packed)
    with pytest.raises(WearcapError, match="mkdir"):
        read_pickle(save(tmp_path / "v.pkl", packed.getvalue()))
    objects = io.BytesIO()
    joblib.dump(np.array([Evil(str(target))], dtype=object), objects)
    with pytest.raises(WearcapError, match="'O8'"):
        read_pickle(save(tmp_path / "v.pkl", objects.getvalue()))
    assert not target.exists()


@fuzz
@given(data=st.data(), protocol=st.integers(0, 5))
def test_fuzz_gives_plain_data_or_one_clear_error(tmp_path, data, protocol):
    content = data.draw(mutated_bytes(pickle.dumps(VALUE, protocol)))
    try:
        read_pickle(save(tmp_path / "v.pkl", content or b"."))
    except WearcapError:
        return


@fuzz
@given(
    opcodes=st.lists(
        st.sampled_from(b"(.0123FIJKLMNPQRSTUVXabcdeghijlmopqrstu}]\x80\x81\x82\x85\x86\x87\x88\x8c\x93\x94\n19"),
        max_size=40,
    )
)
def test_fuzz_of_bare_opcodes(tmp_path, opcodes):
    try:
        read_pickle(save(tmp_path / "v.pkl", bytes(opcodes) + b"."))
    except WearcapError:
        return
