"""Figures of a person's motion: of a walk that is known exactly, and of the same walk with one fault each."""

from dataclasses import replace

import pytest
import torch

from normal_walk import walk
from walking_person import sound_recording
from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.geometry.rotation import about_axis
from wearcap.metrics.gait import STANCE, normal_knee_deg
from wearcap.metrics.truth import truth
from wearcap.recording import ContactTrack, FloorTrack, Motion, Recording

SECONDS = 12.0


def planted(height: float = 0.0, speed: float = 0.0, seconds: float = 4.0) -> Recording:
    """Somebody straight whose four patches count as planted, at a height (m) over the floor and gliding (m/s)."""
    times = torch.arange(round(seconds * 60), dtype=torch.float64) / 60
    t = torch.stack([speed * times, 0 * times, 0.93 + height + 0 * times], 1).float()
    motion = Motion(times, xsens23(), torch.eye(3).repeat(len(times), 23, 1, 1), t)
    contacts = ContactTrack(times, FOOT_PATCHES, torch.ones(len(times), 4, dtype=torch.bool))
    return Recording("planted", motion=motion, contacts=contacts, floor=FloorTrack(times, torch.zeros(len(times))))


@pytest.fixture(scope="module")
def sound() -> Recording:
    return sound_recording(SECONDS)


@pytest.fixture(scope="module")
def figures(sound) -> dict[str, float]:
    return truth([sound])


def moved(recording: Recording, **changes) -> Recording:
    return replace(recording, motion=replace(recording.motion, **changes))


def jumping(recording: Recording) -> Recording:
    t = recording.motion.t_world_root.clone()
    t[300] += 1.0
    return moved(recording, t_world_root=t)


def long_shank(recording: Recording) -> Recording:
    skeleton = recording.motion.skeleton
    t = skeleton.t_parent_joint.clone()
    t[skeleton.index("left_ankle"), 2] -= 0.03
    return moved(recording, skeleton=replace(skeleton, t_parent_joint=t))


def bowed_head(recording: Recording) -> Recording:
    R, head = recording.motion.R_parent_joint.clone(), recording.motion.skeleton.index("head")
    R[:, head] = R[:, head] @ about_axis("y", torch.tensor(20.0).deg2rad())
    return moved(recording, R_parent_joint=R)


def test_a_sound_walk(figures):
    """The walk's own numbers: soles at 0, thigh and shank 0.43 and 0.42 m of 1.73, the head 8.6° down on average."""
    assert figures["minutes"] == pytest.approx(SECONDS / 60, abs=0.001)
    assert (figures["sole_cm"], figures["sole_low_cm"]) == pytest.approx((0, 0), abs=0.05)
    assert (figures["jumps_per_min"], figures["bones_cm"]) == pytest.approx((0, 0), abs=1e-6)
    assert figures["stature_m"] == pytest.approx(0.93 + 0.615 + 0.185)
    assert figures["leg"] == pytest.approx(0.85 / 1.73)
    assert figures["eyes"] == pytest.approx((0.93 + 0.615 + 0.075) / 1.73)
    assert figures["pitch_deg"] == pytest.approx(8.6, abs=1.0)
    assert not {"pitch_spread_deg", "standing_deg", "knee_rms_deg"} & set(figures), (
        "one recording, in which nobody stands"
    )


@pytest.mark.parametrize(
    ("spoil", "name", "change", "within"),
    [
        (jumping, "jumps_per_min", 2 * 60 / SECONDS, 0.1),
        (long_shank, "bones_cm", 3.0, 1e-3),
        (long_shank, "leg", 0.865 / 1.76 - 0.85 / 1.73, 1e-3),
        (bowed_head, "pitch_deg", 20.0, 0.5),
    ],
)
def test_a_fault_changes_its_figure(sound, figures, spoil, name, change, within):
    assert truth([spoil(sound)])[name] - figures[name] == pytest.approx(change, abs=within)


@pytest.mark.parametrize("bend", [0.0, 12.0])
def test_the_knee_over_the_cycle(bend):
    found = truth([Recording("walk", motion=walk(bend))])
    assert found["knee_rms_deg"] == pytest.approx(bend, abs=0.5)
    assert found["stance_deg"] == pytest.approx(normal_knee_deg()[STANCE].median().item() + bend, abs=1.0)
    assert found["curves_deg"] < 0.5
    assert not {"sole_cm", "skate_cm_s", "eyes"} & set(found), "no contacts, no floor, nothing on the head"


@pytest.mark.parametrize(("bend", "stands"), [(5.0, True), (90.0, False)])
def test_who_sits_does_not_stand(bend, stands):
    R, person = torch.eye(3).repeat(120, 23, 1, 1), walk(seconds=2.0)
    for side in ("left", "right"):
        R[:, person.skeleton.index(f"{side}_hip")] = about_axis("y", -torch.tensor(bend).deg2rad())
        R[:, person.skeleton.index(f"{side}_knee")] = about_axis("y", torch.tensor(bend).deg2rad())
    still = replace(person, R_parent_joint=R, t_world_root=torch.zeros(120, 3))
    found = truth([Recording("still", motion=still)])
    assert found.get("standing_deg") == (pytest.approx(bend, abs=0.1) if stands else None)


@pytest.mark.parametrize("height", [0.03, -0.02])
def test_soles_over_the_floor_and_through_it(height):
    found = truth([planted(), planted(height, seconds=12.0)])
    assert found["sole_cm"] == pytest.approx(100 * height, abs=1e-3)
    assert (found["sole_low_cm"], found["sole_high_cm"]) == pytest.approx(sorted([0, 100 * height]), abs=1e-3)


def test_skating_counts_by_the_time_that_feet_are_planted():
    found = truth([planted(speed=0.2, seconds=2.0), planted(seconds=6.0)])
    assert found["skate_cm_s"] == pytest.approx(20 * 119 / (119 + 359), abs=1e-2)


def test_recordings_of_a_person_are_pooled(sound, figures):
    both, glide = truth([sound, bowed_head(sound)]), Recording("glide", motion=walk())
    assert both["minutes"] == pytest.approx(2 * figures["minutes"])
    assert both["pitch_spread_deg"] == pytest.approx(20 / 2**0.5, abs=0.5)
    assert truth([glide, sound, glide])["cycles"] == 2 * truth([glide])["cycles"] >= 20


def test_edges_of_a_floor_are_left_out():
    """The floor below the wearer is not that below a foot that is planted across an edge."""
    person = planted(seconds=12.0)
    times = person.motion.timestamps
    edge = FloorTrack(times, torch.where((times - 6).abs() < 0.5, 0.1, 0.0))
    found = truth([replace(person, floor=edge)])
    assert (found["sole_low_cm"], found["sole_high_cm"]) == pytest.approx((0, 0), abs=1e-3)
    lower = FloorTrack(times, torch.where(times > 3.0, -0.2, 0.0))
    assert truth([replace(person, floor=lower)])["sole_high_cm"] == pytest.approx(20, abs=1e-3)


@pytest.mark.parametrize(
    ("activity", "walks"), [("", True), ("WalkTurnLeft", True), ("sit, walk", True), ("jump", False)]
)
def test_cycles_of_other_activities_are_not_walking(activity, walks):
    """Somebody who runs up to a jump is no walker."""
    recording = Recording("walk", motion=walk(), activity=activity)
    assert (truth([recording]).get("cycles", 0) > 0) == walks
