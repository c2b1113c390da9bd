"""OpenPoints' weights of PointNeXt-S: its names and shapes, its sums written out plainly, and files that are refused."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch.nn import functional as F

from wearcap.errors import WearcapError
from wearcap.models.point_encoder import load_openpoints, to_unit_sphere

RADII = (0.15, 0.225, 0.3375, 0.50625)


def norm(prefix: str, width: int) -> dict[str, torch.Tensor]:
    return {
        f"{prefix}.weight": 0.5 + torch.rand(width),
        f"{prefix}.bias": torch.randn(width),
        f"{prefix}.running_mean": torch.randn(width),
        f"{prefix}.running_var": 0.5 + torch.rand(width),
        f"{prefix}.num_batches_tracked": torch.tensor(7),
    }


def openpoints(width: int = 4) -> dict[str, torch.Tensor]:
    """A checkpoint's tensors as `BaseCls` with `PointNextEncoder` and `ClsHead` names and shapes them; C = `width`."""
    torch.manual_seed(0)
    stem = "encoder.encoder.0.0.convs.0.0"
    tensors = {f"{stem}.weight": torch.randn(width, 3, 1), f"{stem}.bias": torch.randn(width)}
    for stage in range(1, 5):
        narrow, wide, at = width << (stage - 1), width << stage, f"encoder.encoder.{stage}.0"
        tensors |= {f"{at}.skipconv.0.weight": torch.randn(wide, narrow, 1) / narrow**0.5}
        tensors |= {f"{at}.skipconv.0.bias": torch.randn(wide)}
        tensors |= {f"{at}.convs.0.0.weight": torch.randn(wide // 2, narrow + 3, 1, 1) / narrow**0.5}
        tensors |= {f"{at}.convs.1.0.weight": torch.randn(wide, wide // 2, 1, 1) / narrow**0.5}
        tensors |= norm(f"{at}.convs.0.1", wide // 2) | norm(f"{at}.convs.1.1", wide)
    size = width << 4
    for number, given in enumerate((size + 3, size)):
        at = f"encoder.encoder.5.0.convs.{number}"
        tensors |= {f"{at}.0.weight": torch.randn(size, given, 1, 1) / size**0.5} | norm(f"{at}.1", size)
    for number, (given, made) in {0: (size, 512), 2: (512, 256), 4: (256, 40)}.items():
        tensors |= {f"prediction.head.{number}.0.weight": torch.randn(made, given)}
        tensors |= (
            norm(f"prediction.head.{number}.1", made) if made > 40 else {"prediction.head.4.0.bias": torch.zeros(40)}
        )
    return tensors


def saved(path: Path, tensors: dict) -> Path:
    if path.suffix == ".safetensors":
        save_file(tensors, path)
    else:
        torch.save({"model": tensors, "optimizer": {}, "epoch": 600, "best_val": 94.0}, path)
    return path


def conv(t: dict, at: str, x: torch.Tensor, act: bool) -> torch.Tensor:
    """Convolution over single points, batch norm, ReLU, as OpenPoints' create_convblock2d stacks them."""
    y = F.conv2d(x, t[f"{at}.0.weight"])
    y = F.batch_norm(y, t[f"{at}.1.running_mean"], t[f"{at}.1.running_var"], t[f"{at}.1.weight"], t[f"{at}.1.bias"])
    return F.relu(y) if act else y


def plain(t: dict, points: torch.Tensor, normalized: bool) -> torch.Tensor:
    """One cloud's feature, every neighbour gathered before anything is computed."""
    p = to_unit_sphere(points[None])[0][0]
    p = torch.stack([p[:, 0], p[:, 2], -p[:, 1]], -1)
    stem = "encoder.encoder.0.0.convs.0.0"
    f = F.conv1d(p.T[None], t[f"{stem}.weight"], t[f"{stem}.bias"])[0]
    for stage, radius in enumerate(RADII, 1):
        at, chosen = f"encoder.encoder.{stage}.0", [int(p.norm(dim=-1).argmax()) if stage == 1 else 0]
        while len(chosen) < len(p) // 2:
            chosen.append(int(torch.cdist(p, p[chosen]).min(1).values.argmax()))
        groups = []
        for center in p[chosen]:
            apart = (p - center).norm(dim=-1)
            inside = [i for i in apart.argsort().tolist() if apart[i] <= radius][:32]
            relative = (p[inside] - center) / (radius if normalized else 1.0)
            x = torch.cat([relative.T, f[:, inside]])[None, :, None]
            x = conv(t, f"{at}.convs.1", conv(t, f"{at}.convs.0", x, True), False)
            groups.append(x.amax((0, 2, 3)))
        skip = F.conv1d(f[:, chosen][None], t[f"{at}.skipconv.0.weight"], t[f"{at}.skipconv.0.bias"])[0]
        f, p = F.relu(torch.stack(groups, 1) + skip), p[chosen]
    x = torch.cat([p.T, f])[None, :, None]
    x = conv(t, "encoder.encoder.5.0.convs.1", conv(t, "encoder.encoder.5.0.convs.0", x, True), True)
    return x.amax((0, 2, 3))


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
@pytest.mark.parametrize("normalized", [True, False])
def test_the_weights_make_what_they_make_there(suffix, normalized, tmp_path):
    tensors = openpoints()
    net = load_openpoints(saved(tmp_path / f"w{suffix}", tensors), normalized).double()
    random = torch.Generator().manual_seed(5)
    points = torch.rand(2, 300, 3, generator=random, dtype=torch.float64) * torch.tensor([1.0, 0.6, 0.4])
    double = {name: value.double() for name, value in tensors.items()}
    expected = torch.stack([plain(double, cloud, normalized) for cloud in points])
    torch.testing.assert_close(net(points), expected)
    assert not net.training
    assert not any(p.requires_grad for p in net.parameters())


def test_the_papers_size_is_read_off_the_file(tmp_path):
    net = load_openpoints(saved(tmp_path / "w.pth", openpoints(64)))
    assert net.size == 1024
    assert sum(p.numel() for p in net.parameters()) == sum(
        value.numel()
        for name, value in openpoints(64).items()
        if name.startswith("encoder.") and "running" not in name and "num_batches" not in name
    )


def test_other_files_are_refused(tmp_path):
    with pytest.raises(WearcapError, match="no such file of weights"):
        load_openpoints(tmp_path / "nowhere.pth")
    with pytest.raises(WearcapError, match="not the weights of PointNeXt-S: .* is nothing"):
        load_openpoints(saved(tmp_path / "other.pth", {"conv1.weight": torch.zeros(4, 3)}))
    six = openpoints() | {"encoder.encoder.0.0.convs.0.0.weight": torch.zeros(4, 6, 1)}
    with pytest.raises(WearcapError, match=r"other axes.*in_channels: 3"):
        load_openpoints(saved(tmp_path / "six.pth", six))
    extra = openpoints() | {"encoder.encoder.1.1.pwconv.0.0.weight": torch.zeros(4, 4, 1)}
    with pytest.raises(WearcapError, match=r"1 unexpected \(encoder.encoder.1.1.pwconv"):
        load_openpoints(saved(tmp_path / "deeper.pth", extra))
    wide = openpoints() | {"encoder.encoder.2.0.skipconv.0.bias": torch.zeros(5)}
    with pytest.raises(WearcapError, match="another size of PointNeXt-S"):
        load_openpoints(saved(tmp_path / "wide.pth", wide))
    torch.save({"model": openpoints(), "path": Path("x")}, tmp_path / "code.pth")
    with pytest.raises(WearcapError, match="was not opened"):
        load_openpoints(tmp_path / "code.pth")
