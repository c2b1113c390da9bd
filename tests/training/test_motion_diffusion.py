"""The training module: which noise levels the network sees, and what its losses compare."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from wearcap.body.skeleton import xsens23
from wearcap.data.windows import Source, Windows
from wearcap.diffusion.schedule import CosineSchedule
from wearcap.errors import WearcapError
from wearcap.models.layers import TransformerSize
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import MotionDenoiser
from wearcap.systems.hmd2.training import Levels, Loss, MotionDiffusion
from wearcap.systems.hmd2.training_windows import HeadContent
from wearcap.training.base import Optimization
from wearcap_testing import seeded, small_dataset


class Spy(nn.Module):
    """A denoiser that answers with the truth it was given, and remembers the levels."""

    def __init__(self, net: MotionDenoiser, answer: torch.Tensor):
        super().__init__()
        self.motion_normalizer, self.self_conditioning = net.motion_normalizer, False
        self.answer = answer

    def encode(self, conditions, valid):
        return conditions.head

    def forward(self, x_t, level, encoded, valid):
        self.level = level
        return self.answer


def system(batch, level_tilt: float, pure: float = 0.0) -> MotionDiffusion:
    features = HeadFeatures()

    def net(motion_size, condition_size, conditions):
        plain = MotionDenoiser(motion_size, condition_size, 60, TransformerSize(32, 1, 4, 32, 0.0), 4)
        return Spy(plain, features.encode(batch.R_parent_joint, batch.R_world_head, batch.foot_contact))

    loss, levels = Loss({"motion": 1.0, "joints": 1.0, "velocity": 1.0}, 0.0, None), Levels(level_tilt, pure)
    how = levels, loss, Optimization(torch.optim.AdamW)
    return MotionDiffusion(net, features, CosineSchedule(), xsens23(), 60.0, *how)


def test_a_tilt_draws_high_levels_more_often_and_the_truth_costs_nothing(tmp_path):
    store = small_dataset(tmp_path)
    windows = Windows([Source(str(store.root))], "train", content=HeadContent(), window=60, stride=30, fps=60.0)
    batch = windows.batch(torch.arange(400) % len(windows), torch.arange(400))
    for tilt in (0.0, 2.0):
        module = system(batch, tilt)
        terms = module.terms(batch)
        seen = module.net.level
        # A density of (1 + tilt) l^tilt has this mean.
        assert abs(seen.mean().item() - (1 + tilt) / (2 + tilt)) < 0.04
        assert terms["motion"] < 1e-9
        assert terms["velocity"] < 1e-6
        assert terms["joints"] < 2e-3  # the distance's own smallest value


def test_a_share_of_the_windows_is_pure_noise_and_the_others_keep_their_levels(tmp_path):
    store = small_dataset(tmp_path)
    windows = Windows([Source(str(store.root))], "train", content=HeadContent(), window=60, stride=30, fps=60.0)
    batch = windows.batch(torch.arange(400) % len(windows), torch.arange(400))
    module = system(batch, 0.0, pure=0.6)
    module.terms(batch)
    pure = module.net.level == 1
    assert abs(pure.float().mean().item() - 0.6) < 0.08
    assert abs(module.net.level[~pure].mean().item() - 0.5) < 0.09


def test_all_windows_of_pure_noise_are_refused(tmp_path):
    store = small_dataset(tmp_path)
    windows = Windows([Source(str(store.root))], "train", content=HeadContent(), window=60, stride=30, fps=60.0)
    with pytest.raises(WearcapError, match="pure=1.0.*Expected from 0 to less than 1"):
        system(seeded(windows, 0, 1), 0.0, pure=1.0)


def test_the_last_frames_that_exist_weigh_more_by_the_tail(tmp_path):
    store = small_dataset(tmp_path)
    windows = Windows([Source(str(store.root))], "train", content=HeadContent(), window=60, stride=30, fps=60.0)
    batch = seeded(windows, 0, 1)
    batch = batch._replace(valid=torch.arange(60)[None] < 50)
    module = system(batch, 0.0)
    truth = module.net.answer

    def cost(frame: int, tail: float) -> float:
        module.loss = replace(module.loss, tail=tail)
        module.net.answer = truth + 0.1 * (torch.arange(60) == frame)[None, :, None]
        return module.terms(batch)["motion"].item()

    assert cost(0, 0.0) == pytest.approx(cost(49, 0.0), rel=1e-4)
    assert cost(49, 3.0) == pytest.approx(4 * cost(49, 0.0), rel=1e-4)
    assert cost(0, 3.0) < 1.3 * cost(0, 0.0)
    assert cost(55, 3.0) == pytest.approx(0.0, abs=1e-9)
