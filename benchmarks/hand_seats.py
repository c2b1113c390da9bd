"""Which seat of controllers on the hands is found in logs that do not say it, and by how much the wrists are off.

    python benchmarks/hand_seats.py [--dataset datasets/fubot_vr] [--split train] [--seconds 60] [--seeds 0 1]

True wrists are given controllers of every family, with drawn errors of each seat (its angle's deviation, 6 degrees about the
other axes, 2 cm), and a headset with its nominal seat. "Hand" is the angle between the hand's axis found and the true one.
"""

import argparse
from collections import Counter, defaultdict
from pathlib import Path

import torch

from wearcap.body.skeleton import WRISTS
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.devices.hand_seats import CANDIDATES, SEATS, most_likely_seat, palm_of, side_of, wrist_of_hand
from wearcap.recording import Recording, RecordingStore

OTHER_DEG, OFF_M = 6.0, 0.02
_BEFORE = "grip"


def controllers(
    recording: Recording, family: str, random: torch.Generator, frames: slice
) -> tuple[Trajectory, dict[str, Trajectory], dict[str, Trajectory]]:
    """Poses of the headset, of controllers of a family with drawn errors, and the true wrists of a recording's frames."""
    head, motion = recording.head, recording.motion
    assert head is not None
    assert motion is not None
    device = Trajectory(head.timestamps[frames], head.R_world_device[frames], head.t_world_device[frames])
    hands, wrists = {}, {}
    drawn = torch.randn(3, generator=random) * torch.tensor([OTHER_DEG, SEATS[family].deviation_deg, OTHER_DEG])
    moved = torch.randn(3, generator=random) * OFF_M
    for joint in WRISTS:
        T, side = motion.joint(joint), torch.tensor([side_of(joint), 1.0, side_of(joint)])
        T = T[frames]
        error = rotation.exp((drawn * side).deg2rad())  # both hands hold it alike: mirrored
        R_wrist_device = wrist_of_hand(torch.eye(3)[None], joint, family)[0].mT @ error
        place = palm_of(joint, family) + moved * torch.tensor([1.0, side_of(joint), 1.0])
        wrists[joint] = Trajectory(device.timestamps, T.R, T.t)
        hands[joint] = Trajectory(device.timestamps, T.R @ R_wrist_device, T.t + T.R @ place)
    return device, hands, wrists


def off_deg(hands: dict[str, Trajectory], wrists: dict[str, Trajectory], family: str) -> torch.Tensor:
    """Angles between true hands' axes and those that a family's seat gives, of all hands and frames."""
    both = []
    for joint, hand in hands.items():
        found = wrist_of_hand(hand.R_world_body, joint, family)[:, :, 1]
        both.append((found * wrists[joint].R_world_body[:, :, 1]).sum(-1).clamp(-1, 1).acos().rad2deg())
    return torch.cat(both)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=Path, default=Path("datasets/fubot_vr"), metavar="DIR")
    parser.add_argument("--split", default="train")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    options = parser.parse_args()
    store, found, angles = RecordingStore.open(options.dataset), defaultdict(Counter), defaultdict(list)
    sure, randoms = defaultdict(list), [torch.Generator().manual_seed(seed) for seed in options.seeds]
    for name in store.names(options.split):
        recording = store.load(name)
        if recording.head is None or recording.motion is None:
            continue
        count = round(options.seconds / recording.head.timestamps.diff().median().item())
        for random in randoms:
            for begin in range(0, max(len(recording.motion) - count, 0) + 1, max(1, count)):
                for family in CANDIDATES:
                    head, hands, wrists = controllers(recording, family, random, slice(begin, begin + count))
                    taken, probability = most_likely_seat(head, hands)
                    found[family][taken] += 1
                    angles[family, "found"].append(off_deg(hands, wrists, taken).mean())
                    angles[family, "before"].append(off_deg(hands, wrists, _BEFORE).mean())
                    angles[family, "known"].append(off_deg(hands, wrists, family).mean())
                    sure[taken == family].append(probability)
    for family in CANDIDATES:
        total = sum(found[family].values())
        means = ", ".join(
            f"{how} {torch.stack(angles[family, how]).mean():.1f}" for how in ("known", "found", "before")
        )
        others = ", ".join(f"{other} {100 * n / total:.0f}" for other, n in found[family].most_common())
        print(f"{family} ({total} logs): taken (%) {others}; hand off by (degrees) {means}", flush=True)
    for right, values in sorted(sure.items()):
        print(
            f"{'right' if right else 'wrong'}: {len(values)} logs, {100 * sum(values) / len(values):.0f} % sure on average"
        )


if __name__ == "__main__":
    main()
