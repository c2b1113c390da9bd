"""BVH: any hierarchy and channel order, units and axes, round trip, hostile files, fuzz."""

import dataclasses
import re
import warnings

import numpy as np
import pytest
import torch
from hypothesis import given
from scipy.spatial.transform import Rotation

from hostile import fuzz, mutated
from own_bvh import read_bvh
from wearcap.body.skeleton import Site, Skeleton, xsens23
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.formats.bvh import read_bvh_content, write_bvh
from wearcap.recording import Motion

BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Yposition Xposition Zposition Xrotation Zrotation Yrotation
  JOINT Left Leg {
    OFFSET 10 -5 1
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT LeftToe {
      OFFSET 0 -90 0
      CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation
      End Site { OFFSET 0 0 12 }
    }
  }
  JOINT Spine
  {
    OFFSET 0 30 0
    CHANNELS 1 Yrotation
    JOINT Head
    {
      OFFSET 0 40 0
      CHANNELS 3 Yrotation Xrotation Zrotation
      End Site
      {
        OFFSET 0 20 0
      }
    }
    JOINT LeftHand {
      OFFSET 80 25 0
      CHANNELS 0
    }
  }
}
MOTION
Frames: 3
Frame Time: .0083333
"""
ROWS = np.array([
    [90, 1, 2, 10, 20, 30, 40, -50, 60, 0, -90, 0, 5, 6, 7, 33, 1, 2, 3],
    [91, 2, 3, -10, 25, 35, 45, -55, 65, 0, -90, 0, 8, 9, 10, 34, 4, 5, 6],
    [92, 3, 4, 170, -80, 95, 50, -59, 70, 0, -90, 0, 11, 12, 13, 35, 7, 8, 9],
], dtype=float)  # fmt: skip
TEXT = BVH + "\n".join(" ".join(f"{v:g}" for v in row) for row in ROWS) + "\n"


def save(tmp_path, text: str):
    (tmp_path / "t.bvh").write_bytes(text.encode("utf-8", "replace"))
    return tmp_path / "t.bvh"


def euler(order: str, *degrees: float) -> np.ndarray:
    """The first axis is the outermost: intrinsic rotations in scipy's words."""
    return Rotation.from_euler(order.upper(), degrees, degrees=True).as_matrix()


def random_motion(skeleton: Skeleton, frames: int = 40, seed: int = 0) -> Motion:
    generator = torch.Generator().manual_seed(seed)
    R = rotation.exp(1.2 * torch.randn(frames, len(skeleton), 3, generator=generator))
    return Motion(
        torch.arange(frames, dtype=torch.float64) / 60,
        skeleton,
        R,
        torch.randn(frames, 3, generator=generator) + torch.tensor([0.0, 0.0, 1.0]),
    )


def test_positions_follow_the_files_channel_orders(tmp_path):
    motion = read_bvh(save(tmp_path, TEXT))
    assert motion.skeleton.joint_names == ("Hips", "Left Leg", "LeftToe", "Spine", "Head", "LeftHand")
    assert motion.fps == pytest.approx(120)
    for k, row in enumerate(ROWS):
        root = np.array([row[1], row[0], row[2]])
        hips = euler("xzy", *row[3:6])
        leg = root + hips @ [10, -5, 1]
        leg_R = hips @ euler("zxy", *row[6:9])
        toe = leg + leg_R @ [0, -90, 0]
        toe_R = leg_R @ euler("yxz", *row[12:15])
        spine_R = hips @ euler("y", row[15])
        head = root + hips @ [0, 30, 0] + spine_R @ [0, 40, 0]
        tip = toe + toe_R @ [0, 0, 12]
        ours = {"Left Leg": leg, "LeftToe": toe, "Head": head}
        for name, (x, y, z) in ours.items():
            np.testing.assert_allclose(motion.joint(name).t[k].numpy(), [z / 100, x / 100, y / 100], atol=1e-5)
        site = torch.tensor(motion.skeleton.sites["left_toe_tip"].t_joint_site)
        found = (motion.joint("LeftToe")[k : k + 1] @ site)[0].numpy()
        np.testing.assert_allclose(found, np.array([tip[2], tip[0], tip[1]]) / 100, atol=1e-5)
    assert motion.skeleton.sites["crown"].joint == "Head"


def test_axes_and_units_are_the_callers(tmp_path):
    metres = read_bvh(save(tmp_path, TEXT), unit_m=1)
    centimetres = read_bvh(save(tmp_path, TEXT))
    torch.testing.assert_close(metres.t_world_root, 100 * centimetres.t_world_root)
    z_up = read_bvh(save(tmp_path, TEXT), up="z", forward="-y")
    np.testing.assert_allclose(z_up.t_world_root[0].numpy(), [-0.90, 0.01, 0.02], atol=1e-6)
    with pytest.raises(WearcapError, match="one axis"):
        read_bvh(save(tmp_path, TEXT), up="z")
    with pytest.raises(WearcapError, match="axis 'up'"):
        read_bvh(save(tmp_path, TEXT), up="up")


def test_position_channels_of_children_replace_or_add_to_the_offset(tmp_path):
    whole = read_bvh(save(tmp_path, TEXT))
    shifts = TEXT.replace(" 0 -90 0 ", " 0 0 0 ").replace("OFFSET 0 0 0 ", "OFFSET 0 -90 0 ")
    with pytest.warns(UserWarning, match="of 1 joints are read as shifts"):
        added = read_bvh(save(tmp_path, shifts))
    torch.testing.assert_close(whole.skeleton.t_parent_joint, added.skeleton.t_parent_joint)
    stretched = TEXT.replace("45 -55 65 0 -90 0", "45 -55 65 0 -95 0")
    with pytest.warns(UserWarning, match="LeftToe.*0.050 m"):
        read_bvh(save(tmp_path, stretched))


@pytest.mark.parametrize("unit_m", [0.01, 1.0])
def test_round_trip(tmp_path, unit_m):
    motion = random_motion(xsens23())
    write_bvh(motion, tmp_path / "m.bvh", unit_m=unit_m)
    back = read_bvh(tmp_path / "m.bvh", unit_m=unit_m)
    order = [back.skeleton.index(name) for name in motion.skeleton.joint_names]
    assert (back.T_world_joint.t[:, order] - motion.T_world_joint.t).norm(dim=-1).max() < 1e-4
    assert rotation.geodesic(back.R_parent_joint[:, order], motion.R_parent_joint).max() < 2e-3
    torch.testing.assert_close(back.timestamps, motion.timestamps)
    for name in ("left_toe_tip", "right_toe_tip", "left_fingertip", "crown"):
        a, b = back.skeleton.sites[name], motion.skeleton.sites[name]
        assert a.joint == b.joint
        np.testing.assert_allclose(a.t_joint_site, b.t_joint_site, atol=2e-6)


def test_gimbal_lock_survives_the_round_trip(tmp_path):
    motion = random_motion(xsens23(), 5)
    locked = rotation.about_axis("z", torch.tensor([0.3])) @ rotation.about_axis("y", torch.tensor([np.pi / 2]).float())
    motion = dataclasses.replace(motion, R_parent_joint=locked.expand_as(motion.R_parent_joint).contiguous())
    write_bvh(motion, tmp_path / "m.bvh")
    back = read_bvh(tmp_path / "m.bvh")
    order = [back.skeleton.index(name) for name in motion.skeleton.joint_names]
    assert (back.T_world_joint.t[:, order] - motion.T_world_joint.t).norm(dim=-1).max() < 1e-4


def test_gaps_are_held_so_that_nothing_shifts_in_time(tmp_path):
    motion = random_motion(xsens23(), 10)
    keep = [0, 1, 2, 3, 6, 7, 8, 9]
    gap = Motion(motion.timestamps[keep], motion.skeleton, motion.R_parent_joint[keep], motion.t_world_root[keep])
    write_bvh(gap, tmp_path / "m.bvh")
    back = read_bvh(tmp_path / "m.bvh")
    assert len(back) == 10
    torch.testing.assert_close(back.t_world_root[9], motion.t_world_root[9], atol=1e-5, rtol=0)


def test_what_cannot_be_written_is_refused_and_leaves_nothing(tmp_path):
    motion = random_motion(xsens23(), 5)
    broken = dataclasses.replace(motion, t_world_root=motion.t_world_root * float("nan"))
    for bad in (broken, motion.sliced(0, 0), dataclasses.replace(motion, timestamps=-motion.timestamps)):
        with pytest.raises(WearcapError):
            write_bvh(bad, tmp_path / "m.bvh")
    assert list(tmp_path.iterdir()) == []
    write_bvh(motion.sliced(0, 1), tmp_path / "one.bvh")
    assert len(read_bvh(tmp_path / "one.bvh")) == 1


def test_a_leaf_without_site_gets_an_empty_end_site(tmp_path):
    skeleton = Skeleton(
        "rod", ("a", "b"), (-1, 0), torch.tensor([[0.0, 0, 0], [0, 0, 1]]), {"tip": Site("b", (0.0, 0.0, 0.5))}
    )
    write_bvh(random_motion(skeleton), tmp_path / "m.bvh")
    assert read_bvh(tmp_path / "m.bvh").skeleton.sites["b_end"].t_joint_site == pytest.approx((0, 0, 0.5))
    bare = dataclasses.replace(skeleton, sites={})
    write_bvh(random_motion(bare), tmp_path / "m.bvh")
    assert read_bvh(tmp_path / "m.bvh").skeleton.sites["b_end"].t_joint_site == pytest.approx((0, 0, 0))


FAULTS = {
    "empty": ("", "empty"),
    "garbage": ("\x01\x02 what", "line 1"),
    "no motion": (BVH.split("MOTION")[0], "MOTION"),
    "unclosed": (TEXT.replace("}\nMOTION", "MOTION"), "no complete HIERARCHY"),
    "truncated hierarchy": (TEXT[:300], "broken|complete"),
    "short row": (TEXT.replace("45 -55 65 ", "45 -55 "), "line 38.*18 values.*19"),
    "cut in a row": (TEXT[:-9], "cut short: 15 of 19 values"),
    "cut in a number": (TEXT.replace("Frames: 3", "Frames: 5").rstrip()[:-1] + "-", "cut short: 19 of 19 values"),
    "cut in its only row": (TEXT[: TEXT.index("91 2 3") - 22], "line 37.*1[0-9] values.*19"),
    "no frames": (
        TEXT.split("Frames: 3")[0] + "Frames: 0\nFrame Time: .01\n\n",
        "no frames.*a row of numbers.*export it",
    ),
    "nan": (TEXT.replace("45 -55", "nan -55"), "line 38.*'nan'"),
    "missing channel": (TEXT.replace("CHANNELS 1 Yrotation", "CHANNELS 2 Yrotation"), "CHANNELS 2"),
    "unknown channel": (TEXT.replace("CHANNELS 1 Yrotation", "CHANNELS 1 Wrotation"), "line 18.*wrotation"),
    "wrong count": (TEXT.replace("CHANNELS 1 Yrotation", "CHANNELS 2 Yrotation Xrotation"), "line 37.*19 values"),
    "commas and points": (TEXT.replace("45 -55", "4,5 -5.5"), "line 38.*'4,5'"),
    "commas between values": (TEXT.replace("45 -55", "45,-55"), "line 38.*'45,-55'"),
    "huge channels": (TEXT.replace("CHANNELS 0", "CHANNELS 99999999999"), "CHANNELS 9999"),
    "no frame rate": (TEXT.replace(".0083333", "0"), "frame time"),
    "time or rate": (TEXT.replace(".0083333", "60"), "milliseconds or a rate.*Time: 0.06'.*Time: 0.0166667'"),
    "television's rate": (TEXT.replace(".0083333", "29.97"), "milliseconds or a rate"),
    "frame time in microseconds": (TEXT.replace(".0083333", "8333.3"), "frame time 8333"),
    "two roots": (TEXT.replace("JOINT Spine", "ROOT Spine"), "line 15.*ROOT"),
    "same name": (TEXT.replace("JOINT Head", "JOINT Spine"), "share a name"),
    "bad offset": (TEXT.replace("OFFSET 0 40 0", "OFFSET 0 40"), "line 21.*CHANNELS"),
    "joint in end site": (TEXT.replace("{ OFFSET 0 0 12 }", "{ OFFSET 0 0 12 JOINT x { } }"), "End Site holds"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_hostile_bvh_is_named(tmp_path, fault):
    text, message = FAULTS[fault]
    with pytest.raises(WearcapError, match=message) as caught:
        read_bvh(save(tmp_path, text))
    assert "t.bvh" in str(caught.value)


def test_deep_nesting_is_refused_without_recursion(tmp_path):
    text = "HIERARCHY\nROOT a {\n" + "".join(f"JOINT j{k} {{\n" for k in range(5000)) + "}" * 5001 + "\nMOTION\n"
    with pytest.raises(WearcapError, match="more than"):
        read_bvh(save(tmp_path, text))


LAST = TEXT.rindex("92 3 4")
MENDED = {
    "more rows than its header says": (TEXT.replace("Frames: 3", "Frames: 2"), 3, "says 2 frames, its rows are 3"),
    "fewer rows": (TEXT.replace("Frames: 3", "Frames: 99999999999999"), 3, "says 99999999999999 frames, its rows are 3"),
    "cut between rows": (TEXT[:LAST], 2, "says 3 frames, its rows are 2"),
    "comments": ("// made by hand\n# v2\n" + TEXT.replace("MOTION\n", "MOTION\n# 120 Hz\n"), 3, "comments: 3"),
    "decimal commas": (TEXT.replace(".0083333", "0,0083333").replace("OFFSET 10 -5 1", "OFFSET 10,0 -5,0 1,0")
                       .replace(" -50 ", " -50,0 ").replace("\n91 ", "\n9,1E1 "), 3, "read as points: 4"),
    "frame time in milliseconds": (TEXT.replace(".0083333", "8.3333"), 3, "8.3333, is read as milliseconds: 120 Hz"),
    "whole milliseconds": (TEXT.replace(".0083333", "8"), 3, "8, is read as milliseconds: 125 Hz"),
}  # fmt: skip


@pytest.mark.parametrize("fault", MENDED)
def test_what_is_certain_is_read_and_noted(tmp_path, fault):
    text, frames, note = MENDED[fault]
    plain = read_bvh_content(save(tmp_path, TEXT))
    assert plain.notes == ()
    content = read_bvh_content(save(tmp_path, text))
    assert any(note in line for line in content.notes), content.notes
    assert content.step_s == pytest.approx(1 / 125 if "125" in note else 1 / 120, rel=1e-4)
    torch.testing.assert_close(content.R_parent_joint, plain.R_parent_joint[:frames])
    torch.testing.assert_close(content.t_parent_joint, plain.t_parent_joint[:frames])
    with pytest.warns(UserWarning, match=re.escape(note)):
        read_bvh(tmp_path / "t.bvh")


@fuzz
@given(text=mutated(TEXT))
def test_fuzz_gives_a_motion_or_one_clear_error(tmp_path, text):
    try:
        with warnings.catch_warnings(action="ignore"):
            motion = read_bvh(save(tmp_path, text))
    except WearcapError:
        return
    assert motion.R_parent_joint.isfinite().all()
