"""Plain networks: tensors in, tensors out; no Lightning, no losses, no schedules.

One file per network: `denoiser.py` (HMD²), `echo.py`, `watch_estimator.py` and `motion_manifold.py` (MocapEvery),
`contact_*.py` (iReplica), `superpoint.py`, `lightglue.py` and `netvlad.py` (HPS); `*_runtime.py` run them fast. Open
`denoiser.py` first; `checkpoint.py` brings any of them back, without executing anything from its file.
"""
