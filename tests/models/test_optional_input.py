"""A modality that is missing altogether is encoded as where it is missing in some frames."""

import torch

from wearcap.systems.hmd2.model import OptionalInput


def test_nothing_at_all_is_encoded_like_nothing_in_single_frames():
    torch.manual_seed(0)
    layer = OptionalInput(5, 8, 3).eval()
    torch.nn.init.normal_(layer.null)
    frames, some = torch.randn(2, 12, 5), torch.zeros(2, 12, dtype=torch.bool)
    nothing = layer(frames, some)
    some[1, -1] = True
    assert nothing.shape == (2, 4, 8)
    torch.testing.assert_close(nothing[0], layer(frames, some)[0], atol=1e-6, rtol=0)
    assert not torch.allclose(layer(frames, some)[1, -1], nothing[1, -1])
