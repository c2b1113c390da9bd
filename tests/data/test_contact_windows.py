"""Windows for contact detection: what they hold, how they are varied, and what the networks see of them."""

import math
from dataclasses import replace

import pytest
import scipy.stats
import torch

from benchmarks.rivals.single_windows import contact_windows
from benchmarks.rivals.single_windows import transforms as before
from contact_motion import CLASSES, bending, bending_dataset, bending_recording
from drawn_windows import numbers, one
from wearcap.body.skeleton import xsens23
from wearcap.body.skeletons import smpl24, smplh52
from wearcap.data.batch import Batch
from wearcap.data.draws import Draws
from wearcap.data.packing import Packed, Track, joined
from wearcap.data.transforms import DropFrames, Mirror, Shift, TimeStretch, mirrored_rotations
from wearcap.data.windows import Source, Windows
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import RecordingStore
from wearcap.systems.ireplica.features import HandViews, SmplAngles, in_skeleton, pose_frames, retarget_skeleton
from wearcap.systems.ireplica.training_windows import ContactContent, PoseNoise

SHIFTED = {"shift": Shift(), "stretch": TimeStretch(1.0), "drop": DropFrames(0.0)}
ALL = {"shift": Shift(), "stretch": TimeStretch(), "drop": DropFrames(), "noise": PoseNoise(), "mirror": Mirror()}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return bending_dataset(tmp_path_factory.mktemp("contact")).root


def dataset(root, transforms=None, features=None, split="train", stride=40, stream="suit") -> Windows:
    content = ContactContent(features or HandViews(), CLASSES, 60.0, stream)
    settings = {"window": 120, "stride": stride, "fps": 60.0, "transforms": transforms}
    return Windows([Source(str(root))], split, True, content=content, **settings)


def test_a_plain_window_is_the_recordings_own(root):
    windows = dataset(root)
    motion, interactions = bending(900, 0)
    window = one(windows, 1, 5)
    torch.testing.assert_close(window.R_parent_joint, motion.R_parent_joint[40:160], atol=2e-4, rtol=0)
    for index, name in enumerate(CLASSES):
        assert torch.equal(window.contact[..., index], interactions.hand_contact(motion.timestamps[40:160], name))
    assert window.contact.any()
    assert not window.error.any()


def test_content_is_a_function_of_the_seed(root):
    windows = dataset(root, ALL)
    first, again, other = (one(windows, 2, seed) for seed in (7, 7, 8))
    assert all(torch.equal(a, b) for a, b in zip(first, again))
    assert not torch.equal(first.R_parent_joint, other.R_parent_joint)
    assert first.error.norm(dim=-1).mean() < math.radians(5)


def test_a_mirrored_window_swaps_hands_and_sides(root):
    plain = one(dataset(root), 0)
    turned = dataset(root, SHIFTED | {"mirror": Mirror()}, stride=1).batch(numbers(0).repeat(20), torch.arange(20))
    held = turned.contact.any(1)[:, 0].any(-1)
    swapped = held != plain.contact.any(0)[0].any()
    assert 3 < swapped.sum() < 17
    first = int(swapped.nonzero()[0])
    mirrored = mirrored_rotations(turned.R_parent_joint[first], xsens23())
    torch.testing.assert_close(mirrored, plain.R_parent_joint, atol=1e-6, rtol=0)
    assert torch.equal(turned.contact[first].flip(1), plain.contact)


def test_stretched_windows_keep_poses_and_truth_together(root):
    """Bent elbows are contacts, at any speed and with frames lost."""
    windows = dataset(root, {"shift": Shift(), "stretch": TimeStretch(1.2), "drop": DropFrames(0.3)})
    body = xsens23()
    for seed in range(6):
        window = one(windows, seed, seed)
        elbows = window.R_parent_joint[:, body.indices("left_elbow", "right_elbow")]
        bent = rotation.log(elbows)[..., 2].abs()
        contact = window.contact.any(-1)
        assert bent[contact].median() > 1.0
        assert bent[~contact].median() < 0.5
        torch.testing.assert_close(elbows @ elbows.mT, torch.eye(3).expand_as(elbows), atol=1e-5, rtol=0)


def batch_of(R: torch.Tensor, count: int = 1, **changes) -> Batch:
    packed, zeros = (
        Packed(*joined([Track({"R_parent_joint": R}).packed()], ["one"])),
        torch.zeros(count, dtype=torch.long),
    )
    sensed = frozenset({"R_parent_joint"})
    return Batch(packed, Draws(torch.arange(count)), zeros, zeros, len(R) - 1, 60.0, sensed=sensed, **changes)


def test_lost_frames_are_bridged():
    R, kept = bending(30)[0].R_parent_joint, torch.ones(1, 31, dtype=torch.bool)
    kept[0, [7, 8, 15]] = False
    whole, bridged = (batch_of(R, **more).read().values["R_parent_joint"][0] for more in ({}, {"kept": kept}))
    assert torch.equal(bridged[kept[0, :29]], whole[kept[0, :29]])
    assert not torch.equal(bridged[~kept[0, :29]], whole[~kept[0, :29]])
    assert rotation.geodesic(bridged, R[:29]).max() < math.radians(3)


def test_errors_have_the_size_that_was_asked_for():
    batch = PoseNoise(5.0)(batch_of(torch.eye(3).repeat(301, 23, 1, 1), 200).read())
    sizes = batch.values["error"].square().sum(-1).mean((1, 2)).sqrt()
    assert sizes.max() < math.radians(5.6)
    assert sizes.mean().item() == pytest.approx(math.radians(2.5), rel=0.15)
    random = before.Draws(0)
    window = before.Window({"R_parent_joint": torch.eye(3).repeat(300, 23, 1, 1)})
    older = torch.stack([contact_windows.PoseNoise(5.0)(window, random).values["error"] for _ in range(200)])
    slow = [each.diff(dim=1).square().sum(-1).mean((1, 2)).sqrt() for each in (batch.values["error"], older)]
    assert scipy.stats.ks_2samp(*slow).pvalue > 0.01
    assert scipy.stats.ks_2samp(sizes, older.square().sum(-1).mean((1, 2)).sqrt()).pvalue > 0.01


def test_another_skeleton_and_rate_are_converted(tmp_path):
    store = RecordingStore(tmp_path)
    recording = bending_recording(400, "slow")
    assert recording.suit is not None
    half = replace(
        recording.suit,
        timestamps=recording.suit.timestamps[::2],
        R_parent_joint=recording.suit.R_parent_joint[::2],
        t_world_root=recording.suit.t_world_root[::2],
    )
    store.add(replace(recording, suit=half), split="train", config_hash="test")
    window = one(dataset(tmp_path, features=SmplAngles()), 0)
    expected = in_skeleton(xsens23(), retarget_skeleton(xsens23(), smpl24()), recording.suit.R_parent_joint[:120])
    assert rotation.geodesic(window.R_parent_joint, expected).max() < math.radians(2)


def test_recordings_without_truth_or_suit_are_named(tmp_path):
    store = RecordingStore(tmp_path)
    store.add(replace(bending_recording(400, "a"), interactions=None), split="train", config_hash="test")
    store.add(replace(bending_recording(400, "b"), suit=None), split="val", config_hash="test")
    with pytest.raises(WearcapError, match="a.safetensors: this recording has no interactions"):
        dataset(tmp_path)
    with pytest.raises(WearcapError, match="no suit"):
        dataset(tmp_path, split="val")
    with pytest.raises(WearcapError, match='"suit" or "motion"'):
        dataset(tmp_path, stream="watch")


def test_angles_are_smpls_in_its_own_axes():
    rotvec = torch.zeros(2, 24, 3)
    rotvec[0, smpl24().index("left_knee")] = torch.tensor([0.1, 0.5, 0.2])  # ours: about x forward, y left, z up
    angles = SmplAngles().encode(rotation.exp(rotvec))
    assert angles.shape == (2, 69)
    knee = smpl24().index("left_knee") - 1
    torch.testing.assert_close(angles[0].view(23, 3)[knee], torch.tensor([0.5, 0.2, 0.1]))
    fingers = SmplAngles(fingers=True)
    seen = fingers.encode(rotation.exp(0.1 * torch.ones(1, len(smplh52()), 3)))[0]
    assert seen.shape == (fingers.size,) == (159,)
    assert not seen[63:69].any()
    assert seen[69:].min() > 0.09


def test_views_know_neither_place_nor_heading_and_swap_in_a_mirror():
    views, R = HandViews(), bending(60)[0].R_parent_joint
    seen = views.encode(R)
    assert seen.shape == (60, views.size)
    turned = R.clone()
    turned[:, 0] = rotation.about_axis("z", torch.tensor(1.3)) @ R[:, 0]
    torch.testing.assert_close(views.encode(turned), seen, atol=1e-5, rtol=0)
    tipped = R.clone()
    tipped[:, 0] = rotation.about_axis("y", torch.tensor(0.3)) @ R[:, 0]
    assert (views.encode(tipped) - seen).abs().max() > 0.1
    left, right = seen.chunk(2, -1)
    mirrored = views.encode(mirrored_rotations(R, views.skeleton))
    torch.testing.assert_close(mirrored, torch.cat([right, left], -1), atol=1e-5, rtol=0)


def test_poses_that_are_not_numbers_are_named():
    motion = bending(60)[0]
    broken = motion.R_parent_joint.clone()
    broken[7, 3] = math.nan
    with pytest.raises(WearcapError, match="1 of 60 poses are not numbers, first frame 7"):
        pose_frames(replace(motion, R_parent_joint=broken), xsens23(), 60.0)
