"""A Recording goes in, a Motion comes out.

`hps.py`, `ireplica.py`, `hmd2.py`, `mocap_every.py` and `echo.py` show their paper's steps in order: open the one you
care for first. Around each stand `*_stream.py` (while things happen), `*_windows.py`, `*_evaluation.py` and
`*_baselines.py`. HPS and iReplica keep results from step to step by `stages.py`; `evaluation.py` scores any of them.
`doctor/` examines recordings.
"""
