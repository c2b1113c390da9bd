"""Checks of an interactive environment: its objects, their degrees of freedom, and likely problems."""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from wearcap.doctor.report import Finding, refusal
from wearcap.errors import WearcapError
from wearcap.io.formats.environment import FILE_NAME, read_environment
from wearcap.recording import Recording
from wearcap.scene.environment import Environment, box_in_world, hinge_gap_m, surface_index
from wearcap.scene.objects import SceneObject

TINY_M, HUGE_M = 0.05, 12.0
"""Range of the longest side (m) of an object's bounding box outside which its unit is doubtful."""
HINGE_GAP_M = 0.10
FLOOR_M = 0.10
"""Largest distance (m) of a sliding object from the common floor of all."""
SAME_SURFACE_M = 0.02
_SAME_SHARE, _INSIDE_SHARE = 0.5, 0.8
_SAMPLES = 400


def is_environment(folder: Path) -> bool:
    """Whether a folder holds an environment.json."""
    return (folder / FILE_NAME).is_file()


def read_environment_file(path: Path) -> tuple[Recording, list[Finding]]:
    """All findings about an environment.json, including errors of reading it."""
    try:
        return Recording(path.name), check_environment(read_environment(path))
    except WearcapError as error:
        return Recording(path.name), [refusal(error, "environment")]


def check_environment(environment: Environment) -> list[Finding]:
    """One finding per object with its degrees of freedom, then likely problems."""
    objects = environment.objects
    if not objects:
        return [
            Finding("warning", "environment", "no objects", "nothing in it can be moved", "Add some: wearcap scene.")
        ]
    kinds = [item.freedom.kind for item in objects]
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in sorted(set(kinds)))
    findings = [Finding("ok", "environment", f"{len(objects)} objects", counts)]
    findings += [_about(item) for item in objects]
    for item in objects:
        findings += _size(item) + _freedom(item)
    return findings + _floor(objects) + _overlaps(objects)


def _about(item: SceneObject) -> Finding:
    """Category, position and degrees of freedom of an object."""
    low, high = box_in_world(item)
    size = " x ".join(f"{side:.2f}" for side in high - low)
    place = ", ".join(f"{v:.2f}" for v in item.t_world_object.tolist())
    triangles = len(item.mesh.faces)
    shape = f"{triangles} triangles" if triangles else f"a cloud of {len(item.mesh.vertices)} points"
    return Finding(
        "ok",
        f"object {item.name}",
        f"{item.category or 'object'}: {_moves(item)}",
        f"{size} m, {shape}, at ({place}) m",
    )


def _moves(item: SceneObject) -> str:
    freedom = item.freedom
    words = {
        "plane": "slides on the floor",
        "free": "is carried",
        "axis": "slides along an axis",
        "hinge": "turns about a hinge",
    }
    if freedom.limits is None:
        return words[freedom.kind]
    low, high = freedom.limits
    span = (
        f"{math.degrees(low):.0f}° to {math.degrees(high):.0f}°"
        if freedom.kind == "hinge"
        else f"{low:.2f} to {high:.2f} m"
    )
    return f"{words[freedom.kind]}, {span}"


def _size(item: SceneObject) -> list[Finding]:
    longest = float(np.ptp(box_in_world(item), axis=0).max())
    if longest < TINY_M:
        return [
            Finding(
                "warning",
                f"object {item.name}: size",
                "the mesh is tiny",
                f"{100 * longest:.2g} cm at most",
                "Is it in another unit? Meshes are in metres.",
            )
        ]
    if longest > HUGE_M:
        return [
            Finding(
                "warning",
                f"object {item.name}: size",
                "the mesh is larger than an object",
                f"{longest:.3g} m",
                "Is it in millimetres, or the whole scan?",
            )
        ]
    return []


def _freedom(item: SceneObject) -> list[Finding]:
    check, found = f"object {item.name}: freedom", []
    if item.freedom.pivot is not None:
        gap = hinge_gap_m(item)
        low, high = box_in_world(item)[:, :2]
        side = int((high - low).argmax())
        along = (item.freedom.pivot[side] - low[side]) / max(high[side] - low[side], 1e-9)
        if gap > HINGE_GAP_M:
            found.append(
                Finding(
                    "warning",
                    check,
                    "the hinge is beside the mesh",
                    f"{100 * gap:.0f} cm from its box, from above",
                    "Put the pivot at the hinge.",
                )
            )
        elif 0.3 < along < 0.7:
            found.append(
                Finding(
                    "note",
                    check,
                    "the hinge is in the middle",
                    f"at {100 * along:.0f} % of its longest side",
                    "Doors turn about an edge.",
                )
            )
    if item.freedom.kind in ("hinge", "axis") and item.freedom.limits is None:
        found.append(
            Finding("note", check, "no limits", "it may turn or slide without end", "Set limits where they are known.")
        )
    return found


def _floor(objects: tuple[SceneObject, ...]) -> list[Finding]:
    """Sliding objects stand on one floor, and nothing is below it."""
    lowest = {item.name: float(box_in_world(item)[0, 2]) for item in objects}
    standing = [lowest[item.name] for item in objects if item.freedom.kind == "plane"]
    if not standing:
        return []
    floor, found = float(np.median(standing)), []
    for item in objects:
        height = lowest[item.name] - floor
        if height < -FLOOR_M:
            found.append(
                Finding(
                    "warning",
                    f"object {item.name}: floor",
                    "reaches below the floor",
                    f"{-100 * height:.0f} cm below what slides",
                    "Lift it, or cut the floor's points off its mesh.",
                )
            )
        elif height > FLOOR_M and item.freedom.kind == "plane":
            found.append(
                Finding(
                    "note",
                    f"object {item.name}: floor",
                    "slides above the others' floor",
                    f"{100 * height:.0f} cm above it",
                    "Another storey, or not an object that slides on the floor.",
                )
            )
    return found


def _overlaps(objects: tuple[SceneObject, ...]) -> list[Finding]:
    """Pairs of objects with overlapping surfaces, or with one inside the other's bounding box."""
    boxes = np.array([box_in_world(item) for item in objects])
    low, high = boxes[:, 0], boxes[:, 1]
    shared = np.maximum(
        np.minimum(high[:, None], high[None]) - np.maximum(low[:, None], low[None]) + SAME_SURFACE_M, 0
    ).prod(-1)
    volume = np.maximum(high - low + SAME_SURFACE_M, 0).prod(-1)
    found = []
    for a, b in np.argwhere(np.triu(shared > 0, 1)):
        inner, outer = (a, b) if volume[a] <= volume[b] else (b, a)
        names = f"{objects[inner].name} and {objects[outer].name}"
        same = _share_at(objects[inner], objects[outer])
        inside = float(shared[a, b] / volume[inner])
        if same > _SAME_SHARE:
            found.append(
                Finding(
                    "warning",
                    f"objects {names}",
                    "are at the same place",
                    f"{100 * same:.0f} % of the first's surface is within 2 cm of the second's",
                    "Was one object cut out twice? Remove one of them.",
                )
            )
        elif inside > _INSIDE_SHARE:
            found.append(
                Finding(
                    "note",
                    f"objects {names}",
                    "the first stands within the second's box",
                    f"{100 * min(inside, 1):.0f} % of its own box",
                    "A chair under a table does; a sofa in a wardrobe does not.",
                )
            )
    return found


def _share_at(inner: SceneObject, outer: SceneObject) -> float:
    """Share of one object's surface that coincides with another's."""
    points = _surface(inner) @ inner.R_world_object.double().numpy().T + inner.t_world_object.double().numpy()
    local = (points - outer.t_world_object.double().numpy()) @ outer.R_world_object.double().numpy()
    distance, _ = surface_index(outer.mesh).nearest(np.ascontiguousarray(local))
    return float((distance < SAME_SURFACE_M).mean())


def _surface(item: SceneObject) -> Float64[np.ndarray, "sample 3"]:
    """Points sampled on an object's surface (a cloud's own points), in its axes."""
    rng = np.random.default_rng(0)
    vertices, faces = item.mesh.vertices.astype(np.float64), item.mesh.faces
    if not len(faces):
        return vertices[:: len(vertices) // _SAMPLES + 1]
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) + 1e-12
    face = rng.choice(len(faces), _SAMPLES, p=area / area.sum())
    u, v = rng.random((2, _SAMPLES, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[face] + u * (b - a)[face] + v * (c - a)[face]
