"""Scores of whole motions, their aggregation, and the tables."""

import io
import json
import math
from dataclasses import replace

import pytest
import torch
from rich.console import Console

from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.errors import WearcapError
from wearcap.evaluation.breakdown import part_table
from wearcap.geometry import rotation
from wearcap.metrics import physics, table
from wearcap.metrics.table import Row, Summary
from wearcap.recording import Motion


def wobbling(frames: int = 120, fps: float = 60.0, seed: int = 0) -> Motion:
    """A body that walks ahead while its joints swing."""
    generator = torch.Generator().manual_seed(seed)
    t = torch.arange(frames, dtype=torch.float64) / fps
    swing = 0.3 * torch.randn(23, 3, generator=generator)
    rotvec = torch.sin(2 * math.pi * t.float())[:, None, None] * swing
    root = torch.stack([1.2 * t, 0.05 * torch.sin(6 * t), 0.95 + 0.03 * torch.cos(12 * t)], -1).float()
    return Motion(t, xsens23(), rotation.exp(rotvec), root)


def test_scores_of_the_truth_itself():
    truth = wobbling()
    scores = table.evaluate_motion(truth, truth)
    zero = ("mpjpe_cm", "hand_pe_cm", "lower_pe_cm", "upper_pe_cm", "p95_cm", "root_cm", "mpjve_cm_s")
    assert {name: scores[name] for name in zero} == dict.fromkeys(zero, 0.0)
    assert scores["rotation_deg"] == pytest.approx(0, abs=0.05)
    assert scores["jitter_ratio"] == 1.0
    assert scores["physicality"] == scores["truth_physicality"] > 0
    assert scores["floor_penetration_cm"] == 0
    assert scores["jitter_m_s3"] > 1


def test_a_truth_row_holds_the_truths_own_values_to_enough_digits():
    truth = wobbling()
    sunk = replace(truth, t_world_root=truth.t_world_root - torch.tensor([0.0, 0.0, 0.2]))
    standing = torch.ones(len(truth), len(FOOT_PATCHES), dtype=torch.bool)
    rows = [Row("one", 0, len(truth), table.evaluate_motion(sunk, truth, standing))]
    row = table.truth_row(table.aggregate(rows))
    assert set(row) == {"jitter_m_s3", "foot_skate_cm_s", "physicality", "floor_penetration_cm"}
    own = table.evaluate_motion(truth, truth, standing)
    assert {name: value.mean for name, value in row.items()} == {name: own[name] for name in row}
    shown = {0.001234: "0.0012", 12.345: "12.35", 0.0: "0.00", 0.0456: "0.046", 3e-9: "0.000000"}
    assert {value: str(Summary(value, None, 1)) for value in shown} == shown
    assert str(Summary(0.00123, 0.0004, 2)) == "0.0012 ± 0.0004"
    assert str(Summary(math.nan, None, 1)) == "nan"


def test_scores_of_a_shifted_motion():
    truth = wobbling()
    sunk = replace(truth, t_world_root=truth.t_world_root - torch.tensor([0.0, 0.0, 0.2]))
    scores = table.evaluate_motion(sunk, truth)
    for name in ("mpjpe_cm", "hand_pe_cm", "lower_pe_cm", "upper_pe_cm", "p95_cm", "root_cm"):
        assert scores[name] == pytest.approx(20.0, rel=1e-4)
    lowest = physics.local_floor(truth.T_world_joint.t, 60.0) - sunk.T_world_joint.t[..., 2].amin(-1)
    assert scores["floor_penetration_cm"] == pytest.approx(100 * lowest.clamp(min=0).mean().item(), rel=1e-4)
    assert scores["floor_penetration_cm"] > 10


def test_given_contact_decides_where_skate_is_measured():
    truth = wobbling()
    nothing = torch.zeros(len(truth), len(FOOT_PATCHES), dtype=torch.bool)
    assert math.isnan(table.evaluate_motion(truth, truth, nothing)["foot_skate_cm_s"])
    assert table.evaluate_motion(truth, truth, ~nothing)["foot_skate_cm_s"] > 20


def test_a_wrong_wrist_shows_in_the_hand_alone():
    truth = wobbling()
    R = truth.R_parent_joint.clone()
    elbow = truth.skeleton.index("left_elbow")
    R[:, elbow] = R[:, elbow] @ rotation.about_axis("z", torch.tensor(0.5))
    scores = table.evaluate_motion(replace(truth, R_parent_joint=R), truth)
    chord = 2 * 0.25 * math.sin(0.25)  # the forearm is 25 cm long
    assert scores["hand_pe_cm"] == pytest.approx(100 * chord / 2, rel=1e-3)
    assert scores["upper_pe_cm"] == pytest.approx(100 * chord / 14, rel=1e-3)
    assert scores["lower_pe_cm"] == pytest.approx(0, abs=1e-9)


def test_what_cannot_be_compared_is_refused():
    truth = wobbling()
    with pytest.raises(WearcapError, match="same timestamps"):
        table.evaluate_motion(truth.sliced(0, 60), truth)
    with pytest.raises(WearcapError, match="same timestamps"):
        table.evaluate_motion(replace(truth, timestamps=truth.timestamps + 0.01), truth)
    s = truth.skeleton
    other = type(s)("other", ("p", *s.joint_names[1:]), s.parents, s.t_parent_joint, s.sites)
    with pytest.raises(WearcapError, match="same joints"):
        table.evaluate_motion(replace(truth, skeleton=other), truth)
    root = truth.t_world_root.clone()
    root[7] = torch.nan
    with pytest.raises(WearcapError, match="captured motion is not finite at frame 7"):
        table.evaluate_motion(replace(truth, t_world_root=root), truth)
    with pytest.raises(WearcapError, match="two frames"):
        table.evaluate_motion(truth.sliced(0, 1), truth.sliced(0, 1))
    with pytest.raises(WearcapError, match="3 frames of contact"):
        table.evaluate_motion(truth, truth, torch.ones(3, 4, dtype=torch.bool))


def test_aggregate_weighs_frames_then_spreads_over_seeds():
    rows = [
        Row("a", 0, 100, {"mpjpe_cm": 1.0, "p95_cm": 2.0, "skate": math.nan}),
        Row("b", 0, 300, {"mpjpe_cm": 5.0, "p95_cm": 4.0, "skate": 7.0}),
        Row("a", 1, 100, {"mpjpe_cm": 3.0, "p95_cm": 2.0, "skate": math.nan}),
        Row("b", 1, 300, {"mpjpe_cm": 7.0, "p95_cm": 6.0, "skate": 9.0}),
    ]
    means = table.aggregate(rows)
    assert means["mpjpe_cm"].mean == pytest.approx((4.0 + 6.0) / 2)
    assert means["mpjpe_cm"].std == pytest.approx(math.sqrt(2.0))
    assert means["p95_cm"].mean == pytest.approx((3.0 + 4.0) / 2)  # sequences count alike
    assert means["skate"].mean == 8.0
    assert table.aggregate(rows[:2])["mpjpe_cm"] == Summary(4.0, None, 1)


def test_shares_of_the_truths_are_ratios_of_means_and_missing_scores_are_ignored():
    scores = [(10.0, 1.0), (30.0, 9.0), (math.nan, math.nan)]
    rows = [
        Row(str(k), 0, 10, {"foot_skate_cm_s": mine, "truth_foot_skate_cm_s": true})
        for k, (mine, true) in enumerate(scores)
    ]
    found = table.aggregate([*rows, Row("late", 0, 10, {"seam_ratio": 2.0})])
    assert found["skate_ratio"] == Summary(4.0, None, 1)
    assert found["seam_ratio"].mean == 2.0
    still = [Row("a", 0, 10, {"foot_skate_cm_s": 1.0, "truth_foot_skate_cm_s": 0.0})]
    assert math.isnan(table.aggregate(still)["skate_ratio"].mean)


def test_aggregate_refuses_uneven_seeds():
    row = Row("a", 0, 10, {"x": 1.0})
    with pytest.raises(WearcapError, match="same recordings"):
        table.aggregate([row, replace(row, recording="b"), replace(row, seed=1)])
    with pytest.raises(WearcapError, match="twice"):
        table.aggregate([row, row])
    with pytest.raises(WearcapError, match="nothing"):
        table.aggregate([])


def test_tables_are_written(tmp_path):
    methods = {
        "ours": {"mpjpe_cm": Summary(8.361, 0.02, 3), "skate": Summary(math.nan, math.nan, 3)},
        "mean pose": {"mpjpe_cm": Summary(20.0, None, 1)},
    }
    lines = table.markdown_table(methods).splitlines()
    assert lines[0] == "| method | mpjpe_cm | skate |"
    assert lines[2].startswith("| ours | 8.36 ± 0.02 |")
    assert lines[3] == "| mean pose | 20.00 | – |"
    shown = table.rich_table("t", methods, ("mpjpe_cm",))
    assert [column.header for column in shown.columns] == ["", "ours", "mean pose"]
    assert [list(column.cells) for column in shown.columns] == [["mpjpe_cm"], ["8.36 ± 0.02"], ["20.00"]]
    table.write_scores(tmp_path / "t.json", methods, {"frames": 3})
    written = json.loads((tmp_path / "t.json").read_text())
    assert written["methods"]["ours"]["mpjpe_cm"] == {"mean": 8.361, "std": 0.02, "seeds": 3}
    assert written["methods"]["ours"]["skate"]["mean"] is None


def test_a_recording_of_fifteen_minutes_is_scored_whole():
    truth = wobbling(frames=54_000)
    assert table.evaluate_motion(truth, truth)["mpjpe_cm"] == 0


@pytest.mark.parametrize("draw", [table.rich_table, table.rich_lines])
def test_a_table_fits_the_terminal(draw):
    """Nothing is cut: what does not fit stands in a second table."""
    names = [f"metric_{number}_cm" for number in range(9)]
    methods = {f"method {k}": {name: Summary(12.25 + k, 1.5, 3) for name in names} for k in range(9)}
    console = Console(width=80, file=io.StringIO())
    console.print(draw("scores", methods))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "…" not in text
    assert text.count("± 1.50") == 81
    assert max(map(len, text.splitlines())) <= 80


def test_a_ratio_to_a_truth_of_almost_0_is_none():
    row = Row("a", 0, 10, {"mpjpe_cm": 4.0, "foot_skate_cm_s": 2.5, "truth_foot_skate_cm_s": 0.001})
    scores = table.aggregate([row])
    assert math.isnan(scores["skate_ratio"].mean)
    console = Console(width=80, file=io.StringIO())
    console.print(part_table("parts", {"ours": scores}))
    text = " ".join(console.file.getvalue().split())  # type: ignore[attr-defined]
    assert "beyond" in text
    assert "2.50" in text
    assert "2500" not in text
