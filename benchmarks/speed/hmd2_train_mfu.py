"""Training of HMD² on a GPU in bfloat16, full model, 512 windows a step: share of the GPU's peak that it uses.

A step is everything from a batch on the device to new weights: losses with forward kinematics, backward, AdamW.
FLOPs are those of the matrix products of forward and backward, as PyTorch's FlopCounterMode counts them on the network
as it is. value: their rate (TFLOP/s); baseline: the GPU's dense bfloat16 peak (H200, H100: 989; A100: 312); ratio =
value / baseline, to be at least `goal`. Without a CUDA device, or on one of unknown peak, it is left out.
"""

import sys
import time

import torch
from hydra.utils import instantiate
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.speed.online import EXPERIMENTS, IMAGE
from wearcap.cli.conf import compose
from wearcap.data.features import LIMBS
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.systems.hmd2.training import MotionDiffusion
from wearcap.systems.hmd2.training_windows import HeadWindow

PEAK_TFLOPS = {"H200": 989.0, "H100": 989.0, "A100": 312.0}
BATCH = 512


def measure(batch: int = BATCH, steps: int = 30) -> list[dict]:
    if not torch.cuda.is_available():
        print("hmd2_train_mfu: left out, no CUDA device", file=sys.stderr)
        return []
    peak = next((rate for name, rate in PEAK_TFLOPS.items() if name in torch.cuda.get_device_name()), None)
    if peak is None:
        print(f"hmd2_train_mfu: left out, the peak of {torch.cuda.get_device_name()} is not known", file=sys.stderr)
        return []
    windows = HeadWindow(*(part.cuda() for part in _windows(batch)))
    with FlopCounterMode(display=False) as counter:
        _Training(compile=False).step(windows)
    training = _Training(compile=True)
    for _ in range(5):
        training.step(windows)
    torch.cuda.synchronize()
    begin = time.perf_counter()
    for _ in range(steps):
        training.step(windows)
    torch.cuda.synchronize()
    rate = counter.get_total_flops() * steps / (time.perf_counter() - begin) / 1e12
    return [
        {
            "name": "hmd2_train_mfu",
            "value": rate,
            "unit": "TFLOP/s",
            "baseline": peak,
            "ratio": rate / peak,
            "goal": 0.25,
        }
    ]


class _Training:
    def __init__(self, compile: bool, device: str = "cuda"):
        torch.manual_seed(0)
        config = compose(
            "train", [f"experiment={EXPERIMENTS['full']}", "surroundings=head", f"model.compile={compile}"]
        )
        points, image = {"encoder": VoxelAutoencoder()}, {"size": IMAGE, "encoder": "any"}
        self.system: MotionDiffusion = instantiate(
            config.model, conditions={"points": points, "image": image}, _convert_="all"
        ).to(device)
        self.system.train()
        self.optimizer = torch.optim.AdamW(self.system.net.parameters(), fused=device == "cuda")

    def step(self, batch: HeadWindow) -> None:
        with torch.autocast(batch.valid.device.type, torch.bfloat16):
            terms, weights = self.system.terms(batch), self.system.loss_weights
        torch.stack([weights.get(name, 0.0) * term for name, term in terms.items()]).sum().backward()
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)


def _windows(batch: int, time_steps: int = 240, joints: int = 23) -> HeadWindow:
    """Random windows: how fast does not ask how well."""
    shape = batch, time_steps
    turns = torch.linalg.qr(torch.randn(*shape, joints, 3, 3))[0]
    there = torch.ones(shape, dtype=torch.bool)
    return HeadWindow(
        R_parent_joint=turns,
        R_world_head=turns[:, :, 0].clone(),
        t_world_head=torch.randn(*shape, 3),
        floor_height=torch.zeros(shape),
        floor_from_head=torch.zeros(shape),
        valid=there,
        t_parent_joint=0.2 * torch.randn(batch, joints, 3),
        size=torch.ones(batch, len(LIMBS)),
        foot_contact=torch.rand(*shape, 2).round(),
        others=torch.randn(*shape, VoxelAutoencoder().size + IMAGE),
        given=there[..., None].expand(-1, -1, 2),
        noise=torch.randn(*shape, 6 * joints + 2),
        level=torch.rand(batch, 1),
        chance=torch.rand(batch, 3),
    )
