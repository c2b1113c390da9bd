"""Export of a system's networks to ONNX or torch.export, and systems that run the exported files.

A system says in its `export.py` what it exports (`exports`) and how it runs from files (`from_export`). `files.py`
writes the graphs, compares them with the eager networks, and opens them.
"""
