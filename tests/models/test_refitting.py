"""How sure a checkpoint's network is, fitted anew to captures of a data set: all its weights stay as they were."""

from dataclasses import replace

import pytest
import torch
from scipy.stats import norm, t

from wearcap.errors import WearcapError
from wearcap.evaluation.certainty import refitted
from wearcap.metrics.certainty import certainty_scores
from wearcap.models.checkpoint import load_trained, read_checkpoint, share_checkpoint
from wearcap.recording import RecordingStore
from wearcap.runtime.system import Captured, CaptureInput, System
from wearcap_testing import recording_of, swaying_motion

DOF, WIDER = 3.0, 1.7


class Erring(System):
    """Returns the truth, is sure of all joints within 2 cm, and draws errors of a known distribution that are larger."""

    name = "erring"

    def capture(self, recordings, seeds, options=None):
        truth = CaptureInput.of(recordings[0]).recording.motion
        away = t(DOF, scale=WIDER * 0.02 / t(DOF).ppf(norm.cdf(1))).rvs((len(truth), 3), random_state=0)
        head = truth.joint("head").t
        std = torch.full((*head.shape[:1], len(truth.skeleton)), 0.02)
        std[:, truth.skeleton.index("head")] = 0.0
        self.away = torch.from_numpy(away).float()
        return [Captured(replace(truth, joint_std=std))]


class Silent(Erring):
    def capture(self, recordings, seeds, options=None):
        return [Captured(CaptureInput.of(recordings[0]).recording.motion)]


def test_a_shared_checkpoint_takes_factor_and_tails_and_keeps_its_weights(tmp_path, monkeypatch):
    store = RecordingStore(tmp_path / "data")
    store.add(recording_of(swaying_motion(3000), "one"), split="val", config_hash="")
    system = Erring()

    def off(motion, recording, name):  # all joints but the head, by the same errors
        moved = replace(motion)
        pose = motion.T_world_joint
        moved.__dict__["T_world_joint"] = replace(pose, t=pose.t + system.away[:, None])
        return moved, recording.motion, None

    monkeypatch.setattr("wearcap.evaluation.certainty.comparable", off)
    changed = refitted(system, "mocap_every", store, ["one"])
    assert changed["joint_dof"].item() == pytest.approx(DOF, rel=0.15)
    share_checkpoint("mocap_every", tmp_path / "fitted.safetensors", "bfloat16", changed)
    before, after = (read_checkpoint(path)[1] for path in ("mocap_every", tmp_path / "fitted.safetensors"))
    mean = "net.motion_normalizer.mean"
    assert all(torch.equal(after[name], before[name]) for name in before if name not in (mean, "joint_dof"))
    grown = (after[mean] - before[mean]).exp()
    assert torch.equal(grown[:-23], torch.ones(len(grown) - 23)), "poses stay"
    torch.testing.assert_close(grown[-23:], torch.full((23,), WIDER), rtol=0.05, atol=0.0)
    model = load_trained(tmp_path / "fitted.safetensors")[0].pipeline_parts()["model"]
    assert model.joint_dof == pytest.approx(changed["joint_dof"].item())
    wider = replace(system(store.load("one")), joint_dof=model.joint_dof)
    wider = off(replace(wider, joint_std=WIDER * wider.joint_std), store.load("one"), "one")[0]
    scores = certainty_scores(wider, store.load("one").motion)
    assert (scores["within_68"], scores["within_95"]) == pytest.approx((68.3, 95.0), abs=1.5)


def test_a_network_that_does_not_say_is_refused(tmp_path):
    store = RecordingStore(tmp_path)
    store.add(recording_of(swaying_motion(30), "one"), split="val", config_hash="")
    with pytest.raises(WearcapError, match="does not say how sure"):
        refitted(Silent(), "mocap_every", store, ["one"])
    with pytest.raises(WearcapError, match="no recordings"):
        refitted(Erring(), "mocap_every", store, [])
