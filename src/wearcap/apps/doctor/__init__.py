"""The doctor (`wearcap doctor`): what is in a path, what is wrong with it, and how to mend it.

`examine.py` opens whatever is there and lets `wearcap.checks` judge it; `preflight.py` holds it against what a pipeline needs.
"""

from wearcap.apps.doctor.examine import examine

__all__ = ["examine"]
