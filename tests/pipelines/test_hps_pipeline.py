"""HPS from a recording to a motion: planted errors go, steps resume, pictures are localised, faults are reported."""

import functools
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hps_walk import CLAPS_S, MOUNT, floor_points, hps_dataset, hps_recording
from hydra.utils import instantiate
from PIL import Image

from benchmarks.rivals import SEARCH
from benchmarks.rivals.hps_suit import HpsBaseline
from wearcap.body.kinematics import local_rotations
from wearcap.cli.conf import compose
from wearcap.errors import WearcapError
from wearcap.evaluation.evaluate import evaluate
from wearcap.geometry import rotation
from wearcap.localization.features import RootSift
from wearcap.localization.localizer import Localizer
from wearcap.localization.map_builder import MapSettings, build_map
from wearcap.localization.point_map import PointMapper
from wearcap.optimize.losses import Loss
from wearcap.recording import Motion, Recording
from wearcap.recording.timing import resampled
from wearcap.runtime.stages import digest
from wearcap.runtime.system import Captured, CaptureInput, StageOptions, System
from wearcap.scene.scan import Scan
from wearcap.systems.hps import pipeline as hps_module
from wearcap.systems.hps.banded import BandedSettings, solve_banded
from wearcap.systems.hps.camera import MapLocalization, Synchronization
from wearcap.systems.hps.constants import ConstantsPrior
from wearcap.systems.hps.energy import HpsEnergy
from wearcap.systems.hps.pipeline import HPS, at_frames
from wearcap.systems.ireplica.bent_suit import BentSuit
from wearcap.systems.ireplica.trajectory import Bending, bend
from wearcap.systems.ireplica.trajectory_banded import bend_banded

ENERGY = HpsEnergy(
    {
        "self": 220.0,
        "hold": 9.0,
        "translation_step": 1e4,
        "root_step": 1e5,
        "head_step": 6e4,
        "pose": 400.0,
        "slide": 9e3,
        "contact_plane": 4.4e3,
    },
    {
        "self": Loss("cauchy", 0.1),
        "hold": Loss("cauchy", 0.1),
        "slide": Loss("huber", 0.01),
        "contact_plane": Loss("cauchy", 0.02),
        "translation_step": Loss("square"),
        "root_step": Loss("square"),
        "head_step": Loss("square"),
        "pose": Loss("square"),
    },
)
SOLVER = functools.partial(solve_banded, settings=BandedSettings(iterations=4, relaxation=1.0))
PIPELINE = HPS(ENERGY, SOLVER)
CLAPPING = Synchronization("auto", camera_claps_s=list(CLAPS_S))
STAGES = ["synchronize", "localize", "align", "initialize", "optimize"]


@pytest.fixture(scope="module")
def walk() -> Recording:
    return hps_recording(seconds=12.0)


def run(
    pipeline: System, recording: Recording, folder: Path = Path(), cache: Path | None = None, until: str | None = None
) -> Captured:
    """One capture of a recording of a data set."""
    source = CaptureInput.in_dataset(recording, folder)
    return pipeline.capture([source], [0], StageOptions(cache, until))[0]


def root_error_m(motion: Motion, recording: Recording) -> torch.Tensor:
    assert recording.motion is not None
    frame = torch.searchsorted(recording.motion.timestamps, motion.timestamps - 1e-6)
    return (motion.t_world_root - recording.motion.t_world_root[frame]).norm(dim=-1)


def test_planted_errors_of_suit_and_clock_go():
    recording = hps_recording(camera_lead_s=1.7)
    scanned = replace(recording, scene=None)
    with pytest.raises(WearcapError, match="no scan of the scene, which the energy's term contact_plane needs"):
        run(replace(PIPELINE, synchronization=CLAPPING), scanned)
    pipeline = replace(PIPELINE, synchronization=CLAPPING)
    motion = pipeline(CaptureInput(recording, scan=Scan(floor_points())))
    assert motion.timestamps.diff().median().item() == pytest.approx(1 / 30)
    assert root_error_m(motion, recording).mean() < 0.05
    clock = pipeline.synchronization(recording, Path())
    assert clock is not None
    assert clock.offset_s == pytest.approx(1.7, abs=0.002)
    wrong_clock = replace(PIPELINE, synchronization=Synchronization("shared"))(
        CaptureInput(recording, scan=Scan(floor_points()))
    )
    assert root_error_m(wrong_clock, recording).mean() > 0.5


def prior(**deviations: float) -> ConstantsPrior:
    """Constants that are nominal but for those named."""
    return ConstantsPrior(**dict.fromkeys(("scale", "mount_m", "height_m", "segments_deg"), 0.0) | deviations)


@pytest.mark.parametrize(("scale", "moved_m"), [(1.0, 0.0), (0.97, 0.0), (1.0, 0.03)])
def test_a_body_of_the_wrong_size_and_a_mount_that_was_not_measured_are_found(walk, scale, moved_m):
    suit, camera = walk.suit, walk.camera
    wrong = replace(
        walk,
        suit=replace(suit, skeleton=suit.skeleton.scaled(scale)),
        camera=replace(camera, t_head_cam=camera.t_head_cam - torch.tensor([0.0, 0.0, moved_m])),
    )
    pipeline = replace(PIPELINE, constants=prior(mount_m=0.03) if moved_m else prior(scale=0.03))
    source = CaptureInput(wrong, scan=Scan(floor_points()))
    results = pipeline.results(source)
    constants = results["constants"]
    assert constants.scale == pytest.approx(1 / scale, abs=0.015)
    assert constants.t_mount[2] == pytest.approx(moved_m, abs=0.01)
    assert pipeline.report(source, results)["bone_scale"] == constants.scale
    found, given = pipeline.motion_of(results), replace(PIPELINE, constants=None)(source)
    assert found.skeleton.stature == pytest.approx(constants.scale * wrong.suit.skeleton.stature)
    if scale != 1.0:
        true = resampled(walk.motion, 30.0).joint("head").t[:, 2]
        off = [(motion.joint("head").t[:, 2] - true[: len(motion)]).abs().mean() for motion in (found, given)]
        assert off[0] < 0.6 * off[1]


def test_legs_that_are_too_short_are_found_and_the_height_of_the_suits_root_does_not_matter(walk):
    suit, legs = walk.suit, [f"{side}_{joint}" for side in ("left", "right") for joint in ("knee", "ankle")]
    bones = suit.skeleton.indices(*legs)
    offsets = suit.skeleton.t_parent_joint.clone()
    offsets[bones] *= 1 - 0.03 / offsets[bones[:2]].norm(dim=1).sum()
    short = replace(suit.skeleton, t_parent_joint=offsets)
    lifted = replace(suit, skeleton=short, t_world_root=suit.t_world_root + torch.tensor([0.0, 0.0, 0.1]))
    pipeline = replace(PIPELINE, constants=prior(height_m=0.03))
    source = CaptureInput(replace(walk, suit=lifted), scan=Scan(floor_points()))
    results = pipeline.results(source)
    assert results["constants"].height_m == pytest.approx(0.03, abs=0.015)
    found = pipeline.motion_of(results).skeleton.t_parent_joint[bones].norm(dim=1).sum()
    assert found == pytest.approx(2 * (0.85 - 0.03 + results["constants"].height_m), abs=1e-4)


def test_a_constant_error_of_a_shank_is_found(walk):
    suit, turn = walk.suit, torch.tensor(6.0).deg2rad()
    R_world_joint = suit.T_world_joint.R.clone()
    R_world_joint[:, suit.skeleton.index("left_knee")] @= rotation.about_axis("y", -turn)
    wrong = replace(suit, R_parent_joint=local_rotations(suit.skeleton, R_world_joint))
    pipeline = replace(PIPELINE, constants=prior(segments_deg=4.0))
    source = CaptureInput(replace(walk, suit=wrong), scan=Scan(floor_points()))
    turned = pipeline.report(source, pipeline.results(source))["segments_turned_deg"]
    # Soles that are thicker than the wearer's bend both knees alike.
    assert 3.0 < turned["left_knee"][1] - turned["right_knee"][1] < 9.0
    assert turned["left_knee"][1] > 1.5


def test_constants_without_a_deviation_change_nothing(walk):
    source = CaptureInput(walk, scan=Scan(floor_points()))
    with_prior, without = (replace(PIPELINE, constants=given)(source) for given in (prior(), None))
    assert torch.equal(with_prior.R_parent_joint, without.R_parent_joint)
    assert torch.equal(with_prior.t_world_root, without.t_world_root)
    assert torch.equal(with_prior.skeleton.t_parent_joint, without.skeleton.t_parent_joint)


def test_the_report_tells_what_was_found(walk, tmp_path):
    hps_dataset(tmp_path / "data", walk)
    captured = run(PIPELINE, walk, tmp_path / "data")
    report = captured.report
    assert [stage["stage"] for stage in report["stages"]] == STAGES
    assert report["clock"] is None
    assert report["localized"] == {"frames": 360, "share": 1.0}
    assert report["alignment_deg"] == pytest.approx(-np.rad2deg(0.8), abs=3)
    assert report["energy"][-1]["total"] < report["energy"][0]["total"]
    assert set(report["energy"][0]) == {*ENERGY.weights, "total"}
    assert isinstance(report["stopped"], str)
    started = run(PIPELINE, walk, tmp_path / "data", until="initialize")
    assert started.motion is not None
    assert "energy" not in started.report
    assert run(PIPELINE, walk, tmp_path / "data", until="localize").motion is None


def test_a_killed_capture_goes_on_to_the_same_motion(walk, tmp_path, monkeypatch):
    hps_dataset(tmp_path / "data", walk)
    capture = functools.partial(run, PIPELINE, walk, tmp_path / "data", tmp_path / "cache")
    monkeypatch.setattr(hps_module.HPS, "optimize", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        capture()
    monkeypatch.undo()
    resumed = capture()
    assert [stage["reused"] for stage in resumed.report["stages"]] == [True, True, True, True, False]
    straight = run(PIPELINE, walk, tmp_path / "data")
    assert resumed.motion is not None
    assert straight.motion is not None
    assert torch.equal(resumed.motion.t_world_root, straight.motion.t_world_root)
    assert torch.equal(resumed.motion.R_parent_joint, straight.motion.R_parent_joint)
    reused = capture()
    assert all(stage["reused"] for stage in reused.report["stages"])
    assert reused.motion is not None
    assert torch.equal(reused.motion.t_world_root, straight.motion.t_world_root)


@pytest.mark.parametrize(
    ("changed", "stale"),
    [
        (
            lambda r, root: (
                r,
                replace(
                    PIPELINE, solver=functools.partial(SOLVER, settings=BandedSettings(iterations=2, relaxation=1.5))
                ),
            ),
            ["optimize"],
        ),
        (lambda r, root: (r, replace(PIPELINE, name="other")), []),
        (lambda r, root: (replace(r, motion=None), PIPELINE), []),
        (lambda r, root: (replace(r, suit=r.suit.sliced(0, 600)), PIPELINE), ["align", "initialize", "optimize"]),
        (lambda r, root: (rescanned(r, root), PIPELINE), ["optimize"]),
    ],
    ids=["solver", "name", "truth", "suit", "scan"],
)
def test_only_what_follows_a_change_is_made_again(changed, stale, walk, tmp_path):
    hps_dataset(tmp_path / "data", walk)
    run(PIPELINE, walk, tmp_path / "data", tmp_path / "cache")
    recording, pipeline = changed(walk, tmp_path / "data")
    runs = run(pipeline, recording, tmp_path / "data", tmp_path / "cache").report["stages"]
    assert [run["stage"] for run in runs if not run["reused"]] == stale


def rescanned(recording: Recording, root: Path) -> Recording:
    path = root / "scene/pointcloud.ply"
    path.write_bytes(path.read_bytes() + b"\n")
    return recording


def test_a_baseline_shares_the_first_stages(walk, tmp_path):
    hps_dataset(tmp_path / "data", walk)
    run(PIPELINE, walk, tmp_path / "data", tmp_path / "cache")
    for kind in ("imu", "imu_cam_filtered"):
        placed = run(HpsBaseline(kind), walk, tmp_path / "data", tmp_path / "cache")
        assert [stage["reused"] for stage in placed.report["stages"]] == [True, True, False]
        assert placed.motion is not None
        assert placed.motion.provenance["pipeline"] == kind


def test_it_is_scored_in_the_world_and_anchored(walk, tmp_path):
    store = hps_dataset(tmp_path, walk)
    imu, ours = (next(evaluate(p, store, ["walk"], [0])).scores for p in (HpsBaseline("imu"), PIPELINE))
    assert ours["world_root_cm"] < imu["world_root_cm"]
    assert ours["mpjpe_cm"] < 5
    assert ours["world_mpjpe_cm"] == pytest.approx(ours["world_root_cm"], rel=0.5)


def test_a_path_bent_to_the_camera_is_nearer_than_the_suits_own(walk, tmp_path):
    store = hps_dataset(tmp_path, walk)
    bent = BentSuit(functools.partial(bend, settings=Bending(100.0, free_start=True), solver=bend_banded))
    imu, ours = (next(evaluate(p, store, ["walk"], [0])).scores for p in (HpsBaseline("imu"), bent))
    assert ours["world_root_cm"] < imu["world_root_cm"]
    assert bent(walk).provenance["pipeline"] == "bent_suit"


def test_rarely_localised_orientations_are_carried_by_the_suit(walk):
    head = walk.motion.joint("head")
    motion, found = walk.motion, walk.localization
    rare = replace(
        found,
        timestamps=found.timestamps[::9],
        R_world_cam=found.R_world_cam[::9],
        t_world_cam=found.t_world_cam[::9],
        confidence=found.confidence[::9],
    )
    R_cam, sure = at_frames(rare, motion)
    inside = motion.timestamps < rare.timestamps[-1] + 0.1
    assert (sure[inside] == 1).all()
    off = (R_cam - (head.R @ MOUNT.R).double()).abs().amax((1, 2))
    assert off[inside].max() < 1e-5


# Pictures ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """A data set with a painted room, its map, and pictures that a head took in it."""
    sys.path.append(str(Path(__file__).parents[1] / "localization"))
    from textured_room import CAMERA, looking, photo_poses, photograph, take_photos, textured_room

    root = tmp_path_factory.mktemp("filmed")
    (root / "scene").mkdir()
    mapper = PointMapper(textured_room(), 0.01)
    photos = take_photos(mapper, CAMERA, photo_poses(10), root / "scene")
    build_map(photos, Scan(mapper.scan.points), RootSift(400), settings=MapSettings(splat_m=0.01, words=8)).save(
        root / "scene/map.safetensors"
    )
    poses = [looking((2.0 + 0.05 * k, 2.0, 1.6), 0.3 + 0.02 * k, 0.1) for k in range(6)]
    for number, pose in enumerate(poses):
        Image.fromarray(photograph(mapper, CAMERA, pose)).save(root / f"{number}.png")
    files = tuple(f"{number}.png" for number in range(6))
    walk = hps_recording(seconds=2.0)
    assert walk.camera is not None
    stream = replace(walk.camera, timestamps=walk.camera.timestamps[:6], camera=CAMERA, image_files=files)
    return root, replace(walk, camera=stream, localization=None), poses


def test_pictures_are_localised_in_the_scenes_map(filmed):
    root, recording, poses = filmed
    found = MapLocalization(RootSift(400), every=2)(recording, root)
    assert torch.equal(found.timestamps, recording.camera.timestamps[::2])
    assert (found.confidence > 0.5).all()
    truth = torch.stack([pose.t for pose in poses[::2]])
    assert (found.t_world_cam - truth).norm(dim=-1).max() < 0.02
    # 6 Hz of the stream's 30
    assert len(MapLocalization(RootSift(400))(recording, root).timestamps) == 2


def test_landmarks_are_tracked_between_key_frames(filmed, monkeypatch):
    root, recording, poses = filmed
    tracking = instantiate(compose("capture", ["pipeline=hps", "recording=x"]).pipeline.localization.tracking)
    localize = MapLocalization(RootSift(400), every=1, tracking=tracking)
    key_frames = []
    monkeypatch.setattr(
        Localizer, "locate", lambda *args, real=Localizer.locate: key_frames.append(args) or real(*args)
    )
    found = localize(recording, root)
    assert len(key_frames) == 1
    assert torch.equal(found.timestamps, recording.camera.timestamps)
    assert (found.confidence > 0.5).all()
    truth = torch.stack([pose.t for pose in poses])
    assert (found.t_world_cam - truth).norm(dim=-1).max() < 0.02
    assert len(replace(localize, every=None)(recording, root).timestamps) == 2  # 10 Hz of the stream's 30
    anew = replace(localize, tracking=None)
    assert digest(*localize.reads(recording, root)) != digest(*anew.reads(recording, root))
    assert len(anew(recording, root).timestamps) == 6
    assert len(key_frames) == 1 + 1 + 6


@pytest.mark.parametrize(
    ("choices", "tracks"),
    [
        (["pipeline=hps"], True),
        (["pipeline=hps", "head_camera@pipeline=each_frame"], False),
        (["pipeline=paper/hps"], False),
        ([SEARCH, "pipeline=baseline/hps_suit"], False),
    ],
)
def test_landmarks_are_tracked_by_default_and_not_in_published_rows(choices, tracks):
    localization = compose("capture", [*choices, "recording=x"]).pipeline.localization
    assert (localization.tracking is not None) == tracks


def test_poses_that_are_there_are_taken_unless_a_map_is_given(filmed, walk):
    root, recording, _ = filmed
    known = replace(recording, localization=walk.localization)
    assert MapLocalization()(known, root) is walk.localization
    again = MapLocalization(RootSift(400), map=str(root / "scene"), every=5)(known, root)
    assert len(again.timestamps) == 2


def test_another_map_is_another_result(filmed, tmp_path):
    root, recording, _ = filmed
    cache = tmp_path / "cache"
    pipeline = replace(PIPELINE, localization=MapLocalization(RootSift(400), every=3))
    (root / "0.ply").write_bytes(b"")
    source = CaptureInput.in_dataset(recording, root, root / "0.ply")

    def reused() -> bool:
        report = pipeline.capture([source], [0], StageOptions(cache, "localize"))[0].report
        return report["stages"][1]["reused"]

    assert not reused()
    assert reused()
    path = root / "scene/map.safetensors"
    content = path.read_bytes()
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    assert not reused()
    path.write_bytes(content)


# Faults --------------------------------------------------------------------------------------------------------------

FAULTS = {
    "no suit": (lambda r: replace(r, suit=None), PIPELINE, "walk: no suit in this recording"),
    "no camera": (lambda r: replace(r, camera=None), PIPELINE, "walk: no camera in this recording"),
    "no poses": (lambda r: replace(r, localization=None), PIPELINE, "no localisation in this recording, and no map"),
    "no map": (
        lambda r: r,
        replace(PIPELINE, localization=MapLocalization(map="none.safetensors")),
        "none.safetensors: no such map",
    ),
    "no pictures": (
        lambda r: r,
        replace(PIPELINE, localization=MapLocalization(map=__file__)),
        "no pictures of the head camera",
    ),
    "no clap": (
        lambda r: hps_recording(seconds=12.0),
        replace(PIPELINE, synchronization=Synchronization("claps", [1.0])),
        "no clap found",
    ),
    "silent video": (
        lambda r: r,
        replace(PIPELINE, synchronization=Synchronization("claps")),
        "a camera without a video",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_missing_is_reported(fault, walk):
    change, pipeline, message = FAULTS[fault]
    with pytest.raises(WearcapError, match=message):
        pipeline(CaptureInput(change(walk), scan=Scan(floor_points())))


def test_a_suit_without_contacts_is_registered_with_those_of_its_feet(walk):
    source = CaptureInput(replace(walk, suit=replace(walk.suit, contact_prob=None)), scan=Scan(floor_points()))
    derived, given = PIPELINE(source), PIPELINE(CaptureInput(walk, scan=Scan(floor_points())))
    assert (derived.T_world_joint.t - given.T_world_joint.t).norm(dim=-1).mean() < 0.02


def test_settings_that_cannot_be_are_refused():
    with pytest.raises(WearcapError, match="clock='clap'. Expected one of shared, claps, auto"):
        Synchronization("clap")
    with pytest.raises(WearcapError, match="every=0"):
        MapLocalization(every=0)
