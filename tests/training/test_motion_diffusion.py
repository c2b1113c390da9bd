"""The training module: which noise levels the network sees, and what its losses compare."""

import torch
from torch import nn

from wearcap.body.skeleton import xsens23
from wearcap.data.features import HeadFeatures
from wearcap.data.statistics import collate
from wearcap.data.windows import Source, WindowDataset
from wearcap.diffusion.schedule import CosineSchedule
from wearcap.models.denoiser import MotionDenoiser
from wearcap.training.motion_diffusion import MotionDiffusion
from wearcap_testing import small_dataset


class Spy(nn.Module):
    """A denoiser that answers with the truth it was given, and remembers the levels."""

    def __init__(self, net: MotionDenoiser, answer: torch.Tensor):
        super().__init__()
        self.motion_normalizer, self.self_conditioning, self.past = net.motion_normalizer, False, False
        self.answer = answer

    def encode(self, conditions, valid):
        return conditions.head

    def forward(self, x_t, level, encoded, valid):
        self.level = level
        return self.answer


def system(batch, level_tilt: float) -> MotionDiffusion:
    features = HeadFeatures()

    def net(motion_size, condition_size, points_size, image_size):
        plain = MotionDenoiser(motion_size, condition_size, 60, 32, 1, 4, 32, 0.0, 4)
        return Spy(plain, features.encode(batch.R_parent_joint, batch.R_world_head, batch.foot_contact))

    weights = {"motion": 1.0, "joints": 1.0, "velocity": 1.0}
    return MotionDiffusion(net, features, CosineSchedule(), xsens23(), 60.0, weights, torch.optim.AdamW,
                           level_tilt=level_tilt)  # fmt: skip


def test_a_tilt_draws_high_levels_more_often_and_the_truth_costs_nothing(tmp_path):
    store = small_dataset(tmp_path)
    windows = WindowDataset([Source(str(store.root))], "train", window=60, stride=30, fps=60.0)
    batch = collate([windows[(i % len(windows), i)] for i in range(400)])
    for tilt in (0.0, 2.0):
        module = system(batch, tilt)
        terms = module.terms(batch)
        seen = module.net.level
        # A density of (1 + tilt) l^tilt has this mean.
        assert abs(seen.mean().item() - (1 + tilt) / (2 + tilt)) < 0.04
        assert terms["motion"] < 1e-9
        assert terms["velocity"] < 1e-6
        assert terms["joints"] < 2e-3  # the distance's own smallest value


def test_pasts_end_late_are_doubtful_and_what_is_new_weighs_more(tmp_path):
    store = small_dataset(tmp_path)
    windows = WindowDataset([Source(str(store.root))], "train", window=60, stride=30, fps=60.0)
    batch = collate([windows[(i % len(windows), i)] for i in range(400)])
    features, seen = HeadFeatures(), []

    class Listening(MotionDenoiser):
        def encode(self, conditions, valid):
            seen.append(conditions)
            return super().encode(conditions, valid)

        def forward(self, x_t, level, encoded, valid, last=None):
            seen.append(x_t)
            return super().forward(x_t, level, encoded, valid, last)

    def net(motion_size, condition_size, points_size, image_size):
        return Listening(motion_size, condition_size, 60, 32, 1, 4, 32, 0.0, 4, past=True)

    module = MotionDiffusion(net, features, CosineSchedule(), xsens23(), 60.0, {"motion": 1.0}, torch.optim.AdamW, recall=0.5)  # fmt: skip
    module.terms(batch)
    *_, conditions, x_t = seen
    known = conditions.past_valid
    has = known.any(1)
    assert 0.4 < has.float().mean() < 0.55
    count, first = known[has].sum(1), known[has].float().argmax(1)
    end = first + count
    assert all(row[a:b].all() for row, a, b in zip(known[has], first.tolist(), end.tolist())), "one stretch"
    assert (end < batch.valid[has].sum(1)).float().mean() > 0.9, "something is new"
    assert (end > 50).float().mean() > 0.3
    assert 0.35 < (first == 0).float().mean() < 0.7, "half of them from the beginning"
    truth = features.encode(batch.R_parent_joint, batch.R_world_head, batch.foot_contact)
    # This network, which has learned nothing, says zero.
    doubt = (1.5 * batch.chance[:, 6, None, None]).clamp_max(1)
    assert torch.allclose(conditions.past, truth * (1 - doubt), atol=1e-6)
    weight = module._weight(batch)
    new = batch.valid[has] & (torch.arange(60) >= end[:, None])
    share = new.sum(1) / batch.valid[has].sum(1)
    rows = share > 0
    assert torch.allclose(weight[has][rows].mul(new[rows]).amax(1), share[rows].rsqrt(), rtol=1e-4)
    assert torch.equal(weight[~has], batch.valid[~has].float())
    level = batch.level[..., None]
    noise = (1 - module.schedule(level)).sqrt() * batch.noise[..., : truth.shape[-1]]
    told = torch.where(known[..., None], conditions.past, truth)
    assert torch.allclose(x_t, module.schedule(level).sqrt() * told + noise, atol=1e-4)
