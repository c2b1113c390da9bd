"""Forward kinematics of ASF/AMC files in NumPy, independent of the package: places of all bones' starts."""

import gzip
import lzma
from pathlib import Path

import numpy as np

from foreign_bvh import turn


def _lines(path: Path) -> list[list[str]]:
    packed = {".xz": lzma.open, ".gz": gzip.open}.get(path.suffix, open)
    with packed(path, "rt", encoding="latin-1") as file:
        return [words for line in file if (words := line.split("#")[0].split())]


def _rotation(degrees: np.ndarray) -> np.ndarray:
    """Rz · Ry · Rx of angles "… 3"."""
    x, y, z = np.moveaxis(np.radians(degrees), -1, 0)
    return turn("z", z) @ turn("y", y) @ turn("x", x)


def acclaim_places(asf: Path, amc: Path) -> dict[str, np.ndarray]:
    """Start of each bone "time 3" (m, x forward, z up), by its name; of CMU's kind (degrees, order XYZ)."""
    bones: dict[str, dict[str, list[str]]] = {}
    above: dict[str, str] = {}
    section, bone, unit_m = "", {}, 0.0254
    for words in _lines(asf):
        if words[0].startswith(":"):
            section = words[0]
        elif section == ":units" and words[0] == "length":
            unit_m /= float(words[1])
        elif section == ":bonedata":
            bone = {} if words[0] == "begin" else bone | {words[0]: words[1:]}
            if words[0] == "end":
                bones[bone["name"][0]] = bone
        elif section == ":hierarchy" and words[0] not in ("begin", "end"):
            above |= dict.fromkeys(words[1:], words[0])
    frames: list[dict[str, list[float]]] = []
    for words in _lines(amc):
        if len(words) == 1 and words[0].isdigit():
            frames.append({})
        elif frames:
            frames[-1][words[0]] = [float(word) for word in words[1:]]
    root = np.array([frame["root"] for frame in frames])
    world, end = {"root": _rotation(root[:, 3:])}, {"root": root[:, :3]}
    start = {"root": root[:, :3]}

    def place(name: str) -> None:
        if name in world:
            return
        place(above[name])
        fields = bones[name]
        own = _rotation(np.array([float(angle) for angle in fields["axis"][:3]]))
        angles = np.zeros((len(frames), 3))
        for column, freedom in enumerate(fields.get("dof", [])):
            angles[:, "xyz".index(freedom[1].lower())] = [frame[name][column] for frame in frames]
        world[name] = world[above[name]] @ own @ _rotation(angles) @ own.T
        bone = np.array([float(v) for v in fields["direction"]]) * float(fields["length"][0])
        start[name] = end[above[name]]
        end[name] = start[name] + world[name] @ bone

    for name in bones:
        place(name)
    return {name: places[:, [2, 0, 1]] * unit_m for name, places in start.items()}
