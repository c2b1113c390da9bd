"""Our motion file: exact round trip, AMASS-like keys, hostile files, fuzz."""

import dataclasses
import io
import json
import zipfile

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hostile import fuzz, mutated_bytes
from wearcap.body.skeleton import xsens23
from wearcap.boundary.arrays import read_npz, require
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.motion_npz import read_motion, write_motion
from wearcap.recording import Motion
from wearcap.recording.motion import Interactions

HELD = Interactions(
    torch.tensor([1e3, 1e3 + 0.1]).double(),
    torch.tensor([1e3 + 0.1, 1e3 + 0.2]).double(),
    torch.tensor([[True, False], [True, True]]),
    ("door", ""),
    ("hinged", ""),
)


def sample(frames: int = 6) -> Motion:
    generator = torch.Generator().manual_seed(3)
    door = Trajectory(
        torch.tensor([0.0, 0.3, 0.4], dtype=torch.float64),
        rotation.exp(torch.randn(3, 3, generator=generator)),
        torch.randn(3, 3, generator=generator),
    )
    return Motion(
        torch.arange(frames, dtype=torch.float64) / 30 + 1e3,
        xsens23(),
        rotation.exp(torch.randn(frames, 23, 3, generator=generator)),
        torch.randn(frames, 3, generator=generator),
        contact_prob=torch.rand(frames, 4, generator=generator),
        object_motion={"door": door},
        hand_contact_prob=torch.rand(frames, 2, generator=generator),
        interactions=HELD,
        provenance={"pipeline": "hmd2", "config": "ä"},
    )


def same(a: Motion, b: Motion) -> bool:
    assert a.object_motion is not None
    assert b.object_motion is not None
    parts = [(a, b), (a.object_motion["door"], b.object_motion["door"]), (a.interactions, b.interactions)]
    pairs = [(getattr(x, f.name), getattr(y, f.name)) for x, y in parts for f in dataclasses.fields(x)]
    return all(
        x.dtype == y.dtype and torch.equal(x, y)
        if isinstance(x, torch.Tensor)
        else isinstance(x, dict | Interactions) or x == y
        for x, y in pairs
    )


def test_round_trip_is_exact_and_bytes_repeat(tmp_path):
    motion = sample()
    write_motion(motion, tmp_path / "a.npz")
    write_motion(motion, tmp_path / "b.npz")
    back = read_motion(tmp_path / "a.npz")
    assert same(motion, back)
    assert back.provenance == motion.provenance
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "b.npz"]


def test_a_bare_motion_comes_back_bare(tmp_path):
    bare = {"contact_prob": None, "hand_contact_prob": None, "object_motion": None, "interactions": None}
    motion = dataclasses.replace(sample(1), **bare, provenance={})
    write_motion(motion, tmp_path / "a.npz")
    back = read_motion(tmp_path / "a.npz")
    assert back.contact_prob is None
    assert back.object_motion is None
    assert back.hand_contact_prob is None
    assert back.interactions is None
    assert back.provenance == {}
    assert torch.equal(back.R_parent_joint, motion.R_parent_joint)


def test_no_interaction_is_read_as_none_of_any(tmp_path):
    write_motion(dataclasses.replace(sample(), interactions=Interactions.of([])), tmp_path / "a.npz")
    back = read_motion(tmp_path / "a.npz").interactions
    assert back is not None
    assert len(back) == 0


def test_nan_is_not_written(tmp_path):
    motion = dataclasses.replace(sample(), t_world_root=torch.full((6, 3), float("nan")))
    with pytest.raises(WearcapError, match="t_world_root"):
        write_motion(motion, tmp_path / "a.npz")
    assert list(tmp_path.iterdir()) == []


def test_numpy_alone_reads_the_amass_like_keys(tmp_path):
    motion = sample()
    write_motion(motion, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        assert file["mocap_framerate"] == pytest.approx(30)
        assert tuple(file["joint_names"]) == motion.skeleton.joint_names
        np.testing.assert_array_equal(file["trans"], motion.t_world_root.numpy())
        R = rotation.exp(torch.from_numpy(file["poses"]).reshape(6, 23, 3))
    torch.testing.assert_close(R, motion.R_parent_joint, atol=1e-5, rtol=0)


def rewritten(path, **changes):
    """The file with some arrays replaced (None: left out)."""
    with np.load(path) as file:
        arrays = dict(file) | changes
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})


def described(path, change) -> None:
    with np.load(path) as file:
        tree = json.loads(str(file["wearcap"]))
    change(tree)
    rewritten(path, wearcap=np.array(json.dumps(tree)))


FAULTS = {
    "array missing": (lambda p: rewritten(p, R_parent_joint=None), "R_parent_joint"),
    "nan": (lambda p: rewritten(p, t_world_root=np.full((6, 3), np.nan, np.float32)), "NaN"),
    "wrong count": (lambda p: rewritten(p, t_world_root=np.zeros((5, 3), np.float32)), "t_world_root"),
    "text for numbers": (lambda p: rewritten(p, t_world_root=np.array(["a"] * 6)), "damaged|real"),
    "objects": (lambda p: rewritten(p, trans=np.array([{}], dtype=object)), "Python objects"),
    "foreign": (lambda p: rewritten(p, wearcap=None), "not of ours"),
    "newer": (lambda p: described(p, lambda t: t.update(schema=9)), "schema version 9"),
    "unknown part": (lambda p: described(p, lambda t: t["motion"].update({"$type": "System"})), "System"),
    "other part": (lambda p: described(p, lambda t: t["motion"].update({"$type": "Site"})), "damaged"),
    "list": (lambda p: described(p, lambda t: t.update(motion=[1])), "no motion|damaged"),
    "loose site": (
        lambda p: described(p, lambda t: t["motion"]["skeleton"]["sites"]["crown"].update(joint="tail")),
        "tail",
    ),
    "three hands": (lambda p: rewritten(p, hand_contact_prob=np.zeros((6, 3), np.float32)), "hand_contact_prob"),
    "hands of other frames": (
        lambda p: rewritten(p, hand_contact_prob=np.zeros((5, 2), np.float32)),
        "hand_contact_prob",
    ),
    "interactions of NaN": (lambda p: rewritten(p, **{"interactions.stop_s": np.full(2, np.nan)}), "stop_s"),
    "ends of other interactions": (lambda p: rewritten(p, **{"interactions.stop_s": np.zeros(3)}), "stop_s"),
    "hands that are numbers": (lambda p: rewritten(p, **{"interactions.hands": np.ones((2, 2))}), "damaged"),
    "an object too many": (
        lambda p: described(p, lambda t: t["motion"]["interactions"]["objects"]["$tuple"].append("a")),
        "2 interactions",
    ),
    "no interactions": (lambda p: described(p, lambda t: t["motion"].update(interactions=[1])), "damaged"),
    "empty file": (lambda p: p.write_bytes(b""), "readable .npz"),
    "garbage": (lambda p: p.write_bytes(bytes(range(256)) * 30), "readable .npz"),
    "truncated": (lambda p: p.write_bytes(p.read_bytes()[:3000]), "readable .npz"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_hostile_motion_is_named(tmp_path, fault):
    damage, message = FAULTS[fault]
    path = tmp_path / "m.npz"
    write_motion(sample(), path)
    damage(path)
    with pytest.raises(WearcapError, match=message):
        read_motion(path)


def test_an_array_larger_than_its_file_is_refused_without_allocating(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (1 << 40,)})
    with zipfile.ZipFile(tmp_path / "m.npz", "w") as archive:
        archive.writestr("poses.npy", header.getvalue() + b"12345678")
    with pytest.raises(WearcapError, match="poses"):
        read_npz(tmp_path / "m.npz")


def test_a_broken_array_header_is_named(tmp_path):
    for header in (b"{'descr': '<f8', 'shape': (", b"{'descr': '<f8', 'shape': [3]", b"\xff\xfe", b"7"):
        with zipfile.ZipFile(tmp_path / "m.npz", "w") as archive:
            archive.writestr("poses.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
        with pytest.raises(WearcapError, match="poses"):
            read_npz(tmp_path / "m.npz")


def test_fortran_order_and_missing_keys(tmp_path):
    array = np.asfortranarray(np.arange(12.0).reshape(3, 4))
    np.savez(tmp_path / "m.npz", a=array)
    found = read_npz(tmp_path / "m.npz", ["a", "b"])
    np.testing.assert_array_equal(found["a"], array)
    assert list(found) == ["a"]
    with pytest.raises(WearcapError, match="no such file"):
        read_npz(tmp_path / "none.npz")
    with pytest.raises(WearcapError, match=r"shape \(3, 4\).*\(time=3, 3\)"):
        require(found, "m.npz", a=("time", 3))


@fuzz
@given(data=st.data())
def test_fuzz_gives_a_motion_or_one_clear_error(tmp_path, data):
    write_motion(sample(2), tmp_path / "m.npz")
    (tmp_path / "m.npz").write_bytes(data.draw(mutated_bytes((tmp_path / "m.npz").read_bytes())))
    try:
        motion = read_motion(tmp_path / "m.npz")
    except WearcapError:
        return
    assert motion.R_parent_joint.isfinite().all()
