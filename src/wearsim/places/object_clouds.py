"""Point clouds of the object classes of a simulated household."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int64
from rich.progress import track
from torch import Tensor

from wearcap.data.objects import POINTS, object_cloud
from wearcap.errors import WearcapError, nearest
from wearsim.places.interactive_flat import build_interactive_flat
from wearsim.places.movables import MOVABLES, make_movable

OPENABLES = ("door", "window", "drawer", "cabinet_door")
_SEEDS = {"train": 0, "val": 1, "test": 2}
_PER_FLAT = 3
"""Number of instances of a category taken from one flat: more would be much alike."""


def generate_clouds(
    split: str, classes: Sequence[str], per_class: int, points: int = POINTS
) -> tuple[Float[Tensor, "object point 3"], Int64[Tensor, "object"]]:
    """Clouds (m, in their objects' own axes) and their class indices; splits share no seed.

    Raises WearcapError for an unknown class.
    """
    available = (*MOVABLES, *OPENABLES)
    for name in classes:
        if name not in available:
            what = f"no objects of class {name!r} are generated"
            raise WearcapError(what, expected=f"some of {', '.join(available)}", fix=nearest(name, available))
    clouds, labels = [], []
    for label, name in enumerate(track(classes, f"objects to {split} on")):
        if name in MOVABLES:
            for number in range(per_class):
                rng = np.random.default_rng([_SEEDS[split], sum(name.encode()), number])
                clouds.append(object_cloud(make_movable(name, name, rng).object.mesh, points, number))
                labels.append(label)
    wanted = {name: label for label, name in enumerate(classes) if name in OPENABLES}
    taken: Counter[str] = Counter()
    number = 0
    while any(taken[name] < per_class for name in wanted):
        flat = build_interactive_flat(np.random.default_rng([_SEEDS[split], number]), "flat")
        here: Counter[str] = Counter()
        for item in flat.openables:
            name = item.category
            if name in wanted and taken[name] < per_class and here[name] < _PER_FLAT:
                clouds.append(object_cloud(item.object.mesh, points, taken[name]))
                labels.append(wanted[name])
                taken[name] += 1
                here[name] += 1
        number += 1
    return torch.stack(clouds), torch.tensor(labels)
