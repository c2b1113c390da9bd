"""Blender as a receiver of `wearcap live`: its own armature, posed by what the VMC protocol says, against the captured motion.

    python benchmarks/live_blender.py --blender PYTHON [--recording DATASET/NAME] [--system mocap_every]

PYTHON: an interpreter with `pip install bpy python-osc`; neither Blender nor bpy is a dependency of wearcap. A replay is sent to
the Blender process over UDP; there each bone of an armature gets its rotation, and the hips and the spine their place, and
Blender computes the bones' heads in the world. Prints one JSON line: frames, and the distance (mm, mean and largest) of bones'
heads from the joints of the motion that was recorded at the same time.
"""

import argparse
import json
import math
import subprocess
import tempfile
from pathlib import Path

import torch

from wearcap.cli.conf import compose, load_pipeline
from wearcap.io.formats.motion_npz import read_motion
from wearcap.live.capture import LiveCapture
from wearcap.live.sinks.files import FilesSink
from wearcap.live.sinks.vmc import BONES, PARENTS, VmcSink
from wearcap.live.source import Address
from wearcap.live.sources.replay import ReplaySource
from wearcap.reading import read
from wearcap.recording.timing import first_seconds

RECEIVER = """
import json, socket, sys
import bpy
from mathutils import Matrix, Quaternion, Vector
from pythonosc.osc_packet import OscPacket

PARENT = json.loads(sys.argv[-1])
inbox = socket.socket(type=socket.SOCK_DGRAM)
inbox.bind(("127.0.0.1", 0))
inbox.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 24)
inbox.settimeout(120.0)
print(inbox.getsockname()[1], flush=True)

# Unity (left-handed, y up) to Blender (right-handed, z up): x stays, y and z change places.
place = lambda p: Vector((p[0], p[2], p[1]))
turn = lambda q: Quaternion((q[3], -q[0], -q[2], -q[1]))

frames = []
while True:
    try:
        data = inbox.recv(65536)
    except TimeoutError:  # the replay has ended
        break
    inbox.settimeout(10.0)
    frame = {}
    for timed in OscPacket(data).messages:
        message = timed.message
        if message.address == "/VMC/Ext/T":
            time_s = message.params[0]
        if message.address == "/VMC/Ext/Bone/Pos":
            frame[message.params[0]] = message.params[1:]
    frames.append((time_s, frame))

bpy.ops.wm.read_factory_settings(use_empty=True)
armature = bpy.data.armatures.new("body")
body = bpy.data.objects.new("body", armature)
bpy.context.scene.collection.objects.link(body)
bpy.context.view_layer.objects.active = body
bpy.ops.object.mode_set(mode="EDIT")
first, rest = frames[0][1], {}
for name in PARENT:
    parent = PARENT[name]
    rest[name] = (rest[parent] + place(first[name])) if parent else Vector((0, 0, 0))
    bone = armature.edit_bones.new(name)
    bone.head, bone.tail = rest[name], rest[name] + Vector((0, 0, 0.1))
    if parent:
        bone.parent = armature.edit_bones[parent]
bpy.ops.object.mode_set(mode="POSE")
found = []
for time_s, frame in frames:
    for name, values in frame.items():
        bone = body.pose.bones[name]
        bone.rotation_mode = "QUATERNION"
        axes = bone.bone.matrix_local.to_3x3()
        R = turn(values[3:]).to_matrix()
        bone.rotation_quaternion = (axes.inverted() @ R @ axes).to_quaternion()
        parent = PARENT[name]
        at_rest = rest[name] - rest[parent] if parent else Vector((0, 0, 0))
        bone.location = axes.inverted() @ (place(values[:3]) - at_rest)
    bpy.context.view_layer.update()
    found.append([time_s, [list(body.pose.bones[name].head) for name in PARENT]])
print(json.dumps(found), flush=True)
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blender", required=True)
    parser.add_argument("--recording", default="datasets/simulated/sim-test-0-0000")
    parser.add_argument("--system", default="mocap_every")
    parser.add_argument("--seconds", type=float, default=20.0)
    options = parser.parse_args()
    overrides = ["recording=x", f"pipeline={options.system}_online"]
    system = load_pipeline(None, compose("live", overrides).pipeline, "cpu", True)
    source = ReplaySource(first_seconds(read(options.recording), options.seconds), system.session_class(), math.inf)
    with tempfile.TemporaryDirectory() as folder:
        script = Path(folder) / "receiver.py"
        script.write_text(RECEIVER, encoding="utf-8")
        parents = json.dumps({name: PARENTS[name] for name in BONES})
        command = [options.blender, script, parents]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert process.stdout is not None
        port = int(next(line for line in process.stdout if line.strip().isdigit()))
        sink = VmcSink(Address("vmc", "127.0.0.1", port), pace=True)
        LiveCapture(system, [source], [sink], setup=source.setup, recorder=FilesSink, record=Path(folder) / "out").run()
        motion = read_motion(Path(folder) / "out" / "wearer" / "motion.npz")
        found = json.loads(next(line for line in process.stdout if line.startswith("[[")))
        process.wait()
    times = torch.tensor([row[0] for row in found], dtype=torch.float64)
    heads = torch.tensor([row[1] for row in found])
    frames = (motion.timestamps[None] - times[:, None]).abs().argmin(1)
    # Blender's axes are Unity's with y and z exchanged; ours: x is Unity's z, y its -x, z its y.
    ours = torch.stack([heads[..., 1], -heads[..., 0], heads[..., 2]], -1)
    apart = 1000 * (ours - motion.T_world_joint.t[frames][:, motion.skeleton.indices(*BONES.values())]).norm(dim=-1)
    row = {"name": "live_blender", "frames": len(found), "of": len(motion), "mean_mm": round(apart.mean().item(), 3)}
    print(json.dumps(row | {"largest_mm": round(apart.max().item(), 3)}), flush=True)


if __name__ == "__main__":
    main()
