"""Windows: the right frames, padding, mirror, and draws that depend on seed and step alone."""

from functools import partial

import pytest
import torch

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import xsens23
from wearcap.data.datamodule import Loading, WindowsModule
from wearcap.data.transforms import Mirror, Shift, mirrored
from wearcap.data.windows import FixedSampler, SeededSampler, Source, Windows, collate
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
    index = next(i for i, (_, start, _) in enumerate(windows.starts.tolist()) if start == 60)
    window, truth = windows[(index, 0)], store.load("r0").motion
    assert torch.equal(window.R_parent_joint, truth.R_parent_joint[60:180])
    assert torch.allclose(window.t_world_head, truth.joint("head").t[60:180], atol=1e-5)
    assert window.valid.all()
    assert window.size[0].item() == pytest.approx(xsens23().height_of("head"))


def test_a_clip_shorter_than_a_window_is_padded_with_its_last_frame(store):
    windows = dataset(store)
    short = next(i for i, (_, _, frames) in enumerate(windows.starts.tolist()) if frames == 90)
    window = windows[(short, 0)]
    assert window.valid.sum() == 90
    assert torch.equal(window.R_parent_joint[90:], window.R_parent_joint[89:90].expand(30, -1, -1, -1))


def test_balance_shares_the_draws_among_recordings(store):
    def shares(balance: float) -> torch.Tensor:
        windows = dataset(store, balance=balance, stride=10)
        return torch.zeros(len(windows.recordings), dtype=torch.float64).index_add(
            0, windows.starts[:, 0], windows.weights
        )

    counts = torch.bincount(dataset(store, stride=10).starts[:, 0]).double()
    assert len(counts.unique()) > 1
    assert torch.allclose(shares(1.0), counts / counts.sum())
    assert torch.allclose(shares(0.0), torch.full_like(counts, 1 / len(counts)))
    assert torch.allclose(shares(0.5), counts.sqrt() / counts.sqrt().sum())


def test_hanging_the_truth_from_the_head_gives_the_truth(store):
    window = dataset(store)[(0, 0)]
    true = forward_kinematics(xsens23(), window.R_parent_joint, torch.zeros(120, 3)).t
    anchored = anchor(xsens23(), window.R_parent_joint, Rigid(window.R_world_head, window.t_world_head))[1].t
    assert torch.allclose(anchored - anchored[:, :1], true - true[:, :1], atol=1e-5)


def test_the_mirror_swaps_sides_and_is_its_own_inverse(store):
    skeleton, window = xsens23(), dataset(store)[(0, 0)]
    swapped = dataset(store, transforms={"mirror": lambda window, _: mirrored(window)})[(0, 0)]
    flip = torch.tensor([1.0, -1.0, 1.0])
    pose = lambda w: anchor(skeleton, w.R_parent_joint, Rigid(w.R_world_head, w.t_world_head))[1].t  # noqa: E731
    left, right = skeleton.index("left_wrist"), skeleton.index("right_wrist")
    assert torch.allclose(pose(swapped)[:, left], pose(window)[:, right] * flip, atol=1e-5)


def test_noise_and_augmentation_are_functions_of_the_seed(store):
    windows = dataset(store, transforms={"shift": Shift(), "mirror": Mirror()})
    assert all(torch.equal(a, b) for a, b in zip(windows[(0, 7)], windows[(0, 7)]))
    assert not torch.equal(windows[(0, 7)].noise, windows[(0, 8)].noise)


def test_ranks_share_out_the_draws_of_one_process():
    weights = torch.ones(50, dtype=torch.float64)
    alone = list(SeededSampler(weights, 24, seed=3))
    ranks = [list(SeededSampler(weights, 24, seed=3, rank=r, world=2)) for r in (0, 1)]
    assert [item for pair in zip(*ranks) for item in pair] == alone


def test_epochs_differ_and_repeat():
    sampler = SeededSampler(torch.ones(50, dtype=torch.float64), 24, seed=3)
    first = list(sampler)
    sampler.set_epoch(1)
    second = list(sampler)
    sampler.set_epoch(0)
    assert list(sampler) == first != second


def test_sources_are_drawn_by_their_weights(store, tmp_path):
    other = small_dataset(tmp_path)
    both = dataset(store, other)
    drawn = list(SeededSampler(both.weights, 4000, seed=0))
    from_first = sum(both.recordings[both.starts[i][0]][0].root == store.root for i, _ in drawn)
    assert from_first / 4000 == pytest.approx(0.75, abs=0.03)


def test_statistics_normalise_what_the_loader_gives(store):
    windows, features = dataset(store), HeadFeatures()
    mean, scale = feature_statistics(windows, features, {})["motion"]
    batch = collate([windows[item] for item in FixedSampler(len(windows)).items])
    encoded = (
        features.encode(batch.R_parent_joint, batch.R_world_head, batch.foot_contact)[batch.valid] - mean
    ) / scale
    assert encoded.mean(0).abs().max() < 0.5
    assert encoded.std(0).mean() == pytest.approx(1.0, abs=0.3)


def test_a_wrong_rate_and_an_empty_split_are_named(store, tmp_path):
    with pytest.raises(WearcapError, match=r"60.0 frames per second.*Expected 30"):
        dataset(store, fps=30.0)
    with pytest.raises(WearcapError, match="no windows in split 'train'.*at least 30 frames"):
        dataset(small_dataset(tmp_path, (20,) * 6))


def test_datamodule_batches(store):
    dataset = partial(Windows, content=HeadContent(), window=120, stride=60, fps=60.0)
    data = WindowsModule(dataset, Loading(4, steps_per_epoch=3), {"a": {"root": str(store.root)}, "b": None})
    data.setup("fit")
    batches = list(data.train_dataloader())
    assert len(batches) == 3
    assert batches[0].R_parent_joint.shape == (4, 120, 23, 3, 3)
    assert batches[0].level.shape == (4, 1)
