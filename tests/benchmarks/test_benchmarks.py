"""Tables measure what they claim, and rivals see as much as ours."""

import argparse
import json
import math
from dataclasses import replace

import pytest
import torch

from benchmarks.rivals import compose
from benchmarks.speed import latent_optimisation_vs_best_adam as clocks
from benchmarks.tables import echo as tables_echo
from benchmarks.tables import gait_statistics as gait
from benchmarks.tables import hmd2 as tables_hmd2
from benchmarks.tables import mocap_every as tables
from benchmarks.tables import tabling
from benchmarks.tables.hmd2_runs import Result, best_of
from benchmarks.tables.sensed import GIVEN, WRONG_HEIGHTS, SensedStore, sensed
from normal_walk import walk
from wearcap.geometry.rotation import about_axis
from wearcap.metrics.gait import normal_knee_deg
from wearcap.recording import Motion


def test_a_row_prints_what_its_training_took(tmp_path, trusted):
    from wearcap.models.checkpoint import read_checkpoint

    took = tabling.training_of("hmd2")
    assert [*took, "rate_swept", "trainings"] == list(tabling.TRAINING), (
        "no rate of it was swept, and it is one training"
    )
    assert 5 < took["parameters_m"].mean < 7
    assert "training" in read_checkpoint("hmd2")[0] or str(took["frames_seen_m"]) == "not recorded"
    record = {"parameters": 2_500_000, "frames": 13_824_000, "core_seconds": 1815.0}
    config = json.dumps({"model": {}, "training": record})
    torch.save({"wearcap": {"config": config}, "state_dict": {"net.weight": torch.zeros(2)}}, tmp_path / "run.ckpt")
    took = tabling.training_of(str(tmp_path / "run.ckpt"))
    assert [str(value) for value in took.values()] == ["2.50", "13.82", "30.25"]
    on_gpu = json.dumps({"model": {}, "training": record | {"machine": "x86_64, 1 threads, NVIDIA H200"}})
    torch.save({"wearcap": {"config": on_gpu}, "state_dict": {"net.weight": torch.zeros(2)}}, tmp_path / "gpu.ckpt")
    assert str(tabling.training_of(str(tmp_path / "gpu.ckpt"))["core_minutes"]) == "not recorded"
    assert tabling.training_of(str(tmp_path / "run.ckpt"), "seed_1.ckpt", "seed_2.ckpt")["trainings"].mean == 3


def test_adams_clock_stops_at_equal_energy_and_says_where_it_never_gets_there():
    goal = torch.linspace(-1, 1, 48).reshape(2, 4, 6)
    problem = clocks.Problem(torch.zeros(2, 4, 6), lambda z: {"bowl": (z - goal).square().sum((1, 2))})
    schedule, solver = clocks.Schedule(0.1, 60), clocks.LatentSolver(steps=30)
    whole = clocks.adam(problem, schedule, 300)
    assert len(whole) == 61
    stopped = clocks.adam(problem, schedule, 300, target=1.0)
    assert stopped[-1].energy <= 1.001 < stopped[-2].energy
    assert clocks.ours(problem, solver, 1.0).energy <= 1.001

    def figure(schedule: clocks.Schedule, budget: int) -> dict:
        pair = clocks.ours(problem, solver, 1.0), clocks.adam(problem, schedule, budget, 1.0)[-1]
        return clocks.compared("bowl", [pair], 1.0, schedule, None)

    reached = figure(schedule, 300)
    assert "lower bound" not in reached["unit"]
    assert reached["ratio"] == pytest.approx(reached["baseline"] / reached["value"])
    slow = figure(clocks.Schedule(1e-5, None), 10)
    assert "Adam does not reach 1.0000: its time is a lower bound" in slow["unit"]


def test_sensed_stores_hold_no_truth_and_lend_it_to_scores(tmp_path):
    from watched_walk import watched_walk
    from wearcap.recording import RecordingStore

    recording = watched_walk(2.0)
    RecordingStore(tmp_path).add(recording, split="test", config_hash="")
    stores = {name: SensedStore.open(tmp_path, name) for name in ("typical", "poor", GIVEN)}
    found = {name: store.load(recording.name) for name, store in stores.items()}
    assert found[GIVEN].motion is not None
    for name in ("typical", "poor"):
        assert found[name].motion is None
        assert found[name].floor is None
        assert stores[name].true(recording.name).motion is not None
    off = {name: each.head.t_world_device - found[GIVEN].head.t_world_device for name, each in found.items()}
    assert 0 < off["typical"].norm(dim=-1).mean() < off["poor"].norm(dim=-1).mean()
    again = SensedStore.open(tmp_path, "typical").load(recording.name)
    assert torch.equal(again.head.t_world_device, found["typical"].head.t_world_device)


@pytest.mark.parametrize("sensors", ["typical", "given"])
def test_a_wrong_height_is_off_by_as_much_whatever_is_sensed_and_the_truth_stays(sensors):
    from watched_walk import watched_walk

    recording = watched_walk(1.0)
    assert recording.motion is not None
    true = recording.motion.skeleton.stature
    for off in WRONG_HEIGHTS.values():
        given = sensed(recording, sensors, off)
        assert given.skeleton.stature == pytest.approx(true + off, abs=1e-4)
        assert (given.motion is None) == (sensors == "typical")
        if given.motion is not None:
            assert given.motion.skeleton.stature == pytest.approx(true)
    assert sorted(WRONG_HEIGHTS.values()) == [-0.03, 0.03]


def test_best_samples_are_chosen_by_recording():
    from wearcap.metrics.table import Row, aggregate

    errors = {("a", 0): (3.0, 9.0), ("a", 1): (2.0, 8.0), ("b", 0): (4.0, 5.0), ("b", 1): (6.0, 1.0)}
    rows = [Row(name, seed, 10, {"mpjpe_cm": e, "hand_pe_cm": hand}) for (name, seed), (e, hand) in errors.items()]
    best = aggregate(best_of(rows))
    assert best["mpjpe_cm"].mean == 3.0
    assert best["hand_pe_cm"].mean == 6.5  # of the samples with the least MPJPE, not the best hands


def test_scenarios_are_where_ours_is_best_in_the_middle_and_worst():
    from wearcap.metrics.table import Summary

    def scores(value: float) -> dict[str, Summary]:
        return {name: Summary(value, None, 1) for name in tables_hmd2.PARTS}

    ours = Result(tables_hmd2.OURS, {}, {"walk": scores(3.0), "sit": scores(7.0), "run": scores(5.0)})
    other = Result("mean pose", {}, {"walk": scores(9.0), "sit": scores(8.0), "run": scores(1.0)})
    found = tables_hmd2._scenarios([other, ours])
    titles = [title.rpartition(", ")[2] for title in found]
    assert titles == ["walk", "run", "sit"]
    first = next(iter(found.values()))
    assert first["mean pose"]["hand_pe_cm"].mean == 9.0
    assert tables_hmd2._scenarios([other]) == {}


def test_hmd2_tables_write_tails_scenarios_and_sweeps_on_validation(tmp_path, monkeypatch, capsys):
    from watched_walk import watched_walk
    from wearcap.metrics.table import Summary
    from wearcap.recording import RecordingStore

    store, seen = RecordingStore(tmp_path / "walks"), {}
    for split in ("val", "test"):
        store.add(replace(watched_walk(1.0), name=f"walk_{split}"), split=split, config_hash="")

    def run_method(method, case):
        seen[method.name] = method.sensors or case.sensors, case.names
        names = [*tables_hmd2.COLUMNS, *tables_hmd2.PARTS, *tables_hmd2.TAIL, "truth_physicality"]
        scores = {name: Summary(0.00123, 0.0001, 2) for name in names}
        return Result(method.name, scores, {"walk": scores})

    monkeypatch.setattr(tables_hmd2, "run_method", run_method)
    monkeypatch.setattr(tables_hmd2, "_exists", lambda checkpoint: True)
    parser = argparse.ArgumentParser()
    tables_hmd2.add_arguments(parser)
    arguments = ["--dataset", str(tmp_path / "walks"), "--jobs", "1", "--strides", "60", "--steps", "5"]
    options = parser.parse_args(
        [*arguments, "--sensors", "poor"], argparse.Namespace(quick=False, leave=[], output=tmp_path)
    )
    tree = json.loads(tables_hmd2.tables(options, {}).read_text())
    assert tree["about"]["sensors"] == "poor"
    assert set(tree["tables"]) == {tables_hmd2.FIRST, "Table 6.5: latency", "Table 6.7: steps"}
    assert seen["full"] == ("poor", ("walk_test",))
    assert seen["full, typical sensors"][0] == "typical"
    assert seen["AvatarPoser-style (head and hands)"][0] == GIVEN
    assert seen["5 steps"] == ("poor", ("walk_val",))
    assert tree["percentiles"]["full"]["p95_hand_pe_cm"]["mean"] == 0.00123
    assert len(tree["scenarios"]) == 3
    shown = capsys.readouterr().out
    assert "0.0012" in shown
    assert "truth" in shown
    assert "Table 6.10" in shown


@pytest.mark.parametrize("keep", [None, "before it"])
def test_hmd2_strangers_are_captured_from_the_head_alone(keep, tmp_path, monkeypatch):
    from watched_walk import watched_walk
    from wearcap.metrics.table import Summary
    from wearcap.recording import RecordingStore

    RecordingStore(tmp_path / "walks").add(watched_walk(1.0), split="test", config_hash="")
    seen = {}

    def run_method(method, case):
        seen[method.name] = method.sensors or case.sensors, method.height_off_m, case.dataset.name
        assert (
            method.checkpoint is None
            or "pipeline.use=[]" in method.pipeline
            or not method.name.startswith("head alone,")
            or method.name == tables_hmd2.BRIEF
        )
        return Result(method.name, {"mpjpe_cm": Summary(9.0, None, 1), "truth_physicality": Summary(0.5, None, 1)}, {})

    monkeypatch.setattr(tables_hmd2, "run_method", run_method)
    monkeypatch.setattr(tables_hmd2, "_exists", lambda checkpoint: True)
    parser = argparse.ArgumentParser()
    tables_hmd2.add_arguments(parser)
    arguments = ["--strangers", str(tmp_path / "walks"), "--jobs", "1", *(["--keep", keep] if keep else [])]
    options = parser.parse_args(arguments, argparse.Namespace(quick=False, leave=["nearest window"], output=tmp_path))
    path = tables_hmd2.tables(options, {})
    assert path.name == "hmd2_people.json"
    (title, rows), *others = json.loads(path.read_text())["tables"].items()
    assert not others
    assert title.startswith("before it, People (walks):" if keep else "People (walks):")
    assert rows["truth"] == {"physicality": {"mean": 0.5, "std": None, "seeds": 1}}
    assert set(rows) == {*seen, "truth"}
    assert "nearest window" not in rows, "it stays as it was published"
    assert ("mean pose" in rows) == ("EgoAllo-style" in rows) == (tables_hmd2.BRIEF in rows) == (keep is None)
    assert seen["head alone"] == ("typical", None, "walks")
    assert seen["head alone, 3 cm too short"] == ("typical", -0.03, "walks")
    assert seen["head alone, exact sensors, bones given"] == (GIVEN, None, "walks")


def frames_of(overrides: list[str]) -> tuple[str, int]:
    """Name of a training, and the frames of all windows that it draws."""
    config = compose("train", overrides)
    batches = config.trainer.max_steps * config.data.loading.batch_size
    assert config.early_stop == 3
    assert config.trainer.precision == "bf16-mixed"
    return config.name, batches * config.data.dataset.window


def test_learned_rivals_of_hmd2_see_as_many_frames_as_ours():
    for run in tables_hmd2.RUNS:
        name, frames = frames_of(tables_hmd2.training(run))
        assert name == run
        if run.startswith("avatarposer"):  # of 240 frames drawn, its two pairs of poses see 41 each
            frames = frames * tables_hmd2.WINDOW[run] // 240
        assert frames == pytest.approx(tables_hmd2.BUDGET, rel=0.02)


def test_learned_rivals_of_echo_see_as_many_frames_as_ours():
    _, ours = frames_of(tables_echo.training("echo_short"))
    for run in tables_echo.TRAININGS:
        assert frames_of(tables_echo.training(run))[1] == pytest.approx(ours, rel=0.05), run


def test_learned_rivals_of_mocap_every_see_as_many_frames_as_ours():
    assert len({frames_of(tables.training(run))[1] for run in tables.RUNS}) == 1


def test_dominant_frequency_finds_a_planted_one():
    t = torch.arange(gait.WINDOW) / gait.FPS
    waves = torch.stack([3 + torch.sin(2 * math.pi * f * t + f) for f in (0.7, 0.95, 1.2)])
    assert gait.dominant_frequency(waves).tolist() == pytest.approx([0.7, 0.95, 1.2], abs=0.015)
    assert gait.peak_to_peak(waves[:1] + 5 * t).item() == pytest.approx(2.0, abs=0.3)


def walker(speed: float, person: str, seconds: int = 6, bob: float = 0.03, swing: float = 0.2):
    """A clip of someone whose pelvis bobs and whose legs swing in antiphase."""
    t = torch.arange(seconds * gait.FPS) / gait.FPS
    phase = 2 * math.pi * 0.9 * t
    pelvis = torch.stack([speed * t, 0.02 * phase.sin(), 0.95 + bob / 2 * (2 * phase).cos()], -1)
    joints = {}
    for name in gait.JOINTS:
        side = {"left": 1.0, "right": -1.0}.get(name.split("_")[0], 0.0)
        drop = {"head": -0.6, "knee": 0.45, "ankle": 0.9, "toe": 0.95, "shoulder": -0.45, "wrist": 0.1}
        down = drop.get(name.split("_")[-1], 0.0)
        offset = torch.stack([side * swing * max(down, 0.0) * phase.sin(), 0 * t + 0.1 * side, 0 * t - down], -1)
        joints[name] = pelvis + offset
    return gait.Clip(person, joints, torch.eye(3).expand(len(t), 3, 3), torch.zeros(len(t)), 1.55)


def test_gait_statistics_of_a_planted_walk():
    found = gait.statistics(walker(1.25, "a"))
    assert len(found["speed_m_s"]) == 5
    assert found["speed_m_s"].mean().item() == pytest.approx(1.25, abs=0.01)
    assert found["cadence_steps_min"].mean().item() == pytest.approx(108, abs=2)
    assert found["pelvis_vertical_cm"].mean().item() == pytest.approx(3.0, abs=0.15)
    assert found["pelvis_lateral_cm"].mean().item() == pytest.approx(4.0, abs=0.4)
    assert found["head_height_share"].mean().item() == pytest.approx(1.0, abs=0.01)
    assert not gait.is_walking(walker(0.2, "b")).any()
    assert not gait.is_walking(walker(1.2, "b", bob=0.2)).any()


def bent_walk(hip_deg: float, ankle_deg: float, speed: float) -> Motion:
    """A walk with normal knees whose thighs are flexed and whose feet are drawn up by constant angles."""
    motion = walk(speed=speed)
    R = motion.R_parent_joint.clone()
    for side in ("left", "right"):
        R[:, motion.skeleton.index(f"{side}_hip")] = about_axis("y", -torch.tensor(math.radians(hip_deg)))
        R[:, motion.skeleton.index(f"{side}_ankle")] = about_axis("y", -torch.tensor(math.radians(ankle_deg)))
    return replace(motion, R_parent_joint=R)


def test_curves_of_walking_are_those_of_the_joints():
    curves = gait.walking_curves(bent_walk(12.0, 7.0, 1.1))
    assert len(curves["knee"]) == len(curves["speed"]) > 8
    assert curves["speed"].numpy() == pytest.approx(1.1, abs=1e-3)
    assert (curves["knee"] - normal_knee_deg()).abs().max() < 1.5
    assert curves["hip"].numpy() == pytest.approx(12.0, abs=0.01)
    assert curves["ankle"].numpy() == pytest.approx(7.0, abs=0.01)


def test_curves_are_compared_with_healthy_adults_by_speed():
    rows = gait.curve_deviations([bent_walk(0.0, 0.0, 1.1), bent_walk(0.0, 0.0, 1.3), bent_walk(6.0, 0.0, 1.35)])
    assert {name: row["recordings"] for name, row in rows.items()} == {"0.95 to 1.2 m/s": 1, "1.2 to 1.45 m/s": 2}
    slow = rows["0.95 to 1.2 m/s"]
    hip = gait.normal_curves()["hip"]
    assert hip.amin() == pytest.approx(-20, abs=1)
    assert hip.amax() == pytest.approx(25, abs=1)
    assert slow["hip_rms_deg"] == pytest.approx(hip.square().mean().sqrt().item(), abs=0.05)
    assert slow["knee_rms_deg"] == pytest.approx(slow["worst_knee_deg"], abs=1e-9)
    assert slow["knee_rms_deg"] < 1.0


def test_cycles_with_a_flight_are_no_walk():
    motion = bent_walk(0.0, 0.0, 1.1)
    contact = torch.ones(len(motion), 4)
    assert len(gait.walking_curves(replace(motion, contact_prob=contact))["knee"]) > 8
    contact[::5] = 0.0
    assert len(gait.walking_curves(replace(motion, contact_prob=contact))["knee"]) == 0
