"""Visual localisation of a camera in a mapped scene: map, retrieval, matching, absolute pose.

Open `localizer.py` first: it lists the steps in order. `map_builder.py` builds the map (`visual_map.py`) that it
localises in; `tracking.py` estimates a camera path without a map; `keypoints.py` is the interface of body detectors.
"""
