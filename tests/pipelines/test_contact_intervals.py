import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.systems.ireplica.object_tracker import ContactInterval, ContactSettings, active, contact_intervals


def times(count: int, fps: float = 60.0) -> torch.Tensor:
    return torch.arange(count, dtype=torch.float64) / fps


def test_gaps_up_to_the_limit_are_filled_and_longer_ones_are_not():
    prob = torch.zeros(200, 2)
    prob[10:20] = 1.0
    prob[49:60, 0] = 1.0  # 30 steps = 0.5 s after frame 19
    prob[50:60, 1] = 1.0  # 31 steps
    held = active(prob, times(200), ContactSettings(gap_s=0.5))
    assert held[10:60, 0].all()
    assert not held[20:50, 1].any()
    assert not held[:10].any()
    assert not held[60:].any()


def test_a_sure_contact_goes_on_while_it_is_likely_and_a_likely_one_alone_is_none():
    prob = torch.full((100, 2), 0.1)
    prob[20:60, 0] = 0.4
    prob[40:45, 0] = 0.8
    prob[20:60, 1] = 0.4
    held = active(prob, times(100), ContactSettings(threshold=0.7, keep=0.3))
    assert held[:, 0].nonzero()[:, 0].tolist() == list(range(20, 60))
    assert not held[:, 1].any()


def test_an_interval_is_split_where_the_hands_change():
    held = torch.zeros(30, 2, dtype=torch.bool)
    held[5:20, 0] = True
    held[10:25, 1] = True
    assert contact_intervals(held) == [
        ContactInterval(5, 10, (True, False)),
        ContactInterval(10, 20, (True, True)),
        ContactInterval(20, 25, (False, True)),
    ]


def test_nothing_in_nothing_out():
    assert contact_intervals(torch.zeros(0, 2, dtype=torch.bool)) == []
    assert contact_intervals(torch.zeros(9, 2, dtype=torch.bool)) == []


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(WearcapError, match="between 0 and 1"):
        ContactSettings(threshold=1.0)
    with pytest.raises(WearcapError, match="between 0 and 1"):
        ContactSettings(threshold=0.5, keep=0.6)
