"""HMD² as a pipeline: the head stays where it was measured, windows join, batches change nothing."""

from dataclasses import replace

import pytest
import torch

from small_hmd2 import hmd2_of
from wearcap.errors import WearcapError
from wearcap.evaluation.evaluate import evaluate
from wearcap.geometry.camera import Camera
from wearcap.models.layers import TransformerSize
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.recording import CameraStream, PointCloud, Recording
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import MotionDenoiser
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.tracking.anchor import anchored_to_head
from wearcap_testing import recording_of, small_dataset, swaying_motion

IMAGE_SIZE = 6


def pipeline(frame: str = "heading", **changes) -> HMD2:
    """A small pipeline with random weights that listens to everything."""
    torch.manual_seed(0)
    features, places = HeadFeatures(frame, contacts=True), VoxelAutoencoder()
    net = MotionDenoiser(
        features.motion_size,
        features.condition_size,
        60,
        TransformerSize(32, 1, 4, 64, 0.0),
        4,
        conditions={"points": places.size, "image": IMAGE_SIZE},
    )
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.05)
    settings = {"place_encoder": places.eval(), "image_encoder": "toy", "steps": 3, "stride": 40}
    return hmd2_of(net, features, **settings | changes)


def seeing_recording(frames: int = 150, seed: int = 0) -> Recording:
    """A recording with points around the body, seen one by one, and embeddings at 30 Hz."""
    recording = recording_of(swaying_motion(frames, seed), "seeing")
    random = torch.Generator().manual_seed(seed)
    times = recording.head.timestamps
    points = 3 * torch.rand(4000, 3, generator=random) - 1.5 + torch.tensor([0.0, 0.0, 1.0])
    first_seen = times[0] + (times[-1] - times[0]) * torch.rand(4000, generator=random).double()
    camera = CameraStream(
        times[::2],
        Camera("pinhole", 8, 6, 4.0, 4.0, 3.5, 2.5),
        torch.eye(3),
        torch.zeros(3),
        embedding=torch.randn(len(times[::2]), IMAGE_SIZE, generator=random).half(),
        embedding_name="toy",
    )
    return replace(recording, points=PointCloud(points, None, first_seen), camera=camera)


@pytest.mark.parametrize("frame", ["heading", "window"])
def test_the_head_is_where_it_was_measured(frame):
    recording = recording_of(swaying_motion(150), "a")
    motion = pipeline(frame)(recording)
    assert torch.equal(motion.timestamps, recording.motion.timestamps)
    assert torch.allclose(motion.joint("head").t, recording.motion.joint("head").t, atol=1e-4)
    assert torch.allclose(motion.joint("head").R, recording.motion.joint("head").R, atol=1e-4)


def test_recordings_in_one_batch_come_out_as_alone():
    recordings = [recording_of(swaying_motion(n, n), f"r{n}") for n in (150, 70, 20)]
    together = pipeline().capture(recordings, [5, 6, 7])
    for recording, seed, captured in zip(recordings, (5, 6, 7), together):
        alone = pipeline()(recording, seed)
        assert torch.allclose(captured.motion.R_parent_joint, alone.R_parent_joint, atol=1e-4)


def test_the_same_seed_repeats_and_another_differs():
    recording = recording_of(swaying_motion(100), "a")
    first, again, other = (pipeline()(recording, seed).R_parent_joint for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.allclose(first, other, atol=1e-3)


@pytest.mark.parametrize("frame", ["heading", "window"])
def test_final_poses_stay_as_they_are(frame):
    """Frames that a window has given out are not revised by the next: a longer recording begins the same."""
    long, live = swaying_motion(140), pipeline(frame, live=True, lookahead=0)
    short = recording_of(long.sliced(0, 80), "short")
    captured, prefix = live(recording_of(long, "long")), live(short)
    assert torch.allclose(captured.R_parent_joint[:80], prefix.R_parent_joint, atol=1e-4)


def test_a_stride_longer_than_the_window_is_refused():
    with pytest.raises(WearcapError, match="cannot advance by 61"):
        pipeline(stride=61)(recording_of(swaying_motion(80), "a"))


def test_a_recording_without_head_poses_is_named():
    with pytest.raises(WearcapError, match="blind: no head poses"):
        pipeline()(Recording("blind"))


def test_hanging_the_truth_from_its_own_head_changes_nothing():
    truth = swaying_motion(50)
    anchored = anchored_to_head(truth, truth.joint("head"))
    assert torch.allclose(anchored.T_world_joint.t, truth.T_world_joint.t, atol=1e-5)


def test_evaluation_scores_every_recording_once_per_seed(tmp_path):
    store = small_dataset(tmp_path)
    rows = list(evaluate(pipeline(), store, store.names("test"), [0, 1], batch_size=3))
    assert sorted((row.recording, row.seed) for row in rows) == [(n, s) for n in ("r4", "r5") for s in (0, 1)]
    assert all(row.scores["mpjpe_cm"] > 1 for row in rows)
    assert {row.frames for row in rows} == {260, 300}


def test_points_and_images_matter_and_each_can_be_left_out():
    recording = seeing_recording()
    whole = pipeline()(recording).R_parent_joint
    for use in ((), ("points",), ("images",)):
        part = pipeline(use=use)(recording).R_parent_joint
        assert not torch.allclose(part, whole, atol=1e-3)
    blind = pipeline(use=())(recording).R_parent_joint
    lacking = replace(recording, points=None, camera=None)
    assert torch.equal(pipeline()(lacking).R_parent_joint, blind)


def test_what_is_seen_later_changes_nothing_before():
    recording = seeing_recording()
    cloud, camera = recording.points, recording.camera
    half = recording.head.timestamps[75]
    observed = cloud.first_seen < half
    later = torch.where(camera.timestamps >= half, torch.nan, 1.0)[:, None].half()
    first = replace(
        recording,
        points=PointCloud(cloud.points_world[observed], None, cloud.first_seen[observed]),
        camera=replace(camera, embedding=camera.embedding * later),
    )
    whole, part = (pipeline(stride=25, live=True, lookahead=0)(r).R_parent_joint for r in (recording, first))
    assert torch.allclose(whole[:75], part[:75], atol=1e-5)
    assert not torch.allclose(whole[75:], part[75:], atol=1e-3)


def test_contact_comes_with_the_motion():
    motion = pipeline()(seeing_recording(70))
    assert motion.contact_prob.shape == (70, 4)
    assert motion.contact_prob.amin() >= 0
    assert motion.contact_prob.amax() <= 1


def test_embeddings_of_another_encoder_are_refused():
    recording = seeing_recording(60)
    with pytest.raises(WearcapError, match=r"'clip' with 6.*6 of 'toy'.*use="):
        pipeline()(replace(recording, camera=replace(recording.camera, embedding_name="clip")))
    longer = recording.camera.embedding.repeat(1, 2)
    with pytest.raises(WearcapError, match="with 12 features"):
        pipeline()(replace(recording, camera=replace(recording.camera, embedding=longer)))
    assert pipeline(use=["points"])(replace(recording, camera=replace(recording.camera, embedding=longer)))


def test_an_empty_or_broken_cloud_is_survived():
    recording = seeing_recording(60)
    empty = PointCloud(torch.zeros(0, 3), None, torch.zeros(0, dtype=torch.float64))
    assert pipeline()(replace(recording, points=empty)).R_parent_joint.isfinite().all()
    points = recording.points.points_world.clone()
    points[::2] = torch.nan
    whole = PointCloud(points, None, recording.points.first_seen)
    clean = PointCloud(points[1::2], None, recording.points.first_seen[1::2])
    broken, fine = (pipeline()(replace(recording, points=cloud)).R_parent_joint for cloud in (whole, clean))
    assert torch.allclose(broken, fine, atol=1e-5)


def without(recording: Recording, frames: torch.Tensor) -> Recording:
    """The recording with some head poses missing."""
    head = recording.head
    return replace(
        recording,
        head=replace(
            head,
            timestamps=head.timestamps[frames],
            R_world_device=head.R_world_device[frames],
            t_world_device=head.t_world_device[frames],
        ),
    )


def test_behind_a_gap_the_capture_begins_anew():
    recording = seeing_recording(200)
    kept = torch.ones(200, dtype=torch.bool)
    kept[80:130] = False
    live = pipeline(live=True)
    motion = live(without(recording, kept))
    assert len(motion) == 200
    assert motion.R_parent_joint.isfinite().all()
    head = motion.joint("head").t
    assert torch.allclose(head[130:], recording.motion.joint("head").t[130:], atol=1e-4)
    assert head[79:131].diff(dim=0).norm(dim=-1).max() < 0.05
    alone = live(without(recording, kept & (torch.arange(200) < 80)))
    assert torch.allclose(motion.R_parent_joint[:80], alone.R_parent_joint, atol=1e-4)


def test_a_jump_of_the_tracking_does_not_count_as_speed():
    recording = seeing_recording(120)
    head = recording.head
    moved = head.t_world_device + torch.tensor([5.0, 0.0, 0.0]) * (torch.arange(120) >= 60)[:, None]
    jumped = replace(recording, head=replace(head, t_world_device=moved), points=None)
    motion = pipeline(live=True)(jumped)
    first = pipeline(live=True)(without(replace(recording, points=None), torch.arange(120) < 60))
    assert torch.allclose(motion.R_parent_joint[:60], first.R_parent_joint, atol=1e-4)
    assert torch.allclose(motion.joint("head").t, (jumped.head.T_world_head).t, atol=1e-4)


def test_poses_that_are_not_finite_count_as_missing_and_unsorted_ones_are_refused():
    recording = seeing_recording(100)
    t = recording.head.t_world_device.clone()
    t[40:45] = torch.nan
    motion = pipeline()(replace(recording, head=replace(recording.head, t_world_device=t)))
    assert motion.t_world_root.isfinite().all()
    mixed = torch.arange(100)
    mixed[10], mixed[11] = 11, 10
    with pytest.raises(WearcapError, match="timestamps do not grow"):
        pipeline()(without(recording, mixed))


def test_guidance_of_one_is_none_and_more_is_farther_from_the_blind_answer():
    recording = seeing_recording(60)
    blind, plain, guided = (
        pipeline(steps=1, **how)(recording).R_parent_joint for how in ({"use": ()}, {}, {"guidance": 2.0})
    )
    assert (guided - blind).norm() > 1.3 * (plain - blind).norm()


def test_scaled_rotations_and_clocks_of_another_unit_are_refused():
    recording = seeing_recording(100)
    head = recording.head
    with pytest.raises(WearcapError, match="is no rotation"):
        pipeline()(replace(recording, head=replace(head, R_world_device=1.1 * head.R_world_device)))
    with pytest.raises(WearcapError, match=r"100 head poses over .* s.*in seconds"):
        pipeline()(replace(recording, head=replace(head, timestamps=1e6 * head.timestamps)))
