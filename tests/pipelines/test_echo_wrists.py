"""In every step bodies reach for the tracked wrists, and what is not theirs stays."""

import torch

from carried_box import carrying, drawn_echo, scenario_of
from wearcap.body.skeleton import WRISTS
from wearcap.geometry import rotation
from wearcap.systems.echo.features import Body
from wearcap.systems.echo.observations import Observed, batch_item_of
from wearcap.systems.echo.wrists import Reaching
from wearcap.tracking.head_path import head_path

FRAMES = 8


def reaching_of(turn: float) -> tuple[Reaching, torch.Tensor]:
    """A walk as x̂0, whose shoulders and trunk are turned by an angle (rad)."""
    recording, echo = carrying(0.6), drawn_echo()
    scenario = scenario_of(recording, margin_s=9.0, observed=Observed(recording.motion, recording.object_motion))
    path = head_path(recording, echo.model.skeleton, echo.fps)
    conditioning = batch_item_of(scenario, path, echo.reader()).conditioning.frames(slice(0, FRAMES))
    at, skeleton = echo.model.features.canonical(conditioning.points), recording.motion.skeleton
    R = conditioning.R_parent_joint.clone()
    joints = list(skeleton.indices("left_shoulder", "right_elbow", "t12"))
    R[:, :, joints] = R[:, :, joints] @ rotation.exp(torch.tensor([0.0, turn, 0.7 * turn]))
    body = echo.model.features.encode_body(Body(R, conditioning.t_world_root), at)
    raw = torch.cat([body, torch.ones(1, FRAMES, sum(echo.model.net.sizes[1:]))], -1)
    bones = skeleton.t_parent_joint[None, None]
    return Reaching(echo.model.net, echo.model.features, skeleton, bones, conditioning, at), (
        echo.model.net.motion_normalizer(raw)
    )


def misses(reaching: Reaching, x: torch.Tensor) -> torch.Tensor:
    return reaching.misses(x[..., : reaching.net.sizes[0]]).sqrt()


def test_step_after_step_the_wrists_are_met_by_all_that_carries_them():
    reaching, x = reaching_of(0.4)
    first = misses(reaching, x)
    assert first.min() > 0.05
    corrected = reaching.corrected(x, 0.3)
    assert (misses(reaching, corrected) < 0.95 * first).all()
    size, columns = reaching.net.sizes[0], corrected != x
    assert not columns[..., :3].any(), "the root stays with the head"
    assert not columns[..., size:].any()
    legs = 3 + 6 * reaching.skeleton.index("left_knee")
    assert not columns[..., legs : legs + 6].any()
    for joint in ("t12", "left_shoulder", "right_elbow"):
        at = 3 + 6 * reaching.skeleton.index(joint)
        assert columns[..., at : at + 6].any(), joint
    for _ in range(40):
        corrected = reaching.corrected(corrected, 0.3)
    assert misses(reaching, corrected).max() < 0.01


def test_wrists_that_are_met_change_nothing_and_neither_does_padding():
    reaching, x = reaching_of(0.0)
    assert misses(reaching, x).max() < 1e-3
    torch.testing.assert_close(reaching.corrected(x, 1.0), x, atol=2e-3, rtol=0)
    reaching, x = reaching_of(0.4)
    reaching.conditioning.valid[:, 5:] = False
    assert torch.equal(reaching.corrected(x, 0.3)[:, 5:], x[:, 5:])


def test_a_capture_is_nearer_to_its_wrists():
    recording = carrying(1.0)
    true = torch.stack([recording.motion.joint(name).t for name in WRISTS])
    away = []
    for share in (None, 0.3):
        motion = drawn_echo(wrists=share).capture_scenarios([scenario_of(recording)], [0])[0]
        away.append((torch.stack([motion.joint(name).t for name in WRISTS]) - true).norm(dim=-1).mean())
    assert away[1] < 0.9 * away[0], "eight steps of a network that knows nothing"
