"""The simulated wearer: seeded people in seeded places, with the readings of their sensors and the ground truth.

Open `recordings/simulate.py` first: one recording from a seed. A `World` (`places/world.py`; made by `flat.py`,
`outdoor.py`, `site.py`) and a `Person` go in; activities (`people/actions.py`, where one is added;
those with objects in `handling/`) write footsteps and channels onto a `Plan`
(`people/plan.py`), out of which `people/wearer.py` makes the whole body's motion at once: feet (`gait.py`), trunk
(`posture.py`), arms (`arms.py`). `recordings/` has the recordings of HPS, iReplica and ECHO as well; `rendering/` is
what cameras and scanners see.
"""
