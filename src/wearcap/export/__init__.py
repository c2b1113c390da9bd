"""Export of networks to ONNX or torch.export archives, and pipelines that run the exported files.

`network.py` writes any network and compares it with the eager one; `sidecar.py` writes the metadata beside it. Each
system has a module of its name; iReplica's are `contact.py` and `contact_runner.py`. Open `mocap_every.py` first: the
shortest complete export and import.
"""
