"""A suit registered in a scanned scene: python examples/suit_and_scan.py DATASET/NAME MOTION.glb

DATASET is what `wearcap prepare mvnx source=TAKE.mvnx camera=camera.json camera_poses=POSES.txt scene=SCAN.ply` made: the
suit's take, the head camera's poses in the scene, and the scene's scan.
"""

import sys

import wearcap

recording = wearcap.source(sys.argv[1])  # with its scan
motion = wearcap.load("hps")(recording)
wearcap.save(motion, sys.argv[2])
suit = wearcap.load("recorded")(recording)
left = (motion.t_world_root - motion.t_world_root[0]).norm(dim=1)[-1] - (suit.t_world_root - suit.t_world_root[0]).norm(
    dim=1
)[-1]
print(f"{sys.argv[2]}: from its start the wearer ended {left:+.2f} m farther away than the suit alone believes")
