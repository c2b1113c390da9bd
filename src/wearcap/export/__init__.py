"""Networks as ONNX or torch.export archives, with what is needed to run them elsewhere.

`network.py` writes any of them and compares it with the eager one; `sidecar.py` says beside it what the file does not.
Each system has a module of its name, and iReplica's are `contact.py` and `contact_runner.py`; open `mocap_every.py`
first, the shortest whole way there and back.
"""
