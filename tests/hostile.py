"""Damage for the fuzz tests of readers."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st


@contextmanager
def in_time(seconds: int = 60) -> Iterator[None]:
    """Raise TimeoutError where a pipe or a device is waited for (POSIX, main thread)."""

    def late(*_: object) -> None:
        raise TimeoutError(f"not done within {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


fuzz = settings(max_examples=4 * settings().max_examples, deadline=None, suppress_health_check=list(HealthCheck))

JUNK = ["nan", "-1e400", "\n", "9" * 30, "\0", "{", "}", ":", "#", "begin\n", "<", ">", "&a;", '"', "-1", "1e9"]


def mutated(text: str):
    """Strategy: the text with a stretch cut out, overwritten or filled with junk."""
    place = st.integers(0, len(text))
    junk = st.text(max_size=6) | st.sampled_from(JUNK)
    cut = st.builds(lambda a, b, new: text[: min(a, b)] + new + text[max(a, b) :], place, place, junk)
    over = st.builds(lambda a, new: text[:a] + new + text[a + len(new) :], place, junk)
    return over | st.builds(lambda a, new: text[:a] + new + text[a:], place, junk) | cut


def mutated_bytes(content: bytes):
    """Strategy: the bytes cut short or with a few overwritten."""
    place = st.integers(0, len(content) - 1)

    def patched(patches: dict[int, int]) -> bytes:
        damaged = bytearray(content)
        for at, value in patches.items():
            damaged[at] = value
        return bytes(damaged)

    patch = st.dictionaries(place, st.integers(0, 255), min_size=1, max_size=4).map(patched)
    return patch | place.map(lambda stop: content[:stop])
