"""Networks as ONNX or torch.export archives, with what is needed to run them elsewhere.

`network.py` writes any of them and compares it with the eager one; beside it a sidecar says what the file does not.
Open `watches.py` (MocapEvery) first, the shortest whole way there and back. `contact.py` is iReplica's, `sidecar.py`
and `runner.py` are HMD²'s.
"""
