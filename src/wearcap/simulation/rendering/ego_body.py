"""The wearer's own body as a head camera sees it: without the head; skin, sleeves, trousers and shoes."""

import zlib
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, Int32

from wearcap.body.anny_body import anny_body
from wearcap.body.model import BodyModel
from wearcap.body.skeleton import Skeleton
from wearcap.simulation.places.builder import hue

_SKIN = np.array([[0.93, 0.76, 0.66], [0.80, 0.58, 0.44], [0.56, 0.36, 0.25], [0.30, 0.19, 0.14]])
"""Skin tones from light to dark."""
_WORN = {
    "wrist": "skin",
    "elbow": "forearm",
    "shoulder": "sleeve",
    "collar": "shirt",
    "hip": "trousers",
    "knee": "shin",
    "ankle": "shoe",
    "toe": "shoe",
    "pelvis": "trousers",
}
"""Clothing of the body part that follows each joint; the shirt covers all others."""
_MOTTLE = 0.06
"""Deviation of the colour from vertex to vertex, as a share: folds and veins."""


@dataclass(frozen=True, eq=False)
class EgoBody:
    """A dressed body without its head and neck."""

    model: BodyModel
    faces: Int32[np.ndarray, "face 3"]
    """Faces of the body model."""
    color: Float32[np.ndarray, "vertex 3"]
    """Vertex colours, RGB 0…1."""


def ego_body(skeleton: Skeleton, shape: dict[str, float], rng: np.random.Generator) -> EgoBody:
    """A body fitted to the skeleton's bones; the skin tone is derived from the skeleton, the clothes are drawn.

    Raises WearcapError as `anny_body` does.
    """
    whole = anny_body(skeleton, shape)
    dominant = whole.skin_joints.gather(1, whole.skin_weights.argmax(1, keepdim=True))[:, 0]
    above = [skeleton.index(name) for name in ("neck", "head")]
    kept = ~torch.isin(dominant, torch.tensor(above))
    faces = whole.faces[kept[whole.faces].all(1)]
    vertices = faces.unique()
    number = torch.zeros(len(kept), dtype=torch.int64)
    number[vertices] = torch.arange(len(vertices))
    body = replace(
        whole,
        rest_vertices=whole.rest_vertices[vertices],
        faces=number[faces],
        regions={},
        skin_joints=whole.skin_joints[vertices],
        skin_weights=whole.skin_weights[vertices],
    )
    color = _colors(skeleton, dominant[vertices].numpy(), rng)
    return EgoBody(body, body.faces.numpy().astype(np.int32), color)


def skin_tone(skeleton: Skeleton) -> Float32[np.ndarray, "3"]:
    """Skin tone, RGB 0…1, always the same for the same bones."""
    own = np.random.default_rng(zlib.crc32(skeleton.t_parent_joint.numpy().tobytes()))
    place = own.uniform(0, len(_SKIN) - 1)
    tone = [np.interp(place, np.arange(len(_SKIN)), _SKIN[:, channel]) for channel in range(3)]
    return (np.array(tone) * own.uniform(0.94, 1.06)).astype(np.float32)


def _colors(skeleton: Skeleton, dominant: np.ndarray, rng: np.random.Generator) -> Float32[np.ndarray, "vertex 3"]:
    skin = skin_tone(skeleton)
    shirt, trousers, shoe = (np.array(hue(rng, (0.0, 0.75))) * rng.uniform(0.25, 1.1) for _ in range(3))
    worn = {"skin": skin, "shirt": shirt, "trousers": trousers, "shoe": shoe}
    bare = rng.uniform(size=3)
    worn["sleeve"] = skin if bare[0] < 0.1 else shirt
    worn["forearm"] = skin if bare[1] < 0.5 or bare[0] < 0.1 else shirt
    worn["shin"] = skin if bare[2] < 0.2 else trousers
    parts = [name.removeprefix("left_").removeprefix("right_") for name in skeleton.joint_names]
    table = np.stack([worn[_WORN.get(part, "shirt")] for part in parts])
    mottled = table[dominant] * (1 + _MOTTLE * rng.standard_normal((len(dominant), 1)))
    return np.clip(mottled, 0.02, 0.98).astype(np.float32)
