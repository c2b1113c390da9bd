"""Where a camera stands in a known scene: map, retrieval, matching, absolute pose.

Open `localizer.py` first: it names the steps in order. `map_builder.py` makes the map (`visual_map.py`) that it
localises in; `tracking.py` finds a camera's path where there is none; `keypoints.py` is what detectors of bodies are.
"""
