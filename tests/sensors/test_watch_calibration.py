"""Board and T-pose: planted frames and mountings come back; each way to do a step wrongly is named."""

import math
from dataclasses import replace

import pytest
import torch
from planted_session import SEEDS, apart_deg, calibrated, session

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import ImuStream
from wearcap.sensors.stillness import StepCheck, require, still_intervals
from wearcap.sensors.watch_calibration import measure_watches, propose_steps
from wearcap.sensors.watches import watches_at

JOINTS = ("left_wrist", "right_wrist")
BOARD, T_POSE = (1.0, 4.0), (6.0, 9.0)


@pytest.mark.parametrize("seed", SEEDS)
def test_planted_frames_and_mountings_are_recovered(seed):
    made = session(seed)
    found = calibrated(made.watches, made.board["left_wrist"], made.t_pose["left_wrist"])
    for joint, one in found.items():
        assert apart_deg(one.R_world_ref, made.planted.R_world_ref[joint]) < 0.5
        assert apart_deg(one.R_joint_imu, made.planted.R_joint_imu[joint]) < 0.5
        assert one.board_still_deg < 0.5
        assert one.board_tilt_deg < 1.0
        assert 0.5 < one.pose_still_deg < 3.0


def axis(name: str, degrees: float) -> torch.Tensor:
    return rotation.about_axis(name, torch.tensor(math.radians(degrees)))


def exact(joint: str, *, on_board=None, posed=None, shaken: tuple[float, float] = (0.0, 0.0)) -> ImuStream:
    """4 s on the board, 4 s of T-pose, 20 s of hanging; `on_board` and `posed` turn the watch in the world, `shaken`
    (degrees) while on the board and in the pose."""
    times = torch.arange(0, 30, 0.02, dtype=torch.float64)
    R_joint_imu = axis("z", 90.0)
    hanging = axis("x", -90.0 if joint == "left_wrist" else 90.0)
    keys = torch.stack(
        [
            torch.eye(3) if on_board is None else on_board,
            (torch.eye(3) if posed is None else posed) @ axis("z", 90.0) @ R_joint_imu,
            axis("z", 90.0) @ hanging @ R_joint_imu,
        ]
    )
    step = (times >= 5).long() + (times >= 10).long()
    amount = torch.tensor([*shaken, 0.0])[step] * torch.sin(20 * times).float()
    R = axis("z", -40.0) @ keys[step] @ rotation.about_axis("x", torch.deg2rad(amount))
    return ImuStream(times, joint, R, torch.zeros(len(times), 3))


def both(**wrong) -> dict[str, ImuStream]:
    """Two exact logs, the right one's steps done as in `wrong`."""
    return {"left_wrist": exact("left_wrist"), "right_wrist": exact("right_wrist", **wrong)}


def test_exact_logs_are_calibrated_exactly_and_reach_the_estimator_as_wrists():
    found = calibrated(both(), BOARD, T_POSE)
    streams = {joint: found[joint].apply(stream) for joint, stream in both().items()}
    R, _ = watches_at(streams, torch.tensor([7.0, 20.0], dtype=torch.float64), "test")
    torch.testing.assert_close(R[0], axis("z", 90.0).expand(2, 3, 3), atol=1e-5, rtol=0)
    # Left forearm y down, right forearm y up
    torch.testing.assert_close(R[1, :, 2, 1], torch.tensor([-1.0, 1.0]), atol=1e-5, rtol=0)


def test_accelerations_turn_with_the_reference_frame():
    stream = exact("left_wrist")
    north = replace(stream, acc_world=torch.tensor([1.0, 0.0, 0.5]).expand(len(stream.timestamps), 3))
    made = measure_watches({**both(), "left_wrist": north}, BOARD, T_POSE)["left_wrist"].apply(north)
    expected = torch.tensor([math.cos(math.radians(40)), math.sin(math.radians(40)), 0.5])
    torch.testing.assert_close(made.acc_world[0], expected, atol=1e-5, rtol=0)


def test_crowns_may_point_to_the_hand_or_to_the_elbow():
    flipped = {**both(), "right_wrist": exact("right_wrist", posed=axis("z", 180.0))}
    assert calibrated(flipped, BOARD, T_POSE)["right_wrist"].arm_facing_deg < 0.1


@pytest.mark.parametrize(
    ("wrong", "step", "match"),
    [
        ({"shaken": (5.0, 0.0)}, "board, right_wrist", "not still: 3.5.*at most 1 °.*Let go of the watches"),
        (
            {"on_board": axis("x", 8.0)},
            "board, right_wrist",
            "tilt of its z against gravity: 8 °.*at most 3.*level table",
        ),
        ({"shaken": (0.0, 12.0)}, "T-pose, right_wrist", "not still: 8.*at most 4.*Hold the pose"),
        ({"posed": axis("x", 70.0)}, "T-pose, right_wrist", "face of the watch looks away from up: 70.*palms down"),
        ({"posed": axis("y", 30.0)}, "T-pose, right_wrist", "slope of the forearm: 30.*height of the shoulders"),
        ({"posed": axis("z", 40.0)}, "T-pose, right_wrist", "away from the wearer's side: 40.*Face the board's y"),
        ({"posed": axis("z", 20.0)}, "T-pose, both", "lines disagree: 20.*at most 15.*one line"),
    ],
)
def test_a_step_done_wrongly_is_named(wrong, step, match):
    with pytest.raises(WearcapError, match=match) as caught:
        calibrated(both(**wrong), BOARD, T_POSE)
    assert caught.value.where == step


def test_swapped_watches_are_noticed_once_the_arms_hang():
    streams = both()
    swapped = {a: replace(streams[b], joint=a) for a, b in (JOINTS, JOINTS[::-1])}
    with pytest.raises(WearcapError, match="swapped"):
        calibrated(swapped, BOARD, T_POSE)


@pytest.mark.parametrize(
    ("board", "t_pose", "match"),
    [
        ((1.0, 2.5), T_POSE, "board, left_wrist.*1.50 s long.*at least 2 s.*do this step again"),
        (BOARD, (28.0, 40.0), "T-pose, left_wrist.*within the log, 0.00 s to 29.98 s"),
        (BOARD, (50.0, 53.0), "has 0 samples"),
        (BOARD, (3.0, 9.0), "overlap"),
    ],
)
def test_a_wrong_stretch_is_named(board, t_pose, match):
    with pytest.raises(WearcapError, match=match):
        calibrated(both(), board, t_pose)


def test_missing_parts_are_named():
    with pytest.raises(WearcapError, match="no watch on right_wrist"):
        calibrated({"left_wrist": exact("left_wrist")}, BOARD, T_POSE)
    blind = replace(exact("left_wrist"), R_world_imu=None)
    with pytest.raises(WearcapError, match="without orientation"):
        measure_watches({**both(), "left_wrist": blind}, BOARD, T_POSE)


def test_still_stretches_are_found_and_proposed():
    found = still_intervals(exact("left_wrist").timestamps, exact("left_wrist").R_world_imu)
    assert [(round(a), round(b)) for a, b in found] == [(0, 5), (5, 10), (10, 30)]
    assert still_intervals(torch.zeros(1).double(), torch.eye(3)[None]) == []
    for seed in SEEDS:
        made = session(seed)
        board, t_pose = propose_steps(made.watches)
        for proposed, truth in ((board, made.board), (t_pose, made.t_pose)):
            start, stop = truth["left_wrist"]
            assert proposed is not None
            assert min(stop, proposed[1]) - max(start, proposed[0]) > 1.5
    assert propose_steps({joint: exact(joint, shaken=(40.0, 40.0)) for joint in JOINTS}) == (None, None)


def test_checks_know_both_directions():
    few = StepCheck("swings", "seen", 3, 5, "", "Swing more.", at_least=True)
    require([replace(few, measured=5)])
    with pytest.raises(WearcapError, match="swings: seen: 3. Expected at least 5. Swing more."):
        require([few])
