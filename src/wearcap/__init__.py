"""Motion capture from what a person wears."""

from wearcap.version import __version__ as __version__


def load(pipeline: str, *overrides: str, checkpoint=None, device: str = "cpu", trust: bool = False):
    """The `runtime.system.System` that `wearcap capture pipeline=PIPELINE checkpoint=CHECKPOINT` runs.

    wearcap.load("hmd2") has the shared checkpoint's network, wearcap.load("hps") needs none. `overrides` are those of the
    command line ("pipeline.sampling.steps=20"). Raises WearcapError for an unknown pipeline or setting, and for a checkpoint that
    the pipeline cannot use, or that is somebody else's `.ckpt` (`trust` opens it all the same).
    """
    from wearcap.boundary.own import trusting
    from wearcap.cli.conf import compose, load_pipeline

    config = compose("capture", [f"pipeline={pipeline}", *overrides, "recording=none"])
    with trusting(trust):
        return load_pipeline(checkpoint, config.pipeline, device, shared=True)


def read(path, height: float | None = None, **stated):
    """The `recording.Recording` in any file or folder that holds one: a prepared recording, MVNX, BVH, AMASS, MPS, logs …

    `height` (m) is the wearer's; without it, and without a skeleton in the file, it follows from how high the head is
    carried. `stated` is what the file's content need not decide: unit="cm", up="y", axes="unity" … (`io.conventions.Conventions`).
    Raises WearcapError for what cannot be read.
    """
    return source(path, height, **stated).recording


def source(path, height: float | None = None, scene=None, **stated):
    """The recording with its files (`runtime.system.CaptureInput`), for systems that use them: HPS its scan, iReplica its
    objects. `scene` is another scan, or its folder. Raises WearcapError as `read` does, and for a scene without a cloud.
    """
    from wearcap.body.skeleton import xsens23
    from wearcap.io.conventions import Conventions
    from wearcap.reading import read as read_any
    from wearcap.recording.store import dataset_folder
    from wearcap.runtime.system import CaptureInput
    from wearcap.tracking.stature import with_stature

    recording, _ = with_stature(read_any(path, Conventions(**stated)), xsens23(), height)
    return CaptureInput.in_dataset(recording, dataset_folder(path), scene)


def save(motion, path, rig=None, keep_hands: bool = False) -> None:
    """Write a `recording.Motion` as what the name's ending says: .npz, .bvh, .glb, .usd (.usda, .usdc, .usdz), .vrma (VRM
    animation), _smplh.npz (SMPL+H, as AMASS has it), .trc and .mot (OpenSim) or _angles.csv (joint angles, ISB).

    `rig` is a character of your own, a .glb, .vrm or .bvh: its file is written with the motion on it, its proportions kept;
    `keep_hands` then puts its wrists where the motion's are, instead of keeping the directions of the arms.
    Raises WearcapError for another ending, a missing extra, a character that is not understood, and when the file cannot be written.
    """
    from wearcap.io.saving import save as save_motion
    from wearcap.prepare.rigs import read_rig, write_on_rig

    if rig is None:
        save_motion(motion, path)
    else:
        write_on_rig(motion, read_rig(rig), path, keep_hands)


def show(motion=None, seconds: float = 10.0, fps: float = 15.0, size: tuple[int, int] = (360, 320), **labelled):
    """A video of a `recording.Motion` for a notebook, which shows it where it is the value of a cell (`apps.viewer.inline.Video`).

    `labelled` are further motions of the same moments, or all of them, by their labels (truth=recording.motion). Each has a panel of
    `size` (width, height, in pixels). The video lasts `seconds` at most. Raises WearcapError for no motion, for motions that share no
    time, and for odd sizes.
    """
    from wearcap.apps.viewer.inline import Video

    return Video.of(labelled if motion is None else {"motion": motion, **labelled}, fps, size, seconds)
