"""H-contact (body/, contacts/, splits/): poses with annotated contacts of both hands; bring your own download.

Folders as it unpacks: `body/NAME.json.zip`, `contacts/NAME.json`, and, from the published code, `splits/…/NAME.json`.
Bodies, as EgoHOI's, are SMPL or SMPL+H poses frame by frame, as `.json.zip` or older `.json`: the world is metric and z
up, joint frames are SMPL's (x left, y up, z forward) as in AMASS, but `transl` is the place of the root joint itself.
Fingers may be relative to SMPL+H's mean hand, which the files do not state.
"""

from dataclasses import replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from data_prep.hps import subject_of
from data_prep.shared.engine import NOTE, Splits, Task
from wearcap.body.skeletons import smpl24, smplh52
from wearcap.boundary.arrays import read_packed_json, require
from wearcap.boundary.opening import understood
from wearcap.boundary.texts import read_json
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.io.formats.contact_labels import LabelClock, read_contact_labels
from wearcap.io.formats.poses import check_rising
from wearcap.io.formats.smpl import shape_from_betas, smpl_motion
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording
from wearcap.recording.timing import resampled
from wearcap.scene.objects import CONTACT_CLASSES

CLASSES = {"*door*": "hinged", "*window*": "hinged", "*": "sliding"}
VERSION = 1
"""Version of the conversion, increased when the same source and settings yield another recording."""
_BODY = 63
"""Number of values of SMPL+H's 21 body joints; SMPL's two hand joints follow them."""
_HANDS = ("left_hand_pose", "right_hand_pose")
_SIZES = {"global_orient": 3, "body_pose": "pose", "transl": 3, **dict.fromkeys(_HANDS, 45)}
_EXPECTED = (
    '{"sequence": [{"time", "global_orient", "body_pose" (63 or 69), "transl", …}], "global": {"betas", "gender"}}'
)


def read_smpl_json(path: str | Path) -> tuple[Motion, dict[str, float]]:
    """Read `NAME.json.zip` {sequence, global}, or an older `NAME.json`: [{time, pose (72), translation, shape}].

    Gives the body's motion (smpl24, or smplh52 where the file has hands) on the file's clock, and its shape. Where the
    file has no position, the root stays at the origin.

    Raises WearcapError for what is damaged, missing or misshapen, for NaN, and for times that do not rise.
    """
    path = Path(path)
    content = read_packed_json(path, _EXPECTED) if path.suffix == ".zip" else read_json(path)
    frames, about = _frames(content, path)
    arrays = {}
    for name in ("time", *_SIZES):
        if name in ("time", "global_orient", "body_pose") or name in frames[0]:
            with understood(f"{name} is missing in a frame, or no list of numbers", path, _EXPECTED):
                arrays[name] = np.array([frame[name] for frame in frames], np.float64).reshape(len(frames), -1)
    require(arrays, path, time=("frame", 1), **{name: ("frame", _SIZES[name]) for name in arrays if name != "time"})
    body, hands = arrays["body_pose"], [arrays[name] for name in _HANDS if name in arrays]
    if body.shape[1] not in (_BODY, _BODY + 6) or len(hands) == 1:
        raise WearcapError(f"poses of {body.shape[1]} numbers with {', '.join(arrays)}", path, _EXPECTED)
    check_rising(arrays["time"][:, 0], path)
    parts = [body[:, :_BODY], *hands] if hands else [body, np.zeros((len(body), _BODY + 6 - body.shape[1]))]
    rotvec = np.concatenate([arrays["global_orient"], *parts], 1)
    times, t = torch.from_numpy(arrays["time"][:, 0]), arrays.get("transl", np.zeros((len(frames), 3)))
    gender = about.get("gender")
    gender = gender if isinstance(gender, str) else ""
    skeleton = smplh52() if hands else smpl24()
    motion = smpl_motion(times, skeleton, rotvec, t, source=path.name, format="smpl_json", gender=gender)
    with understood("betas are no numbers", path):
        betas = np.array(about.get("betas") or [], np.float64).reshape(-1)
    if not np.isfinite(betas).all() or len(betas) > 300:
        raise WearcapError(f"{len(betas)} betas, or some that are not finite", path, "10 numbers")
    return motion, shape_from_betas(betas)


def _frames(content: Any, path: Path) -> tuple[list[dict], dict]:
    """Frames in the newer layout, and the content that applies to all of them."""
    sequence = content.get("sequence") if isinstance(content, dict) else content
    if not isinstance(sequence, list) or not sequence or not all(isinstance(frame, dict) for frame in sequence):
        raise WearcapError("no poses", path, _EXPECTED)
    about = content.get("global", {}) if isinstance(content, dict) else {"betas": sequence[0].get("shape", [])}
    if "pose" in sequence[0]:
        for number, frame in enumerate(sequence):
            pose = frame.get("pose")
            if not isinstance(pose, list) or len(pose) != 72:
                raise WearcapError(f"frame {number} has no pose of 72 numbers", path, _EXPECTED)
            newer = {"time": frame.get("time"), "global_orient": pose[:3], "body_pose": pose[3:]}
            sequence[number] = newer | ({"transl": frame["translation"]} if "translation" in frame else {})
    return sequence, about if isinstance(about, dict) else {}


ENDING = ".json.zip"


def hcontact_names(root: str | Path) -> list[str]:
    """Names of all sequences with a body, in order."""
    return sorted(path.name.removesuffix(ENDING) for path in Path(root).glob(f"body/*{ENDING}"))


def read_hcontact(root: str | Path, name: str, contact_class: str = "") -> Recording:
    """Read a sequence: `motion` (smplh52 with hands, else smpl24) on its own clock, and `interactions` of unknown
    objects, all of `contact_class` (of `scene.objects.CONTACT_CLASSES`, or "" where unknown).

    A contact with end < start lasts until the sequence ends. Raises WearcapError for an unknown sequence or class,
    and for what the readers of bodies and contacts refuse.
    """
    if contact_class not in ("", *CONTACT_CLASSES):
        raise WearcapError(f"no contact class {contact_class!r}", expected=f"one of {', '.join(CONTACT_CLASSES)}")
    root = Path(root)
    if name not in hcontact_names(root):
        fix = f"There are {len(hcontact_names(root))}, such as {hcontact_names(root)[:3]}."
        raise WearcapError(f"no sequence {name!r}", root, f"body/{name}{ENDING}", fix)
    motion, shape = read_smpl_json(root / "body" / f"{name}{ENDING}")
    clock = LabelClock.of(name, motion.timestamps)
    contacts = read_contact_labels(root / "contacts" / f"{name}.json", clock)
    return Recording(
        name,
        motion=motion,
        interactions=replace(contacts, classes=tuple(named or contact_class for named in contacts.classes)),
        skeleton=motion.skeleton,
        shape=shape,
        source="H-contact",
        **about_sequence(name),
    )


def about_sequence(name: str) -> dict[str, Any]:
    """Subject, location and activity in a name, as the published code takes it apart: SUB1, MPI_Etage6, sofa; TUB_2OG …"""
    subject = subject_of(name)
    rest = name.split(".")[0].removeprefix(f"{subject}_")
    parts = rest.split("_")
    location = "_".join(parts[: 3 if parts[1:2] == ["BIB"] else 2])
    return {"subject": subject, "location": location, "activity": rest.removeprefix(location).strip("_")}


def read_hcontact_split(path: str | Path) -> dict[str, list[int]]:
    """Middle frames of the windows for "train", "valid" and "test", counted from the first whole window.

    Reads `splits/…/NAME.json` {window_radius, train, valid, test}. Raises WearcapError for anything else.
    """
    content = read_json(path)
    parts: tuple[str, ...] = ("train", "valid", "test")
    content = content if isinstance(content, dict) else {}
    radius, lists = content.get("window_radius"), [content.get(part) for part in parts]
    frames: list[list[Any]] = [windows if isinstance(windows, list) else [None] for windows in lists]
    sound = type(radius) is int and radius > 0
    sound = sound and all(type(k) is int and 0 <= k < 1 << 40 for windows in frames for k in windows)
    if not sound:
        expected = '{"window_radius": 30, "train": [frame, …], "valid": […], "test": […]}'
        raise WearcapError("not a split of windows", path, expected)
    return dict(zip(parts, frames))


def _hcontact(root: Path, name: str, contact_class: str, fps: float | int, license: str) -> Recording:
    """The motion at `fps`; contacts keep their times."""
    read = read_hcontact(root, name, contact_class)
    assert read.motion is not None
    motion = resampled(read.motion, fps)
    if not read.motion.t_world_root.any():
        motion = replace(motion, provenance=motion.provenance | {NOTE: "the body's place is not known"})
    return replace(read, motion=motion, license=license)


def hcontact_tasks(
    source: str | Path,  # the folder that holds body and contacts
    splits: Splits,
    classes: dict[str, str] = CLASSES,  # contact class by sequence name, the first pattern that matches
    fps: float | int = 60,  # motions are brought to this rate; contacts keep their times
    license: str = "H-contact licence (virtualhumans.mpi-inf.mpg.de/ireplica); not to be passed on",
) -> list[Task]:
    """One task per sequence in `source`/body; `classes` maps patterns of names to contact classes, the first match decides.

    A subject with windows in the data set's own `splits/`, none of them for training, belongs to test, regardless of the
    list. Raises WearcapError without sequences, and for a name that no pattern matches.
    """
    source = Path(source)
    names = hcontact_names(source)
    if not names:
        expected, fix = f"body/NAME{ENDING} and contacts/NAME.json", "Give H-contact's folder as source=DIR."
        raise WearcapError("no sequences", where=source, expected=expected, fix=fix)
    trains: dict[str, bool] = {}
    for path in sorted(source.glob("splits/**/*.json")):
        if path.stem in names:
            subject = subject_of(path.stem)
            trains[subject] = bool(read_hcontact_split(path)["train"]) or trains.get(subject, False)
    tasks = []
    for name in names:
        kind = next((kind for pattern, kind in classes.items() if fnmatchcase(name, pattern)), None)
        if kind is None:
            what = f"no contact class for sequence {name!r}"
            raise WearcapError(what, expected="a pattern of `classes` that matches it")
        subject = subject_of(name)
        files = [source / "body" / f"{name}{ENDING}", source / "contacts" / f"{name}.json"]
        there = [path for path in files if path.is_file()]
        key = content_hash(name, kind, float(fps), license, VERSION, *there)
        split = splits.of(subject) if trains.get(subject, True) else "test"
        tasks.append(Task(name, partial(_hcontact, source, name, kind, fps, license), split, key))
    return tasks
