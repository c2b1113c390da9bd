"""What the benchmark of the live capture's first minute measures, on a planted wearer."""

import torch

from benchmarks.faults import live_turns
from standing_person import acting
from wearcap.body.skeleton import WRISTS
from wearcap_testing import recording_of


def test_headings_are_off_by_what_the_watches_worlds_are_turned_beyond_what_is_planted(monkeypatch):
    recording = recording_of(acting(1.75, [("stand", 5.0)]), "stands")
    found = list(live_turns.headings(recording, 0))
    assert [each.wrist for each in found] == list(WRISTS)
    assert all(each.is_hanging and abs(each.off_deg) < 20 for each in found)
    # Whatever the watches' own worlds are, the error is the same.
    monkeypatch.setattr(live_turns, "YAW_RAD", dict(zip(WRISTS, (-0.4, 3.0))))
    again = torch.tensor([each.off_deg for each in live_turns.headings(recording, 0)])
    torch.testing.assert_close(again, torch.tensor([each.off_deg for each in found]), atol=0.1, rtol=0)
    # Where the first minute does not end there are no headings.
    assert not list(live_turns.headings(recording_of(acting(1.75, [("walk", 3.0)]), "walks"), 0))
