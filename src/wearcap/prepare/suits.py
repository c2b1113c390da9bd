"""A suit's captures (MVNX) as recordings: alone, or with the head camera's video, its localisation and the scene's scan."""

from dataclasses import replace
from pathlib import Path

from wearcap.io.formats.mvnx import read_mvnx
from wearcap.recording.recording import Recording
from wearcap.sensors.contacts import contacts_from_motion


def read_suit(path: str | Path) -> Recording:
    """A take: what the suit sensed, its motion with foot contacts (from the feet's speed where it reports none), its sensors.

    Raises WearcapError as `read_mvnx` does.
    """
    recording = read_mvnx(path)
    suit = recording.motion
    if suit is not None and suit.contact_prob is None and len(suit) > 2:
        suit = replace(suit, contact_prob=contacts_from_motion(suit).float())
    return replace(recording, suit=suit, motion=None)
