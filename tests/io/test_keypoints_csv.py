"""Recorded keypoints: they come back, and files that are none are refused with what is wrong and where."""

import pytest
import torch
from hypothesis import given

from data_prep.keypoint_detectors import read_keypoints
from hostile import fuzz, mutated
from keypoint_files import write_keypoints
from wearcap.errors import WearcapError
from wearcap.recording import Cue

HEADER = "timestamp,joint,x,y,confidence\n"


def cue(joint: str, axes: int, frames: int = 9) -> Cue:
    random = torch.Generator().manual_seed(axes)
    times = torch.arange(frames, dtype=torch.float64) / 30 + 1.7e9
    return Cue(times, joint, 900 * torch.rand(frames, axes, generator=random), torch.full((frames,), 0.7))


@pytest.mark.parametrize("axes", [2, 3])
def test_what_is_written_comes_back(tmp_path, axes):
    cues = {name: cue(name, axes) for name in ("left_wrist", "right_wrist")}
    write_keypoints(cues, tmp_path / "a.csv")
    read = read_keypoints(tmp_path / "a.csv")
    assert read.keys() == cues.keys()
    for name, one in read.items():
        assert one.joint == name
        assert torch.equal(one.timestamps, cues[name].timestamps)
        assert torch.equal(one.points, cues[name].points)
        assert torch.equal(one.confidence, cues[name].confidence)


def test_rows_may_come_in_any_order_and_say_nothing(tmp_path):
    (tmp_path / "a.csv").write_text(
        HEADER + "2.0, head ,5,6,0.5\n1.0,head,3,4,1\n0.5,nose,nan,nan,0\n1.5,head,nan,7,0\n"
    )
    read = read_keypoints(tmp_path / "a.csv")
    assert list(read) == ["head"]
    assert read["head"].timestamps.tolist() == [1.0, 2.0]
    assert read["head"].points.tolist() == [[3, 4], [5, 6]]
    assert read["head"].confidence.tolist() == [1.0, 0.5]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        (HEADER, "no rows"),
        ("timestamp,joint,x,y\n1,head,2,3\n", "no column 'confidence'"),
        ("time,joint,x,y,confidence\n1,head,2,3,1\n", "no column 'timestamp'"),
        (HEADER + "1,head,2,3,1\n2,head,,3,1\n", "not a table of numbers"),
        (HEADER + "1,head,2,3,1\nnan,head,2,3,1\n", "row 2 after the header: a timestamp that is no time"),
        (HEADER + "1,head,2,nan,0.5\n", "row 1 after the header: a place that is none"),
        (HEADER + "1,head,2,inf,0.5\n", "a place that is none"),
        (HEADER + "1,head,2,3,1.2\n", "a confidence that is none. Expected 0 to 1"),
        (HEADER + "1,head,2,3,nan\n", "a confidence that is none"),
        (HEADER + "1,,2,3,1\n", "no joint"),
        (HEADER + "1,head,2,3,1\n2,head,2,3,1\n1,head,2,3,1\n", "'head' is twice at 1.000000 s"),
    ],
)
def test_hostile_files_are_refused(tmp_path, text, message):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(WearcapError, match=message):
        read_keypoints(tmp_path / "a.csv")


@fuzz
@given(text=mutated(HEADER + "1.0,left_wrist,3.5,4,0.9\n2.0,left_wrist,5,6,0.5\n1.0,head,3,4,1\n"))
def test_damaged_files_are_read_or_refused(tmp_path, text):
    (tmp_path / "a.csv").write_text(text, encoding="utf-8", errors="surrogatepass")
    try:
        read = read_keypoints(tmp_path / "a.csv")
    except WearcapError:
        return
    for one in read.values():
        assert one.points.isfinite().all()
        assert (one.timestamps.diff() > 0).all()
