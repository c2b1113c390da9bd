"""Hands and what they touch, found by detectors in pictures or on bodies one by one, as contact per hand and picture.

- Hand Object Detector (100DOH): JSON `[{"frame": 12, "hand_dets": [[…]], "obj_dets": [[…]]}, …]` or
  `{"frame_000012.jpg": {"hand_dets": …}, …}` with the detector's own rows x1 y1 x2 y2 (px), score, state, offset to the
  object (x, y, magnitude), side; or CSV with a row per hand and the columns `HOD_COLUMNS`.
- EPIC-KITCHENS VISOR: `{"video_annotations": [{"image", "annotations": [{"name", "in_contact_object"}]}]}`, and the
  COCO files of its hand-object benchmark, whose annotations have `handside`, `isincontact` (and `score`, if predicted).
- POSA and its like: .npz with the probability `contact` ("picture vertex") that each vertex of a body is in contact.
"""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from wearcap.boundary.arrays import read_npz, require
from wearcap.boundary.opening import understood
from wearcap.boundary.texts import read_json, read_json_object
from wearcap.errors import WearcapError
from wearcap.io.formats.csv_table import read_columns
from wearcap.recording.motion import HANDS

_BOX = ("x1", "y1", "x2", "y2")
HOD_COLUMNS = ("frame", *_BOX, "score", "state", "offset_x", "offset_y", "offset_magnitude", "side")
"""Columns of the detector's rows, preceded by the picture's number."""
OBJECT_STATES = (3, 4)
"""The detector's states for contact with a portable or stationary object; 0 is none, 1 self, 2 another person."""
_UNKNOWN = ("inconclusive", "none-of-the-above")
"""VISOR's words for hands whose contact nobody could judge."""
_MAX_NUMBER = 1 << 40
_SEGMENTS = tuple((f"{hand}Hand", f"{hand}HandIndex1") for hand in HANDS)
"""Names of the hands' parts in SMPL's public segmentation of vertices, palms and then fingers."""

_Row = tuple[int, int, float, float]
"""Picture, hand, confidence in the hand, and score of its contact with an object."""


@dataclass(frozen=True, eq=False)
class HandDetections:
    """Contact of the hands (left, right) in pictures, each of which was judged alone."""

    pictures: Int64[Tensor, "picture"]
    """Numbers of the pictures, rising."""
    contact_prob: Float[Tensor, "picture hand"]
    """Score (0…1) of a contact with an object; 0 for hands that were not found."""
    seen: Bool[Tensor, "picture hand"]
    """Whether the hand was found, and its contact judged."""


def read_hand_detections(path: str | Path, min_score: float) -> HandDetections:
    """Read a detector's or annotators' file, recognised by its suffix and content.

    Of several boxes of one hand the most confident counts; boxes below `min_score` do not. Raises WearcapError for any
    other content, numbers that are not finite, boxes, scores, states and sides that are none, and without pictures.
    """
    if ".csv" in Path(path).suffixes:
        columns = read_columns(path, HOD_COLUMNS[1:], integers=HOD_COLUMNS[:1])
        table = np.stack([columns[name] for name in HOD_COLUMNS[1:]], 1)
        numbers = columns["frame"].tolist()
        rows = [_hod_row(number, row, path) for number, row in zip(numbers, table.tolist())]
        return _tallied(numbers, rows, min_score, path)
    content = read_json(path)
    with understood("not laid out as hand detections", path, "Hand Object Detector's, VISOR's or its COCO layout"):
        if isinstance(content, dict) and "video_annotations" in content:
            pictures, rows = _visor(content["video_annotations"], path)
        elif isinstance(content, dict) and "annotations" in content:
            pictures, rows = _coco(content, path)
        else:
            pictures, rows = _hod(content, path)
    return _tallied(pictures, rows, min_score, path)


def read_vertex_contacts(path: str | Path, segmentation: str | Path) -> HandDetections:
    """Mean contact probability of each hand's vertices (thesis §5.4.4), with the mesh's public `segmentation` (JSON).

    The .npz holds `contact` ("picture vertex"), and `frames` ("picture") unless pictures are numbered from 0. Raises
    WearcapError for values that are no probabilities, and a segmentation without hands or of another mesh.
    """
    arrays = read_npz(path, ("contact", "frames"))
    count = require(arrays, path, contact=("picture", "vertex"))
    contact, parts = arrays["contact"], read_json_object(segmentation)
    if not count["picture"] or not ((contact >= 0) & (contact <= 1)).all():
        raise WearcapError("contact is no probability", path, "at least one picture, values from 0 to 1")
    prob = []
    for names in _SEGMENTS:
        listed = [parts.get(name, []) for name in names]
        index = [vertex for part in listed if isinstance(part, list) for vertex in part]
        if not index or not all(type(vertex) is int and 0 <= vertex < count["vertex"] for vertex in index):
            expected = f"vertices of {names[0]} and {names[1]} below {count['vertex']}"
            raise WearcapError("no segmentation of this mesh", segmentation, expected)
        prob.append(contact[:, index].mean(1))
    numbers = np.arange(count["picture"])
    if "frames" in arrays:
        require(arrays, path, contact=("picture", "vertex"), frames=("picture",))
        numbers = arrays["frames"].astype(np.int64)
    if (np.diff(numbers) <= 0).any():
        raise WearcapError("frames do not rise", path, "each picture once, in order")
    result = torch.from_numpy(np.stack(prob, 1)).float()
    return HandDetections(torch.from_numpy(numbers), result, torch.ones_like(result, dtype=torch.bool))


def _tallied(pictures: Iterable[int], rows: list[_Row], min_score: float, where: str | Path) -> HandDetections:
    numbers = sorted(set(pictures))
    if not numbers:
        raise WearcapError("no pictures", where, "at least one picture, with hands or without")
    place = {number: k for k, number in enumerate(numbers)}
    prob, confidence = np.zeros((len(numbers), 2), np.float32), np.full((len(numbers), 2), -1.0)
    for number, hand, score, contact in rows:
        if score >= max(min_score, confidence[place[number], hand]):
            confidence[place[number], hand], prob[place[number], hand] = score, contact
    return HandDetections(torch.tensor(numbers), torch.from_numpy(prob), torch.from_numpy(confidence >= 0))


def _number(picture: Any, where: str | Path) -> int:
    """A picture's number: itself, or the last digits of its name."""
    digits = re.findall(r"\d+", Path(picture).stem[-200:]) if isinstance(picture, str) else [picture]
    if not digits or isinstance(picture, bool | float) or not 0 <= (number := int(digits[-1])) < _MAX_NUMBER:
        raise WearcapError(f"picture {picture!r}"[:200], where, "a number, or a name that ends in one")
    return number


def _hod(content: Any, where: str | Path) -> tuple[list[int], list[_Row]]:
    named = content.items() if isinstance(content, dict) else [(frame["frame"], frame) for frame in content]
    pictures, rows = [], []
    for picture, frame in named:
        pictures.append(_number(picture, where))
        for row in frame["hand_dets"] or ():
            rows.append(_hod_row(pictures[-1], row, where))
        for row in frame.get("obj_dets") or ():
            _check_box(row[:4], row[4], f"an object in picture {picture!r}", where)
    return pictures, rows


def _hod_row(picture: int, row: list[float], where: str | Path) -> _Row:
    """A hand of the detector's; its contact is as certain as the hand itself, the state has no score of its own."""
    what = f"a hand in picture {picture}"
    if len(row) != len(HOD_COLUMNS) - 1:
        raise WearcapError(f"{what} has {len(row)} numbers", where, ", ".join(HOD_COLUMNS[1:]))
    _check_box(row[:4], row[4], what, where)
    state, side = row[5], row[-1]
    if state not in range(5) or side not in (0, 1) or not 0 <= picture < _MAX_NUMBER:
        raise WearcapError(f"{what} has state {state} and side {side}", where, "states 0 to 4, side 0 or 1")
    return picture, int(side), float(row[4]), float(row[4]) if state in OBJECT_STATES else 0.0


def _check_box(box: list[float], score: float, what: str, where: str | Path) -> None:
    x1, y1, x2, y2 = (float(value) for value in box)
    if not (np.isfinite([x1, y1, x2, y2]).all() and x1 <= x2 and y1 <= y2 and 0 <= float(score) <= 1):
        raise WearcapError(f"{what}: box {box}, score {score}"[:200], where, "x1 ≤ x2, y1 ≤ y2 (px), score 0 to 1")


def _visor(annotated: list[dict[str, Any]], where: str | Path) -> tuple[list[int], list[_Row]]:
    pictures, rows = [], []
    for frame in annotated:
        pictures.append(_number(frame["image"]["name"], where))
        for item in frame["annotations"]:
            touched = item.get("in_contact_object")
            if touched is None or touched in _UNKNOWN:
                continue
            contact = 0.0 if touched == "hand-not-in-contact" else 1.0
            rows += [(pictures[-1], hand, 1.0, contact) for hand in _visor_hands(item)]
    return pictures, rows


def _visor_hands(item: dict[str, Any]) -> Iterator[int]:
    """Hands that an annotation is of: the hand's own, or a glove's that it is worn on."""
    names = [item["name"], *(item.get("on_which_hand") or ())]
    return (number for number, hand in enumerate(HANDS) if f"{hand} hand" in names)


def _coco(content: dict[str, Any], where: str | Path) -> tuple[list[int], list[_Row]]:
    pictures = {image["id"]: _number(image["file_name"], where) for image in content["images"]}
    rows = []
    for item in content["annotations"]:
        if item.get("handside") not in (0, 1):  # objects have none
            continue
        x, y, width, height = item["bbox"]
        score, contact = item.get("score", 1.0), item["isincontact"]
        _check_box([x, y, x + width, y + height], score, f"hand {item['id']!r}", where)
        if contact not in (0, 1):
            raise WearcapError(f"hand {item['id']!r} has isincontact {contact!r}"[:200], where, "0 or 1")
        rows.append((pictures[item["image_id"]], int(item["handside"]), float(score), float(score) * contact))
    return list(pictures.values()), rows
