"""Readers and writers of files that others define: the one place that knows their units, axes and quirks.

`formats/` are files that programs exchange, `devices/` what wearables write. What a reader returns is metric, z up and
checked; errors name the file, what was expected and what to do. Open `formats/poses.py` first, a small whole one. Bytes come
in through `wearcap.boundary`. Shared by all: `csv_table.py` and `times.py` for tables, and `smpl.py`, which converts SMPL's
axes to wearcap's. wearcap's own files: `motion_npz.py`, `environment.py`, `camera_json.py`.
"""
