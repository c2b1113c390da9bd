"""Single windows out of batches, for tests, and as the path of before had them."""

from typing import Any

import torch

from benchmarks.rivals.single_windows.transforms import Window
from wearcap.data.batch import Batch
from wearcap.data.windows import Windows


def numbers(*values: int) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.long)


def one(windows: Windows, index: int, seed: int = 0) -> Any:
    """A window by its number and seed, without the batch's axis."""
    batch = windows.batch(numbers(index), numbers(seed))
    return type(batch)(*(part[0] for part in batch))


def single(batch: Batch, number: int) -> Window:
    """A window of a batch that was read, as the transforms of before take it."""
    values = {name: value[number] for name, value in batch.values.items()}
    return Window(values, {name: order.tolist() for name, order in batch.twins.items()}, fps=batch.fps)
