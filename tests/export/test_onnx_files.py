"""ONNX files of strangers: weights lie in the file or beside it, and what is computed on opening stays small."""

import os

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper

from hostile import in_time
from wearcap.errors import WearcapError
from wearcap.runtime.graphs import open_onnx


def adding(location: str) -> bytes:
    """x plus four numbers of another file."""
    weights = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[4], data_location=TensorProto.EXTERNAL)
    for key, value in (("location", location), ("offset", "0"), ("length", "16")):
        weights.external_data.add(key=key, value=value)
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [4]) for name in "xy"]
    graph = helper.make_graph([helper.make_node("Add", ["x", "w"], ["y"])], "g", ends[:1], ends[1:], [weights])
    opset = [helper.make_opsetid("", 18)]
    return onnx.ModelProto.SerializeToString(helper.make_model(graph, opset_imports=opset, ir_version=9))


@pytest.mark.parametrize("location", ["beside.bin", "ABSOLUTE", "../elsewhere.bin", "link.bin", "pipe", "none.bin"])
def test_weights_beside_the_file_alone_are_read(location, tmp_path):
    folder, numbers = tmp_path / "model", np.arange(4, dtype=np.float32).tobytes()
    folder.mkdir()
    (folder / "beside.bin").write_bytes(numbers)
    (tmp_path / "elsewhere.bin").write_bytes(numbers)
    (folder / "link.bin").symlink_to(tmp_path / "elsewhere.bin")
    os.mkfifo(folder / "pipe")
    path = folder / "a.onnx"
    path.write_bytes(adding(location.replace("ABSOLUTE", str(tmp_path / "elsewhere.bin"))))
    if location == "beside.bin":
        assert open_onnx(path)(x=torch.ones(4)).tolist() == [1, 2, 3, 4]
        return
    with in_time(10), pytest.raises(WearcapError, match="not a readable ONNX file"):
        open_onnx(path)
