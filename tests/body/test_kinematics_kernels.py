"""The kernels touch their arrays and nothing else: not by a read whose result is dropped, not by a write."""

import ctypes
import mmap
import multiprocessing
import sys

import numpy as np
import pytest

from wearcap.body import kinematics_kernels

PARENTS = np.array([-1, 0, 1, 1, 0, 3])
JOINTS = len(PARENTS)
NUMBERS = {"R": 9 * JOINTS, "t": 3 * JOINTS, "root": 3}
"""Per sample."""


def arrays(samples, dtype, per_sample_offsets):
    """Arguments of forward and of backward; the outputs hold 7."""
    random = np.random.default_rng(samples)
    draw = lambda kind, n=samples: random.standard_normal(n * NUMBERS[kind]).astype(dtype)  # noqa: E731
    empty = lambda kind, n=samples: np.full(n * NUMBERS[kind], 7, dtype)  # noqa: E731
    own = samples if per_sample_offsets else 1
    offsets = draw("t", own)
    forward = [draw("R"), draw("root"), offsets, empty("R"), empty("t")]
    given = [draw("R"), offsets, draw("R"), draw("R"), draw("t")]
    return forward, [*given, empty("R"), empty("root"), empty("t", own)]


def between_guards(array, at_end):
    """The same numbers in memory that ends (or begins) at a page whose touch kills the process."""
    page = mmap.PAGESIZE
    pages = -(-array.nbytes // page)
    memory = mmap.mmap(-1, (pages + 2) * page)
    address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    libc = ctypes.CDLL(None, use_errno=True)
    for guard in (address, address + (pages + 1) * page):
        assert libc.mprotect(ctypes.c_void_p(guard), ctypes.c_size_t(page), 0) == 0
    begin = (pages + 1) * page - array.nbytes if at_end else page
    guarded = np.frombuffer(memory, array.dtype, array.size, begin)
    guarded[:] = array
    return guarded


def same_between_guards(samples, dtype, per_sample_offsets):
    cases = zip((kinematics_kernels.forward, kinematics_kernels.backward), arrays(samples, dtype, per_sample_offsets))
    for kernel, plain in cases:
        for at_end in (False, True):
            expected = [array.copy() for array in plain]
            guarded = [between_guards(array, at_end) for array in plain]
            kernel(0, samples, PARENTS, *expected)
            kernel(0, samples, PARENTS, *guarded)
            for one, other in zip(expected, guarded):
                np.testing.assert_array_equal(one, other)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs fork and mprotect")
@pytest.mark.parametrize("samples", [1, 3])
@pytest.mark.parametrize("per_sample", [False, True])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_no_memory_around_the_arrays_is_touched(samples, per_sample, dtype):
    child = multiprocessing.get_context("fork").Process(target=same_between_guards, args=(samples, dtype, per_sample))
    child.start()
    child.join(60)
    assert child.exitcode == 0, "killed by a touch of a guard page, or unequal results"


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_only_the_samples_asked_for_are_written(dtype):
    """Another thread's samples and numbers around a slice of a longer buffer keep their values."""
    forward, backward = arrays(5, dtype, True)
    for kernel, plain, written in (
        (kinematics_kernels.forward, forward, 2),
        (kinematics_kernels.backward, backward, 3),
    ):
        whole = [np.concatenate([[-5] * 3, array, [-5] * 3]).astype(dtype) for array in plain]
        part = [array.copy() for array in whole]
        kernel(0, 5, PARENTS, *[array[3:-3] for array in whole])
        kernel(1, 3, PARENTS, *[array[3:-3] for array in part])
        for index, (all_samples, two) in enumerate(zip(whole, part)):
            assert (two[:3] == -5).all()
            assert (two[-3:] == -5).all()
            if index < len(plain) - written:
                np.testing.assert_array_equal(two[3:-3], plain[index])
                continue
            all_samples, two = all_samples[3:-3].reshape(5, -1), two[3:-3].reshape(5, -1)
            np.testing.assert_array_equal(two[1:3], all_samples[1:3])
            assert (two[[0, 3, 4]] == 7).all()
            assert (two[1:3] != 7).any()


def test_one_rounding_of_error_against_plain_matrices():
    (R_local, root, offsets, R, t), _ = arrays(4, np.float32, True)
    kinematics_kernels.forward(0, 4, PARENTS, R_local, root, offsets, R, t)
    local, offset = (R_local.astype(float).reshape(4, JOINTS, 3, 3), offsets.astype(float).reshape(4, JOINTS, 3))
    R_true, t_true = [local[:, 0]], [root.astype(float).reshape(4, 3)]
    for joint, parent in list(enumerate(PARENTS))[1:]:
        R_true.append(R_true[parent] @ local[:, joint])
        t_true.append(t_true[parent] + np.einsum("sij,sj->si", R_true[parent], offset[:, joint]))
    for ours, true in ((R.reshape(4, JOINTS, 3, 3), R_true), (t.reshape(4, JOINTS, 3), t_true)):
        true = np.stack(true, 1)
        assert np.abs(ours - true).max() <= 1e-6 * np.abs(true).max()
