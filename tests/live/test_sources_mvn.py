"""Xsens MVN's stream: poses come out on the wearer's skeleton as they were sent."""

import random
import struct
from collections import Counter

import mvn_datagrams as mvn
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wearcap.apps.live.packets import Packet
from wearcap.apps.live.sources import source_of
from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError

ORDER = [
    *("pelvis", "l5", "l3", "t12", "t8", "neck", "head"),
    *("right_collar", "right_shoulder", "right_elbow", "right_wrist"),
    *("left_collar", "left_shoulder", "left_elbow", "left_wrist"),
    *("right_hip", "right_knee", "right_ankle", "right_toe", "left_hip", "left_knee", "left_ankle", "left_toe"),
]
"""xsens23's joint at the origin of each segment."""


def feed(source, datagrams: list[bytes], at: float) -> tuple[list[Packet], Counter]:
    refused: Counter = Counter()
    packets = [packet for data in datagrams for packet in source.parse(data, at, lambda why: refused.update([why]))]
    return packets, refused


def assert_posed(packet: Packet, seed: int) -> None:
    quat, position = mvn.posed(seed)
    T = packet.sample.suit.T_world_joint
    for segment, joint in enumerate(ORDER):
        k = packet.sample.suit.skeleton.index(joint)
        assert np.allclose(T.t[0, k], position[segment], atol=1e-4), joint
        assert np.allclose(T.R[0, k], Rotation.from_quat(quat[segment][[1, 2, 3, 0]]).as_matrix(), atol=1e-4), joint


@pytest.mark.parametrize("parts", [1, 2, 5])
@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_poses_on_the_wearers_bones(parts, unit):
    source = source_of("mvn")
    assert feed(source, mvn.size(unit=unit), 0.0) == ([], Counter())
    for counter in range(1, 6):
        (packet,), refused = feed(source, mvn.pose(counter, counter, 1000 + 10 * counter, 0, parts, unit), 2 + counter)
        assert not refused
        assert (packet.wearer, packet.device, packet.sent_s) == ("", "suit", 1 + counter / 100)
        assert packet.sample.suit.timestamps.tolist() == [1 + counter / 100]
        assert_posed(packet, counter)
        assert packet.sample.suit.skeleton.sites["left_heel"].t_joint_site == pytest.approx((-0.06, 0, -0.09))


def test_without_a_size_the_bones_are_those_of_a_pose():
    source = source_of("mvn")
    assert feed(source, mvn.pose(1), 0.0) == ([], {"waiting for the size": 1})
    (packet,), _ = feed(source, mvn.pose(2, 3), 1.5)
    assert_posed(packet, 3)
    skeleton = packet.sample.suit.skeleton
    assert {name: site.joint for name, site in skeleton.sites.items()} == {
        name: site.joint for name, site in xsens23().sites.items()
    }


@pytest.mark.parametrize("sized", [True, False])
def test_y_up_and_z_up_give_the_same_sample(sized):
    """The size is z up either way. Without it the bones follow from the poses alone."""
    suits = []
    for up in ("z", "y"):
        source = source_of(f"mvn://127.0.0.1:0?up={up}")
        feed(source, mvn.size() if sized else mvn.pose(1, up=up), 0.0)
        (packet,), refused = feed(source, mvn.pose(2, 5, 1000, up=up), 2.0)
        assert not refused
        assert_posed(packet, 5)
        suits.append(packet.sample.suit)
    z_up, y_up = suits
    assert y_up.timestamps.tolist() == z_up.timestamps.tolist()
    for name in ("R_parent_joint", "t_world_root"):
        assert np.allclose(getattr(y_up, name), getattr(z_up, name), atol=1e-6), name
    assert np.allclose(y_up.skeleton.t_parent_joint, z_up.skeleton.t_parent_joint, atol=1e-6)
    assert y_up.skeleton.sites == z_up.skeleton.sites


def test_y_up_is_where_xsens_own_reader_has_it():
    """One metre ahead and two up is (0, 2, 1), and a turn to the left is one about y."""
    quat, position = mvn.y_up(np.array([[0.8, 0.0, 0.0, 0.6]]), np.array([[1.0, 0.0, 2.0]]))
    assert np.allclose(position, [[0.0, 2.0, 1.0]])
    assert np.allclose(quat, [[0.8, 0.0, 0.6, 0.0]])


def test_what_is_wrong_with_the_axes_is_named():
    with pytest.raises(WearcapError, match=r"up=x.*one of z, y"):
        source_of("mvn://127.0.0.1?up=x")
    lying = mvn.size()[0]
    for segment, name in enumerate(mvn.BODY):
        at = lying.index(mvn.text(name)) + len(mvn.text(name))
        lying = bent(lying, at, ">3f", *mvn.T_POSE[segment][[1, 2, 0]])
    assert feed(source_of("mvn"), [lying], 0.0) == ([], {"size that is not z up": 1})
    assert feed(source_of("mvn"), [b"MXTP05" + mvn.pose(1)[0][6:]], 0.0) == ([], {"datagrams of other types": 1})


def test_a_skeleton_stays_until_another_person_comes():
    source = source_of("mvn")
    feed(source, mvn.pose(1), 0.0)
    (first,), _ = feed(source, mvn.pose(2, 3), 1.5)
    feed(source, mvn.size(scale=1.005), 1.6)
    (second,), _ = feed(source, mvn.pose(3, 4), 1.7)
    assert second.sample.suit.skeleton is first.sample.suit.skeleton
    feed(source, mvn.size(scale=1.1), 2.0)
    assert feed(source, mvn.pose(4, 4), 2.1)[1] == {"waiting for the size": 1}
    (other,), _ = feed(source, mvn.pose(5, 4), 3.2)
    assert other.sample.suit.skeleton.stature > 1.05 * first.sample.suit.skeleton.stature


def test_datagrams_out_of_order_and_lost():
    source = source_of("mvn")
    feed(source, mvn.size(), 0.0)
    shuffled = mvn.pose(1, 7, parts=4)
    random.Random(1).shuffle(shuffled)
    (packet,), _ = feed(source, shuffled, 2.0)
    assert_posed(packet, 7)
    got, refused = [], Counter()
    for counter in range(2, 30):
        found, why = feed(source, mvn.pose(counter, counter, parts=3)[: 3 if counter % 4 else 2], 2.0)
        got += found
        refused += why
    assert len(got) == 21
    assert refused == {"incomplete sample": 4}  # three still wait
    assert feed(source, mvn.pose(29, 29), 2.1)[1] == {"repeated": 1}


def test_characters_are_wearers():
    source = source_of("mvn://127.0.0.1:0?wearer=anna")
    packets = []
    for at in (0.0, 2.0):
        for character in (0, 3):
            packets += feed(source, [*mvn.size(character), *mvn.pose(int(at), character, 0, character)], at)[0]
    assert [packet.wearer for packet in packets] == ["anna", "anna 3"]
    assert_posed(packets[1], 3)


def bent(data: bytes, at: int, form: str, *values) -> bytes:
    changed = bytearray(data)
    struct.pack_into(form, changed, at, *values)
    return bytes(changed)


@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (lambda data: b"", "no MVN datagram"),
        (lambda data: b"MXTP03" + data[6:], "datagrams of other types"),
        (lambda data: data[:-9], "truncated"),
        (lambda data: bent(data, 11, ">B", 255), "truncated"),
        (lambda data: bent(data, 28, ">f", float("nan")), "not finite"),
        (lambda data: bent(data, 28, ">f", 3e38), "out of range"),
        (lambda data: bent(data, 40, ">f", 0.2), "not a rotation"),
        (lambda data: bent(data, 24, ">i", 2), "incomplete sample"),
        (lambda data: bent(data, 24, ">i", -(2**31)), "incomplete sample"),
    ],
)
def test_damaged_poses_are_counted(damage, why):
    source = source_of("mvn")
    feed(source, mvn.size(), 0.0)
    assert feed(source, [damage(mvn.pose(1)[0])], 2.0) == ([], {why: 1})


@pytest.mark.parametrize("cut", [24, 26, 30, 60, 200])
def test_damaged_sizes_are_counted(cut):
    data = mvn.size()[0]
    assert feed(source_of("mvn"), [data[:cut]], 0.0) == ([], {"truncated": 1})
    assert feed(source_of("mvn"), [bent(data, 24, ">i", 2**31 - 1)], 0.0) == ([], {"truncated": 1})
    assert feed(source_of("mvn"), [bent(data, 28, ">i", 2**31 - 1)], 0.0) == ([], {"truncated": 1})
