"""Detections of hands in the layouts of their tools, and files with impossible contents."""

import json

import numpy as np
import pytest
import torch
from hoi_files import write_json
from hypothesis import given

from hostile import fuzz, mutated
from wearcap.errors import WearcapError
from wearcap.io.formats.hand_detections import HOD_COLUMNS, read_hand_detections, read_vertex_contacts

LEFT, RIGHT = 0, 1


def hod_row(score=0.9, state=3, side=LEFT, box=(10, 20, 60, 90)):
    return [*box, score, state, 0.6, 0.8, 0.05, side]


HOD = [
    {"frame": 4, "hand_dets": [hod_row(0.9, 3, LEFT), hod_row(0.8, 0, RIGHT)], "obj_dets": [hod_row(0.7, 0)]},
    {"frame": 5, "hand_dets": None, "obj_dets": None},
    {"frame": 7, "hand_dets": [hod_row(0.6, 4, RIGHT), hod_row(0.95, 1, RIGHT), hod_row(0.2, 3, LEFT)]},
]


def hand(name, touched, **more):
    return {"id": name, "name": name, "in_contact_object": touched, **more}


VISOR = {
    "video_annotations": [
        {
            "image": {"name": "P01_01_frame_0000000120.jpg"},
            "annotations": [
                hand("left hand", "cup"),
                hand("right hand", "hand-not-in-contact"),
                {"id": "cup", "name": "cup"},
            ],
        },
        {
            "image": {"name": "P01_01_frame_0000000180.jpg"},
            "annotations": [hand("left hand", "inconclusive"), hand("glove", "cup", on_which_hand=["right hand"])],
        },
    ]
}
COCO = {
    "images": [{"id": 9, "file_name": "P01_01_frame_0000000120.jpg"}],
    "annotations": [
        {"id": 1, "image_id": 9, "bbox": [5, 5, 40, 30], "handside": 1, "isincontact": 1, "score": 0.8},
        {"id": 2, "image_id": 9, "bbox": [5, 5, 40, 30], "handside": None, "isincontact": None},
    ],
}


def read(content, tmp_path, min_score=0.5):
    write_json(content, tmp_path / "d.json")
    return read_hand_detections(tmp_path / "d.json", min_score)


def test_the_most_confident_box_of_a_hand_counts(tmp_path):
    found = read(HOD, tmp_path)
    assert found.pictures.tolist() == [4, 5, 7]
    assert found.contact_prob.tolist() == [[pytest.approx(0.9), 0.0], [0.0, 0.0], [0.0, 0.0]], "a touch of oneself"
    assert found.seen.tolist() == [[True, True], [False, False], [False, True]], "0.2 is too little"
    assert read(HOD, tmp_path, min_score=0.1).contact_prob[2].tolist() == [pytest.approx(0.2), 0.0]


def test_pictures_by_name_and_as_a_table_are_the_same(tmp_path):
    wanted = read(HOD, tmp_path)
    named = {f"clip_2/frame_{frame['frame']:06d}.jpg": frame for frame in HOD}
    rows = [[frame["frame"], *row] for frame in HOD for row in frame["hand_dets"] or ()]
    path = tmp_path / "d.csv"
    path.write_text("\n".join(",".join(map(str, row)) for row in [HOD_COLUMNS, *rows]) + "\n")
    assert torch.equal(read(named, tmp_path).contact_prob, wanted.contact_prob)
    table = read_hand_detections(path, 0.5)
    assert table.pictures.tolist() == [4, 7], "a table knows no pictures without hands"
    assert torch.equal(table.contact_prob, wanted.contact_prob[[0, 2]])


def test_visor_relations_of_hands_and_gloves(tmp_path):
    found = read(VISOR, tmp_path)
    assert found.pictures.tolist() == [120, 180]
    assert found.contact_prob.tolist() == [[1.0, 0.0], [0.0, 1.0]]
    assert found.seen.tolist() == [[True, True], [False, True]], "nobody could tell for the left hand"
    predicted = read(COCO, tmp_path)
    assert predicted.contact_prob.tolist() == [[0.0, pytest.approx(0.8)]]


def test_contact_of_vertices_becomes_the_mean_of_each_hand(tmp_path):
    contact = np.zeros((2, 12), np.float32)
    contact[1, [3, 4]] = 0.5, 1.0
    np.savez(tmp_path / "p.npz", contact=contact, frames=[10, 12])
    parts = {"leftHand": [3], "leftHandIndex1": [4], "rightHand": [5], "rightHandIndex1": [], "head": [0]}
    write_json(parts, tmp_path / "s.json")
    found = read_vertex_contacts(tmp_path / "p.npz", tmp_path / "s.json")
    assert found.pictures.tolist() == [10, 12]
    assert found.contact_prob.tolist() == [[0.0, 0.0], [0.75, 0.0]]
    write_json(parts | {"leftHand": [12]}, tmp_path / "s.json")
    with pytest.raises(WearcapError, match="segmentation of this mesh"):
        read_vertex_contacts(tmp_path / "p.npz", tmp_path / "s.json")
    np.savez(tmp_path / "p.npz", contact=2 + contact)
    with pytest.raises(WearcapError, match="probability"):
        read_vertex_contacts(tmp_path / "p.npz", tmp_path / "s.json")


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ([], "no pictures"),
        ({"frame_x.jpg": {"hand_dets": []}}, "picture 'frame_x"),
        ([{"frame": -1, "hand_dets": []}], "picture"),
        ([{"frame": 1, "hand_dets": [hod_row()[:9]]}], "9 numbers"),
        ([{"frame": 1, "hand_dets": [hod_row(1.5)]}], "score"),
        ([{"frame": 1, "hand_dets": [hod_row(box=(60, 20, 10, 90))]}], "box"),
        ([{"frame": 1, "hand_dets": [hod_row(box=(0, 0, float("inf"), 9))]}], "box|JSON"),
        ([{"frame": 1, "hand_dets": [hod_row(state=7)]}], "state 7"),
        ([{"frame": 1, "hand_dets": [hod_row(side=0.5)]}], "side"),
        ([{"frame": 1}], "hand_dets"),
        ({"video_annotations": [{"image": {}}]}, "name"),
        (COCO | {"images": []}, "laid out|lacks"),
        (["text"], "laid out"),
    ],
)
def test_impossible_contents_are_refused(tmp_path, content, what):
    with pytest.raises(WearcapError, match=what):
        read(content, tmp_path)


@fuzz
@given(text=mutated(json.dumps(HOD)) | mutated(json.dumps(VISOR)) | mutated(json.dumps(COCO)))
def test_damaged_files_are_read_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "fuzzed.json"
    path.write_text(text, encoding="utf-8")
    try:
        found = read_hand_detections(path, 0.5)
    except WearcapError:
        return
    assert ((found.contact_prob >= 0) & (found.contact_prob <= 1)).all()
    assert (found.pictures.diff() > 0).all()
