"""The five systems, a folder each; what two of them share lies below. Open a folder's `README.md`, then its `pipeline.py`."""
