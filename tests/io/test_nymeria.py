"""Small sequences in Nymeria's layout, written from a synthetic motion with a planted clock, seat and drift."""

import gzip
import json
import math

import numpy as np
import pytest
import torch

from data_prep.nymeria import is_nymeria, read_nymeria, read_xdata
from data_prep.nymeria_alignment import align_head, clock_offset
from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.devices.aria_mps import R_CPF_DEVICE, T_HEAD_DEVICE, nominal_T_aria_cpf

HZ = 240
OFFSET_S = -812.345
"""Device clock minus the suit's."""
SEAT = Rigid(rotation.exp(torch.tensor([0.06, -0.12, 0.1])), torch.tensor([0.10, 0.01, 0.06]))


def suit_motion(seconds=30.0):
    """A 1.6 m person who walks in a circle and looks around: world poses of all joints at 240 Hz."""
    t = torch.arange(int(seconds * HZ), dtype=torch.float64) / HZ
    skeleton = xsens23().scaled(0.92)
    generator = torch.Generator().manual_seed(5)
    phase = 6.28 * torch.rand(23, 3, generator=generator, dtype=torch.float64)
    rate = 1 + 3 * torch.rand(23, 3, generator=generator, dtype=torch.float64)
    rotvec = 0.12 * torch.sin(rate * t[:, None, None] + phase)
    rotvec[:, skeleton.index("head")] = torch.stack(
        [0.2 * (2.1 * t).sin(), 0.3 * (1.3 * t).sin(), 0.7 * (0.9 * t + (0.31 * t).sin()).sin()], -1
    )
    R = rotation.exp(rotvec)
    R[:, 0] = rotation.about_axis("z", 0.4 * t) @ R[:, 0]
    root = torch.stack([2.5 * (0.4 * t).sin(), -2.5 * (0.4 * t).cos(), 0.85 + 0.03 * (11 * t).sin()], -1)
    return t, skeleton, R, forward_kinematics(skeleton, R, root)


def planted_world(t):
    """The suit's world in the device's: a turn and shift that drift."""
    return Rigid(
        rotation.about_axis("z", 0.7 + 0.004 * t), torch.stack([3 + 0.01 * t, -1 - 0.02 * t, 0.2 + 0.002 * t], -1)
    )


def device_poses(t, T_joint, skeleton):
    head = skeleton.index("head")
    return planted_world(t) @ Rigid(T_joint.R[:, head], T_joint.t[:, head]) @ SEAT.to(torch.float64)


def write_sequence(folder, *, hz_device=120, break_xdata=None):
    t, skeleton, _, T_joint = suit_motion()
    quat = rotation.quat_wxyz_from_matrix(T_joint.R)
    arrays = {
        "timestamps_us": np.round(1e6 * (1000 + t.numpy())).astype(np.int64),
        "frameCount": np.array([len(t)]),
        "frameRate": np.array([240]),
        "segmentCount": np.array([23]),
        "segment_tXYZ": T_joint.t.reshape(len(t), -1).numpy().astype(np.float32),
        "segment_qWXYZ": quat.reshape(len(t), -1).numpy().astype(np.float32),
        "foot_contacts": (np.arange(len(t))[:, None] // 60 % 2 == [0, 0, 1, 1]).astype(np.int8),
    }
    (folder / "body").mkdir(parents=True)
    np.savez(folder / "body" / "xdata.npz", **(break_xdata(arrays) if break_xdata else arrays))
    step = HZ // hz_device
    T_aria_device = nominal_T_aria_cpf() @ Rigid(R_CPF_DEVICE, torch.zeros(3))
    T_world_aria = (device_poses(t, T_joint, skeleton) @ T_aria_device.inverse().to(torch.float64))[::step]
    wxyz = rotation.quat_wxyz_from_matrix(T_world_aria.R).numpy()
    count, slam = len(wxyz), folder / "recording_head" / "mps" / "slam"
    slam.mkdir(parents=True)
    header = [
        "graph_uid",
        "tracking_timestamp_us",
        "utc_timestamp_ns",
        *(f"t{a}_world_device" for a in "xyz"),
        *(f"q{a}_world_device" for a in "xyzw"),
        *(f"device_linear_velocity_{a}_device" for a in "xyz"),
        *(f"angular_velocity_{a}_device" for a in "xyz"),
        *(f"gravity_{a}_world" for a in "xyz"),
        "quality_score",
    ]
    times = np.round(1e6 * (1000 + OFFSET_S + t[::step].numpy())).astype(np.int64)
    body = np.column_stack(
        [
            times,
            np.full(count, -1),
            T_world_aria.t.numpy(),
            wxyz[:, [1, 2, 3, 0]],
            np.zeros((count, 8)),
            np.full(count, -9.81),
            np.ones(count),
        ]
    )
    lines = ["g," + ",".join([f"{row[0]:.0f}", "-1", *(f"{v:.7f}" for v in row[2:])]) for row in body]
    (slam / "closed_loop_trajectory.csv").write_text("\n".join([",".join(header), *lines]) + "\n")
    with gzip.open(slam / "semidense_points.csv.gz", "wt") as file:
        file.write(
            "uid,graph_uid,px_world,py_world,pz_world,inv_dist_std,dist_std\n1,g,1,2,0,0.001,0.001\n2,g,1,2,9,0.1,1\n"
        )
    (folder / "metadata.json").write_text(
        json.dumps({"fake_name": "ada_byron", "location": "loc7", "script": "S3-cooking", "participant_height_cm": 160})
    )
    return folder


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    return write_sequence(tmp_path_factory.mktemp("nymeria") / "20230607_s0_ada_byron_act0_e72nhq")


@pytest.fixture(scope="module")
def recording(sequence):
    return read_nymeria(sequence)


def truth_at(times):
    """True joint positions in the device's world at device times."""
    t, _, _, T_joint = suit_motion()
    world = planted_world(t)
    positions = (world.R[:, None] @ T_joint.t[..., None])[..., 0] + world.t[:, None]
    frame = ((times - 1000 - OFFSET_S) * HZ).round().long().clamp(0, len(t) - 1)
    return positions[frame]


def test_joints_arrive_in_the_device_world(recording):
    """Body height, seat, drift and clock were planted; the joints come back to within two centimetres."""
    assert recording.motion is not None
    error = (recording.motion.T_world_joint.t.double() - truth_at(recording.motion.timestamps)).norm(dim=-1)
    inner = slice(120, -120)
    assert error[inner].mean() < 0.01
    assert error[inner].max() < 0.03


def test_clock_seat_and_drift_are_found(recording):
    provenance = recording.motion.provenance
    assert float(provenance["clock_offset_s"]) == pytest.approx(OFFSET_S, abs=0.004)
    assert float(provenance["head_residual_m"]) < 0.005
    assert float(provenance["head_residual_deg"]) < 0.3
    assert rotation.geodesic(recording.head.R_head_device, SEAT.R) < math.radians(0.5)
    assert (recording.head.t_head_device - SEAT.t).norm() < 0.008


def test_head_stream_and_motion_share_frames(recording):
    assert torch.equal(recording.head.timestamps, recording.motion.timestamps)
    assert recording.motion.fps == pytest.approx(60.0)
    apart = (recording.head.T_world_head.t - recording.motion.joint("head").t).norm(dim=-1)
    assert apart.median() < 0.01


def test_about_the_wearer(recording):
    assert recording.subject == "ada_byron"
    assert recording.location == "loc7"
    assert recording.shape == {"height": pytest.approx(1.6)}
    assert recording.points is not None
    assert recording.points.points_world.tolist() == [[1, 2, 0]]
    assert recording.contacts is not None
    assert recording.contacts.contact[0].tolist() == [True, True, False, False]
    assert 0.4 < recording.contacts.contact.double().mean() < 0.6


def test_bones_are_measured(sequence):
    motion, _ = read_xdata(sequence / "body" / "xdata.npz")
    assert motion.skeleton.t_parent_joint == pytest.approx(xsens23().scaled(0.92).t_parent_joint, abs=1e-4)
    assert motion.skeleton.sites["left_heel"].t_joint_site[2] == pytest.approx(0.92 * -0.080, abs=1e-3)
    _, _, R, _ = suit_motion()
    assert rotation.geodesic(motion.R_parent_joint.double(), R).max() < 2e-3


def test_cleaning(tmp_path):
    """A late timestamp becomes nominal, a zero quaternion the one before."""

    def damage(arrays):
        arrays["timestamps_us"][500] += 3000
        arrays["segment_qWXYZ"][700:703, 8:12] = 0
        arrays["segment_qWXYZ"][0, 0:4] = 0
        return arrays

    folder = write_sequence(tmp_path / "s", break_xdata=damage)
    motion, _ = read_xdata(folder / "body" / "xdata.npz")
    assert motion.timestamps.diff() == pytest.approx(
        torch.full((len(motion) - 1,), 1 / HZ, dtype=torch.float64), abs=2e-6
    )
    R_l3 = motion.T_world_joint.R[:, motion.skeleton.index("l3")]
    assert rotation.geodesic(R_l3[699], R_l3[702]) < 1e-3
    assert motion.R_parent_joint[0, 0] == pytest.approx(torch.eye(3))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda a: {k: v for k, v in a.items() if k != "segment_qWXYZ"}, "no array 'segment_qWXYZ'"),
        (lambda a: a | {"segment_tXYZ": a["segment_tXYZ"][:, :60]}, "segment_tXYZ"),
        (lambda a: a | {"segment_tXYZ": a["segment_tXYZ"] * np.nan}, "NaN"),
        (lambda a: a | {"frameRate": np.array([60])}, "frame rate 60"),
        (lambda a: a | {"foot_contacts": a["foot_contacts"][:, :2]}, "foot_contacts"),
        (lambda a: a | {"timestamps_us": np.cumsum(np.full(len(a["timestamps_us"]), 16667))}, "after cleaning"),
    ],
)
def test_defects_are_named(tmp_path, damage, message):
    folder = write_sequence(tmp_path / "s", break_xdata=damage)
    with pytest.raises(WearcapError, match=message):
        read_xdata(folder / "body" / "xdata.npz")


def test_incomplete_sequence(tmp_path):
    assert not is_nymeria(tmp_path)
    with pytest.raises(WearcapError, match="not a complete Nymeria sequence"):
        read_nymeria(tmp_path)


def test_another_persons_device_is_refused():
    t, skeleton, _, T_joint = suit_motion()
    head = skeleton.index("head")
    own = Trajectory(t, T_joint.R[:, head].float(), T_joint.t[:, head].float())
    generator = torch.Generator().manual_seed(9)
    stranger = rotation.exp(torch.randn(len(t) // 48, 3, generator=generator)).repeat_interleave(48, 0)
    other = Trajectory(t[: len(stranger)], stranger, torch.zeros(len(stranger), 3))
    with pytest.raises(WearcapError, match="do not move alike"):
        clock_offset(own, other)


def test_still_head_is_refused():
    t = torch.arange(2400, dtype=torch.float64) / 120
    still = Trajectory(t, torch.eye(3).expand(2400, 3, 3), torch.zeros(2400, 3))
    with pytest.raises(WearcapError, match="hardly turns"):
        align_head(still, still, T_HEAD_DEVICE.t)
    short = Trajectory(t[:600], still.R_world_body[:600], still.t_world_body[:600])
    with pytest.raises(WearcapError, match="less than 10 s"):
        align_head(short, still, T_HEAD_DEVICE.t)


def test_noise_and_outliers_move_the_seat_little():
    """1 cm and 1° of noise and a second of lost tracking: the seat stays within 1 cm and half a degree."""
    t, skeleton, _, T_joint = suit_motion()
    seen = device_poses(t, T_joint, skeleton)[::4]
    generator = torch.Generator().manual_seed(2)
    shake = rotation.exp(0.017 * torch.randn(len(seen.t), 3, generator=generator, dtype=torch.float64))
    position = seen.t + 0.01 * torch.randn(len(seen.t), 3, generator=generator, dtype=torch.float64)
    position[600:660] += 1.0
    head = skeleton.index("head")
    suit = Trajectory(t, T_joint.R[:, head].float(), T_joint.t[:, head].float())
    alignment = align_head(suit, Trajectory(t[::4], (seen.R @ shake).float(), position.float()), T_HEAD_DEVICE.t)
    assert (alignment.T_head_device.t - SEAT.t).norm() < 0.012
    assert rotation.geodesic(alignment.T_head_device.R, SEAT.R) < math.radians(0.5)
