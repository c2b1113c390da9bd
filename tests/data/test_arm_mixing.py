"""Arms of one clip with legs of another: a planted trunk is found, nothing else changes, arms never jump."""

from dataclasses import replace

import pytest
import torch

from wearcap.body.skeleton import xsens23
from wearcap.data.arm_mixing import ARMS, ArmDonors
from wearcap.data.bodies import OtherBodies
from wearcap.data.windows import ARM_VERSIONS, Source, Windows
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import Motion, Recording, RecordingStore
from wearcap.systems.mocap_every.training_windows import WatchContent, WatchWindow
from wearcap_testing import small_dataset

FPS = 60.0
JOINTS = xsens23().indices(*ARMS)


def moving(lean: torch.Tensor, arms: float) -> Motion:
    """A body whose trunk leans forward by `lean` (rad) per frame, with upper arms that swing by `arms` (rad)."""
    skeleton, count = xsens23(), len(lean)
    R = torch.eye(3).repeat(count, len(skeleton), 1, 1)
    R[:, 0] = rotation.about_axis("y", lean)
    swing = arms * torch.sin(torch.arange(count) / FPS * 5)
    for side in ("left", "right"):
        R[:, skeleton.index(f"{side}_shoulder")] = rotation.about_axis("x", swing + arms)
    return Motion(torch.arange(count).double() / FPS, skeleton, R, torch.tensor([0.0, 0.0, 1.0]).repeat(count, 1))


def stored(root, **motions: Motion) -> RecordingStore:
    store = RecordingStore(root)
    for name, motion in motions.items():
        store.add(Recording(name, motion=motion, skeleton=motion.skeleton), split="train", config_hash="test")
    return store


def wave(count: int, speed: float) -> torch.Tensor:
    return 0.6 * torch.sin(speed * torch.arange(count) / FPS)


def donors_of(store: RecordingStore, **settings) -> ArmDonors:
    return ArmDonors([store.open_file(name) for name in store.names()], **settings)


def test_the_arms_are_those_of_the_planted_trunk(tmp_path):
    """Of three donors one leans as the motion does, 90 frames later: its arms are taken, frame by frame."""
    own, later = wave(100, 3.0), torch.cat([torch.full((90,), -1.2), wave(100, 3.0)])
    store = stored(
        tmp_path,
        own=moving(own, 0.1),
        alike=moving(later, 0.5),
        upright=moving(0 * later, 0.9),
        faster=moving(wave(190, 9.0), 1.3),
    )
    motion, donor = store.load("own").motion, store.load("alike").motion
    assert motion is not None
    assert donor is not None
    mixed = donors_of(store).mixed(motion, store.open_file("own"), 0)
    torch.testing.assert_close(mixed.R_parent_joint[:, JOINTS], donor.R_parent_joint[90:190, JOINTS])
    rest = [joint for joint in range(len(motion.skeleton)) if joint not in JOINTS]
    assert torch.equal(mixed.R_parent_joint[:, rest], motion.R_parent_joint[:, rest])
    assert torch.equal(mixed.t_world_root, motion.t_world_root)


def test_arms_stay_where_no_trunk_agrees(tmp_path):
    store = stored(tmp_path, own=moving(wave(300, 3.0), 0.1), upright=moving(torch.zeros(300), 0.9))
    motion = store.load("own").motion
    assert motion is not None
    mixed = donors_of(store, tolerance=0.2).mixed(motion, store.open_file("own"), 0)
    assert torch.equal(mixed.R_parent_joint, motion.R_parent_joint)
    alone = ArmDonors([store.open_file("own")]).mixed(motion, store.open_file("own"), 0)
    assert torch.equal(alone.R_parent_joint, motion.R_parent_joint)


def test_segments_are_blended_and_repeat_with_the_seed(tmp_path):
    """Donors hold their arms 2.6 rad apart; from frame to frame no arm turns by more than a blend's share of that."""
    still = torch.zeros(900)
    donors = {f"donor{number}": moving(still, 0.0) for number in range(2)}
    R = donors["donor1"].R_parent_joint.clone()
    R[:, JOINTS] = rotation.exp(torch.tensor([2.6, 0.0, 0.0]))
    donors["donor1"] = replace(donors["donor1"], R_parent_joint=R)
    store = stored(tmp_path, own=moving(still, 0.2), **donors)
    motion = store.load("own").motion
    assert motion is not None
    library, file = donors_of(store), store.open_file("own")
    made = [library.mixed(motion, file, seed).R_parent_joint[:, JOINTS] for seed in (3, 3, 4)]
    assert torch.equal(made[0], made[1])
    assert not torch.allclose(made[0], made[2])
    steps = rotation.geodesic(made[0][:-1], made[0][1:])
    assert steps.max() < 1.6 * 2.6 / 30
    taken = {round(angle, 1) for angle in rotation.log(made[0])[:, 0].norm(dim=-1).tolist()}
    assert {0.0, 2.6} <= taken
    torch.testing.assert_close(made[0].mT @ made[0], torch.eye(3).expand_as(made[0]), atol=1e-5, rtol=0)


def test_a_blend_passes_half_a_turn_without_a_jump(tmp_path):
    """The two donors drift through a difference of π, where the shorter way changes sides."""
    still = torch.zeros(900)
    drifting = moving(still, 0.0)
    R = drifting.R_parent_joint.clone()
    angle = torch.pi + 0.3 * torch.sin(torch.arange(900) / 7)
    R[:, JOINTS] = rotation.exp(angle[:, None] * torch.tensor([1.0, 0.0, 0.0]))[:, None].expand(-1, len(JOINTS), 3, 3)
    store = stored(
        tmp_path, own=moving(still, 0.2), donor0=moving(still, 0.0), donor1=replace(drifting, R_parent_joint=R)
    )
    motion = store.load("own").motion
    assert motion is not None
    library, file = donors_of(store), store.open_file("own")
    for seed in range(4):
        arms = library.mixed(motion, file, seed).R_parent_joint[:, JOINTS]
        assert rotation.geodesic(arms[:-1], arms[1:]).max() < 1.6 * (torch.pi + 0.3) / 30 + 0.3 / 7


def test_windows_take_other_arms_for_a_share_of_the_others(tmp_path):
    """The wearer moves as recorded; legs of the others, too; their arms are those of another recording of the store."""
    store = small_dataset(tmp_path)
    recording = store.load(store.names("train")[0])
    assert recording.motion is not None
    R = recording.motion.R_parent_joint.clone()
    R[:, JOINTS] = R[:, JOINTS] @ rotation.exp(torch.tensor([0.0, 0.5, 0.0]))
    twin = replace(recording, name="twin", motion=replace(recording.motion, R_parent_joint=R))
    store.add(twin, split="train", config_hash="test")
    settings = {"content": WatchContent(), "window": 40, "stride": 10, "fps": 30.0, "every": 2}
    none, mixed = (
        Windows([Source(str(store.root))], "train", True, bodies=OtherBodies(0.8, arms=arms), **settings)
        for arms in (0.0, 0.5)
    )
    chosen = torch.zeros(400, dtype=torch.long), torch.arange(400)
    before, after, cut = none.batch(*chosen), mixed.batch(*chosen), mixed.cut(*chosen)
    assert isinstance(before, WatchWindow)
    assert isinstance(after, WatchWindow)
    moved = cut.track != mixed.starts[0, 0]
    assert moved.double().mean().item() == pytest.approx(0.8 * 0.5, abs=0.06)
    assert not (moved & ~cut.others).any()
    counts = torch.bincount(cut.track[moved])
    assert (counts > 0).sum() == ARM_VERSIONS  # each as often
    assert counts[counts > 0].min() > 0.6 * moved.sum() / ARM_VERSIONS
    assert torch.equal(before.R_parent_joint[~moved], after.R_parent_joint[~moved])
    legs = [joint for joint in range(23) if joint not in JOINTS]
    assert torch.equal(before.R_parent_joint[:, :, legs], after.R_parent_joint[:, :, legs])
    torch.testing.assert_close(before.t_world_head, after.t_world_head, atol=1e-5, rtol=0)
    turned = rotation.geodesic(before.R_parent_joint[moved], after.R_parent_joint[moved])[:, :, JOINTS]
    assert turned.amax((1, 2)).min() > 0.3
    assert (before.R_world_wrist - after.R_world_wrist)[moved].abs().max() > 0.1


def test_a_share_is_a_share():
    with pytest.raises(WearcapError, match="a share of the people, from 0 to 1"):
        OtherBodies(0.5, arms=1.5)
