"""SMPL's axes and files: rotation vectors to wearcap's rotation matrices, coefficients by name, the user's own models.

SMPL's joint frames are x left, y up, z forward; wearcap's x forward, y left, z up. With A rotating the former into the
latter, a joint's rotation is A · R · Aᵀ and the root's R · Aᵀ, in the world of the file. Model files are licence-gated:
none is shipped or downloaded.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64, Num
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.body.smpl_body import SmplArrays
from wearcap.boundary.arrays import read_npz, require
from wearcap.boundary.pickles import read_pickle
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording.motion import Motion

A = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
"""Rotation of SMPL's axes into wearcap's."""


def smpl_motion(
    timestamps: Float64[Tensor, "time"],
    skeleton: Skeleton,
    rotvec: Num[np.ndarray, "time feature"],
    t_world_pelvis: Num[np.ndarray, "time 3"],
    **provenance: str,
) -> Motion:
    """Motion of a wearcap skeleton from rotation vectors (rad) in SMPL's axes and the pelvis' position (m).

    Empty texts are left out of the provenance.
    """
    R = rotation.exp(torch.from_numpy(rotvec.astype(np.float64)).unflatten(1, (-1, 3)))
    R = torch.cat([R[:, :1] @ A.T, A @ R[:, 1:] @ A.T], 1)
    t = torch.from_numpy(t_world_pelvis.astype(np.float64))
    return Motion(
        timestamps, skeleton, R.float(), t.float(), provenance={key: text for key, text in provenance.items() if text}
    )


def shape_from_betas(betas: Sequence[float] | Float[np.ndarray, "beta"]) -> dict[str, float]:
    """SMPL's coefficients by their names in a recording's `shape`: beta_0 …"""
    return {f"beta_{k}": float(beta) for k, beta in enumerate(betas)}


def shape_from_arrays(arrays: dict[str, np.ndarray], where: str | Path) -> dict[str, float]:
    """The shape of a file whose `betas`, if it has any, are one person's. Raises WearcapError where they are no numbers."""
    if "betas" not in arrays:
        return {}
    betas = {"betas": arrays["betas"].reshape(-1)}
    require(betas, where, betas=("feature",))
    return shape_from_betas(betas["betas"])


_SHAPES = {
    "v_template": ("vertex", 3),
    "shapedirs": ("vertex", 3, "beta"),
    "J_regressor": ("joint", "vertex"),
    "weights": ("vertex", "joint"),
    "f": ("face", 3),
    "kintree_table": (2, "joint"),
}


def read_smpl(path: str | Path) -> SmplArrays:
    """Read a model file: .npz as the makers give it (SMPL+H, SMPL-X), or a .pkl cleaned of chumpy objects.

    Raises WearcapError naming the file and the array that is missing, misshapen or not finite.
    """
    path = Path(path)
    if path.suffix.lower() == ".npz":
        table = read_npz(path, (*_SHAPES, "posedirs"))
    else:
        try:
            table = read_pickle(path)
        except WearcapError as error:
            fix = (
                "SMPL's first releases hold chumpy objects: clean them with smplx's tools/clean_ch.py, or use the .npz."
            )
            raise WearcapError(f"not a plain model file ({error.what})", path, "arrays only", fix) from error
        if not isinstance(table, dict):
            raise WearcapError("not a body model", path, "a dictionary of arrays")
    size = require(table, path, **_SHAPES)
    parents = np.asarray(table["kintree_table"])[0].astype(np.int64)
    parents[0] = -1
    if not all(0 <= parent < joint for joint, parent in enumerate(parents.tolist()) if joint):
        raise WearcapError("joints that do not follow their parents", path, "kintree_table of a tree")
    if "posedirs" in table:
        require(table, path, posedirs=(size["vertex"], 3, 9 * (size["joint"] - 1)))
    faces = torch.from_numpy(np.asarray(table["f"]).astype(np.int64))
    if faces.min() < 0 or faces.max() >= size["vertex"]:
        raise WearcapError("faces that name vertices beyond the last", path)
    names = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights")
    floats = (torch.from_numpy(np.asarray(table[n], np.float32)) if n in table else None for n in names)
    return SmplArrays(*floats, tuple(parents.tolist()), faces)  # pyright: ignore[reportArgumentType]
