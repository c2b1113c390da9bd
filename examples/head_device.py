"""A head device's own files to motion: python examples/head_device.py TRAJECTORY_OR_FOLDER MOTION.glb [HEIGHT]

TRAJECTORY_OR_FOLDER: Aria's MPS output, or a trajectory (TUM, EuRoC, COLMAP, DROID-SLAM …). HEIGHT: the wearer's, in metres.
"""

import sys

import wearcap

recording = wearcap.read(sys.argv[1], height=float(sys.argv[3]) if len(sys.argv) > 3 else None)
motion = wearcap.load("hmd2")(recording)
wearcap.save(motion, sys.argv[2])
print(f"{len(motion)} frames at {motion.fps:.0f} Hz: {sys.argv[2]}")
