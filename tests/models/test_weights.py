"""Weights a user brings: both formats round trip, code is refused, what does not fit is named."""

import os
import pickle
import zipfile
from collections import OrderedDict

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import save_file
from torch import nn

from hostile import in_time
from wearcap.errors import WearcapError
from wearcap.models.weights import load_weights, read_weights


class Code:
    """A pickle of this runs a command when it is opened."""

    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return os.system, (f"touch {self.target}",)


@pytest.fixture
def network() -> nn.Module:
    return nn.Sequential(nn.Linear(3, 2), nn.Linear(2, 4))


def same(found: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> bool:
    return found.keys() == expected.keys() and all(torch.equal(found[k], expected[k]) for k in expected)


@pytest.mark.parametrize("suffix", ["safetensors", "pth"])
def test_round_trip(tmp_path, network, suffix):
    path, state = tmp_path / f"w.{suffix}", network.state_dict()
    save_file(state, path) if suffix == "safetensors" else torch.save(state, path)
    assert same(read_weights(path), state)
    fresh = nn.Sequential(nn.Linear(3, 2), nn.Linear(2, 4))
    load_weights(fresh, read_weights(path), name="it", where=path)
    assert same(fresh.state_dict(), state)


@pytest.mark.parametrize("zipped", [True, False])
def test_a_training_script_s_checkpoint_is_opened(tmp_path, network, zipped):
    """With its epoch, scores as NumPy numbers, optimizer and DataParallel's names; before and since NumPy 2."""
    state = OrderedDict((f"module.{name}", value) for name, value in network.state_dict().items())
    optimizer = torch.optim.SGD(network.parameters(), 0.1).state_dict()
    content = {"epoch": 3, "state_dict": state, "best_score": np.float64(0.5), "optimizer": optimizer}
    path = tmp_path / "checkpoint.pth.tar"
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    assert same(read_weights(path), network.state_dict())
    if not zipped:
        data = path.read_bytes()
        assert b"numpy._core" in data
        path.write_bytes(data.replace(b"numpy._core", b"numpy.core"))
        assert same(read_weights(path), network.state_dict())


@pytest.mark.parametrize("how", ["torch", "legacy", "pickle", "beside"])
def test_a_file_with_code_is_refused_and_not_run(tmp_path, how):
    ran, path = tmp_path / "ran", tmp_path / "evil.pth"
    if how == "pickle":
        path.write_bytes(pickle.dumps(Code(ran), protocol=2))
    else:
        content = {"conv.weight": torch.zeros(2), "code": Code(ran)} if how == "beside" else Code(ran)
        torch.save(content, path, _use_new_zipfile_serialization=how != "legacy")
    with pytest.raises(WearcapError, match="more than tensors.*save_file"):
        read_weights(path)
    assert not ran.exists()


@given(
    st.binary(max_size=60), st.sampled_from(["pth", "safetensors"]), st.sampled_from([b"", b"PK\x03\x04", b"\x80\x02"])
)
def test_any_other_bytes_are_refused(tmp_path_factory, data, suffix, head):
    path = tmp_path_factory.mktemp("junk") / f"junk.{suffix}"
    path.write_bytes(head + data)
    with pytest.raises(WearcapError, match="junk"):
        read_weights(path)


@pytest.mark.parametrize("content", [torch.zeros(3), [1, 2], {"a": 3}, {"state_dict": {"a": "text"}}])
def test_a_file_without_named_tensors_is_refused(tmp_path, content):
    torch.save(content, tmp_path / "w.pth")
    with pytest.raises(WearcapError, match="named tensors"):
        read_weights(tmp_path / "w.pth")


def test_a_name_without_end_is_refused_soon(tmp_path):
    torch.save({"a": torch.zeros(2)}, tmp_path / "w.pth")
    with zipfile.ZipFile(tmp_path / "w.pth") as old, zipfile.ZipFile(tmp_path / "x.pth", "w") as new:
        for name in old.namelist():
            content = b"\x80\x02c" + b"a" * 60_000 + b"\nb\n." if name.endswith("data.pkl") else old.read(name)
            new.writestr(name, content)
    with in_time(5), pytest.raises(WearcapError, match="more than tensors"):
        read_weights(tmp_path / "x.pth")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(WearcapError, match=r"nowhere\.pth: no such file of weights"):
        read_weights(tmp_path / "nowhere.pth")


def test_names_that_do_not_fit_are_shown(network):
    tensors = {f"layer{i}": torch.zeros(1) for i in range(9)} | {"0.weight": torch.zeros(2, 3)}
    with pytest.raises(WearcapError) as error:
        load_weights(network, tensors, name="Toy", where="w.pth")
    message = str(error.value)
    assert "w.pth: these are not the weights of Toy" in message
    assert "3 missing (0.bias, 1.bias, 1.weight)" in message
    assert "9 unexpected (layer0, layer1, layer2, layer3, …)" in message


def test_shapes_that_do_not_fit_are_shown(network):
    tensors = network.state_dict() | {"0.weight": torch.zeros(2, 5)}
    with pytest.raises(WearcapError, match="another size of Toy: 0.weight is 2×5 and should be 2×3"):
        load_weights(network, tensors, name="Toy", where="w.pth")
