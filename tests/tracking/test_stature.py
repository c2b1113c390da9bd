"""How tall a wearer is: planted heads above a floor; people who sit have no height; doctor, capture and live agree."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import wearcap
from wearcap.apps.doctor import examine
from wearcap.body.skeleton import skeleton_of_height, xsens23
from wearcap.checks.examine import examine_recording
from wearcap.cli.conf import compose
from wearcap.errors import WearcapError
from wearcap.reading import load
from wearcap.recording import Recording
from wearcap.recording.recording import FloorTrack, HeadStream, PointCloud
from wearcap.systems.mocap_every.pipeline import MocapEvery
from wearcap.tracking.floor import CARRIED
from wearcap.tracking.stature import estimate_stature, with_stature

FPS = 30
SEATED_M, STANDING_M = 1.11, 1.52
"""Heights of a head joint."""


def still(seconds):
    """Sways by a centimetre."""
    return 0.01 * np.sin(np.arange(seconds * FPS) / FPS)[:, None] * [1.0, 0.5]


def leaning(seconds):
    """Leans by 35 cm to both sides, every two seconds."""
    return 0.35 * np.sin(np.pi * np.arange(seconds * FPS) / FPS)[:, None] * [1.0, 0.0]


def walking(seconds):
    """Walks there and back over three metres, at 1 m/s."""
    return np.abs((np.arange(seconds * FPS) / FPS) % 6 - 3)[:, None] * [0.6, 0.8]


def set_anew(seconds):
    """Sways while its tracker starts anew, two metres aside."""
    return still(seconds) + 2.0 * (np.arange(seconds * FPS) > seconds * FPS / 2)[:, None]


def worn(place, joint_m, floor_m=0.3, down_deg=15.0) -> Recording:
    """A device whose head joint is `joint_m` over the floor; the head looks down, the device sits aslant ahead of its joint."""
    joint_m = np.broadcast_to(joint_m, len(place))
    pitch, slant = (math.radians(angle) for angle in (down_deg, -10.0))
    R = np.array([[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]])
    mount = np.array([[math.cos(slant), 0, math.sin(slant)], [0, 1, 0], [-math.sin(slant), 0, math.cos(slant)]])
    offset = np.array([0.1, 0.0, 0.08])
    at = np.concatenate([place, floor_m + joint_m[:, None]], 1) + R @ offset
    times = torch.arange(len(place), dtype=torch.float64) / FPS
    device, mount, offset = (torch.tensor(value).float() for value in (R @ mount, mount, offset))
    head = HeadStream(times, device.expand(len(times), 3, 3), torch.tensor(at).float(), mount, offset)
    return Recording("worn", head=head, floor=FloorTrack(times[:1], torch.tensor([floor_m])))


def joint_of(height_m: float) -> float:
    """Height of the head joint of somebody upright."""
    return CARRIED * height_m * 1.545 / 1.73


def doctor(recording: Recording):
    return [finding for finding in examine_recording(recording) if finding.check == "height"]


@pytest.mark.parametrize("height_m", [1.55, 1.9])
@pytest.mark.parametrize("down_deg", [0.0, 50.0])
def test_doctor_and_capture_say_one_height_of_the_head_joint_and_not_of_the_device(height_m, down_deg):
    recording = worn(walking(20), joint_of(height_m), down_deg=down_deg)
    fitted, stature = with_stature(recording, xsens23())
    assert stature.height_m == pytest.approx(height_m, abs=0.005)
    assert fitted.skeleton is not None
    assert fitted.skeleton.stature == pytest.approx(height_m, abs=0.005)
    (finding,) = doctor(recording)
    assert (finding.severity, finding.what) == ("note", str(stature))
    assert finding.what.startswith(f"{height_m:.2f} ± 0.03 m")


def test_a_floor_of_points_is_as_good():
    seen = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([8.0, 8.0, 0.01])
    points = PointCloud(seen + torch.tensor([-4.0, -4.0, 0.295]))
    recording = replace(worn(walking(20), joint_of(1.7)), floor=None, points=points)
    assert estimate_stature(recording, xsens23()).height_m == pytest.approx(1.7, abs=0.02)
    few = replace(recording, points=PointCloud(seen[:20]))
    assert estimate_stature(few, xsens23()).source == "unknown"


def test_what_is_given_comes_first():
    recording = worn(walking(20), joint_of(1.7))
    given, stature = with_stature(recording, xsens23(), 1.68)
    assert given.skeleton is not None
    assert (str(stature), given.skeleton.stature) == ("1.68 m, as given", pytest.approx(1.68, abs=1e-4))
    own = replace(recording, skeleton=skeleton_of_height(1.6))
    assert str(with_stature(own, xsens23())[1]) == "1.60 m, of its skeleton"
    nowhere, stature = with_stature(replace(recording, floor=None), xsens23())
    assert (stature.known, nowhere.skeleton) == (False, None)
    assert str(stature) == "the height is not known, 1.73 m is assumed"
    with pytest.raises(WearcapError, match="a height of 17"):
        with_stature(recording, xsens23(), 17.0)


@pytest.mark.parametrize(
    ("place", "joint_m", "source"),
    [
        (still, SEATED_M, "seated"),
        (leaning, SEATED_M, "seated"),
        (set_anew, SEATED_M, "seated"),
        (still, joint_of(1.45), "seated?"),
        (walking, joint_of(1.45), "head"),
        (walking, joint_of(1.25), "head"),
        (still, joint_of(1.52), "head"),
        (walking, 0.8, "unknown"),
        (walking, 2.2, "unknown"),
        (still, 0.2, "unknown"),
    ],
)
def test_who_sits_has_no_height(place, joint_m, source):
    recording = worn(place(40), joint_m)
    fitted, stature = with_stature(recording, xsens23())
    assert stature.source == source
    assert (fitted.skeleton is None) == (source != "head")
    assert ("a child" in str(stature)) == (source == "head" and joint_m < joint_of(1.4))


def test_who_stands_up_once_is_as_tall_as_then():
    """Four and a half minutes at a desk, half a minute before it."""
    joint_m = np.repeat([SEATED_M, STANDING_M, SEATED_M], [120 * FPS, 30 * FPS, 150 * FPS])
    found = estimate_stature(worn(still(300), joint_m), xsens23())
    assert joint_of(found.height_m) == pytest.approx(STANDING_M, abs=0.01)


def test_the_doctor_asks_for_the_height_of_who_sits_unless_it_is_known():
    recording = worn(still(20), SEATED_M)
    (finding,) = doctor(recording)
    assert (finding.severity, finding.what) == ("note", "seated: the height is not known, 1.73 m is assumed")
    assert "height=" in finding.fix
    assert doctor(replace(recording, skeleton=xsens23())) == []
    (finding,) = doctor(replace(worn(walking(20), joint_of(1.9)), skeleton=xsens23()))
    assert finding.severity == "warning"


def test_the_share_at_which_heads_are_carried_has_one_home():
    assert MocapEvery.carried == CARRIED
    assert "carried" not in compose("capture", ["pipeline=mocap_every", "recording=none"]).pipeline


@pytest.mark.real
@pytest.mark.parametrize("name", ["155558", "161518"])
def test_real_logs_of_somebody_at_a_desk(real_data, name):
    path = real_data / "quest_azure_kinect" / f"HMD_P01_Session01_20260114_{name}.csv"
    fitted, stature = with_stature(load(path).recording, xsens23())
    assert (stature.source, fitted.skeleton) == ("seated", None)
    (findings,) = examine(path).findings.values()
    assert [finding.what for finding in findings if finding.check == "height"] == [str(stature)]


@pytest.mark.real
def test_the_real_aria_wearer_s_height_is_read_off_the_path(real_data):
    """The head is 1.50 m above the floor on this walk, so the wearer is not as tall as the default body."""
    recording = wearcap.read(real_data / "aria_mps")
    assert recording.skeleton is not None
    assert recording.skeleton.stature == pytest.approx(1.65, abs=0.05)
