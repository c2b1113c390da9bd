"""TotalCapture's and DIP-IMU's sensors, in files written here from a moving body; orders; hostile files."""

import os
import pickle
import zipfile
from contextlib import suppress

import numpy as np
import pytest
import torch
from hostile import fuzz, mutated_bytes
from hypothesis import given
from hypothesis import strategies as st

from wearcap.body.skeletons import smpl24
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.datasets.totalcapture import DIP_IMU, R_UP, TOTALCAPTURE, as_watches, read_dip_imu, read_totalcapture
from wearcap.io.formats.smpl_axes import A
from wearcap.recording import Motion
from wearcap_testing import swaying_motion


def recorded(joints=TOTALCAPTURE, frames: int = 240) -> dict[str, np.ndarray]:
    """Sensors on bones in a world with y up, SMPL's axes, and the pose that moves them."""
    motion = swaying_motion(frames, seed=3, skeleton=smpl24())
    R = motion.R_parent_joint.double()
    R = torch.cat([R_UP.T @ R[:, :1] @ A, A.T @ R[:, 1:] @ A], 1)
    index = motion.skeleton.indices(*joints)
    ori = R_UP.T @ motion.T_world_joint.R[:, index].double() @ A
    random = np.random.default_rng(0)
    return {
        "ori": ori.numpy().astype(np.float32),
        "acc": random.normal(0, 2, (frames, len(joints), 3)),
        "gt": rotation.log(R).flatten(1).numpy(),
    }


def dip(frames: int = 240) -> dict[str, np.ndarray]:
    arrays = recorded(DIP_IMU, frames)
    return {"imu_ori": arrays["ori"], "imu_acc": arrays["acc"], "gt": arrays["gt"]}


def write(path, arrays: dict) -> None:
    if path.suffix == ".npz":
        np.savez(path, **arrays)
    elif path.suffix == ".pt":
        torch.save({name: torch.from_numpy(array) for name, array in arrays.items()}, path)
    else:
        path.write_bytes(pickle.dumps(arrays))


@pytest.mark.parametrize("suffix", [".pkl", ".npz", ".pt"])
def test_totalcapture(tmp_path, suffix):
    arrays = recorded()
    write(tmp_path / f"a{suffix}", arrays)
    read = read_totalcapture(tmp_path / f"a{suffix}")
    assert tuple(read.imu) == TOTALCAPTURE
    assert read.motion.fps == pytest.approx(60)
    for joint, stream in read.imu.items():
        assert stream.joint == joint
        worn = read.motion.joint(joint).R @ stream.R_joint_imu
        assert rotation.geodesic(stream.R_world_imu, worn).max() < 1e-3
    expected = arrays["acc"][:, 4] @ R_UP.numpy().T
    np.testing.assert_allclose(read.imu["head"].acc_world.numpy(), expected, atol=1e-5)
    assert read.imu["head"].acc_world[0, 2].item() == pytest.approx(arrays["acc"][0, 4, 1], abs=1e-5)  # y was up


def test_the_body_is_as_it_was(tmp_path):
    write(tmp_path / "a.pkl", recorded())
    motion = read_totalcapture(tmp_path / "a.pkl").motion
    truth = swaying_motion(240, seed=3, skeleton=smpl24())
    assert rotation.geodesic(motion.T_world_joint.R, truth.T_world_joint.R).max() < 1e-3


def test_dip_imu_and_its_gaps(tmp_path):
    arrays = dip()
    arrays["imu_ori"][10:13, 7] = np.nan
    arrays["imu_acc"][50, 0] = np.nan
    write(tmp_path / "a.pkl", arrays)
    read = read_dip_imu(tmp_path / "a.pkl")
    assert tuple(read.imu) == DIP_IMU
    assert len(read.imu["left_elbow"].timestamps) == 237
    assert len(read.imu["head"].timestamps) == 239
    assert len(read.imu["pelvis"].timestamps) == 240
    assert read.imu["left_elbow"].timestamps[10].item() == pytest.approx(13 / 60)
    watches = as_watches(read.imu)
    assert watches["left_wrist"].joint == "left_wrist"
    assert torch.equal(watches["right_wrist"].R_world_imu, read.imu["right_elbow"].R_world_imu)


LEGS_FIRST = ("left_knee", "right_knee", "left_elbow", "right_elbow", "head", "pelvis")


def test_a_wrong_order_names_the_one_that_fits(tmp_path):
    write(tmp_path / "a.pkl", recorded(LEGS_FIRST))
    with pytest.raises(WearcapError, match="another order") as caught:
        read_totalcapture(tmp_path / "a.pkl")
    assert f"order=({', '.join(LEGS_FIRST)})" in str(caught.value)
    assert tuple(read_totalcapture(tmp_path / "a.pkl", LEGS_FIRST).imu) == LEGS_FIRST


def test_without_a_pose_the_order_is_checked_against_a_motion_or_believed(tmp_path):
    arrays = recorded(LEGS_FIRST)
    pose = arrays.pop("gt")
    write(tmp_path / "a.pkl", arrays)
    assert read_totalcapture(tmp_path / "a.pkl").motion is None
    write(tmp_path / "b.pkl", arrays | {"gt": pose})
    motion = read_totalcapture(tmp_path / "b.pkl", LEGS_FIRST).motion
    with pytest.raises(WearcapError, match="another order"):
        read_totalcapture(tmp_path / "a.pkl", motion=motion)


def test_a_mounting_and_noise_do_not_disturb_the_check(tmp_path):
    """Real sensors are strapped on somehow, and their attitude wanders by some degrees."""
    arrays = recorded()
    random = torch.Generator().manual_seed(0)
    mount = rotation.exp(torch.randn(6, 3, generator=random))
    wander = rotation.exp(0.04 * torch.randn(240, 6, 3, generator=random))
    arrays["ori"] = (torch.from_numpy(arrays["ori"]) @ mount @ wander).numpy()
    write(tmp_path / "a.pkl", arrays)
    assert tuple(read_totalcapture(tmp_path / "a.pkl").imu) == TOTALCAPTURE


def test_a_body_that_stands_still_says_nothing_of_the_order(tmp_path):
    arrays = recorded(frames=60)
    arrays = {name: np.repeat(array[:1], 60, 0) for name, array in arrays.items()}
    arrays["acc"] *= 0
    write(tmp_path / "a.pkl", arrays)
    read_totalcapture(tmp_path / "a.pkl")


def test_another_recordings_pose_is_refused(tmp_path):
    arrays = recorded()
    turns = torch.cumsum(0.3 * torch.randn(240, 6, 3, generator=torch.Generator().manual_seed(0)), 0)
    arrays["ori"] = rotation.exp(turns).numpy()
    write(tmp_path / "a.pkl", arrays)
    with pytest.raises(WearcapError, match="in whatever order"):
        read_totalcapture(tmp_path / "a.pkl")


class Evil:
    def __reduce__(self):
        return os.system, ("touch evil",)


FAULTS = {
    "no array": ({"ori": None}, "no array 'ori'"),
    "five sensors": ({"ori": np.ones((240, 5, 3, 3))}, r"shapes \(240, 5, 3, 3\)"),
    "other count": ({"acc": np.ones((9, 6, 3))}, "of shapes"),
    "no samples": ({"ori": np.ones((0, 6, 3, 3)), "acc": np.ones((0, 6, 3))}, "of shapes"),
    "no rotations": ({"ori": np.ones((240, 6, 3, 3))}, "no rotations"),
    "mirrors": ({"ori": np.tile(-np.eye(3), (240, 6, 1, 1))}, "no rotations"),
    "nan": ({"ori": np.full((240, 6, 3, 3), np.nan)}, "240 of 240 samples are not finite"),
    "gravity": ({"acc": np.tile([0, 9.8, 0], (240, 6, 1))}, "Take gravity out"),
    "pose": ({"gt": np.zeros((240, 66))}, "'gt' has shape"),
    "pose nan": ({"gt": np.full((240, 72), np.nan)}, "NaN"),
    "poses": ({"gt": np.zeros((9, 72))}, "9 poses for 240 samples"),
    "list": ({"ori": [[1.0]]}, "ori is a list"),
    "text": ({"acc": np.full((240, 6, 3), "x")}, "array of numbers"),
    "code": ({"gt": Evil()}, "system"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_hostile_file_is_named(tmp_path, fault, monkeypatch):
    monkeypatch.chdir(tmp_path)
    changes, message = FAULTS[fault]
    arrays = {name: value for name, value in (recorded() | changes).items() if value is not None}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(arrays))
    with pytest.raises(WearcapError, match=message) as caught:
        read_totalcapture(tmp_path / "a.pkl")
    assert "a.pkl" in str(caught.value)
    assert not (tmp_path / "evil").exists()


def test_files_of_old_pytorch_are_read(tmp_path):
    tensors = {name: torch.from_numpy(array) for name, array in recorded(frames=60).items()}
    torch.save(tensors, tmp_path / "a.pt", _use_new_zipfile_serialization=False)
    assert tuple(read_totalcapture(tmp_path / "a.pt").imu) == TOTALCAPTURE


@pytest.mark.parametrize("packed", [True, False])
def test_a_long_word_in_a_pytorch_file_takes_no_time(tmp_path, packed):
    content = b"\x80\x02c" + b"x" * 200_000 + b"\ny\n."
    (tmp_path / "a.pt").write_bytes(content)
    if packed:
        with zipfile.ZipFile(tmp_path / "a.pt", "w") as archive:
            archive.writestr("a/data.pkl", content)
            archive.writestr("a/version", "3")
    with pytest.raises(WearcapError, match="not a readable PyTorch file.*a word longer than"):
        read_totalcapture(tmp_path / "a.pt")


def test_other_faults(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a.pkl", "a.npz", "a.pt"):
        with pytest.raises(WearcapError, match="no such file"):
            read_totalcapture(tmp_path / name)
    (tmp_path / "a.pkl").write_bytes(pickle.dumps([1]))
    with pytest.raises(WearcapError, match="it holds a list"):
        read_totalcapture(tmp_path / "a.pkl")
    (tmp_path / "a.pt").write_bytes(pickle.dumps(Evil()))
    with pytest.raises(WearcapError, match="not a readable PyTorch file"):
        read_totalcapture(tmp_path / "a.pt")
    with pytest.raises(WearcapError, match="different joints of smpl24"):
        read_totalcapture(tmp_path / "a.pkl", ("head", "nose"))
    assert not (tmp_path / "evil").exists()


@fuzz
@given(data=st.data())
def test_damaged_files_are_read_or_refused(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("tc") / f"a{data.draw(st.sampled_from(['.pkl', '.npz', '.pt']))}"
    write(path, recorded(frames=4))
    path.write_bytes(data.draw(mutated_bytes(path.read_bytes())))
    with suppress(WearcapError):
        read = read_totalcapture(path)
        assert isinstance(read.motion, Motion | None)
        assert all(stream.acc_world.isfinite().all() for stream in read.imu.values())
