"""Windows: the right frames, padding, mirror, and batches that depend on seed and step alone."""

from functools import partial
from types import SimpleNamespace

import pytest
import torch

from drawn_windows import numbers, one
from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import xsens23
from wearcap.data.datamodule import Batches, Loading, WindowsModule
from wearcap.data.transforms import DropFrames, Mirror, SensorErrors, Shift, TimeStretch
from wearcap.data.windows import Source, Windows, drawn, drawn_batches
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.training import feature_statistics
from wearcap.systems.hmd2.training_windows import HeadContent
from wearcap.tracking.anchor import anchor
from wearcap_testing import small_dataset


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return small_dataset(tmp_path_factory.mktemp("windows"))


def dataset(*stores, **changes) -> Windows:
    settings = {"content": HeadContent(), "window": 120, "stride": 60, "fps": 60.0} | changes
    sources = [
        Source(str(store.root), weight) for store, weight in zip(stores, (3.0, 1.0) if len(stores) > 1 else (1.0,))
    ]
    return Windows(sources, "train", True, **settings)


def test_a_window_holds_the_recordings_own_frames(store):
    windows = dataset(store)
    window, truth = one(windows, windows.starts.tolist().index([0, 60])), store.load("r0").motion
    torch.testing.assert_close(window.R_parent_joint, truth.R_parent_joint[60:180], atol=2e-4, rtol=0)
    assert torch.allclose(window.t_world_head, truth.joint("head").t[60:180], atol=1e-5)
    assert window.valid.all()
    assert window.size[0].item() == pytest.approx(xsens23().height_of("head"))


def test_a_clip_shorter_than_a_window_is_padded_with_its_last_frame(store):
    windows = dataset(store)
    window = one(windows, windows.starts[:, 0].tolist().index(2))
    assert window.valid.sum() == 90
    assert torch.equal(window.R_parent_joint[90:], window.R_parent_joint[89:90].expand(30, -1, -1, -1))


def test_balance_shares_the_draws_among_recordings(store):
    def shares(balance: float) -> torch.Tensor:
        windows = dataset(store, balance=balance, stride=10)
        return torch.zeros(3, dtype=torch.float64).index_add(0, windows.starts[:, 0], windows.weights)

    counts = torch.bincount(dataset(store, stride=10).starts[:, 0]).double()
    assert len(counts.unique()) > 1
    assert torch.allclose(shares(1.0), counts / counts.sum())
    assert torch.allclose(shares(0.0), torch.full_like(counts, 1 / len(counts)))
    assert torch.allclose(shares(0.5), counts.sqrt() / counts.sqrt().sum())


def test_hanging_the_truth_from_the_head_gives_the_truth(store):
    window = one(dataset(store), 0)
    true = forward_kinematics(xsens23(), window.R_parent_joint, torch.zeros(120, 3)).t
    anchored = anchor(xsens23(), window.R_parent_joint, Rigid(window.R_world_head, window.t_world_head))[1].t
    assert torch.allclose(anchored - anchored[:, :1], true - true[:, :1], atol=5e-4)


def test_the_mirror_swaps_sides(store):
    skeleton = xsens23()
    batch = dataset(store, transforms={"mirror": Mirror()}).batch(numbers(0).repeat(20), torch.arange(20))
    head = Rigid(batch.R_world_head, batch.t_world_head)
    wrists = [anchor(skeleton, batch.R_parent_joint[k], head[k])[1].t for k in range(20)]
    left, right = (torch.stack([t[:, skeleton.index(f"{side}_wrist")] for t in wrists]) for side in ("left", "right"))
    swapped = (left - left[:1]).flatten(1).abs().amax(1) > 1e-4
    assert 4 < swapped.sum() < 16
    plain, other = int((~swapped).nonzero()[0]), int(swapped.nonzero()[0])
    assert torch.allclose(left[other], right[plain] * torch.tensor([1.0, -1.0, 1.0]), atol=1e-4)


ALL = {
    "shift": Shift(),
    "stretch": TimeStretch(),
    "drop": DropFrames(),
    "mirror": Mirror(),
    "errors": SensorErrors(1.0),
}


def test_a_sample_depends_on_its_window_and_seed_alone(store):
    windows = dataset(store, transforms=ALL)
    index, seed = torch.arange(8), 7 + torch.arange(8)
    whole, order = windows.batch(index, seed), torch.randperm(8)
    halves = [windows.batch(order[part], seed[order[part]]) for part in (slice(4), slice(4, 8))]
    for name, value in whole._asdict().items():
        assert torch.equal(torch.cat([getattr(half, name) for half in halves]), value[order])
    assert not torch.equal(windows.batch(index, seed + 1).noise, whole.noise)
    assert torch.equal(dataset(store, transforms=ALL).batch(index, seed).R_world_head, whole.R_world_head)


def test_windows_are_drawn_by_their_weights(store, tmp_path):
    both = dataset(store, small_dataset(tmp_path))
    found = drawn(both.weights.cumsum(0), torch.arange(20000))
    share = torch.bincount(found, minlength=len(both)) / 20000
    torch.testing.assert_close(share.double(), both.weights / both.weights.sum(), atol=0.006, rtol=0)
    assert (found.long() < len(both) // 2).double().mean().item() == pytest.approx(0.75, abs=0.01)
    none = drawn(torch.tensor([0.0, 0.5, 0.5, 1.0]).double(), torch.arange(1000))
    assert set(none.tolist()) == {1, 3}  # windows of no weight are never drawn


def test_statistics_normalise_what_the_loader_gives(store):
    windows, features = dataset(store), HeadFeatures()
    mean, scale = feature_statistics(windows, features, {})["motion"]
    batch = windows.batch(torch.arange(len(windows)), torch.arange(len(windows)))
    encoded = features.encode(batch.R_parent_joint, batch.R_world_head, batch.foot_contact)
    encoded = (encoded[batch.valid] - mean) / scale
    assert encoded.mean(0).abs().max() < 0.5
    assert encoded.std(0).mean() == pytest.approx(1.0, abs=0.3)
    parts = list(drawn_batches(windows, 10, 4))
    assert [len(part.valid) for part in parts] == [4, 4, 2]
    assert torch.equal(torch.cat([part.noise for part in parts]), next(drawn_batches(windows, 10)).noise)


def test_a_wrong_rate_and_an_empty_split_are_named(store, tmp_path):
    with pytest.raises(WearcapError, match=r"60.0 frames per second.*Expected 30"):
        dataset(store, fps=30.0)
    with pytest.raises(WearcapError, match="no windows in split 'train'.*at least 30 frames"):
        dataset(small_dataset(tmp_path, (20,) * 6))


def module(store, size: int = 4, steps: int = 3, **trainer) -> WindowsModule:
    """The data of a training, or of one rank of several, in one of its epochs."""
    made = partial(Windows, content=HeadContent(), window=120, stride=20, fps=60.0, transforms={"shift": Shift()})
    data = WindowsModule(made, Loading(size, steps, val_windows=3), {"a": {"root": str(store.root)}, "b": None})
    if trainer:
        strategy = SimpleNamespace(root_device=torch.device("cpu"))
        alone = {"global_rank": 0, "world_size": 1, "current_epoch": 0, "overfit_batches": 0, "strategy": strategy}
        data.trainer = SimpleNamespace(**alone | trainer)  # pyright: ignore[reportAttributeAccessIssue]
    data.setup("fit")
    return data


def noise_of(loader: Batches) -> torch.Tensor:
    return torch.cat([batch.noise for batch in loader])


def test_datamodule_batches(store):
    batches = list(module(store).train_dataloader())
    assert len(batches) == len(module(store).train_dataloader()) == 3
    assert batches[0].R_parent_joint.shape == (4, 120, 23, 3, 3)
    assert batches[0].level.shape == (4, 1)


def test_ranks_share_out_the_draws_of_one_process(store):
    alone = noise_of(module(store, size=8, current_epoch=2).train_dataloader())
    ranks = [
        noise_of(module(store, global_rank=rank, world_size=2, current_epoch=2).train_dataloader()) for rank in (0, 1)
    ]
    assert torch.equal(torch.stack(ranks, 1).flatten(0, 1), alone)


def test_epochs_go_on_and_repeat_but_for_one_batch_that_is_overfitted(store):
    first, again, second = (noise_of(module(store, current_epoch=epoch).train_dataloader()) for epoch in (0, 0, 1))
    assert torch.equal(first, again)
    assert len(torch.cat([first, second])[:, 0, 0].unique()) == 24
    long = noise_of(module(store, steps=6, current_epoch=0).train_dataloader())
    assert torch.equal(torch.cat([first, second]), long)
    fixed = noise_of(module(store, current_epoch=5, overfit_batches=1).train_dataloader())
    assert torch.equal(fixed, first)


def test_validations_are_all_the_same(store):
    data, later = module(store, size=2), module(store, size=2, current_epoch=3)
    found = list(data.val_dataloader())
    assert [len(batch.noise) for batch in found] == [2, 1]
    assert torch.equal(noise_of(data.val_dataloader()), noise_of(later.val_dataloader()))
    spread = torch.cat([batch.t_world_head for batch in found])
    assert len(data.val) == 10
    assert torch.equal(spread, data.val.batch(numbers(0, 3, 6), torch.arange(3)).t_world_head)


class Counting:
    """A data set whose batches are their numbers; that of step 3 fails."""

    weights = torch.ones(9)

    def __len__(self) -> int:
        return 9

    def batch(self, index, seed):
        if seed[0] == 3:
            raise WearcapError("no such window")
        return (index, seed)


@pytest.mark.parametrize("count", [1, 3, 5])
def test_batches_come_in_order_and_errors_reach_the_training(count):
    loader = Batches(Counting(), count, lambda step: (numbers(step), numbers(step)), torch.device("cpu"))
    seen = []
    for _ in range(2):
        try:
            for batch in loader:
                seen.append(batch[1].item())
        except WearcapError:
            seen.append("failed")
    assert seen == 2 * [*range(min(count, 3)), *["failed"] * (count > 3)]
