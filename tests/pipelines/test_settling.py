import torch

from wearcap.systems.ireplica.object_tracker import ContactInterval, chains, settled

FPS = 60.0
LEFT, RIGHT, BOTH = (True, False), (False, True), (True, True)


def palm_path(*stretches: tuple[int, float]) -> torch.Tensor:
    """Palms "time hand 3" that move along x at a speed (m/s) for so many frames, one after the other; both alike."""
    speed = torch.cat([torch.full((frames,), value) for frames, value in stretches])
    x = (speed / FPS).cumsum(0)
    return torch.nn.functional.pad(x[:, None], (0, 2))[:, None].expand(-1, 2, 3).contiguous()


def times(palms: torch.Tensor) -> torch.Tensor:
    return torch.arange(len(palms), dtype=torch.float64) / FPS


def test_approach_and_retreat_are_cut_off_where_the_hand_rests():
    palms = palm_path((50, 0.9), (4, 0.0), (60, 0.3), (4, 0.0), (50, 0.9))
    spans = [(ContactInterval(40, 130, LEFT), "sliding")]
    ((found, contact_class),) = settled(spans, palms, times(palms), 0.4)
    assert contact_class == "sliding"
    assert 49 <= found.start <= 54
    assert 112 <= found.stop <= 118


def test_no_more_than_the_limit_is_cut_and_nothing_with_zero():
    palms = palm_path((200, 0.5), (20, 0.0))
    spans = [(ContactInterval(20, 190, RIGHT), "hinged")]
    assert settled(spans, palms, times(palms), 0.0) == spans
    ((found, _),) = settled(spans, palms, times(palms), 0.25)
    assert 20 <= found.start <= 35
    assert 174 <= found.stop <= 190


def test_hands_that_join_and_leave_are_one_hold():
    spans = [
        (ContactInterval(10, 14, LEFT), "sliding"),
        (ContactInterval(14, 80, BOTH), "sliding"),
        (ContactInterval(60, 90, RIGHT), "hinged"),
        (ContactInterval(80, 84, RIGHT), "sliding"),
        (ContactInterval(84, 99, LEFT), "sliding"),
    ]
    assert [len(chain) for chain in chains(spans)] == [3, 1, 1]
    palms = palm_path((20, 0.9), (4, 0.0), (44, 0.3), (4, 0.0), (60, 0.9))
    held = [row for row in settled(spans[:4], palms, times(palms), 0.4) if row[1] == "sliding"]
    assert [contact.hands for contact, _ in held] == [BOTH]  # one hand alone came before and after the hold itself
    assert 19 <= held[0][0].start <= 24
    assert held[0][0].stop <= 73


def test_a_hold_shorter_than_the_limit_keeps_its_middle():
    palms = palm_path((100, 0.5))
    ((found, _),) = settled([(ContactInterval(40, 50, LEFT), "sliding")], palms, times(palms), 0.4)
    assert found.start <= 45 <= found.stop
