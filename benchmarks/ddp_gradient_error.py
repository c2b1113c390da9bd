"""Gradients of two gloo processes with half a batch each, against one process with the joint batch.

The training module's own loss in DistributedDataParallel, samples shared out by the project's sampler, dropout off.
Some windows are padded, and not as many frames in one share as in the other. value: largest difference of any gradient entry. baseline: largest entry of the
one process. ratio = value / baseline, to be at most `goal`.
"""

import tempfile
from pathlib import Path

import planted
import torch
import torch.distributed
import torch.multiprocessing
from hydra.utils import instantiate
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from wearcap.cli.conf import compose
from wearcap.data.datamodule import WindowsModule
from wearcap.data.windows import SeededSampler, collate
from wearcap.systems.hmd2.training import MotionDiffusion
from wearcap.systems.hmd2.training_windows import HeadWindow

PROCESSES = 2
JOINT_BATCH = 8
SEED = 1


class WeightedLoss(nn.Module):
    """The training module's total loss as a forward pass, which is what DistributedDataParallel wraps."""

    def __init__(self, system: MotionDiffusion):
        super().__init__()
        self.system = system

    def forward(self, batch: HeadWindow) -> Tensor:
        weights = self.system.loss_weights
        terms = self.system.terms(batch)
        return torch.stack([weights.get(name, 0.0) * term for name, term in terms.items()]).sum()


def measure() -> list[dict]:
    with tempfile.TemporaryDirectory() as folder:
        planted.write_store(f"{folder}/simulated", (8.0, 2.0, 6.0, 1.0))
        joint = gradients(folder, rank=0, world=1)
        torch.multiprocessing.spawn(_worker, args=(folder,), nprocs=PROCESSES)
        shared = load_file(f"{folder}/gradients.safetensors")
    difference = max((shared[name] - joint[name]).abs().max().item() for name in joint)
    largest = max(value.abs().max().item() for value in joint.values())
    return [
        {
            "name": "ddp_gradient_error",
            "value": difference,
            "unit": "gradient",
            "baseline": largest,
            "ratio": difference / largest,
            "goal": 1e-5,
        }
    ]


def gradients(folder: str, rank: int, world: int) -> dict[str, Tensor]:
    """Gradients of one step on this process's share of the joint batch."""
    config = compose("train", ["experiment=motion_diffusion_head", f"paths.datasets={folder}", "paths.run=unused"])
    data: WindowsModule = instantiate(config.data, _convert_="all")
    dataset = data.dataset("train")
    loss = WeightedLoss(instantiate(config.model)).eval()
    loss.system.set_statistics(dataset)
    random = torch.Generator().manual_seed(0)
    for parameter in loss.parameters():  # the network starts as zero, which would hide most of it
        nn.init.normal_(parameter, std=0.05, generator=random)
    batch = collate([dataset[item] for item in SeededSampler(dataset.weights, JOINT_BATCH, SEED, rank, world)])
    distributed = DistributedDataParallel(loss) if world > 1 else loss  # it must outlive the backward pass
    distributed(batch).backward()
    return {name: parameter.grad for name, parameter in loss.named_parameters() if parameter.grad is not None}


def _worker(rank: int, folder: str) -> None:
    torch.set_num_threads(1)
    meeting = Path(folder, "meeting").as_uri()
    torch.distributed.init_process_group("gloo", init_method=meeting, rank=rank, world_size=PROCESSES)
    found = gradients(folder, rank, PROCESSES)
    if rank == 0:
        save_file(found, f"{folder}/gradients.safetensors")
    torch.distributed.barrier()
    torch.distributed.destroy_process_group()
