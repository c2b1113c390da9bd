"""The simulated wearer: seeded people in seeded places, with the readings of their sensors and the ground truth.

Open `simulate.py` first: one recording from a seed. A `World` (`world.py`; made by `flat.py`, `outdoor.py`,
`site.py`, `hillside.py`) and a `Person` go in; activities (`actions.py`, where one is added; `hands.py`, `settle.py`)
write footsteps and channels onto a `Plan` (`plan.py`), out of which `wearer.py` makes the whole body's motion at
once: feet (`gait.py`), trunk (`posture.py`), arms (`arms.py`). `hps.py`, `interaction_session.py` and
`object_session.py` are the recordings of HPS, iReplica and ECHO; `views.py` and `ego_view.py` are what cameras see.
"""
