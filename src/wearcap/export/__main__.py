"""Running an exported model on a recording, without Lightning, Hydra and the checkpoint.

    python -m wearcap.export MODEL.onnx RECORDING.safetensors OUTPUT

OUTPUT is a motion (.safetensors), or for a contact network a table (.csv).
"""

import argparse
import sys
from pathlib import Path

from wearcap.boundary.own import trusting
from wearcap.errors import WearcapError
from wearcap.export.files import load_exported
from wearcap.recording import Recording
from wearcap.recording.store import RecordingFile, dataset_folder, save_recording
from wearcap.runtime.system import CaptureInput, System


def main(arguments: list[str]) -> None:
    """Capture one recording with an exported model."""
    parser = argparse.ArgumentParser(prog="python -m wearcap.export", description=main.__doc__)
    parser.add_argument("model", type=Path, help="exported .onnx or .pt2 file, with the files written beside it")
    parser.add_argument("recording", type=Path, help="recording (.safetensors) with what the system needs")
    parser.add_argument("output", type=Path, help="where to write the motion (.safetensors), or contact (.csv)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the sampler's noise (default 0)")
    parser.add_argument("--trust", action="store_true", help="open a .pt2 file from elsewhere, which can run code")
    options = parser.parse_args(arguments)
    with trusting(options.trust):
        exported = load_exported(options.model)
    recording = RecordingFile(options.recording).load()
    if not isinstance(exported, System):
        exported.write(recording, options.output)
        print(f"contact: {options.output}")
        return
    motion = exported(CaptureInput(recording, dataset_folder(options.recording)), options.seed)
    captured = Recording(
        options.output.stem,
        motion=motion,
        skeleton=motion.skeleton,
        object_motion=motion.object_motion or {},
        source=f"captured from {recording.name}",
    )
    save_recording(captured, options.output)
    print(f"{len(motion)} frames at {motion.fps:.0f} Hz: {options.output}")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except WearcapError as error:
        sys.exit(f"error: {error}")
