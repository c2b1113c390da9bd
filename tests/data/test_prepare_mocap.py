"""Motion capture to recordings: rates, glitches, floors, contacts, the head's path; CMU's and AMASS's layouts."""

import math
import shutil
import warnings
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from data_prep.amass import amass_tasks
from data_prep.bvh import bvh_tasks
from data_prep.cmu import cmu_tasks
from data_prep.shared.engine import Splits, check_recording
from data_prep.shared.mocap import About, CleaningLimits, MocapSettings, foot_patches, mocap_recording, without_glitches
from foreign_bvh import CONVENTIONS, walk, write
from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.boundary.texts import read_bytes
from wearcap.cli import prepare as verb
from wearcap.cli.conf import compose, splits_dir
from wearcap.cli.verbs import help_of
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.formats.amass import write_amass
from wearcap.metrics.gait import knee_cycles, normal_knee_deg
from wearcap.recording import Motion, RecordingStore
from wearcap.recording.timing import resampled

LIMITS = CleaningLimits(8.0, 15.0, 0.5, 0.06, 0.12)
SETTINGS = MocapSettings(60.0, (0.09, 0.0, 0.09), LIMITS)
ABOUT = About("a", "1", "test", "none")
SPLITS = Splits(Path("any.csv"), (("*", "train"),))


def standing(seconds: float = 2.0, fps: float = 120.0, floor: float = 0.4) -> Motion:
    """Someone who stands on a floor at a given height and turns the head to and fro."""
    skeleton = xsens23()
    times = torch.arange(int(seconds * fps), dtype=torch.float64) / fps
    R = torch.eye(3).repeat(len(times), len(skeleton), 1, 1)
    R[:, skeleton.index("head")] = rotation.about_axis("z", 0.5 * torch.sin(3 * times).float())
    t = torch.tensor([0.0, 0.0, skeleton.root_height + floor]).repeat(len(times), 1)
    return Motion(times, skeleton, R, t)


def walking_in_place(seconds: float = 4.0) -> Motion:
    """Each foot lifted 20 cm for half a second in turn."""
    motion = standing(seconds, floor=0.0)
    skeleton, R = motion.skeleton, motion.R_parent_joint.clone()
    for side, start in (("left", 0.0), ("right", 1.0)):
        phase = (motion.timestamps - start).remainder(2.0).float()
        lift = 0.7 * torch.sin(math.pi * phase.clamp(max=1.0)) ** 2
        R[:, skeleton.index(f"{side}_hip")] = rotation.about_axis("y", -lift)
        R[:, skeleton.index(f"{side}_knee")] = rotation.about_axis("y", 2 * lift)
    return replace(motion, R_parent_joint=R)


def test_a_standing_person_becomes_a_recording_on_a_level_floor():
    recording = mocap_recording(standing(), ABOUT, SETTINGS)
    check_recording(recording)
    motion = recording.motion
    assert motion is not None
    assert recording.floor is not None
    assert recording.contacts is not None
    assert recording.head is not None
    assert motion.fps == pytest.approx(60)
    assert float(motion.provenance["floor_m"]) == pytest.approx(0.4, abs=0.01)
    assert motion.t_world_root[0, 2].item() == pytest.approx(xsens23().root_height, abs=0.01)
    assert recording.contacts.contact.all()
    assert recording.contacts.parts == FOOT_PATCHES
    torch.testing.assert_close(recording.head.T_world_head.t, motion.joint("head").t)
    offset = recording.head.t_world_device - motion.joint("head").t
    assert offset.norm(dim=-1).mean().item() == pytest.approx(0.09 * math.sqrt(2), rel=1e-4)


def test_a_lifted_foot_is_not_in_contact():
    recording = mocap_recording(walking_in_place(), ABOUT, SETTINGS)
    assert recording.contacts is not None
    contact = recording.contacts.contact
    at = lambda seconds: int(seconds * 60)  # noqa: E731
    assert contact[at(0.5)].tolist() == [False, False, True, True]
    assert contact[at(1.5)].tolist() == [True, True, False, False]


@pytest.mark.parametrize(("fps", "frames"), [(120.0, 60), (60.0, 60), (100.0, 60), (59.94, 60), (30.0, 59)])
def test_any_rate_becomes_60_and_keeps_its_motion(fps, frames):
    motion = standing(1.0, fps)
    out = resampled(motion, 60.0)
    assert abs(len(out) - frames) <= 1
    angle = rotation.log(out.joint("head").R)[:, 2]
    torch.testing.assert_close(angle, 0.5 * torch.sin(3 * out.timestamps).float(), atol=2e-3, rtol=0)


def test_a_gap_in_the_clock_is_bridged_at_an_even_rate():
    motion = standing(1.0)
    kept = torch.cat([torch.arange(40), torch.arange(60, 120)])
    motion = replace(
        motion,
        timestamps=motion.timestamps[kept],
        R_parent_joint=motion.R_parent_joint[kept],
        t_world_root=motion.t_world_root[kept],
    )
    steps = resampled(motion, 60.0).timestamps.diff()
    assert steps.max().item() == pytest.approx(1 / 60, abs=1e-6)


def test_a_glitch_cuts_the_motion_and_is_noted():
    motion = standing(1.0)
    t = motion.t_world_root.clone()
    t[30:] += torch.tensor([1.0, 0.0, 0.0])
    out, note = without_glitches(replace(motion, t_world_root=t), LIMITS)
    assert len(out) == 90
    assert note.startswith("kept frames 30 to 119 of 120: 1 impossible steps, the worst 120 m/s")
    assert without_glitches(motion, LIMITS) == (motion, "")


def test_steps_have_no_level_floor():
    motion = standing(3.0, floor=0.0)
    t = motion.t_world_root.clone()
    t[:, 2] += 0.4 * (4 * (motion.timestamps - 1.5)).clamp(0, 1).float()
    recording = mocap_recording(replace(motion, t_world_root=t), ABOUT, SETTINGS)
    assert recording.floor is None
    assert recording.motion is not None
    assert recording.motion.provenance["floor"] == "uneven"


def walking_bvh(path: Path) -> None:
    """A small upright figure in centimetres, 30 frames at 60 Hz."""
    names = "Hips Spine Neck Head LeftArm LeftForeArm LeftHand RightArm RightForeArm RightHand"
    joints = f"{names} LeftUpLeg LeftLeg LeftFoot RightUpLeg RightLeg RightFoot".split()
    offsets = {"Spine": (0, 15, 0), "Neck": (0, 35, 0), "Head": (0, 12, 0), "Arm": (18, 30, 0), "ForeArm": (28, 0, 0),
               "Hand": (25, 0, 0), "UpLeg": (9, 0, 0), "Leg": (0, -42, 0), "Foot": (0, -42, 0)}  # fmt: skip
    chains = ("Hips Spine Neck Head", "Spine Arm ForeArm Hand", "Hips UpLeg Leg Foot")
    parents = {child: parent for chain in chains for parent, child in pairwise(chain.split())}
    ends = {"Head": (0, 18, 0), "Hand": (15, 0, 0), "Foot": (0, -6, 18)}

    def bare(name: str) -> str:
        return name.removeprefix("Left").removeprefix("Right")

    def block(name: str, depth: int) -> list[str]:
        side = name[: len(name) - len(bare(name))]
        x, y, z = offsets.get(bare(name), (0, 0, 0))
        sign = -1 if side == "Right" else 1
        channels = "6 Xposition Yposition Zposition" if name == "Hips" else "3"
        pad = "  " * depth
        lines = [
            f"{pad}{'ROOT' if depth == 0 else 'JOINT'} {name}",
            pad + "{",
            f"{pad}  OFFSET {sign * x} {y} {z}",
            f"{pad}  CHANNELS {channels} Zrotation Xrotation Yrotation",
        ]
        for child in joints:
            parent = parents.get(bare(child))
            sided = parent and (parent if parent in ("Hips", "Spine", "Neck") else child[: -len(bare(child))] + parent)
            if child != "Hips" and sided == name:
                lines += block(child, depth + 1)
        if bare(name) in ends:
            ex, ey, ez = ends[bare(name)]
            lines += [pad + "  End Site", pad + "  {", f"{pad}    OFFSET {sign * ex} {ey} {ez}", pad + "  }"]
        return [*lines, pad + "}"]

    row = " ".join(["0", "90", "0", *["0"] * (3 * len(joints))])
    text = ["HIERARCHY", *block("Hips", 0), "MOTION", "Frames: 30", "Frame Time: 0.0166667", *[row] * 30]
    path.write_text("\n".join(text) + "\n")


@pytest.fixture
def bvh_folder(tmp_path) -> Path:
    (tmp_path / "in").mkdir()
    walking_bvh(tmp_path / "in" / "07_01.bvh")
    walking_bvh(tmp_path / "in" / "dance.bvh")
    (tmp_path / "in" / "broken.bvh").write_text("HIERARCHY\nROOT")
    (tmp_path / "in" / "33_01.amc").write_text(":FULLY-SPECIFIED\n1\nroot 0 0 0 0 0 0\n")
    return tmp_path


def test_the_command_prepares_a_folder_and_names_what_it_cannot_read(bvh_folder, capfd):
    arguments = ["cmu", f"source={bvh_folder / 'in'}", f"output={bvh_folder / 'out'}", "jobs=1"]
    with pytest.raises(SystemExit) as caught:
        verb.main(arguments)
    assert caught.value.code == 1
    printed = capfd.readouterr()
    assert "failed: broken: " in printed.err
    assert "failed: 33_01: " in printed.err
    assert ".asf" in printed.err
    assert "2 written, 0 current, 2 failed" in printed.out
    store = RecordingStore.open(bvh_folder / "out")
    assert store.names() == ["07_01", "dance"]
    assert store.entries["07_01"].context.subject == "7"
    assert (store.entries["07_01"].split, store.entries["07_01"].fps) == ("train", 60.0)
    (bvh_folder / "in" / "broken.bvh").unlink()
    (bvh_folder / "in" / "33_01.amc").unlink()
    verb.main(arguments)
    assert "0 written, 2 current, 0 failed" in capfd.readouterr().out


def test_amass_as_it_unpacks(tmp_path):
    from wearcap.body.skeletons import smplh52

    skeleton = smplh52()
    R = torch.eye(3).repeat(120, len(skeleton), 1, 1)
    t = torch.tensor([0.0, 0.0, skeleton.root_height]).repeat(120, 1)
    folder = tmp_path / "in" / "HumanEva" / "S1"
    folder.mkdir(parents=True)
    write_amass(Motion(torch.arange(120, dtype=torch.float64) / 120, skeleton, R, t), folder / "walk_poses.npz")
    (folder / "shape.npz").write_bytes(b"")
    verb.main(["amass", f"source={tmp_path / 'in'}", f"output={tmp_path / 'out'}", "jobs=1"])
    store = RecordingStore.open(tmp_path / "out")
    assert store.names("val") == ["HumanEva__S1__walk_poses"]
    recording = store.load("HumanEva__S1__walk_poses")
    assert recording.skeleton is not None
    assert recording.skeleton.name == "xsens23"
    assert recording.contacts is not None
    assert recording.contacts.contact.all()


def test_amass_by_data_set_and_by_files(tmp_path):
    """Some data sets of a download; and a split list that deals single files."""
    for name in ("CMU/14/a_poses", "CMU/14/b_poses", "BMLmovi/S1/c_poses", "SFU/S2/d_poses"):
        path = tmp_path / "in" / f"{name}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
    listed = tmp_path / "mine.csv"
    listed.write_text("subject,split\nCMU/14/b_poses,test\nCMU/14,val\n*,train\n")
    splits = Splits.read(listed)
    license = compose("prepare", ["prepare=amass"]).license
    tasks = amass_tasks(tmp_path / "in", splits, SETTINGS, license, ["CMU", "BMLmovi"])
    assert {task.name: task.split for task in tasks} == {
        "BMLmovi__S1__c_poses": "train",
        "CMU__14__a_poses": "val",
        "CMU__14__b_poses": "test",
    }
    assert len(amass_tasks(tmp_path / "in", splits, SETTINGS, license)) == 4
    with pytest.raises(WearcapError, match="no data set 'BMLmov'. Did you mean 'BMLmovi'"):
        amass_tasks(tmp_path / "in", splits, SETTINGS, license, ["BMLmov"])
    assert compose("prepare", ["prepare=amass", "subsets=[CMU,MPI_HDM05]"]).tasks.subsets == ["CMU", "MPI_HDM05"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cmu"], "source has no value"),
        (["cmu", "source=/nowhere"], "/nowhere: no such folder"),
        (["cmuu"], "Did you mean 'cmu'"),
        (["cmu", "source=.", "jbos=2"], "Did you mean 'jobs'"),
        ([], "no source given"),
    ],
)
def test_wrong_commands_are_refused(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(WearcapError, match=message):
        verb.main(arguments)
    assert not list(tmp_path.iterdir())


def test_help_names_what_there_is():
    assert all(source in help_of("prepare", []) for source in verb.sources())
    assert "source=…" in help_of("prepare", ["cmu"])
    assert "jobs=-1" in help_of("prepare", ["cmu"])


@pytest.mark.parametrize(
    "source", sorted(set(verb.sources()) - {"embeddings", "keypoints"})
)  # these work on data sets that stand
def test_every_source_composes_and_has_a_split_list(source):
    config = compose("prepare", [f"prepare={source}"])
    assert config.output == f"datasets/{source}"
    splits = Splits.read(splits_dir() / config.splits)
    assert splits.of("someone/new") in ("train", "val", "test")


def test_cmus_split_covers_every_subject_and_keeps_its_largest_for_training():
    splits = Splits.read(splits_dir() / "cmu.csv")
    places = {number: splits.of(str(number)) for number in range(1, 145)}
    assert places[14] == "train"
    assert [number for number in places if places[number] == "test" and number in (5, 26, 35, 127)] == [5, 26, 35, 127]
    assert 100 < list(places.values()).count("train") < 125


@pytest.mark.real
@pytest.mark.slow
def test_every_kind_of_cmu_trial_becomes_a_recording(real_data):
    config = compose("prepare", ["prepare=cmu"])
    splits = Splits.read(splits_dir() / "cmu.csv")
    tasks = cmu_tasks(
        real_data / "cmu_mocap", splits, SETTINGS, config.amc_fps, "CMU", config.repair, list(config.usual_m)
    )
    indices = [path.read_text(encoding="utf-8") for path in (real_data / "cmu_mocap").glob("index*.csv")]
    assert len(tasks) == sum(len(text.splitlines()) - 1 for text in indices) >= 240
    by_name = {task.name: task for task in tasks}
    for name in ("35_01", "12_01", "05_10", "03_01"):
        task = by_name[name]
        recording = task.make()
        check_recording(recording)
        motion = recording.motion
        assert motion is not None
        assert recording.contacts is not None
        assert motion.fps == pytest.approx(60)
        assert (recording.floor is None) == (name == "03_01")
        assert ("note" in motion.provenance) == (name == "05_10")
        assert 0.3 < recording.contacts.contact.float().mean() < 0.9
        assert 1.2 < motion.joint("head").t[:, 2].median() < 2.2
    walk = by_name["35_01"].make()
    assert (walk.activity, by_name["35_01"].split) == ("walk", "test")
    assert walk.motion is not None
    assert "up" in walk.motion.provenance["hips_moved_m"]
    cycles = torch.cat(knee_cycles(walk.motion))
    assert len(cycles) >= 2
    assert (cycles.mean(0) - normal_knee_deg()).square().mean().sqrt() < 9, "13° with the file's hips"
    path = walk.motion.t_world_root[:, :2].diff(dim=0).norm(dim=-1).sum().item()
    assert 1.0 < path / walk.duration_s < 1.6


@pytest.mark.real
def test_xz_and_plain_give_the_same_recording(real_data, tmp_path):
    folder = real_data / "cmu_mocap/trials/035"
    plain = tmp_path / "35_20.amc"
    plain.write_bytes(read_bytes(folder / "35_20.amc.xz"))
    shutil.copy(folder / "35.asf", tmp_path)
    first, second = (
        next(task for task in bvh_tasks(file, SPLITS, SETTINGS, 120, "CMU", False)).make().motion
        for file in (folder / "35_20.amc.xz", plain)
    )
    assert first is not None
    assert second is not None
    assert torch.equal(first.R_parent_joint, second.R_parent_joint)


@pytest.fixture
def foreign_folder(tmp_path) -> Path:
    """Two people's walks in one convention, a folder each."""
    R, p = walk(frames=90)
    for person in ("anna", "ben"):
        (tmp_path / "in" / person).mkdir(parents=True)
        for take in ("a", "b"):
            write(tmp_path / "in" / person / f"{person}-{take}.bvh", CONVENTIONS["studio"], R, p)
    return tmp_path


@pytest.mark.parametrize(
    ("rule", "subjects", "warned"),
    [
        (None, {"anna", "ben"}, False),
        ("folder", {"anna", "ben"}, False),
        (r"/(\w+)-\w\.bvh", {"anna", "ben"}, False),
        (r"(an|ben)", {"an", "ben"}, False),
        ("everyone", {"everyone"}, False),
        (r"([^/]+)\.bvh", {"anna-a", "anna-b", "ben-a", "ben-b"}, True),
    ],
)
def test_subjects_follow_a_pattern_the_folder_or_a_name(rule, subjects, warned, foreign_folder):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tasks = bvh_tasks(foreign_folder / "in", SPLITS, SETTINGS, 120, "none", False, subject=rule)
    assert [task.name for task in tasks] == [f"{p}__{p}-{take}" for p in ("anna", "ben") for take in ("a", "b")]
    assert {task.make.args[2].subject for task in tasks} == subjects  # pyright: ignore[reportFunctionMemberAccess]
    assert any("subject=" in str(warning.message) for warning in caught) == warned


@pytest.mark.parametrize(
    ("rule", "message"), [("(a", "subject=.a: "), ("(a)(b)", "2 groups"), ("(carl)", "does not match anna/anna-a.bvh")]
)
def test_a_pattern_that_finds_no_subject_is_refused(rule, message, foreign_folder):
    with pytest.raises(WearcapError, match=message):
        bvh_tasks(foreign_folder / "in", SPLITS, SETTINGS, 120, "none", False, subject=rule)


def test_foreign_files_become_recordings_and_what_the_doctor_refuses_does_not(foreign_folder, capfd):
    """A walk that lies on its side is reported as failed; the others are written with what was detected."""
    R, p = walk(frames=90)
    over = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    lying = {joint: over @ turns for joint, turns in R.items()}, {joint: places @ over.T for joint, places in p.items()}
    write(foreign_folder / "in" / "ben" / "lying.bvh", CONVENTIONS["mixamo"], *lying)
    (foreign_folder / "up.yaml").write_text("up: y\nforward: z\n")
    arguments = ["bvh", f"source={foreign_folder / 'in'}", f"output={foreign_folder / 'out'}", "jobs=1"]
    arguments += [f"mapping={foreign_folder / 'up.yaml'}"]
    with pytest.raises(SystemExit):
        verb.main(arguments)
    printed = capfd.readouterr()
    assert "failed: ben__lying: the doctor finds, motion: up axis: the body stands along" in printed.err
    assert "check=false" in printed.err
    assert "4 written, 0 current, 1 failed" in printed.out
    assert "anna__anna-a: names MotionBuilder, centimetres, y up, frames from the motion" in printed.out
    motion = RecordingStore.open(foreign_folder / "out").load("anna__anna-a").motion
    assert motion is not None
    assert "The unit is centimetres (0.01 m)" in motion.provenance["conventions"]
    verb.main([*arguments, "check=false", r"subject=(anna|ben)/[\w-]+\.bvh"])
    store = RecordingStore.open(foreign_folder / "out")
    assert {store.entries[n].context.subject for n in ("anna__anna-a", "ben__ben-b")} == {"anna", "ben"}
    assert "1 written, 4 current, 0 failed" in capfd.readouterr().out
    one = foreign_folder / "in" / "ben" / "ben-a.bvh"
    verb.main(["bvh", f"source={one}", f"output={foreign_folder / 'single'}", "jobs=1", "subject=ben"])
    store = RecordingStore.open(foreign_folder / "single")
    assert store.names() == ["ben-a"]
    assert store.entries["ben-a"].context.subject == "ben"


@pytest.mark.real
def test_another_laboratorys_files_land_in_its_people(real_data):
    tasks = bvh_tasks(real_data / "hdm05" / "trials", SPLITS, SETTINGS, 120, "none", False)
    subjects = [task.make.args[2].subject for task in tasks]  # pyright: ignore[reportFunctionMemberAccess]
    assert len(subjects) == 232
    assert set(subjects) == {"HDM_bd", "HDM_bk", "HDM_dg", "HDM_mm"}


@pytest.mark.real
@pytest.mark.slow
def test_standing_soles_lie_on_the_floor(real_data):
    """Heels and toe tips of CMU's standing feet; when soles kept the bind pose's tilt, heels were at 1.5 cm in the median."""
    tasks = {task.name: task for task in cmu_tasks(real_data / "cmu_mocap", SPLITS, SETTINGS, 120, "CMU", False)}
    heights = []
    for name in ("07_01", "10_01", "14_14", "16_05", "35_20", "55_28", "13_29", "29_01", "127_03", "43_02"):
        if name not in tasks:
            continue
        motion = tasks[name].make().motion
        assert motion is not None
        positions, speed = foot_patches(motion)
        for heel, tip in ((0, 1), (2, 3)):
            low = positions[:, [heel, tip], 2].amin(1) < 0.06
            standing = (speed[:, heel] < 0.1) & (speed[:, tip] < 0.1) & low
            if standing.sum() > 5:
                heights.append(positions[standing][:, [heel, tip], 2].median(0).values)
    assert len(heights) > 8
    heels, tips = torch.stack(heights).unbind(-1)
    assert heels.median().abs() < 0.005
    assert tips.median().abs() < 0.005
    assert heels.abs().mean() < 0.013
