"""Rows of several wearers: who is seen, how wrong views are, and that exact views mend a planted error."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from benchmarks.tables import mocap_every_several as module
from wearcap.geometry import rotation
from wearcap.recording import Motion
from wearcap.systems.mocap_every.energy import LatentSolver, LatentWeights
from wearcap.systems.mocap_every.manifold import MotionManifold
from wearcap.systems.mocap_every.visual_cues import VisualCues
from wearcap.tracking.anchor import anchored_to_head


@pytest.fixture(scope="module")
def several():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "DURATION_S", 1.5)
        patch.setattr(module, "SHORTEST_S", 1.0)
        module.pair_of.cache_clear()
        yield module
        module.pair_of.cache_clear()


class AnyMotion(MotionManifold):
    """Holds every motion: latents are the features themselves."""

    def encode(self, motion):
        return motion.transpose(1, 2).contiguous()

    def decode(self, latent):
        return latent.transpose(1, 2)


def knees_bent(motion: Motion) -> Motion:
    """A capture whose knees are bent 40° too far, its head where it was measured."""
    R = motion.R_parent_joint.clone()
    knees = motion.skeleton.indices("left_knee", "right_knee")
    R[:, knees] = R[:, knees] @ rotation.about_axis("y", torch.tensor(40.0).deg2rad())
    return anchored_to_head(replace(motion, R_parent_joint=R), motion.joint("head"))


def test_exact_views_mend_what_is_seen(several):
    pair = several.watched_pair("val", 0)
    true = {each.recording.name: each.recording.motion for each in pair}
    pipeline = SimpleNamespace(run=lambda r: SimpleNamespace(motion=knees_bent(true[r.name])))
    manifold = AnyMotion(5 + 6 * 23, channels=4, width=3)
    editor = VisualCues(manifold, LatentWeights(stay=1e-3, contact=0.0), LatentSolver(steps=20), window=40)
    rows = several.session_rows(pair, "typical", pipeline, editor)
    lower = {label: max(row.scores["lower_pe_cm"] for row in each) for label, each in rows.items()}
    assert set(rows) == {f"{f}, {r}" for f in several.FRAMES for r in ("estimated", *several.VIEWS)}
    before, typical, exact = (lower[f"frames seen, {row}"] for row in ("estimated", *several.VIEWS))
    assert exact < 0.3 * before
    assert exact < typical
    for all_frames, seen in zip(rows["all frames, estimated"], rows["frames seen, estimated"]):
        assert seen.frames <= all_frames.frames


def test_a_person_of_a_data_set_is_watched_face_to_face(several):
    recording = several.pair_of("val", 0)[1]
    person = several.watched_person(replace(recording, session=None), "val")
    assert person.recording.session == recording.name
    motion, path = recording.motion, person.T_world_cam
    assert path.timestamps[-1] <= motion.timestamps[-1]
    between = motion.joint("head").t[0] - path.t_world_body[0]
    assert between[:2].norm() == pytest.approx(several.WATCHED_FROM_M, abs=0.4)
    assert path.R_world_body[0, :2, 2] @ between[:2] / between[:2].norm() > 0.8
    assert several.watched_person(replace(recording, motion=motion.between(0.0, 0.5)), "val") is None
