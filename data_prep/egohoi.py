"""EgoHOI (smpl_motions/, object_locations/, object_models/, gt_contacts/): people moving scanned objects; bring your own download.

Folders as it unpacks: `smpl_motions/SEQ.json[.zip]`, `smpl_shapes/SUBx.json`, `object_models/OBJECT.ply`, and
`object_locations` and `gt_contacts` with SEQ.json for one object, SEQ/OBJECT.json for several. A model's vertices are in
the scan's axes; a pose turns them about the scan's origin and then moves them. Here an object's origin is its `center`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from data_prep.hcontact import about_sequence, read_smpl_json
from data_prep.hps import read_hps_subject, subject_of
from data_prep.shared.engine import Splits, Task
from wearcap.boundary.opening import understood
from wearcap.boundary.texts import read_json
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.contact_labels import LabelClock, interactions_of, labels_of, parse_labels
from wearcap.io.formats.environment import FILE_NAME, write_environment
from wearcap.io.formats.ply import read_ply
from wearcap.io.formats.poses import checked_trajectory
from wearcap.recording.motion import HANDS, Interactions
from wearcap.recording.recording import Recording
from wearcap.recording.timing import resampled
from wearcap.scene.objects import Environment, Freedom, SceneObject

NONE: dict[str, str] = {}
VERSION = 1
"""Version of the conversion, increased when the same source and settings yield another recording."""
MOTION_TYPES = ("hinge", "along_floor", "free", "absent")
"""Motion types of the published configurations, and "absent" for objects that were mapped but not present."""
_CONTACTS = ("gt_contacts", "contacts")


@dataclass(frozen=True)
class _AnnotatedObject:
    """An object's poses, annotated a few times in a sequence."""

    center: tuple[float, float, float]
    """Centre of the model in its own (the scan's) axes (m): the origin of wearcap's object axes."""
    hinge: tuple[float, float, float] | None
    """A point on the hinge's vertical axis in the world (m); None without a hinge."""
    trajectory: Trajectory
    """Sparse trajectory: one pose per annotation."""


def egohoi_names(root: str | Path) -> list[str]:
    """Names of all sequences with a body, in order."""
    files = [path.name for path in Path(root).glob("smpl_motions/*.json*")]
    return sorted({name.removesuffix(".zip").removesuffix(".json") for name in files})


def read_egohoi(
    root: str | Path, name: str, motion_types: Mapping[str, str] | None = None, object_name: str | None = None
) -> tuple[Recording, Environment]:
    """Read a sequence: `motion` (HPS's estimate), `object_motion` (sparse ground truth), `interactions`, environment.

    `motion_types` maps patterns of object names to one of `MOTION_TYPES`, the first match decides; by default objects
    with a hinge turn and all others slide. `object_name` names the object of a single-object sequence whose own name
    does not contain it. Raises WearcapError for an unknown sequence, type or model, a hinged object without a hinge, and for
    labels that end before they start, overlap, lie outside the motion or name unknown parts.
    """
    root = Path(root)
    if name not in egohoi_names(root):
        fix = f"There are {len(egohoi_names(root))}, such as {egohoi_names(root)[:3]}."
        raise WearcapError(f"no sequence {name!r}", root, f"smpl_motions/{name}.json.zip or .json", fix)
    packed = root / "smpl_motions" / f"{name}.json.zip"
    motion, betas = read_smpl_json(packed if packed.is_file() else packed.with_suffix(""))
    clock = LabelClock.of(name, motion.timestamps)
    objects, paths, contacts = [], {}, []
    for object_id, (locations, labels) in _object_files(root, name, object_name).items():
        annotated = read_object_locations(locations)
        default = "along_floor" if annotated.hinge is None else "hinge"
        kind = next(
            (kind for pattern, kind in (motion_types or {}).items() if fnmatchcase(object_id, pattern)), default
        )
        if kind not in MOTION_TYPES:
            raise WearcapError(f"motion type {kind!r} of {object_id}", expected=f"one of {', '.join(MOTION_TYPES)}")
        if kind == "hinge" and annotated.hinge is None:
            what = f"{object_id} is to turn about a hinge and has none"
            raise WearcapError(what, locations, '"hinge": [x, y, z]', "Give it another motion type.")
        if kind == "absent":
            continue
        item = _scene_object(object_id, annotated, root / "object_models" / f"{object_id}.ply", kind, clock.start_s)
        objects.append(item)
        paths[object_id] = annotated.trajectory
        if labels is not None:
            contacts.append(read_egohoi_contacts(labels, clock, object_id, item.freedom.contact_class))
    rows = sorted((row for part in contacts for row in part.rows), key=lambda row: row[0])
    interactions = Interactions.of(rows) if contacts else None
    if interactions is not None:
        labels_of(interactions, clock)  # raises for a hand that holds two objects at once
    shape = root / "smpl_shapes" / f"{subject_of(name)}.json"
    betas = betas or (read_hps_subject(shape)[0] if shape.is_file() else {})
    recording = Recording(
        name,
        motion=motion,
        object_motion=paths,
        interactions=interactions,
        skeleton=motion.skeleton,
        shape=betas,
        source="EgoHOI",
        **about_sequence(name),
    )
    return recording, Environment(tuple(objects))


def _object_files(root: Path, name: str, object_name: str | None) -> dict[str, tuple[Path, Path | None]]:
    """Files of locations and of contacts (None where there are none) by object."""
    several, single = root / "object_locations" / name, root / "object_locations" / f"{name}.json"
    if several.is_dir():
        found = {path.stem: (path, Path(name) / path.name) for path in sorted(several.glob("*.json"))}
    elif single.is_file():
        if not object_name:  # the sequence is named after the model of its only object
            stem = name.split(".")[0].removeprefix(f"{subject_of(name)}_")
            models = sorted(path.stem for path in root.glob("object_models/*.ply"))
            fitting = [stem] if stem in models else [model for model in models if model.startswith(stem)]
            if len(fitting) != 1:
                what = f"{len(fitting)} models fit the sequence {name!r}"
                fix = f"Give its object's name: one of {', '.join(fitting or models)}."
                raise WearcapError(what, root / "object_models", f"{stem}.ply", fix)
            object_name = fitting[0]
        found = {object_name: (single, Path(single.name))}
    else:
        raise WearcapError("no object locations of this sequence", single, f"this file, or a folder {several}")
    return {
        object_id: (path, next((place for folder in _CONTACTS if (place := root / folder / labels).is_file()), None))
        for object_id, (path, labels) in found.items()
    }


def read_object_locations(path: str | Path) -> _AnnotatedObject:
    """Read {center, hinge where it has one, locations: [{time, position, quaternion (wxyz)}]}.

    Raises WearcapError for missing keys, NaN, quaternions that are none, two poses at one time, or no pose at all.
    """
    expected = '{"center": [x, y, z], "locations": [{"time", "position", "quaternion"}]}'
    content = read_json(path)
    with understood("no object locations", path, expected):
        rows = sorted(content["locations"], key=lambda row: row["time"])
        times, positions, quaternions = (
            np.array([row[key] for row in rows], np.float64) for key in ("time", "position", "quaternion")
        )
        center = np.array(content["center"], np.float64)
        hinge = np.array(content["hinge"], np.float64) if content.get("hinge") is not None else None
        if positions.shape != (len(rows), 3) or quaternions.shape != (len(rows), 4) or not rows:
            raise ValueError(f"{len(rows)} of shapes {positions.shape}, {quaternions.shape}")
        if any(p.shape != (3,) or not (np.abs(p) < 1e6).all() for p in (center, hinge) if p is not None):
            raise ValueError("center or hinge is no point")
    checked_trajectory(times, positions, quaternions, path)
    # The path of the centre c: a vertex v is at R·v + p = R·(v - c) + (p + R·c).
    R = rotation.matrix_from_quat_wxyz(torch.from_numpy(quaternions))
    t = torch.from_numpy(positions) + R @ torch.from_numpy(center)
    trajectory = Trajectory(torch.from_numpy(times), R.float(), t.float())
    return _AnnotatedObject(tuple(center.tolist()), None if hinge is None else tuple(hinge.tolist()), trajectory)


def _scene_object(
    name: str, annotated: _AnnotatedObject, model: str | Path, motion_type: str, start_s: float
) -> SceneObject:
    """SceneObject at its last annotated pose before `start_s`, else its first. Raises WearcapError without its model."""
    if not Path(model).is_file():
        raise WearcapError(f"no model of {name}", model, "object_models/OBJECT.ply")
    mesh = read_ply(model).mesh
    if not len(mesh.vertices):
        raise WearcapError("an empty model", model, "at least one point")
    mesh = replace(mesh, vertices=(mesh.vertices.astype(np.float64) - annotated.center).astype(np.float32))
    kind = {"hinge": "hinge", "along_floor": "plane", "free": "free"}[motion_type]
    freedom = Freedom(kind, annotated.hinge if motion_type == "hinge" else None)
    seen = max(int(torch.searchsorted(annotated.trajectory.timestamps, start_s, right=True)) - 1, 0)
    first = annotated.trajectory.T_world_body[seen]
    return SceneObject(name, name.rpartition("_")[2], mesh, first.R, first.t, freedom)


def read_egohoi_contacts(path: str | Path, clock: LabelClock, object_name: str, contact_class: str) -> Interactions:
    """Read {"interactions": [{start, end, parts}]} with one object; intervals without parts have no contact.

    Raises WearcapError for labels that end before they start, that overlap or lie outside the motion, for parts that
    are no hands, and for NaN.
    """
    content = read_json(path)
    rows = content.get("interactions") if isinstance(content, dict) else None
    if not isinstance(rows, list):
        raise WearcapError("no contact labels", path, '{"interactions": [{"start", "end", "parts"}]}')
    parts: dict[str, list[list[Any]]] = {f"{hand}_hand": [] for hand in HANDS}
    for number, row in enumerate(rows):
        if not isinstance(row, dict) or not isinstance(row.get("parts"), list):
            raise WearcapError(f"interaction {number} is {row!r}"[:200], path, '{"start", "end", "parts"}')
        start, end = row.get("start"), row.get("end")
        if isinstance(start, int | float) and isinstance(end, int | float) and end < start:
            what = f"interaction {number} ends before it starts: {start} to {end} s"
            raise WearcapError(what, path, "start < end", "Exchange the two, if that is what was meant.")
        for part in row["parts"]:
            if not isinstance(part, str) or part not in parts:
                raise WearcapError(f"interaction {number} is with {part!r}", path, " or ".join(parts))
            parts[part].append([start, end])
    named = {
        key: {hand: [text] * len(spans) for hand, spans in parts.items()}
        for key, text in (("objects", object_name), ("classes", contact_class))
    }
    return interactions_of(parse_labels({"contacts": parts, **named}, clock, where=path))


def _egohoi(
    root: Path,
    name: str,
    motion_types: dict[str, str],
    object_name: str | None,
    fps: float | int,
    license: str,
    output: Path,
) -> Recording:
    """The body at `fps` and the annotated object poses; the environment is written beside the recording."""
    recording, environment = read_egohoi(root, name, motion_types, object_name)
    assert recording.motion is not None
    file = Path("scenes") / name / FILE_NAME
    write_environment(environment, output / file)
    motion = resampled(recording.motion, fps)
    return replace(recording, motion=motion, environment=file.as_posix(), license=license)


def egohoi_tasks(
    source: str | Path,  # the folder that holds smpl_motions and the others
    output: str | Path,
    splits: Splits,
    # by pattern of object names, the first that matches: hinge, along_floor, free or absent
    # (+motion_types.OBJECT=free); otherwise objects with a hinge turn and all others slide
    motion_types: dict[str, str] = NONE,
    # by sequence, for single-object sequences that are not named after their model
    object_names: dict[str, str] = NONE,
    fps: float | int = 30,  # bodies (HPS's estimates) are brought to this rate; objects keep their annotations
    license: str = "EgoHOI licence (virtualhumans.mpi-inf.mpg.de/ireplica); not to be passed on",
) -> list[Task]:
    """One task per sequence in `source`/smpl_motions; environments go to `output`/scenes.

    `motion_types` and `object_names` as `read_egohoi` takes them, the latter by sequence. Raises WearcapError without
    sequences.
    """
    source = Path(source)
    names = egohoi_names(source)
    if not names:
        expected, fix = "smpl_motions/NAME.json.zip or .json", "Give EgoHOI's folder as source=DIR."
        raise WearcapError("no sequences", where=source, expected=expected, fix=fix)
    models = sorted(source.glob("object_models/*.ply"))
    tasks = []
    for name in names:
        subject, object_name = subject_of(name), object_names.get(name)
        files = [*sorted(source.glob(f"*/{name}.json*")), *sorted(source.glob(f"*/{name}/*.json")), *models]
        files += [path for path in [source / "smpl_shapes" / f"{subject}.json"] if path.is_file()]
        key = content_hash(name, motion_types, object_name, float(fps), license, VERSION, *files)
        make = partial(_egohoi, source, name, motion_types, object_name, fps, license, Path(output))
        tasks.append(Task(name, make, splits.of(subject), key))
    return tasks
