import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from benchmarks.rivals import ireplica_baselines as baselines
from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rotation import about_axis
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.contact_labels import LabelClock, labels_of
from wearcap.io.formats.environment import write_environment
from wearcap.metrics.objects import summary
from wearcap.recording import CameraStream, Motion, Recording
from wearcap.recording.motion import Interactions
from wearcap.runtime.stages import StagedSystem, digest
from wearcap.runtime.system import CaptureInput
from wearcap.scene.objects import UNKNOWN_CLASS, Environment, Freedom, SceneObject
from wearcap.systems.ireplica.contact_correction import OffsetSettings
from wearcap.systems.ireplica.detected_contacts import DetectedContacts
from wearcap.systems.ireplica.object_tracker import PALMS, AttachmentSettings, ObjectTracker
from wearcap.systems.ireplica.pipeline import IReplica
from wearcap.systems.ireplica.scores import score_interactions
from wearcap.systems.ireplica.snapping import BendCorrection, HandSnapping, HingeFit, SnapCorrection, fit_about_hinge
from wearcap.systems.ireplica.trajectory import Bending, bend
from wearcap.systems.ireplica.trajectory_banded import bend_banded

FPS, FRAMES = 60.0, 360
TAKE, LEAVE = 60, 240
CUBE = np.array([[x, y, z] for x in (-0.2, 0.2) for y in (-0.2, 0.2) for z in (-0.2, 0.2)], np.float32)
QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
FACES = np.array([f for a, b, c, d in QUADS for f in ((a, b, c), (a, c, d))], np.int32)


def cube(name: str, place: torch.Tensor, freedom: Freedom) -> SceneObject:
    return SceneObject(name, "box", Mesh(CUBE, FACES, np.ones(3, np.float32)), torch.eye(3), place.float(), freedom)


def walked(displacement: torch.Tensor) -> Motion:
    """Someone in a T-pose who is moved along x."""
    skeleton = xsens23()
    root = torch.tensor([0.0, 0.0, skeleton.root_height]) + torch.nn.functional.pad(
        displacement[:, None].float(), (0, 2)
    )
    times = torch.arange(len(displacement), dtype=torch.float64) / FPS
    return Motion(times, skeleton, torch.eye(3).repeat(len(displacement), len(skeleton), 1, 1), root)


@pytest.fixture
def displacement() -> torch.Tensor:
    """At rest, 1 m in the two seconds in which something is held, at rest, on."""
    u = ((torch.arange(FRAMES) - TAKE - 30) / 120.0).clamp(0, 1)
    return u * u * (3 - 2 * u) + 0.5 * ((torch.arange(FRAMES) - 260) / 100.0).clamp(0, 1)


@pytest.fixture
def scene(displacement) -> tuple[Motion, Environment]:
    motion = walked(displacement)
    left, right = site_positions(motion.skeleton, motion.T_world_joint, PALMS)[0]
    beside = torch.tensor([0.2, 0.0, 0.0])
    scene_objects = (
        cube("near", left + beside, Freedom("plane")),
        cube("far", left + 5 * beside, Freedom("plane")),
        cube("door", right + beside, Freedom("hinge", pivot=tuple((right + 4 * beside).tolist()), limits=(-2.0, 2.0))),
    )
    return motion, Environment(scene_objects)


def held_left(frames: int = FRAMES) -> torch.Tensor:
    prob = torch.zeros(frames, 2)
    prob[TAKE:LEAVE, 0] = 0.9
    return prob


def objects_of(motion: Motion) -> dict[str, Trajectory]:
    assert motion.object_motion is not None
    return motion.object_motion


def held_of(motion: Motion) -> Interactions:
    assert motion.interactions is not None
    return motion.interactions


def tracker(**settings) -> ObjectTracker:
    return ObjectTracker(None, attachment=AttachmentSettings(**{"settle_s": 0.0} | settings))


def test_what_is_held_goes_along_and_stays_where_it_is_left(scene, displacement):
    motion, environment = scene
    contacts = {"timestamps": motion.timestamps, "sliding": held_left(), "hinged": torch.zeros(FRAMES, 2)}
    captured = tracker()(motion, contacts, environment)
    near = objects_of(captured)["near"]
    moved = near.t_world_body[:, 0] - near.t_world_body[0, 0]
    torch.testing.assert_close(moved[TAKE:LEAVE], (displacement - displacement[TAKE])[TAKE:LEAVE], atol=1e-5, rtol=0)
    assert (moved[LEAVE:] == moved[LEAVE - 1]).all()
    assert len(objects_of(captured)["far"]) == 2
    assert held_of(captured).objects == ("near",)
    assert held_of(captured).hands.tolist() == [[True, False]]
    assert held_of(captured).start_s.item() == pytest.approx(TAKE / FPS)
    assert held_of(captured).stop_s.item() == pytest.approx(LEAVE / FPS)


def test_a_contact_of_a_class_without_an_object_in_reach_is_ignored(scene):
    motion, environment = scene
    contacts = {"timestamps": motion.timestamps, "hinged": held_left(), "sliding": torch.zeros(FRAMES, 2)}
    assert len(held_of(tracker()(motion, contacts, environment))) == 0


def test_a_hand_that_joins_keeps_the_object_and_is_a_new_interval(scene):
    motion, environment = scene
    both = held_left()
    both[120:180, 1] = 0.9  # the right palm is far from "near"
    contacts = {"timestamps": motion.timestamps, "sliding": both}
    captured = tracker()(motion, contacts, environment)
    assert held_of(captured).objects == ("near",) * 3
    steps = objects_of(captured)["near"].t_world_body.diff(dim=0).norm(dim=-1)
    assert steps.max() < 0.02


def test_the_less_probable_class_gives_way(scene):
    motion, environment = scene
    right = torch.zeros(FRAMES, 2)
    right[TAKE:LEAVE, 1] = 0.6
    contacts = {"timestamps": motion.timestamps, "hinged": right + 0.2 * (right > 0), "sliding": right}
    assert held_of(tracker()(motion, contacts, environment)).objects == ("door",)
    together = tracker(one_class=False)(motion, contacts, environment)
    assert "door" in held_of(together).objects


def test_a_hand_holds_one_thing_at_a_time(scene):
    """The class flickers: the gap in the one is filled, and the other does not take the hand meanwhile."""
    motion, environment = scene
    sliding = held_left()
    hinged = torch.zeros(FRAMES, 2)
    hinged[120:140, 0] = 0.95
    left = site_positions(motion.skeleton, motion.T_world_joint, PALMS)[120, 0]
    door = cube("left_door", left, Freedom("hinge", pivot=tuple((left + 0.4).tolist())))
    contacts = {"timestamps": motion.timestamps, "sliding": sliding, "hinged": hinged}
    captured = tracker(settle_s=0.0)(motion, contacts, Environment((*environment.objects, door)))
    assert held_of(captured).objects == ("near",)
    labels_of(held_of(captured), LabelClock.of("r", motion.timestamps))


def test_a_hand_that_moves_otherwise_than_the_object_can_does_not_hold_it(scene):
    """The wearer walks a metre towards the door's hinge: no hand on a door does that."""
    motion, environment = scene
    contacts = {"timestamps": motion.timestamps, "hinged": held_left().flip(1)}
    assert held_of(tracker()(motion, contacts, environment)).objects == ("door",)
    checked = tracker(slip_m=0.1)(motion, contacts, environment)
    held = held_of(checked)
    assert all(stop - start < 2.0 for start, stop in zip(held.start_s, held.stop_s))
    moving = (held.start_s > 1.6) & (held.stop_s < 3.3)
    assert not moving.any()
    sliding = {"timestamps": motion.timestamps, "sliding": held_left()}
    assert held_of(tracker(slip_m=0.1)(motion, sliding, environment)).stop_s.item() == pytest.approx(LEAVE / FPS)


def test_a_hand_that_leaves_the_surface_lets_go(scene):
    """The hand rises by half a metre before the network notices the release; what slides on the floor stays behind."""
    motion, environment = scene
    rise = 0.5 * ((torch.arange(FRAMES) - 200) / 30.0).clamp(0, 1)
    motion = replace(motion, t_world_root=motion.t_world_root + torch.nn.functional.pad(rise[:, None], (2, 0)))
    contacts = {"timestamps": motion.timestamps, "sliding": held_left()}
    (stop,) = held_of(tracker(slip_m=0.1)(motion, contacts, environment)).stop_s.tolist()
    assert 200 / FPS < stop < 215 / FPS


def test_what_is_touched_without_being_moved_stays_exactly(scene):
    motion, environment = scene
    drift = torch.linspace(0.0, 0.03, FRAMES)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    still = replace(motion, t_world_root=motion.t_world_root[:1] + drift)
    both = held_left()
    both[120:180, 1] = 0.9
    contacts = {"timestamps": motion.timestamps, "sliding": both}
    moved = objects_of(tracker()(still, contacts, environment))["near"].t_world_body
    assert (moved[-1] - moved[0]).norm() > 0.01
    kept = tracker(rest_m=0.05)(still, contacts, environment)
    assert (objects_of(kept)["near"].t_world_body.diff(dim=0) == 0).all()
    assert held_of(kept).objects == ("near",) * 3
    gone = objects_of(tracker(rest_m=0.05)(motion, contacts, environment))["near"].t_world_body
    assert (gone[-1] - gone[0]).norm() > 0.9


def test_of_objects_within_reach_the_one_that_can_move_so_is_taken(scene):
    """Both doors are as near; the hand goes round one's hinge. A class that is wrong but near gives way, too."""
    motion, environment = scene
    angle = 1.2 * ((torch.arange(FRAMES) - TAKE - 30) / 120.0).clamp(0, 1)
    left = site_positions(motion.skeleton, motion.T_world_joint, PALMS)[0, 0]
    path = torch.stack([0.8 * angle.sin(), 0.8 * (1 - angle.cos()), torch.zeros(FRAMES)], 1)
    motion = replace(motion, t_world_root=motion.t_world_root[:1] + path)
    place = left - torch.tensor([0.2, 0.0, 0.0])
    right = cube("right", place, Freedom("hinge", pivot=tuple((left + torch.tensor([0.0, 0.8, 0.0])).tolist())))
    wrong = cube("wrong", place, Freedom("hinge", pivot=tuple((left - torch.tensor([0.8, 0.0, 0.0])).tolist())))
    objects = Environment((wrong, right, replace(environment.objects[1], t_world_object=left + 3.0)))
    for classes in ({"hinged": 0.9, "sliding": 0.1}, {"hinged": 0.2, "sliding": 0.9}):
        contacts = {"timestamps": motion.timestamps} | {name: held_left() * p for name, p in classes.items()}
        captured = tracker(class_m=0.03)(motion, contacts, objects)
        assert held_of(captured).objects == ("right",)


def test_a_hand_may_come_within_reach_after_the_network_says_contact(scene):
    motion, environment = scene
    near = replace(
        environment.objects[0], t_world_object=environment.objects[0].t_world_object + torch.tensor([0.5, 0, 0])
    )
    contacts = {"timestamps": motion.timestamps, "sliding": held_left()}
    late = Environment((near,))
    assert len(held_of(tracker(reach_m=0.2)(motion, contacts, late))) == 0
    (start,) = held_of(tracker(reach_m=0.2, seek_s=3.0)(motion, contacts, late)).start_s.tolist()
    assert start > TAKE / FPS + 0.5


def test_captured_interactions_are_labels_on_an_uneven_clock(scene):
    motion, environment = scene
    uneven = motion.timestamps + 0.003 * torch.rand(FRAMES, generator=torch.Generator().manual_seed(0))
    motion = replace(motion, timestamps=uneven)
    both = held_left()
    both[120:180, 1] = 0.9
    held = held_of(tracker()(motion, {"timestamps": uneven, "sliding": both}, environment))
    assert len(held) == 3
    assert (held.stop_s[:-1] == held.start_s[1:]).all()
    labels = labels_of(held, LabelClock.of("r", uneven))
    assert [len(labels[hand]) for hand in ("left", "right")] == [1, 1]


def test_what_cannot_be_tracked_is_reported(scene):
    motion, environment = scene
    contacts = {"timestamps": motion.timestamps + 1e4, "sliding": held_left()}
    with pytest.raises(WearcapError, match="contacts at other times"):
        tracker()(motion, contacts, environment)
    for settings in ({"anchor": "left"}, {"reach_m": 0.0}):
        with pytest.raises(WearcapError, match="anchor"):
            AttachmentSettings(**settings)


def test_a_room_without_objects_and_a_motion_of_one_frame(scene):
    motion, environment = scene
    contacts = {"timestamps": motion.timestamps, "sliding": torch.ones(FRAMES, 2)}
    empty = ObjectTracker(SnapCorrection(), hands=HandSnapping())(motion, contacts, Environment(()))
    assert (len(held_of(empty)), objects_of(empty)) == (0, {})
    assert torch.equal(empty.t_world_root, motion.t_world_root)
    one = {name: value[:1] for name, value in contacts.items()}
    assert len(ObjectTracker(SnapCorrection(), hands=HandSnapping())(motion, one, environment)) == 1
    throughout = ObjectTracker(SnapCorrection(), hands=HandSnapping())(motion, contacts, environment)
    assert throughout.t_world_root.isfinite().all()
    assert held_of(throughout).stop_s[-1] == pytest.approx(FRAMES / FPS, abs=0.5)


def test_handlings_outside_of_the_capture_spoil_no_mean(scene, displacement):
    """A handling before the capture's first frame is not measured at its last one."""
    motion, environment = scene
    track = Trajectory(motion.timestamps, torch.eye(3).repeat(FRAMES, 1, 1), torch.zeros(FRAMES, 3))
    spans = torch.tensor([[0.1, 0.3], [2.0, 3.0]]).double()
    held = Interactions(
        spans[:, 0].contiguous(),
        spans[:, 1].contiguous(),
        torch.tensor([[True, False]] * 2),
        ("far", "near"),
        ("sliding",) * 2,
    )
    truth = Recording("r", motion=motion, interactions=held, object_motion={"near": track})
    late = baselines.static_objects(motion.sliced(60, FRAMES), environment)
    far = late.object_motion["far"]  # pyright: ignore[reportOptionalSubscript]
    far.t_world_body[-1] += 5.0
    scores = score_interactions(late, truth, environment)
    assert scores.handlings[0].end_cm == pytest.approx(0.0, abs=0.1)
    assert np.isnan(scores.handlings[0].hand_object_cm)
    assert np.isfinite(list(summary(scores.handlings).values())).all()
    assert np.isnan(summary([])["end_cm"])


class Registered(StagedSystem):
    """A registration without steps."""

    name = "registered"

    def stages(self, source):
        return []

    def motion_of(self, results):
        return None

    def report(self, source, results):
        return {}


def test_objects_are_tracked_again_when_a_mesh_changes_wherever_it_lies(scene, tmp_path):
    motion, environment = scene
    pipeline = IReplica(Registered(), dict, tracker(), environment=tmp_path)  # the folder, too, names the file
    keys = []
    for size in (1.0, 2.0):
        near, *others = environment.objects
        larger = replace(near, mesh=replace(near.mesh, vertices=size * near.mesh.vertices))
        write_environment(Environment((larger, *others)), tmp_path)
        (tmp_path / "objects").rename(tmp_path / f"meshes{size:.0f}")
        file = tmp_path / "environment.json"
        file.write_text(file.read_text().replace("objects/", f"meshes{size:.0f}/"))
        keys.append(digest(*pipeline.stages(CaptureInput(Recording("r", suit=motion)))[-1].reads()))
    assert keys[0] != keys[1]


def test_scores_tell_the_perfect_capture_from_the_static_one(scene, displacement):
    motion, environment = scene
    contacts = {"timestamps": motion.timestamps, "sliding": held_left()}
    captured = tracker()(motion, contacts, environment)
    held = Interactions(
        torch.tensor([TAKE / FPS]).double(),
        torch.tensor([LEAVE / FPS]).double(),
        torch.tensor([[True, False]]),
        ("near",),
        ("sliding",),
    )
    truth = Recording("r", motion=motion, interactions=held, object_motion={"near": objects_of(captured)["near"]})
    perfect = score_interactions(captured, truth, environment)
    assert perfect.handlings[0].end_cm == pytest.approx(0.0, abs=1e-3)
    assert perfect.handlings[0].hand_object_cm < 0.1
    still = score_interactions(baselines.static_objects(motion, environment), truth, environment)
    assert still.handlings[0].end_cm == pytest.approx(100.0, abs=0.5)
    assert still.handlings[0].hand_cm == pytest.approx(0.0, abs=1e-3)
    assert still.object_chamfer_cm > 5 > perfect.object_chamfer_cm
    line = score_interactions(
        baselines.interpolated_objects(motion, environment, held, truth.object_motion), truth, environment
    )
    assert line.handlings[0].end_cm < 0.1
    assert line.handlings[0].hand_object_cm > 2 * perfect.handlings[0].hand_object_cm
    near = score_interactions(baselines.held_when_near(tracker(), motion, environment), truth, environment)
    assert near.handlings[0].end_cm < 60


def test_objects_keep_their_own_clock(scene, displacement):
    motion, environment = scene
    track = Trajectory(motion.timestamps[[0, -1]], torch.eye(3).repeat(2, 1, 1), torch.zeros(2, 3))
    held = Interactions(torch.zeros(0).double(), torch.zeros(0).double(), torch.zeros(0, 2, dtype=torch.bool), (), ())
    truth = Recording("r", motion=motion, interactions=held, object_motion={"near": track})
    scores = score_interactions(baselines.static_objects(motion, environment), truth, environment)
    assert scores.handlings == ()
    assert scores.false_moves_cm == 0


@pytest.mark.parametrize("off", [(0.05, 0.08), (-0.1, 0.0)])
def test_the_wearer_is_snapped_onto_a_door_by_the_arc_of_the_hand(off):
    """A hand that turns with a door, registered some centimetres off, is put back on its circle about the hinge."""
    pivot, radius = torch.tensor([2.0, 1.0]).double(), 0.75
    angle = torch.linspace(0, 1.5, 200).double()
    true = pivot + radius * torch.stack([angle.cos(), angle.sin()], 1)
    wrong = true + torch.tensor(off).double()
    touch = torch.tensor([0.0, -off[1]]).double()  # the nearest point of the leaf tells one direction alone
    found = fit_about_hinge(wrong, pivot, touch, HingeFit())
    assert (found + torch.tensor(off)).norm() < 0.4 * torch.tensor(off).norm()


def test_corrections_move_the_wearer_to_the_object_and_back(scene):
    motion, environment = scene
    off = replace(motion, t_world_root=motion.t_world_root + torch.tensor([0.0, -0.3, 0.0]))
    contacts = {"timestamps": motion.timestamps, "sliding": held_left()}
    plain = tracker()(off, contacts, environment)
    snapped = replace(tracker(), correction=SnapCorrection(OffsetSettings(transition_s=0.8)))(
        off, contacts, environment
    )
    shift = (snapped.t_world_root - off.t_world_root)[:, 1]
    torch.testing.assert_close(shift[TAKE:LEAVE], torch.full((LEAVE - TAKE,), 0.1), atol=3e-3, rtol=0)
    assert shift[[0, -1]].abs().max() < 0.03
    assert shift.diff().abs().max() * FPS < 0.25
    nearest = environment.by_name("near")
    for captured, least, most in ((plain, 0.05, 0.2), (snapped, 0.0, 0.005)):
        palm = site_positions(captured.skeleton, captured.T_world_joint, PALMS)[TAKE:LEAVE, 0]
        T = objects_of(captured)[nearest.name].T_world_body[TAKE:LEAVE]
        distance, _ = environment.distance(nearest.name, palm, T)
        assert least <= distance.mean() < most


def test_the_papers_correction_runs_on_the_same_contacts(scene):
    motion, environment = scene
    off = replace(motion, t_world_root=motion.t_world_root + torch.tensor([0.0, -0.25, 0.0]))
    contacts = {"timestamps": motion.timestamps, "sliding": held_left()}
    correction = BendCorrection(partial(bend, settings=Bending(rigidity=1.0, clamped_ends=True), solver=bend_banded))
    captured = replace(tracker(), correction=correction)(off, contacts, environment)
    assert held_of(captured).objects == ("near",)
    assert captured.t_world_root.isfinite().all()


def test_hands_are_put_onto_what_they_hold_by_the_arms_alone(scene):
    motion, environment = scene
    bent = motion.R_parent_joint.clone()
    bent[:, motion.skeleton.index("left_elbow")] = about_axis("z", torch.tensor(-0.6))
    motion = replace(motion, R_parent_joint=bent)
    contacts = {"timestamps": motion.timestamps, "sliding": held_left()}
    plain = tracker()(motion, contacts, environment)
    snapped = replace(tracker(), hands=HandSnapping())(motion, contacts, environment)
    nearest = environment.by_name("near")
    T = objects_of(snapped)[nearest.name].T_world_body[TAKE:LEAVE]
    apart = []
    for captured in (plain, snapped):
        palm = site_positions(captured.skeleton, captured.T_world_joint, PALMS)[TAKE:LEAVE, 0]
        apart.append(environment.distance(nearest.name, palm, T)[0].mean())
    assert apart[1] < 0.004 < 0.05 < apart[0]
    joints = [captured.T_world_joint for captured in (plain, snapped)]
    wrist, elbow = motion.skeleton.indices("left_wrist", "left_elbow")
    torch.testing.assert_close(joints[0].R[:, wrist], joints[1].R[:, wrist], atol=1e-5, rtol=0)
    others = [j for j in range(len(motion.skeleton)) if j not in (wrist, elbow)]
    torch.testing.assert_close(joints[0].t[:, others], joints[1].t[:, others])
    assert (joints[1].t - joints[0].t).diff(dim=0).diff(dim=0).abs().max() < 0.004


def detected(motion: Motion, tmp_path, **settings) -> IReplica:
    """A pipeline with a detector's file: a left hand in contact in every third picture while it holds."""
    row = [10, 10, 60, 60, 0.9, 3, 0.0, 1.0, 0.1, 0]
    pictures = [{"frame": k + 1, "hand_dets": [row] if TAKE <= k < LEAVE else None} for k in range(0, FRAMES, 3)]
    (tmp_path / "r.json").write_text(json.dumps(pictures))
    given = {"segmentation": None, "first_picture": 1, "hold_s": 0.1, "min_score": 0.5} | settings
    return IReplica(Registered(), None, tracker(), DetectedContacts(tmp_path, **given), fps=FPS)


def test_a_pipeline_without_a_network_exports_nothing():
    with pytest.raises(WearcapError, match="0 contact networks"):
        IReplica(Registered(), None, tracker(), None).exports()


def filmed(motion: Motion) -> Recording:
    camera = Camera.pinhole(640, 480, 70.0)
    return Recording("r", suit=motion, camera=CameraStream(motion.timestamps, camera, torch.eye(3), torch.zeros(3)))


def test_contacts_detected_in_pictures_move_the_nearest_object_of_any_class(scene, displacement, tmp_path):
    motion, environment = scene
    pipeline = detected(motion, tmp_path)
    contacts = pipeline.contacts(filmed(motion))
    captured = pipeline.interact(motion, contacts, environment)
    assert held_of(captured).objects == ("near",)
    assert held_of(captured).classes == ("sliding",)
    assert held_of(captured).start_s.item() == pytest.approx(TAKE / FPS, abs=0.11)
    assert held_of(captured).stop_s.item() == pytest.approx(LEAVE / FPS, abs=0.11)
    right = {"timestamps": motion.timestamps, UNKNOWN_CLASS: held_left().flip(1)}
    assert held_of(tracker()(motion, right, environment)).classes == ("hinged",), "the door is at the right hand"


def test_pictures_without_a_hand_end_a_contact_only_after_a_while(scene, tmp_path):
    motion, _ = scene
    short = detected(motion, tmp_path, hold_s=0.01).contacts(filmed(motion))[UNKNOWN_CLASS]
    assert 0 < (short[TAKE:LEAVE, 0] > 0).float().mean() < 0.5, "only the pictures themselves"
    whole = detected(motion, tmp_path).contacts(filmed(motion))[UNKNOWN_CLASS]
    assert (whole[TAKE:LEAVE, 0] > 0.5).all()
    assert not whole[:, 1].any()


def test_detections_of_another_recording_are_refused(scene, tmp_path):
    motion, _ = scene
    with pytest.raises(WearcapError, match="pictures 1 to 358"):
        detected(motion, tmp_path, first_picture=0).contacts(filmed(motion.sliced(0, 100)))
    with pytest.raises(WearcapError, match="no camera"):
        detected(motion, tmp_path).contacts(Recording("r", suit=motion))
    with pytest.raises(WearcapError, match="no detections for s"):
        detected(motion, tmp_path).contacts(replace(filmed(motion), name="s"))


def test_what_a_missed_contact_moved_is_found_where_it_is_touched(scene, displacement):
    """A drawer was pulled by half a metre unseen; the next hand on it says where it is, if it then follows the hand."""
    motion, _ = scene
    left = site_positions(motion.skeleton, motion.T_world_joint, PALMS)[0, 0]
    along = Freedom("axis", axis=(1.0, 0.0, 0.0), limits=(0.0, 1.6))
    drawer = cube(
        "drawer", left + torch.tensor([0.2 - 0.5 - 0.4, 0.0, 0.0]), along
    )  # its far face was left of the hand
    contacts = {"timestamps": motion.timestamps, "sliding": held_left(), "hinged": torch.zeros(FRAMES, 2)}
    rules = {"slip_m": 0.15, "rest_m": 0.06, "reach_m": 0.2}
    assert len(held_of(tracker(**rules)(motion, contacts, Environment((drawer,))))) == 0
    captured = tracker(found_m=0.1, **rules)(motion, contacts, Environment((drawer,)))
    assert held_of(captured).objects == ("drawer",)
    track = objects_of(captured)["drawer"].t_world_body[:, 0]
    torch.testing.assert_close(
        track[LEAVE - 1] - track[TAKE], (displacement[LEAVE - 1] - displacement[TAKE]).float(), atol=1e-3, rtol=0
    )
    assert abs(track[TAKE] + 0.2 - left[0]) < 0.04  # the nearest face that reaches the hand
    still = {**contacts, "sliding": held_left()}
    still["sliding"][TAKE + 20 : LEAVE] = 0.0  # a touch that moves nothing finds nothing
    assert len(held_of(tracker(found_m=0.1, **rules)(motion, still, Environment((drawer,))))) == 0
