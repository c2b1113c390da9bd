"""Running exported contact networks on a recording frame by frame, without Lightning, Hydra or the networks' code.

    python -m wearcap.export.contact_runner MODEL.onnx RECORDING.safetensors CONTACT.csv

Poses are processed frame by frame with a lookahead of 30 frames; the state is the last 61 frames.
"""

import torch

from wearcap.errors import WearcapError
from wearcap.export import command
from wearcap.export.contact import load_exported_contact
from wearcap.files import write_text
from wearcap.recording.interactions import HANDS
from wearcap.recording.store import RecordingFile
from wearcap.systems.ireplica.contact_prediction import ContactStream
from wearcap.systems.ireplica.features import pose_frames


def main(arguments: list[str]) -> None:
    """Predict hand contact in one recording with an exported model and write it as a table."""
    parser = command.parser("contact_runner", main.__doc__, "a suit, or a motion", "times and probabilities (.csv)")
    options = parser.parse_args(arguments)
    detector = load_exported_contact(options.model)
    recording = RecordingFile(options.recording).load()
    motion = recording.suit or recording.motion
    if motion is None:
        raise WearcapError("this recording has no poses", where=options.recording, expected="a suit, or a motion")
    times, R = pose_frames(motion, detector.features.skeleton, detector.fps)
    stream = ContactStream((detector,), detector.features.skeleton)
    predictions = [found for frame in R if (found := stream.push(frame)) is not None] + stream.finish()
    header = ["time_s", *(f"{hand}_{name}" for name in detector.classes for hand in HANDS)]
    rows = [
        [f"{time:.6f}", *(f"{p:.7f}" for p in torch.cat([found[name] for name in detector.classes]).tolist())]
        for time, found in zip(times.tolist(), predictions)
    ]
    write_text(options.output, "".join(",".join(row) + "\n" for row in [header, *rows]))
    print(f"{len(rows)} frames at {detector.fps:.0f} Hz: {options.output}")


if __name__ == "__main__":
    command.run(main)
