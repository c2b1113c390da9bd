"""Readers and writers of files that others define: the one place that knows their units, axes and quirks.

One file per format, or per data set (`amass.py`, `nymeria.py`, `hps_sequence.py`); what it gives is metric, z up, and
checked, and what it refuses it names with the file, what was expected, and what to do. Open `tum.py` first, a small
whole one. Shared by all: `text.py`, `json_text.py`, `npz.py`, `csv_table.py`, `restricted_pickle.py`, and
`smpl_axes.py` where SMPL's axes become ours. Our own files: `motion_npz.py`, `environment.py`, `camera_json.py`,
`photos.py`.
"""
