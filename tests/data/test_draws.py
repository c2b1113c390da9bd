"""Random numbers of windows: counted from seed and name, alike on their own and in any batch, and distributed as they say."""

import pytest
import scipy.stats
import torch

from wearcap.data import draws
from wearcap.data.draws import Draws

KINDS = ("uniform", "normal")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(), (7,), (3, 5)])
def test_a_number_depends_on_seed_name_and_place_alone(kind, shape):
    seeds, order = torch.tensor([5, 2**61, 0, 77, -3]), torch.tensor([3, 0, 4])
    whole = getattr(Draws(seeds), kind)("a", *shape)
    assert whole.shape == (5, *shape)
    some = Draws(seeds[order])
    for other in (some.normal, some.uniform):
        other("b", 4)
    assert torch.equal(getattr(some, kind)("a", *shape), whole[order])
    assert torch.equal(getattr(Draws(seeds[1:2]), kind)("a", *shape), whole[1:2])
    more = getattr(some, kind)("a", 40)
    assert torch.equal(more[:, : whole[0].numel()], whole[order].reshape(3, -1))
    assert not torch.equal(getattr(some, kind)("b", 40), more)


@pytest.mark.parametrize("kind", KINDS)
def test_numbers_are_distributed_as_they_say_and_independent(kind):
    seeds = torch.arange(3000)
    found = torch.cat([getattr(Draws(seeds), kind)(name, 4) for name in ("a", "b")], 1).double()
    assert scipy.stats.kstest(found.flatten().numpy(), {"uniform": "uniform", "normal": "norm"}[kind]).pvalue > 0.01
    neighbours = torch.cat([found[:-1], found[1:]], 1)
    related = torch.corrcoef(neighbours.T) - torch.eye(16)
    assert related.abs().max() < 4.5 / 3000**0.5
    assert torch.corrcoef(neighbours.square().T).fill_diagonal_(0).abs().max() < 4.5 / 3000**0.5
    if kind == "normal":
        assert found.mean().item() == pytest.approx(0, abs=0.02)
        assert found.std().item() == pytest.approx(1, abs=0.02)
        assert (found.abs() > 3).double().mean().item() == pytest.approx(0.0027, abs=0.001)
    else:
        assert 0 <= found.min() < found.max() < 1


def test_shares_choose_among_many_without_gaps():
    found = Draws(torch.arange(5000)).share("window")
    assert found.dtype == torch.float64
    assert 0 <= found.min() < found.max() < 1
    assert scipy.stats.kstest(found.numpy(), "uniform").pvalue > 0.01
    assert len((found * 2**40).long().unique()) == 5000


@pytest.mark.parametrize("count", [1, 6, 400])
def test_the_loop_of_the_cpu_gives_the_numbers_of_tensor_code(count):
    """What other devices do: four numbers of 16 bits of every 64, as indices of the table of quantiles."""
    random = Draws(torch.tensor([0, 3, -9, 2**60]))
    bits = random._bits("noise", -(-count // 4)).view(torch.int16).long()
    expected = draws._quantiles(torch.device("cpu"))[bits][:, :count]
    assert torch.equal(random.normal("noise", count), expected)
