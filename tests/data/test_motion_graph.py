"""Walks through a motion graph: clips of one motion give it back, feet must not slide, dead ends are avoided."""

from dataclasses import replace

import pytest
import torch

from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.cli import prepare as verb
from wearcap.cli.conf import compose
from wearcap.data.bodies import Proportions, with_bones
from wearcap.data.motion_graph import MotionGraph, WalkSettings
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import Motion, Recording, RecordingStore
from wearcap.recording.recording import ContactTrack, FloorTrack

FPS = 60.0
EXACT = WalkSettings(agreement_m=1e-3, slide_m_s=100.0)
EIGHT_SECONDS = tuple(k * 2 * torch.pi / 8 for k in (2, 3, 1))


def wandering(frames: int = 480, speeds: tuple[float, ...] = (2.1, 3.3, 0.9)) -> Motion:
    """A body that goes round a circle, with knees and head that move at some speeds (rad/s), in a way that never repeats."""
    skeleton, at = xsens23(), torch.arange(frames) / FPS
    R = torch.eye(3).repeat(frames, len(skeleton), 1, 1)
    R[:, 0] = rotation.about_axis("z", 0.3 * at)
    for name, speed in zip(("left_knee", "right_knee", "head"), speeds):
        R[:, skeleton.index(name)] = rotation.about_axis("y", 0.4 - 0.4 * torch.cos(speed * at))
    round_a_circle = torch.sin(0.3 * at) / 0.3, (1 - torch.cos(0.3 * at)) / 0.3
    root = torch.stack([*round_a_circle, torch.full_like(at, skeleton.root_height + 0.1)], -1)
    return Motion(at.double(), skeleton, R, root)


def clip(name: str, motion: Motion, feet: bool = True, **changed) -> Recording:
    times = motion.timestamps
    contact = torch.full((len(times), len(FOOT_PATCHES)), feet)
    return Recording(
        name,
        motion=motion,
        contacts=ContactTrack(times, FOOT_PATCHES, contact),
        floor=FloorTrack(times, torch.zeros(len(times))),
        skeleton=motion.skeleton,
        subject=name,
        license=f"licence of {name}",
        **changed,
    )


def turned(motion: Motion) -> Motion:
    turn, R = rotation.about_axis("z", torch.tensor(1.3)), motion.R_parent_joint.clone()
    R[:, 0] = turn @ R[:, 0]
    t = (turn @ motion.t_world_root[..., None])[..., 0] + torch.tensor([3.0, -2.0, 0.0])
    return replace(motion, R_parent_joint=R, t_world_root=t)


def halves() -> list[Recording]:
    """One motion as two clips of which the second begins in the middle of the first, at another place and heading."""
    whole = wandering()
    return [clip("a", whole.sliced(0, 240)), clip("b", turned(whole.sliced(120, 480)))]


def test_clips_of_one_motion_give_it_back():
    """Elsewhere and turned, but with the same joints as seen from the body; no jump where the clips meet."""
    graph, whole = MotionGraph(halves(), EXACT), wandering()
    walks = [graph.walk(8.0, seed) for seed in range(20)]
    motion, parts = next((motion, parts) for motion, parts in walks if [each.clip for each in parts] == [0, 1])
    assert len(motion) == len(whole)
    torch.testing.assert_close(motion.R_parent_joint[:, 1:], whole.R_parent_joint[:, 1:], atol=1e-5, rtol=0)
    torch.testing.assert_close(motion.T_world_joint.t, whole.T_world_joint.t, atol=1e-3, rtol=0)
    assert parts[0].stop - 24 == 120 + parts[1].start  # they share the frames of the blend


def test_a_walk_is_a_function_of_its_seed_and_as_long_as_wanted():
    whole = wandering(600, EIGHT_SECONDS)
    graph = MotionGraph([clip(str(k), whole.sliced(k, k + 300)) for k in (0, 120, 240)], EXACT)
    for seed in range(5):
        motion, parts = graph.walk(20.0, seed)
        again, _ = graph.walk(20.0, seed)
        assert torch.equal(motion.R_parent_joint, again.R_parent_joint)
        assert len(motion) == 20 * FPS
        assert sum(part.stop - part.start - 24 for part in parts) + 24 == len(motion)
    assert len({tuple(part.clip for part in graph.walk(20.0, seed)[1]) for seed in range(5)}) > 1


def test_feet_that_slide_or_sink_forbid_a_transition():
    sliding = MotionGraph(halves(), WalkSettings(agreement_m=1e-3, slide_m_s=0.3))
    assert sliding.transitions == 0
    lifted = [replace(each, contacts=clip("", each.motion, feet=False).contacts) for each in halves() if each.motion]
    assert MotionGraph(lifted, WalkSettings(agreement_m=1e-3, slide_m_s=0.3)).transitions > 10
    sunk = [
        clip(each.name, replace(each.motion, t_world_root=each.motion.t_world_root - torch.tensor([0.0, 0.0, 0.5])))
        for each in halves()
        if each.motion is not None
    ]
    assert MotionGraph(sunk, EXACT).transitions == 0


def test_the_first_clips_person_does_it_all():
    """A longer body's path is shortened with its legs."""
    first, second = halves()
    motion = second.motion
    assert motion is not None
    taller = with_bones(motion.skeleton, Proportions(*[1.2] * 5))
    second = clip("b", replace(motion, skeleton=taller, t_world_root=1.2 * motion.t_world_root))
    graph, whole = MotionGraph([first, second], EXACT), wandering()
    walks = [graph.walk(8.0, seed) for seed in range(20)]
    found = next(motion for motion, parts in walks if [each.clip for each in parts] == [0, 1])
    assert found.skeleton.stature == pytest.approx(xsens23().stature)
    torch.testing.assert_close(found.T_world_joint.t, whole.T_world_joint.t, atol=1e-3, rtol=0)


def test_dead_ends_are_avoided():
    """Many transitions lead to a clip that leads nowhere; a walk takes the few that do not."""
    whole = wandering(600, EIGHT_SECONDS)
    around = [clip(str(k), whole.sliced(k, k + 300)) for k in (0, 240)]
    ends = [clip(f"end {k}", whole.sliced(150, 260)) for k in range(6)]
    graph = MotionGraph(around + ends, replace(EXACT, shortest_s=1.6))
    assert any(part.clip > 1 for seed in range(20) for part in MotionGraph(around[:1] + ends, EXACT).walk(9.0, seed)[1])
    for seed in range(5):
        motion, _ = graph.walk(15.0, seed)
        assert len(motion) == 15 * FPS


def test_what_cannot_be_joined_is_named():
    first, second = halves()
    with pytest.raises(WearcapError, match="without two clips"):
        MotionGraph([first, clip("short", wandering(30))])
    with pytest.raises(WearcapError, match="a has no motion with contacts on a level floor"):
        MotionGraph([replace(first, floor=None), second])
    slower = wandering(200)
    with pytest.raises(WearcapError, match="slow has 30 frames per second"):
        MotionGraph([first, clip("slow", replace(slower, timestamps=2 * slower.timestamps))])


def prepared(root, output, *more: str):
    settings = [f"sources=[{root}]", f"output={output}", "recordings=3", "seconds=6", "jobs=1", "backend=threading"]
    return verb.run(
        compose("prepare", ["prepare=motion_graph", "walk.slide_m_s=100", "walk.sink_m=1", *settings, *more])
    )


def test_prepare_joins_the_training_recordings(tmp_path):
    store = RecordingStore(tmp_path / "source")
    for each in halves():
        store.add(each, split="train", config_hash="test")
    store.add(clip("kept out", wandering()), split="test", config_hash="test")
    assert prepared(store.root, tmp_path / "a").failed == {}
    made = RecordingStore.open(tmp_path / "a")
    assert made.names("train") == ["walk_0000", "walk_0001", "walk_0002"]
    for name in made.names():
        recording = made.load(name)
        assert recording.motion is not None
        assert recording.head is not None
        assert recording.contacts is not None
        assert recording.source.startswith("a walk through ")
        assert "kept out" not in recording.source
        assert all(
            f"licence of {clip}" in recording.license for clip in recording.source.split("through ")[1].split(", ")
        )
    assert prepared(store.root, tmp_path / "a").current == made.names()
    prepared(store.root, tmp_path / "b")
    assert [entry.sha256 for entry in made.entries.values()] == [
        entry.sha256 for entry in RecordingStore.open(tmp_path / "b").entries.values()
    ]
