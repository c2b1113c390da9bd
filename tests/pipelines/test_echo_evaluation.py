"""ECHO's scores and its baselines: the truth is perfect, what is wrong is wrong by as much, and baselines find their
like."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.rivals import echo_baselines as baselines
from benchmarks.tables import echo_rows as rows
from carried_box import GRIP, WINDOW, boxes, carried_dataset, carrying, drawn_echo, scenario_of, small_features
from wearcap.data.windows import Source, Windows
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.environment import write_environment
from wearcap.metrics.objects import vertex_error_cm
from wearcap.recording import RecordingStore
from wearcap.runtime.system import CaptureInput
from wearcap.systems.echo.features import CONTACTS
from wearcap.systems.echo.model import MODALITIES
from wearcap.systems.echo.observations import batch_item_of
from wearcap.systems.echo.scores import score_echo, truth_of
from wearcap.systems.echo.training_windows import EchoContent
from wearcap.tracking.head_path import head_path

RECORDING = carrying(1.5)
TIMES = RECORDING.motion.timestamps


@pytest.fixture(scope="module")
def scenario():
    return scenario_of(RECORDING)


@pytest.fixture(scope="module")
def truth(scenario):
    return truth_of(scenario, TIMES, drawn_echo().reader())


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Windows:
    root = carried_dataset(tmp_path_factory.mktemp("carried"))
    content = EchoContent(small_features(), None)
    return Windows([Source(root)], "train", content=content, window=WINDOW, stride=4, fps=30.0, every=None)


def perfect(truth):
    return replace(truth.motion, object_motion=RECORDING.object_motion, body_contact_prob=truth.touch.float())


def test_the_truth_is_perfect(truth):
    scores = score_echo(perfect(truth), truth, "a", 0).scores
    zero = ("mpjpe_mm", "mpjve_mm", "v2v_cm", "center_cm", "rotation_deg", "quaternion", "busy_mpjpe_mm")
    for name in (*zero, "symmetric_rotation_deg", "symmetric_v2v_cm", "add_s_cm"):
        assert scores[name] == pytest.approx(0.0, abs=0.05), name
    assert scores["touch_f1"] == 1.0
    for name in ("foot_contact", "jitter_m_s3", "foot_skate_cm_s", "physicality", "floor_penetration_cm"):
        assert scores[name] == pytest.approx(scores[f"truth_{name}"], nan_ok=True), name
    assert scores["foot_contact"] > 0


def test_what_is_wrong_is_wrong_by_as_much(truth):
    motion = perfect(truth)
    track = RECORDING.object_motion["box_1"]
    shifted = Trajectory(track.timestamps, track.R_world_body, track.t_world_body + torch.tensor([0.03, 0.0, 0.04]))
    moved = replace(motion, t_world_root=motion.t_world_root + 0.1, object_motion={"box_1": shifted})
    scores = score_echo(moved, truth, "a", 0).scores
    assert scores["mpjpe_mm"] == pytest.approx(100 * 3**0.5, rel=1e-3)
    assert scores["mpjve_mm"] == pytest.approx(0.0, abs=0.01)
    assert scores["v2v_cm"] == pytest.approx(5.0, rel=1e-3)
    assert scores["center_cm"] == pytest.approx(5.0, rel=1e-3)
    assert scores["rotation_deg"] == pytest.approx(0.0, abs=0.05)
    assert 0 < scores["add_s_cm"] < scores["v2v_cm"]


def test_a_box_that_is_turned_over_is_a_box(truth):
    track = RECORDING.object_motion["box_1"]
    flipped = truth.objects[0].centred(track.T_world_body) @ Rigid(
        torch.diag(torch.tensor([-1.0, -1, 1])), torch.zeros(3)
    )
    pose = truth.objects[0].of_mesh(flipped)
    motion = replace(perfect(truth), object_motion={"box_1": Trajectory(track.timestamps, pose.R, pose.t)})
    scores = score_echo(motion, truth, "a", 0).scores
    assert scores["rotation_deg"] == pytest.approx(180.0, abs=0.1)
    assert scores["v2v_cm"] > 10
    assert scores["symmetric_rotation_deg"] == pytest.approx(0.0, abs=0.1)
    assert scores["add_s_cm"] == pytest.approx(0.0, abs=0.05)


def test_doors_and_loose_objects_are_scored_by_themselves_too(truth):
    track = RECORDING.object_motion["box_1"]
    shifted = Trajectory(track.timestamps, track.R_world_body, track.t_world_body + torch.tensor([0.03, 0.0, 0.04]))
    moved = replace(perfect(truth), object_motion={"box_1": shifted})
    loose = score_echo(moved, truth, "a", 0).scores
    assert loose["loose_center_cm"] == pytest.approx(5.0, rel=1e-3)
    assert loose["loose_symmetric_v2v_cm"] == loose["symmetric_v2v_cm"]
    assert "fastened_center_cm" not in loose
    door = replace(truth, objects=[replace(truth.objects[0], category="door")])
    fastened = score_echo(moved, door, "a", 0).scores
    assert fastened["fastened_center_cm"] == pytest.approx(5.0, rel=1e-3)
    assert "loose_center_cm" not in fastened


def test_objects_count_while_they_are_active_alone(truth):
    track, busy = RECORDING.object_motion["box_1"], truth.active >= 0
    assert busy.any()
    assert not busy.all()
    away = torch.where(busy[:, None], track.t_world_body, 9.0)
    moved = replace(perfect(truth), object_motion={"box_1": Trajectory(track.timestamps, track.R_world_body, away)})
    assert score_echo(moved, truth, "a", 0).scores["v2v_cm"] == pytest.approx(0.0, abs=0.05)


def test_a_human_alone_has_no_scores_of_objects():
    recording = carrying(1.0, carried=())
    alone = truth_of(scenario_of(recording), recording.motion.timestamps, drawn_echo().reader())
    scores = score_echo(alone.motion, alone, "a", 0).scores
    assert "v2v_cm" not in scores
    assert "touch_f1" not in scores


def test_touch_that_is_never_found_scores_nothing_and_of_a_human_alone_there_is_no_score(truth):
    never = replace(perfect(truth), body_contact_prob=torch.zeros_like(truth.touch, dtype=torch.float32))
    assert score_echo(never, truth, "a", 0).scores["touch_f1"] == 0.0
    assert "touch_f1" not in score_echo(replace(never, object_motion=None), truth, "a", 0).scores


def test_truth_is_read_at_a_captures_own_times(truth, scenario):
    fine = torch.arange(0.0, 1.2, 0.01, dtype=torch.float64)
    other = truth_of(scenario, fine, drawn_echo().reader())
    assert len(other.motion) == len(fine) == len(other.touch)
    torch.testing.assert_close(other.T_world_object[0].t[::10], truth.T_world_object[0].t[:36:3], atol=1e-4, rtol=0)


@pytest.mark.parametrize("missing", ["motion", "object_motion"])
def test_without_a_truth_there_is_nothing_to_compare_with(scenario, missing):
    nothing = replace(RECORDING, **{missing: None if missing == "motion" else {}})
    with pytest.raises(WearcapError, match="carry: no true .*Expected"):
        truth_of(replace(scenario, recording=nothing), TIMES, drawn_echo().reader())


@pytest.mark.parametrize("modality", MODALITIES)
@pytest.mark.parametrize("share", [0.1, 1.0])
def test_a_share_of_the_truth_is_observed(truth, scenario, modality, share):
    seen = rows.observed_share(truth, modality, share, seed=1)
    echo = drawn_echo()
    item = batch_item_of(
        replace(scenario, observed=seen), head_path(RECORDING, echo.model.skeleton, echo.fps), echo.reader()
    )
    observed_parts, place = item.conditioning.is_observed[0], MODALITIES.index(modality)
    assert not observed_parts[:, [k for k in range(3) if k != place]].any()
    if share == 1.0:
        active = item.conditioning.has_object[0]
        assert torch.equal(observed_parts[:, place], active if modality == "object" else torch.ones_like(active))
    elif modality != "object":
        assert observed_parts[:, place].sum() == round(share * len(TIMES))
    other = rows.observed_share(truth, modality, share, seed=1)
    assert str(other) == str(seen)
    if modality == "contact":
        assert seen.contact.shape[1] == CONTACTS


def test_an_unknown_modality_is_refused(truth):
    with pytest.raises(WearcapError, match="no modality 'smell'. Expected one of human, object, contact"):
        rows.observed_share(truth, "smell", 0.1, 0)


def test_a_data_set_brings_its_objects(dataset):
    store = dataset.recordings[0].store
    echo = drawn_echo()
    sources = [CaptureInput(store.load(name), store.root) for name in ("c0", "c1")]
    motions = [captured.motion for captured in echo.capture(sources, [0, 0])]
    assert [set(motion.object_motion) for motion in motions] == [{"box_1"}] * 2
    row = echo.score(motions[0], sources[0], 0)
    assert {"v2v_cm", "mpjpe_mm"} <= set(row.scores)
    assert echo.objects(CaptureInput(replace(sources[0].recording, environment=None), store.root)) is None
    given = drawn_echo(environment=str(store.root / "scene"))
    assert given.objects(CaptureInput(sources[0].recording, Path("elsewhere"))).by_name("box_1") is not None


def test_the_nearest_window_of_what_was_seen_is_itself(dataset):
    nearest = baselines.NearestEcho.fit(dataset, window=12, stride=1)
    recording = replace(dataset.recordings[0].store.load("c0"), name="again")
    motion = nearest.capture_scenarios([scenario_of(recording, margin_s=2.0)], [0])[0]
    away = (motion.T_world_joint.t - recording.motion.T_world_joint.t).norm(dim=-1)
    assert away.mean() < 0.03
    found, true = motion.object_motion["box_1"], recording.object_motion["box_1"]
    assert (found.t_world_body - true.t_world_body).norm(dim=-1).mean() < 0.03


def test_an_object_is_stuck_to_the_wrist_that_carried_it(dataset):
    stuck = baselines.RigidWrist.fit(dataset)
    echo, recording = drawn_echo(), carrying(1.5)
    scenario = scenario_of(recording, margin_s=2.0)
    item = batch_item_of(scenario, head_path(recording, echo.model.skeleton, echo.fps), echo.reader())
    motion = stuck.attached(recording.motion, item)
    found, true = motion.object_motion["box_1"], recording.object_motion["box_1"]
    wrist = recording.motion.joint("left_wrist").t
    assert (found.t_world_body - wrist).norm(dim=-1).max() < 0.4
    error = vertex_error_cm(found.T_world_body, true.T_world_body, torch.zeros(1, 3))
    assert error.mean() < 20
    assert GRIP.t.norm() > 0.05


def test_baselines_are_functions_of_the_training_split_alone(dataset):
    one, two = (baselines.NearestEcho.fit(dataset, window=12) for _ in range(2))
    assert torch.equal(one.outputs, two.outputs)
    assert set(one.descriptor) == {"box"}
    np.testing.assert_array_equal(one.frames["box"].numpy(), two.frames["box"].numpy())
    assert RecordingStore.open(dataset.recordings[0].store.root).names("train") == ["c0"]
    assert len(boxes()) == 1


def test_few_environments_stay_in_memory(tmp_path):
    """Of a data set in which each recording has its own objects only the last few are kept, and scores are the same."""
    echo, motion = drawn_echo(), perfect(truth_of(scenario_of(RECORDING), TIMES, drawn_echo().reader()))
    scores = []
    for number in range(20):
        folder = tmp_path / f"{number}"
        write_environment(boxes(), folder)
        recording = replace(RECORDING, environment=f"{number}/environment.json")
        scores.append(echo.score(motion, CaptureInput.in_dataset(recording, tmp_path), 0).scores["v2v_cm"])
        assert len(echo._environments) <= 16
    assert scores == [pytest.approx(0.0, abs=0.05)] * 20
