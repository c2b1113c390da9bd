"""Two wearers of one session: each one's captured pose is mended by what the other's camera saw."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.tables import two_wearers
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import Motion, Recording, RecordingStore
from wearcap.systems.mocap_every.energy import LatentSolver, LatentWeights
from wearcap.systems.mocap_every.manifold import MotionManifold
from wearcap.systems.mocap_every.visual_cues import View, VisualCues, capture_session
from wearcap.tracking.anchor import anchored_to_head
from wearsim.recordings.simulate import SimulationConfig


@pytest.fixture(scope="module")
def pair() -> tuple[Recording, Recording]:
    config = SimulationConfig(duration_s=3.0, fps=30.0, points=False, suit=None, world="flat")
    return two_wearers.simulate_two_wearers(config, "talk", "val", 3, distance_m=2.5)


class AnyMotion(MotionManifold):
    """Holds every motion: latents are the features themselves."""

    def encode(self, motion):
        return motion.transpose(1, 2).contiguous()

    def decode(self, latent):
        return latent.transpose(1, 2)


@pytest.fixture(scope="module")
def cues(pair) -> VisualCues:
    size = 5 + 6 * len(pair[0].motion.skeleton)
    manifold = AnyMotion(size, channels=4, width=3)
    return VisualCues(manifold, LatentWeights(stay=1e-3, contact=0.0), LatentSolver(steps=60), window=40)


def wrong(recording: Recording) -> Motion:
    """A capture whose arms are off by 30°, its head where it was measured."""
    motion = recording.motion
    R = motion.R_parent_joint.clone()
    turn = rotation.about_axis("x", torch.tensor(30.0).deg2rad())
    for joint in ("left_shoulder", "right_shoulder"):
        R[:, motion.skeleton.index(joint)] = R[:, motion.skeleton.index(joint)] @ turn
    return anchored_to_head(replace(motion, R_parent_joint=R), motion.joint("head"))


def arms_off_deg(motion: Motion, truth: Motion) -> float:
    arms = motion.skeleton.indices("left_shoulder", "right_shoulder")
    return rotation.geodesic(motion.R_parent_joint[:, arms], truth.R_parent_joint[:, arms]).rad2deg().mean().item()


def true_views(recordings) -> dict[str, list[View]]:
    """A view of each wearer whose arms are seen as they are."""
    confidence = torch.ones(len(recordings[0].motion), len(recordings[0].motion.skeleton))
    return {recording.name: [View(recording.motion, confidence)] for recording in recordings}


def test_the_others_views_lower_a_planted_error(pair, cues):
    motions = capture_session(pair, wrong, cues, true_views(pair))
    for recording in pair:
        edited = motions[recording.name]
        before = arms_off_deg(wrong(recording), recording.motion)
        assert before == pytest.approx(30, abs=0.5)
        assert arms_off_deg(edited, recording.motion) < 0.5 * before
        head = edited.joint("head").t - recording.motion.joint("head").t
        assert head.norm(dim=-1).max() < 1e-3


def test_without_views_everyone_is_as_captured(pair, cues):
    motions = capture_session(pair, wrong, cues, {})
    for recording in pair:
        assert torch.equal(motions[recording.name].R_parent_joint, wrong(recording).R_parent_joint)


def test_a_view_comes_back_from_its_files(pair, tmp_path):
    (view,) = true_views(pair)["talk-a"]
    view.write(tmp_path / "talk-a.by.talk-b.npz")
    read = View.read(tmp_path / "talk-a.by.talk-b.npz")
    assert torch.equal(read.motion.R_parent_joint, view.motion.R_parent_joint)
    assert torch.equal(read.confidence, view.confidence)
    np.savez(tmp_path / "talk-a.by.talk-b.confidence.npz", confidence=np.full((3, 2), 0.5))
    with pytest.raises(WearcapError, match="array 'confidence' has shape"):
        View.read(tmp_path / "talk-a.by.talk-b.npz")
    np.savez(tmp_path / "talk-a.by.talk-b.confidence.npz", confidence=2.0 * np.ones(view.confidence.shape))
    with pytest.raises(WearcapError, match="0 to 1"):
        View.read(tmp_path / "talk-a.by.talk-b.npz")
    (tmp_path / "talk-a.by.talk-b.confidence.npz").unlink()
    with pytest.raises(WearcapError, match="no such file"):
        View.read(tmp_path / "talk-a.by.talk-b.npz")


def test_a_session_survives_the_store_and_may_be_absent(pair, tmp_path):
    store = RecordingStore(tmp_path)
    for recording in (pair[0], replace(pair[1], session=None)):
        store.add(recording, split="val", config_hash="x")
    assert [store.load(name).session for name in store.names()] == ["talk", None]


def test_what_is_no_session_is_refused(pair, cues):
    a, b = pair
    late = replace(b, head=replace(b.head, timestamps=b.head.timestamps + 100))
    for recordings, message in (
        ((a, replace(b, session="other")), "talk-b: session 'other'"),
        ((replace(a, session=None), b), "talk-a: session None"),
        ((a, a), "two recordings are called 'talk-a'"),
        ((a, late), "at different times"),
    ):
        with pytest.raises(WearcapError, match=message):
            capture_session(recordings, wrong, cues, {})
    with pytest.raises(WearcapError, match="views of 'talk-b'"):
        capture_session([a], wrong, cues, true_views(pair))
