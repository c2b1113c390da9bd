"""The user's own SMPL, SMPL+H and SMPL-X model files (licence-gated; none is shipped or downloaded)."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from wearcap.body.smpl_body import SmplArrays
from wearcap.errors import WearcapError
from wearcap.io.formats.npz import read_npz, require
from wearcap.io.formats.restricted_pickle import read_pickle

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
    table = read_npz(path, (*_SHAPES, "posedirs")) if path.suffix.lower() == ".npz" else _cleaned_pickle(path)
    size = require(table, path, **_SHAPES)
    parents = np.asarray(table["kintree_table"])[0].astype(np.int64)
    parents[0] = -1
    if not all(0 <= parent < joint for joint, parent in enumerate(parents.tolist()) if joint):
        raise WearcapError("joints that do not follow their parents", where=path, expected="kintree_table of a tree")
    blend = table.get("posedirs")
    if blend is not None:
        require(table, path, posedirs=(size["vertex"], 3, 9 * (size["joint"] - 1)))
    faces = torch.from_numpy(np.asarray(table["f"]).astype(np.int64))
    if faces.min() < 0 or faces.max() >= size["vertex"]:
        raise WearcapError("faces that name vertices beyond the last", where=path)
    return SmplArrays(
        _floats(table["v_template"]),
        _floats(table["shapedirs"]),
        None if blend is None else _floats(blend),
        _floats(table["J_regressor"]),
        _floats(table["weights"]),
        tuple(parents.tolist()),
        faces,
    )


def _cleaned_pickle(path: Path) -> dict:
    try:
        table = read_pickle(path)
    except WearcapError as error:
        raise WearcapError(
            f"not a plain model file ({error.what})",
            where=path,
            expected="arrays only",
            fix="SMPL's first releases hold chumpy objects: clean them with smplx's tools/clean_ch.py, or use the .npz.",
        ) from error
    if not isinstance(table, dict):
        raise WearcapError("not a body model", where=path, expected="a dictionary of arrays")
    return table


def _floats(array) -> Tensor:
    return torch.from_numpy(np.asarray(array, dtype=np.float32))
