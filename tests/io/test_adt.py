import json
import shutil

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from data_prep.adt import is_adt, read_adt, read_moving_objects, read_skeleton
from wearcap.errors import WearcapError


def skeleton_file(path, joints=51, frames=3):
    content = {
        "frames": [
            {
                "timestamp_ns": 10**9 + 8_333_333 * i,
                "joints": [[0.1 * j, 1.0 + j, -0.5] for j in range(joints)],
                "markers": [],
            }
            for i in range(frames)
        ]
    }
    path.write_text(json.dumps(content))
    return path


def test_skeleton_becomes_cues(tmp_path):
    cues = read_skeleton(skeleton_file(tmp_path / "Skeleton_A.json"))
    assert cues["head"].points[0].tolist() == pytest.approx([0.4, 0.5, 5.0]), "y up becomes z up"
    assert cues["left_wrist"].timestamps.diff()[0].item() == pytest.approx(1 / 120, abs=1e-6)
    assert set(cues) >= {"pelvis", "left_ankle", "right_toe"}


@pytest.mark.parametrize(
    "content",
    ["{", "[]", '{"frames": [{"joints": [[1, 2]]}]}', '{"frames": [{"timestamp_ns": 1, "joints": [[1, 2, 3]]}]}'],
)
def test_malformed_skeletons_are_named(tmp_path, content):
    (tmp_path / "s.json").write_text(content)
    with pytest.raises(WearcapError, match=r"s\.json"):
        read_skeleton(tmp_path / "s.json")


def test_objects_from_small_files(tmp_path):
    (tmp_path / "scene_objects.csv").write_text(
        "object_uid,timestamp[ns],t_wo_x[m],t_wo_y[m],t_wo_z[m],q_wo_w,q_wo_x,q_wo_y,q_wo_z\n"
        "9007199254740993,-1,1,2,3,1,0,0,0\n77,1000000000,0,0,0,1,0,0,0\n77,2000000000,1,0,0,1,0,0,0\n"
    )
    (tmp_path / "3d_bounding_box.csv").write_text(
        "object_uid,timestamp[ns],p_local_obj_xmin[m],p_local_obj_xmax[m],p_local_obj_ymin[m],p_local_obj_ymax[m],p_local_obj_zmin[m],p_local_obj_zmax[m]\n"
        "9007199254740993,-1,-1,1,-2,2,-3,3\n77,-1,0,1,0,1,0,1\n"
    )
    about = {
        "9007199254740993": {"instance_name": "Sofa", "category": "sofa", "motion_type": "static"},
        "77": {"instance_name": "Cup", "category": "cup", "motion_type": "dynamic"},
    }
    (tmp_path / "instances.json").write_text(json.dumps(about))
    found = read_moving_objects(tmp_path)
    assert list(found) == ["Cup"], "the sofa's pose is for all time"
    assert found["Cup"].timestamps.tolist() == [1.0, 2.0]
    assert found["Cup"].t_world_body.tolist() == [[0, 0, 0], [1, 0, 0]]


def test_other_folders_are_refused(tmp_path):
    assert not is_adt(tmp_path)
    with pytest.raises(WearcapError, match="aria_trajectory"):
        read_adt(tmp_path)


JUNK = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=3),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["frames", "joints", "timestamp_ns"]), inner, max_size=3)
    ),
)


@settings(max_examples=150, deadline=None)
@given(JUNK)
def test_any_json_is_read_or_refused(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("fuzz") / "s.json"
    path.write_text(json.dumps(content))
    with pytest.raises(WearcapError):
        read_skeleton(path)


@pytest.mark.real
def test_real_sequence(real_data):
    recording = read_adt(real_data / "aria_adt_sample" / "raw")
    assert recording.head is not None
    assert recording.location == "Apartment"
    assert recording.head.timestamps.diff().median().item() == pytest.approx(1 / 30, abs=1e-3)
    joint = recording.cues["head"].points[0]
    eyes = recording.head.t_world_device[0]
    forward = recording.head.R_world_device[0, :, 0]
    assert torch.dot(eyes - joint, forward) > 0.05, "the pupils are ahead of the head joint"
    assert (eyes - joint).norm() < 0.25
    assert recording.head.R_world_device[:, 2, 2].min() > 0.6, "upright, looking down at a table"
    assert 1.4 < eyes[2] < 1.7
    hands = (recording.cues["left_wrist"].points[0] + recording.cues["right_wrist"].points[0]) / 2
    assert torch.dot(hands - joint, forward) > 0.2, "the hands work before the wearer"
    ankles = torch.stack([recording.cues[f"{side}_ankle"].points[0] for side in ("left", "right")])
    assert (ankles[:, 2] > 0).all()
    assert (ankles[:, 2] < 0.2).all()


@pytest.mark.real
def test_real_objects(real_data):
    objects = read_moving_objects(real_data / "aria_adt_sample" / "raw")
    assert len(objects) > 10
    heights = torch.stack([track.t_world_body[0, 2] for track in objects.values()])
    assert heights.min() > -0.2
    assert heights.max() < 4


@pytest.mark.real
def test_truncated_trajectory_is_named(real_data, tmp_path):
    shutil.copytree(real_data / "aria_adt_sample" / "raw", tmp_path / "s", ignore=shutil.ignore_patterns("*.vrs"))
    path = tmp_path / "s" / "aria_trajectory.csv"
    path.chmod(0o644)
    path.write_text(path.read_text()[:-60])
    with pytest.raises(WearcapError, match="aria_trajectory"):
        read_adt(tmp_path / "s")
