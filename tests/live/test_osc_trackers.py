"""The sink of VRChat's OSC trackers: python-osc and SciPy rebuild the poses, and our own source takes them."""

import socket

import numpy as np
import pytest
import torch
from pythonosc.osc_packet import OscPacket
from scipy.spatial.transform import Rotation

from wearcap.apps.live.sinks import sink_of
from wearcap.apps.live.sinks.osc_trackers import euler_deg
from wearcap.apps.live.sources import source_of
from wearcap.errors import WearcapError
from wearcap.geometry.rotation import about_axis
from wearcap_testing import swaying_motion

SEATS = ["pelvis", "t8", "left_ankle", "right_ankle", "left_knee", "right_knee", "left_elbow", "right_elbow"]
BONES = ["pelvis", "t8", "left_ankle", "right_ankle", "left_hip", "right_hip", "left_shoulder", "right_shoulder"]
TO_UNITY = np.array([[0, -1, 0], [0, 0, 1], [1, 0, 0]])
"""x forward, y left, z up in x right, y up, z forward."""


def sent(options: str = "", frames: int = 5):
    """Datagrams of a swaying body, and its motion."""
    motion = swaying_motion(frames, 3)
    with socket.socket(type=socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(2.0)
        sink = sink_of(f"osctrackers://127.0.0.1:{receiver.getsockname()[1]}{options}", "127.0.0.1", pace=False)
        sink.open()
        sink.begin("anna", motion.skeleton, 60.0)
        sink.take("anna", motion)
        sink.take("ben", motion)
        sink.close()
        data = [receiver.recv(65536) for _ in range(frames)]
    assert sink.sent == frames
    return data, motion


def test_poses_are_vrchats_by_an_independent_receiver():
    data, motion = sent()
    for k, datagram in enumerate(data):
        found = {m.message.address: m.message.params for m in OscPacket(datagram).messages}
        assert len(found) == 18
        for name, seat, bone in zip([*"12345678", "head"], [*SEATS, "head"], [*BONES, "head"]):
            place = TO_UNITY @ motion.joint(seat).t[k].numpy()
            np.testing.assert_allclose(found[f"/tracking/trackers/{name}/position"], place, atol=1e-5)
            # Degrees about z, then x, then y, each about the world's axis: SciPy's lower case.
            x, y, z = found[f"/tracking/trackers/{name}/rotation"]
            R = Rotation.from_euler("zxy", [z, x, y], degrees=True).as_matrix()
            np.testing.assert_allclose(R, TO_UNITY @ motion.joint(bone).R[k].numpy() @ TO_UNITY.T, atol=1e-5)


def test_our_source_takes_what_the_sink_sends():
    (datagram, *_), motion = sent()
    packets = source_of("osctrackers").parse(datagram, 100.0, lambda why: pytest.fail(why))
    poses = {packet.device: packet.sample for packet in packets if packet is not None}
    assert len(poses) == 9
    for device, seat, bone in (
        ("head", "head", "head"),
        ("tracker4", "right_ankle", "right_ankle"),
        ("tracker7", "left_elbow", "left_shoulder"),
    ):
        pose = getattr(poses[device], "T_world_device", None) or poses[device].T_world_joint
        torch.testing.assert_close(pose.t, motion.joint(seat).t[0], atol=1e-5, rtol=0)
        torch.testing.assert_close(pose.R, motion.joint(bone).R[0], atol=1e-5, rtol=0)


def test_some_trackers_keep_their_numbers():
    (datagram, *_), _ = sent("?trackers=hip+feet&wearer=anna")
    numbers = {m.message.address.split("/")[3] for m in OscPacket(datagram).messages}
    assert numbers == {"head", "1", "3", "4"}
    with pytest.raises(WearcapError, match="no trackers 'foot'.*feet"):
        sink_of("osctrackers://127.0.0.1:9000?trackers=foot", "127.0.0.1", True)


@pytest.mark.parametrize("up", [90.0, -90.0])
def test_looking_straight_up_is_a_rotation_still(up):
    angle = torch.tensor([0.4, -2.0], dtype=torch.float64)
    R = (
        about_axis("y", angle)
        @ about_axis("x", torch.deg2rad(torch.tensor(up, dtype=torch.float64)))
        @ about_axis("z", angle)
    )
    x, y, z = euler_deg(R).numpy().T
    np.testing.assert_allclose(
        Rotation.from_euler("zxy", np.stack([z, x, y], -1), degrees=True).as_matrix(), R, atol=1e-6
    )
