"""The one exception that users are meant to read, and a typo's nearest valid neighbours."""

import difflib
from collections.abc import Collection, Iterable
from pathlib import Path


class WearcapError(Exception):
    """Something a user can mend: says, in this order, what was wrong, where, what was expected, and what to do.

    The command line prints it without a traceback and exits with code 2.
    """

    def __init__(self, what: str, where: str | Path | None = None, expected: str = "", fix: str = ""):
        parts = [f"{where}: {what}" if where is not None else what]
        if expected:
            parts.append(f"Expected {expected}.")
        if fix:
            parts.append(fix)
        super().__init__(" ".join(part if part.endswith((".", "!", "?")) else part + "." for part in parts))
        self.what, self.where, self.expected, self.fix = what, where, expected, fix

    def __reduce__(self):
        """Survive the trip back from a worker process."""
        return type(self), (self.what, self.where, self.expected, self.fix)


def require_choice(value: object, allowed: Collection[str], what: str) -> None:
    """Raise WearcapError with what is wrong and the allowed words, unless the value is one of them."""
    if value not in allowed:
        raise WearcapError(what, expected=f"one of {', '.join(allowed)}")


def nearest(wrong: str, valid: Iterable[str]) -> str:
    """A sentence that names the valid words nearest to a wrong one, or all of them when none is near."""
    valid = sorted(valid)
    near = difflib.get_close_matches(wrong, valid, n=3, cutoff=0.5)
    if near:
        return f"Did you mean {' or '.join(repr(word) for word in near)}?"
    return f"Expected one of {', '.join(valid[:40])}." if valid else ""
