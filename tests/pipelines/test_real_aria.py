"""Real Project Aria recordings through surroundings, pictures, alignment and comparison."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial import cKDTree

from data_prep.adt import read_adt
from small_hmd2 import hmd2_of
from wearcap.apps.doctor import examine
from wearcap.apps.viewer.picture import contact_sheet, draw_head_path
from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, interpolate, resample
from wearcap.io.devices.aria_mps import read_closed_loop, read_mps
from wearcap.metrics.scores import cue_errors_cm
from wearcap.models.layers import TransformerSize
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.recording import HeadStream, Motion, PointCloud, Recording
from wearcap.scene.floor import estimate_floor
from wearcap.scene.voxels import VoxelGrid, VoxelMap, voxelize
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import MotionDenoiser
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.tracking.anchor import anchor


@pytest.fixture(scope="module")
def living_room(real_data) -> tuple[Recording, HeadStream, PointCloud]:
    """Somebody walks past a table with sofas around it and sits down."""
    recording = read_mps(real_data / "aria_mps")
    assert recording.head is not None
    assert recording.points is not None
    return recording, recording.head, recording.points


@pytest.fixture(scope="module")
def grids(living_room) -> torch.Tensor:
    _, head, points = living_room
    return voxelize(points.points_world, head.T_world_device)


@pytest.mark.real
def test_grids_are_the_distances_of_real_points(living_room, grids):
    """Against a search tree over the same points, turned and shifted by hand."""
    _, head, points = living_room
    assert grids.shape == (684, 10, 10, 10)
    centre = (torch.arange(10) + 0.5) * 0.2 - 1
    cells = torch.stack(torch.meshgrid(centre, centre, centre, indexing="ij"), -1).reshape(-1, 3)
    tree = cKDTree(points.points_world.numpy())
    for frame in (0, 321, 683):
        forward = head.R_world_device[frame, :2, 0]
        x = torch.tensor([*(forward / forward.norm()).tolist(), 0.0])
        R = torch.stack([x, torch.tensor([-x[1], x[0], 0.0]), torch.tensor([0.0, 0.0, 1.0])], 1)
        world = cells @ R.T + head.t_world_device[frame] - torch.tensor([0.0, 0.0, 1.0])
        expected = np.minimum(tree.query(world.numpy())[0], 0.1).reshape(10, 10, 10)
        assert np.abs(grids[frame].numpy() - expected).max() < 1e-4


@pytest.mark.real
def test_grids_show_the_room(living_room, grids):
    """Floor at the wearer's feet, hardly anything below it, sofas and table above, free way where the wearer walks."""
    _, head, points = living_room
    floor = estimate_floor(points.points_world, head.t_world_device).height
    above = head.t_world_device[:, 2] - floor
    assert above[:120].min() > 1.4, "walks upright"
    assert above[-60:].max() < 1.2, "and sits in the end"
    layer = ((2 - above) / 0.2).long()
    count = (grids < VoxelGrid().clip_m).double().sum((1, 2))
    k = torch.arange(10)
    assert count[k < layer[:, None] - 1].sum() < 0.01 * count.sum()
    assert count[(k - layer[:, None]).abs() <= 1].sum() > 0.4 * count.sum()
    assert count[k > layer[:, None] + 1].sum() > 0.4 * count.sum()
    walking = (grids < VoxelGrid().clip_m)[:120]
    assert walking[:, 4:6, 4:6, 5:].double().mean() < 0.4 * walking[:, :, :, 5:].double().mean() + 0.01


@pytest.mark.real
def test_a_map_that_grows_while_walking_ends_up_the_same(living_room, grids):
    _, head, points = living_room
    growing = VoxelMap()
    for part in points.points_world.split(5000):
        growing.add(part)
        growing.voxelize(head.T_world_device[:1])
    assert torch.equal(growing.voxelize(head.T_world_device), grids)


@pytest.mark.real
def test_a_picture_of_the_way_through_the_room(living_room):
    picture = draw_head_path(living_room[0], (160, 130))
    assert picture.shape == (130, 320, 3)
    orange = (picture[..., 0].astype(int) - picture[..., 2]) > 100
    assert 20 < orange.sum() < 3000, "the path"
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 200, "among many points"


@pytest.mark.real
def test_a_true_skeleton_rides_with_the_real_head(real_data):
    """ADT: device and skeleton come from different systems; the head joint holds its place on the glasses to a millimetre."""
    folder = real_data / "aria_adt_sample" / "raw"
    found = {finding.check: finding for finding in examine(folder).findings["raw"]}
    assert found["head against cues"].severity == "ok"
    recording = read_adt(folder)
    head, cue = recording.head, recording.cues["head"]
    assert head is not None
    track = Trajectory(head.timestamps, head.R_world_device, head.t_world_device)
    inside = cue.timestamps <= head.timestamps[-1]
    place = resample(track, cue.timestamps[inside]).T_world_body.inverse() @ cue.points[inside]
    assert place.std(0).max() < 1e-3
    assert place.mean(0)[0] < -0.1, "behind the pupils"
    off_cm = 100 * (-place.mean(0) - head.t_head_device)
    print(
        f"seat off by {off_cm[0]:.1f} cm ahead, {off_cm[1]:.1f} to the left, {off_cm[2]:.1f} up, as the glasses are tilted"
    )
    assert off_cm.norm() < 8, "the assumed seat is near"
    late = {
        name: type(cue)(cue.timestamps + 60, cue.joint, cue.points, cue.confidence)
        for name, cue in recording.cues.items()
    }
    findings = examine(Recording("late", head=head, cues=late)).findings["late"]
    assert [f.severity for f in findings if f.check == "head against cues"] == ["error"]


@pytest.mark.real
def test_a_body_anchored_to_the_real_head_beside_the_true_one(real_data):
    """The wearer stands, bends the head over a bowl and holds it: legs are where a standing body has them, hands are not."""
    recording = read_adt(real_data / "aria_adt_sample" / "raw")
    head = recording.head
    assert head is not None
    skeleton, T_world_head = xsens23(), head.T_world_head
    yaw = rotation.about_axis("z", rotation.yaw_of(T_world_head.R))
    R = torch.eye(3).repeat(len(yaw), len(skeleton), 1, 1)
    R[:, 0] = yaw
    R, T_world_joint = anchor(skeleton, R, T_world_head)
    motion = Motion(head.timestamps, skeleton, R, T_world_joint.t[:, 0])
    errors = cue_errors_cm(motion, recording.cues)
    assert set(errors) == set(recording.cues), "every tracked joint has its like"
    mean = {name: error.mean().item() for name, error in errors.items()}
    assert all(mean[f"{side}_{name}"] < 20 for side in ("left", "right") for name in ("hip", "knee", "ankle"))
    assert all(mean[f"{side}_wrist"] > 50 for side in ("left", "right")), "a T-pose holds no bowl"
    assert mean["head"] < 10


@pytest.mark.real
def test_true_joints_lie_on_the_wearers_arm_in_the_real_frames(real_data):
    """Head pose, skeleton and camera model of three files meet in a picture: elbow to wrist runs along a black sleeve."""
    folder = real_data / "aria_adt_sample"
    cues = read_adt(folder / "raw").cues
    T_world_aria = read_closed_loop(folder / "raw" / "aria_trajectory.csv")[0]
    meta = json.loads((folder / "extracted" / "meta.json").read_text())
    about = meta["cameras"]["camera-slam-left"]
    focal, cx, cy, *lens = about["projection_params"]
    camera = Camera("fisheye624", *about["image_size_wh"], focal, focal, cx, cy, tuple(lens))
    T_aria_cam = Rigid.from_matrix(torch.tensor(about["T_device_camera"]))
    frames = [frame for frame in meta["frames"] if frame["camera"] == "camera-slam-left"]
    assert len(frames) == 3
    for frame in frames:
        time = torch.tensor([frame["timestamp_ns"] * 1e-9], dtype=torch.float64)
        T_cam_world = (resample(T_world_aria, time).T_world_body[0] @ T_aria_cam).inverse()
        joints = [
            interpolate(cues[name].timestamps, cues[name].points, time)[0] for name in ("left_elbow", "left_wrist")
        ]
        pixels, valid = camera.project(torch.stack([T_cam_world @ joint for joint in joints]))
        assert valid.all()
        along = torch.linspace(0.1, 0.9, 30)[:, None]
        sleeve = (1 - along) * pixels[0] + along * pixels[1]
        across = torch.nn.functional.normalize((pixels[1] - pixels[0]).flip(0) * torch.tensor([1.0, -1.0]), dim=0)
        picture = np.asarray(Image.open(folder / "extracted" / frame["image"]).convert("L"))
        shades = [
            picture[tuple((sleeve + shift * across).round().long().flip(1).T.numpy())].mean() for shift in (0, 60, -60)
        ]
        assert shades[0] < 30, "a black sleeve"
        assert min(shades[1:]) > 1.3 * shades[0], "and something else beside it"


@pytest.fixture(scope="module")
def hmd2() -> HMD2:
    """The whole pipeline with random weights that listens to head and points."""
    torch.manual_seed(0)
    features, places = HeadFeatures(), VoxelAutoencoder()
    net = MotionDenoiser(
        features.motion_size,
        features.condition_size,
        60,
        TransformerSize(32, 1, 4, 64, 0.0),
        4,
        conditions={"points": places.size},
    )
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.05)
    return hmd2_of(net, features, place_encoder=places.eval(), steps=2, stride=40)


@pytest.mark.real
def test_a_real_recording_is_captured_with_its_points(living_room, hmd2, tmp_path):
    recording, head, _ = living_room
    motion = hmd2(recording)
    assert torch.equal(motion.timestamps, head.timestamps)
    assert torch.allclose(motion.joint("head").t, head.T_world_head.t, atol=1e-4), "no drift of body from head"
    assert torch.allclose(motion.joint("head").R, head.T_world_head.R, atol=1e-4)
    blind = hmd2(replace(recording, points=None))
    assert not torch.allclose(motion.R_parent_joint, blind.R_parent_joint, atol=1e-3), "points are listened to"
    sheet = contact_sheet({"capture": motion}, [0, 300, 683], size=(120, 100))
    assert np.asarray(sheet).std() > 5, "a body is drawn"


@pytest.mark.real
def test_a_fifth_of_a_second_is_refused(real_data, hmd2):
    with pytest.raises(WearcapError, match=r"raw: head poses of 6 frames.*at least 0.25 s"):
        hmd2(read_adt(real_data / "aria_adt_sample" / "raw"))
