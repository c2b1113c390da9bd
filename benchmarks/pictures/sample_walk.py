"""Makes the sample recording, `examples/headset_walk.csv`: a simulated wearer's headset and controllers, as OpenXR has them.

    python -m benchmarks.pictures.sample_walk [--dataset datasets/simulated] [--name sim-test-0-0017] [--begin 5.0]

Fifteen seconds of true motion at 30 Hz, tracked with 1 mm and 0.2° of noise. Prints the wearer's height for README.
"""

import argparse
from pathlib import Path

import torch

import wearcap
from wearcap.body.skeleton import WRISTS, skeleton_of_height, xsens23
from wearcap.files import write_text
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.io.devices.hand_seats import palm_of, wrist_of_hand
from wearcap.recording import RecordingStore

SAMPLE = Path(__file__).parents[2] / "examples" / "headset_walk.csv"
SECONDS, FPS, NOISE_M, NOISE_DEG = 15, 30, 0.001, 0.2
R_XR = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
"""OpenXR's axes (x right, y up, z backwards) of wearcap's (x forward, y left, z up)."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=Path, default=Path("datasets/simulated"))
    parser.add_argument("--name", default="sim-test-0-0017")
    parser.add_argument("--begin", type=float, default=5.0)
    options = parser.parse_args()
    recording = RecordingStore.open(options.dataset).load(options.name)
    motion, floor = recording.motion, recording.floor
    assert motion is not None
    assert floor is not None
    step, first = round(motion.fps / FPS), round(options.begin * motion.fps)
    motion = motion.sliced(first, first + SECONDS * round(motion.fps) + 1)
    inside = (floor.timestamps >= motion.timestamps[0]) & (floor.timestamps <= motion.timestamps[-1])
    ground = floor.height[inside].median()
    seat = wearcap.read(SAMPLE, height=1.7).head  # where the reader takes a headset to sit
    assert seat is not None
    devices = {"head": motion.joint("head") @ Rigid(seat.R_head_device, seat.t_head_device)}
    for joint in WRISTS:
        wrist, turn = motion.joint(joint), wrist_of_hand(torch.eye(3), joint, "grip")
        devices[f"{joint.split('_')[0]}_grip"] = wrist @ Rigid(turn.mT, palm_of(joint, "grip"))
    generator = torch.Generator().manual_seed(0)
    names, columns = ["time"], [(torch.arange(SECONDS * FPS + 1) / FPS)[:, None].double()]
    origin = torch.tensor([*devices["head"].t[0, :2], ground])
    for name, device in devices.items():
        R, t = device.R[::step], device.t[::step] - origin
        t = t + NOISE_M * torch.randn(t.shape, generator=generator)
        R = R @ rotation.exp(torch.deg2rad(NOISE_DEG * torch.randn(t.shape, generator=generator)))
        wxyz = rotation.quat_wxyz_from_matrix(R_XR @ R @ R_XR.T)
        columns += [t @ R_XR.T, wxyz[:, 1:], wxyz[:, :1]]
        names += [f"{name}_pos_{axis}" for axis in "xyz"] + [f"{name}_rot_{axis}" for axis in "xyzw"]
    rows = torch.cat([each.double() for each in columns], -1).tolist()
    lines = [",".join([f"{row[0]:.3f}", *(f"{value:.4f}" for value in row[1:])]) for row in rows]
    write_text(SAMPLE, "\n".join([",".join(names), *lines]) + "\n")
    ratio = skeleton_of_height(1.0, xsens23()).height_of("head")
    print(f"{SAMPLE}: a wearer of {motion.skeleton.height_of('head') / ratio:.2f} m")


if __name__ == "__main__":
    main()
