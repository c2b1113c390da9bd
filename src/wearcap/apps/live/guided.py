"""The steps of the guided first minute, as the page shows them."""

from dataclasses import dataclass

STAND, ARMS, TURN, RAISE, WALK = "stand", "arms", "turn", "raise", "walk"
SENTENCES = {
    STAND: "Stand still and look straight ahead.",
    ARMS: "Let your arms hang.",
    TURN: "Turn on the spot to one side and back, twice, arms hanging.",
    RAISE: "Raise your left hand.",
    WALK: "Walk some steps forward.",
}


@dataclass(frozen=True)
class Step:
    """A step of the guided first minute."""

    name: str
    sentence: str
    """What to do."""
    progress: float
    """0…1."""
    reason: str = ""
    """Why it does not go on."""

    def __str__(self) -> str:
        return f"{self.sentence} {self.reason}".strip()
