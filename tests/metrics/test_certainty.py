"""How sure a motion says that it is of its joints: shares within deviations, likelihood, and how deviations are fitted."""

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
import torch
from lightning.pytorch import LightningModule, Trainer
from scipy.stats import norm

from wearcap.body.skeleton import xsens23
from wearcap.metrics.certainty import certainty_scores, deviations
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
    net = SimpleNamespace(motion_normalizer=Normalizer(5))
    trainer, module = MagicMock(spec=Trainer, val_dataloaders=errors), MagicMock(spec=LightningModule, net=net)
    module.transfer_batch_to_device, module.away = (lambda batch, *_: batch), torch.abs
    FitSpread().on_validation_epoch_end(trainer, module)
    assert net.motion_normalizer.mean[:2].tolist() == [0, 0], "the pose's mean stays"
    assert net.motion_normalizer.mean[2:].exp().tolist() == pytest.approx([0.5, 1.0, 3.0], rel=0.03)
    module.away = lambda batch: None
    before = net.motion_normalizer.mean.clone()
    FitSpread().on_validation_epoch_end(trainer, module)
    assert torch.equal(net.motion_normalizer.mean, before)
