"""Two watches and a head camera to motion: python examples/two_watches.py FOLDER MOTION.glb HEIGHT

FOLDER holds one session's logs: one watch's with `left` in its name, one with `right`, and the camera's trajectory.
HEIGHT: the wearer's, in metres. Logs of clocks that differ are calibrated first: `wearcap calibrate steps=watches --guide`.
"""

import sys

import wearcap

recording = wearcap.read(sys.argv[1], height=float(sys.argv[3]))
motion = wearcap.load("mocap_every")(recording)
wearcap.save(motion, sys.argv[2])
print(f"{len(motion)} frames at {motion.fps:.0f} Hz: {sys.argv[2]}")
