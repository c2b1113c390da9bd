"""RoMa, imported without PyTorch's compiler: that takes as long as PyTorch itself, and RoMa only wants to be left out of it."""

import sys
from types import SimpleNamespace

import torch

if "torch._dynamo" in sys.modules:
    import roma
else:
    torch.__dict__["_dynamo"] = SimpleNamespace(disable=torch._disable_dynamo)  # the same, at the first call
    try:
        import roma
    finally:
        del torch.__dict__["_dynamo"]

__all__ = ["roma"]
