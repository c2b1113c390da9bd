"""How sure a motion says that it is of its joints: shares within deviations, likelihood, and how deviations are fitted."""

import math
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
import torch
from lightning.pytorch import LightningModule, Trainer
from scipy.stats import norm, t

from wearcap.body.skeleton import xsens23
from wearcap.io.formats.motion_npz import read_motion, write_motion
from wearcap.metrics.certainty import certainty_scores, deviations, tails
from wearcap.models.layers import Normalizer
from wearcap.recording import Motion
from wearcap.training.callbacks import FitSpread

FRAMES = 400


def still(std: float | torch.Tensor | None) -> Motion:
    """Somebody who stands; deviations of all joints (m)."""
    skeleton = xsens23()
    R = torch.eye(3).expand(FRAMES, len(skeleton), 3, 3)
    times = torch.arange(FRAMES, dtype=torch.float64) / 60
    joint_std = None if std is None else torch.as_tensor(std).expand(FRAMES, len(skeleton))
    return Motion(times, skeleton, R, torch.zeros(FRAMES, 3), joint_std=joint_std)


@pytest.mark.parametrize(("std", "within"), [(0.05, (68.3, 95.0)), (0.1, (95.4, 99.99)), (0.025, (38.3, 67.3))])
def test_shares_and_likelihood_are_those_of_a_normal_distribution(std, within):
    random = torch.Generator().manual_seed(0)
    away = 0.05 * torch.randn(FRAMES, 3, generator=random)
    truth, found = still(None), replace(still(std), t_world_root=away)  # all joints are off alike
    scores = certainty_scores(found, truth)
    assert (scores["within_68"], scores["within_95"]) == pytest.approx(within, abs=2.5)
    assert scores["surprise"] == pytest.approx(-norm(0, std).logpdf(away.double().numpy()).mean(), abs=1e-3)


@pytest.mark.parametrize("dof", [1.5, 3.0, 8.0])
def test_shares_and_likelihood_are_those_of_students_distribution(dof, tmp_path):
    away = t(dof, scale=0.05 / t(dof).ppf(norm.cdf(1))).rvs((FRAMES, 3), random_state=0)
    found = replace(still(0.05), t_world_root=torch.from_numpy(away).float(), joint_dof=dof)
    scores = certainty_scores(found, still(None))
    assert (scores["within_68"], scores["within_95"]) == pytest.approx((68.3, 95.0), abs=2.5)
    likely = t(dof, scale=0.05 / t(dof).ppf(norm.cdf(1))).logpdf(away)
    assert scores["surprise"] == pytest.approx(-likely.mean(), abs=1e-3)
    assert scores["surprise"] < certainty_scores(replace(found, joint_dof=None), still(None))["surprise"]
    assert found.joint_within(0.9)[0, 0] == pytest.approx(t.interval(0.9, dof)[1] * 0.05 / t(dof).ppf(norm.cdf(1)))
    write_motion(found, tmp_path / "motion.npz")
    assert read_motion(tmp_path / "motion.npz").joint_dof == dof


@pytest.mark.parametrize(("dof", "found"), [(1.5, 1.5), (3.0, 3.0), (math.inf, None), (0.4, 1.0)])
def test_tails_are_found_again(dof, found):
    away = torch.from_numpy(abs(2 * t(dof).ppf((torch.arange(20000).numpy() + 0.5) / 20000)))
    factor, fitted = tails(away)
    assert factor == pytest.approx(2 * t(dof).ppf(norm.cdf(1)), rel=1e-3)
    assert fitted == (None if found is None else pytest.approx(found, rel=1e-2))


def test_measured_joints_say_nothing_and_who_says_nothing_is_not_scored():
    skeleton = xsens23()
    std = torch.full((len(skeleton),), 0.05)
    std[skeleton.index("head")] = 0.0004
    found = replace(still(std), t_world_root=torch.full((FRAMES, 3), 0.04))
    assert certainty_scores(found, still(None)) == pytest.approx(
        {"within_68": 100.0, "within_95": 100.0, "surprise": -norm(0, 0.05).logpdf(0.04)}, abs=1e-4
    )
    away = deviations(found, still(None))
    assert away[:, skeleton.index("head")].isnan().all()
    assert certainty_scores(still(None), still(None)) == {}


def test_factors_put_two_thirds_of_the_errors_of_each_joint_within_the_deviations():
    random = torch.Generator().manual_seed(0)
    errors = [torch.tensor([0.5, 1.0, 3.0])[:, None] * torch.randn(2000, 3, 3, generator=random) for _ in range(2)]
    errors = [each / (torch.randn(2000, 3, 3, 5, generator=random).square().mean(-1).sqrt()) for each in errors]
    net = SimpleNamespace(motion_normalizer=Normalizer(5))
    trainer, module = MagicMock(spec=Trainer, val_dataloaders=errors), MagicMock(spec=LightningModule, net=net)
    module.joint_dof = torch.zeros(())
    module.transfer_batch_to_device, module.away = (lambda batch, *_: batch), torch.abs
    FitSpread().on_validation_epoch_end(trainer, module)
    assert net.motion_normalizer.mean[:2].tolist() == [0, 0], "the pose's mean stays"
    deviation = t(5).ppf(norm.cdf(1))
    assert net.motion_normalizer.mean[2:].exp().tolist() == pytest.approx(
        [0.5 * deviation, deviation, 3 * deviation], rel=0.03
    )
    assert module.joint_dof.item() == pytest.approx(5, rel=0.15)
    module.away = lambda batch: None
    before = net.motion_normalizer.mean.clone()
    FitSpread().on_validation_epoch_end(trainer, module)
    assert torch.equal(net.motion_normalizer.mean, before)
