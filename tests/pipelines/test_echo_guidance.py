"""Guidance follows the negative gradient of its costs: objects move to hands, feet to the floor, and nothing else."""

from dataclasses import replace

import pytest
import torch

from carried_box import box_mesh, boxes, carrying, drawn_echo, scenario_of, scene_object
from wearcap.body.contact_points import BODY_POINTS
from wearcap.geometry.rigid import Rigid
from wearcap.scene.objects import Environment
from wearcap.systems.echo.contacts import ContactUse, Guidance, GuidedScene
from wearcap.systems.echo.features import OBJECT_SIZE, Body
from wearcap.systems.echo.observations import Observed, batch_item_of
from wearcap.systems.echo.pipeline import pulled_by
from wearcap.tracking.head_path import head_path

FRAMES = 8
LEFT_HAND = slice(0, 7)


def scene_of(frame: str = "own", shift=(0.0, 0.0, 0.0), lift: float = 0.0, contact=None):
    """A walk as x̂0, the box shifted and the body lifted (m); contacts as in `contact`, else of the left hand and all
    feet."""
    recording, echo = carrying(0.6), drawn_echo(frame)
    motion = recording.motion
    batch_item = batch_item_of(
        scenario_of(recording, margin_s=9.0, observed=Observed(motion, recording.object_motion)),
        head_path(recording, echo.model.skeleton, echo.fps),
        echo.reader(),
    )
    conditioning = batch_item.conditioning.frames(slice(0, FRAMES))
    at = echo.model.features.canonical(conditioning.points)
    body = Body(conditioning.R_parent_joint, conditioning.t_world_root + torch.tensor([0.0, 0.0, lift]))
    box = Rigid(conditioning.R_world_object, conditioning.t_world_object + torch.tensor(shift))
    if contact is None:
        contact = torch.full((1, FRAMES, BODY_POINTS + 4), -0.9)
        contact[..., LEFT_HAND] = contact[..., BODY_POINTS:] = 0.9
    raw = torch.cat(
        [echo.model.features.encode_body(body, at), echo.model.features.encode_object(box, at), contact], -1
    )
    scene = GuidedScene(
        echo.model.net, echo.model.features, conditioning, at, *pulled_by([motion.skeleton], [{}], [batch_item.objects])
    )
    return scene, echo.model.net.motion_normalizer(raw)


@pytest.mark.parametrize("frame", ["own", "window", "world"])
def test_an_object_comes_to_the_hand_that_touches_it(frame):
    scene, x = scene_of(frame, shift=(0.1, 0.05, -0.1))
    corrected = Guidance(object=1.0, human=0.0, feet=0.0, held=0.0, within_m=0.0).corrected(x, scene)
    assert scene.costs(corrected, 0.5)[0] < 0.9 * scene.costs(x, 0.5)[0]
    first = scene.net.sizes[0]
    changed = (corrected != x).any(0).any(0)
    assert not changed[:first].any()
    assert not changed[first + OBJECT_SIZE :].any(), "contacts are what they were predicted to be"


def test_a_body_comes_to_its_object():
    scene, x = scene_of(shift=(0.1, 0.05, -0.1))
    corrected = Guidance(object=0.0, human=0.3, feet=0.0, held=0.0).corrected(x, scene)
    assert scene.costs(corrected, 0.5)[0] < scene.costs(x, 0.5)[0]
    assert torch.equal(corrected[..., scene.net.sizes[0] :], x[..., scene.net.sizes[0] :])


@pytest.mark.parametrize("lift", [0.1, -0.1])
def test_feet_come_to_the_floor_from_above_and_from_below(lift):
    scene, x = scene_of(lift=lift)
    corrected = Guidance(object=0.0, human=0.0, feet=0.5).corrected(x, scene)
    assert scene.costs(corrected, 0.5)[1] < 0.9 * scene.costs(x, 0.5)[1]


def test_step_after_step_it_converges():
    """With the weights of the config, whatever number of points touches."""
    contact = torch.full((1, FRAMES, BODY_POINTS + 4), 0.9)
    contact[..., 14:BODY_POINTS] = -0.9
    scene, x = scene_of(shift=(0.3, 0.1, -0.2), lift=0.1, contact=contact)
    first = last = sum(scene.costs(x, 0.5))
    for _ in range(30):
        x = Guidance().corrected(x, scene)
        now = sum(scene.costs(x, 0.5))
        assert now < 1.02 * last
        last = now
    assert last < 0.5 * first


def test_what_does_not_touch_is_left_alone():
    contact = torch.full((1, FRAMES, BODY_POINTS + 4), -0.9)
    scene, x = scene_of(shift=(0.1, 0.0, 0.0), lift=0.1, contact=contact)
    assert torch.equal(Guidance().corrected(x, scene), x)


@pytest.mark.parametrize(("threshold", "moves"), [(0.9, True), (0.97, False)])
def test_the_threshold_is_a_probability(threshold, moves):
    scene, x = scene_of(shift=(0.1, 0.0, 0.0))
    assert torch.equal(Guidance(threshold=threshold).corrected(x, scene), x) != moves


@pytest.mark.parametrize("part", ["valid", "has_object"])
def test_what_is_not_there_is_not_pulled(part):
    scene, x = scene_of(shift=(0.1, 0.0, 0.0))
    there = getattr(scene.conditioning, part).clone()
    there[:, 4:] = False
    scene = replace(scene, conditioning=scene.conditioning._replace(**{part: there}))
    moved = (Guidance(feet=0.0).corrected(x, scene) != x).any(-1)[0]
    assert moved.tolist() == [True] * 4 + [False] * 4


@pytest.mark.parametrize("given", [0.0, 1.0])
def test_observed_contacts_count_whatever_the_network_says(given):
    contact = torch.full((1, FRAMES, BODY_POINTS + 4), 0.9 - 1.8 * given)
    scene, x = scene_of(shift=(0.1, 0.05, -0.1), lift=0.1, contact=contact)
    labels = torch.zeros(1, FRAMES, BODY_POINTS + 4)
    labels[..., LEFT_HAND] = labels[..., BODY_POINTS:] = given
    is_observed = scene.conditioning.is_observed.clone()
    is_observed[..., 2] = True
    is_observed[:, 4:, 2] = False
    scene = replace(scene, conditioning=scene.conditioning._replace(contact=labels, is_observed=is_observed))
    moved = (Guidance(held=0.0).corrected(x, scene) != x).any(-1)[0]
    assert moved.tolist() == [given > 0] * 4 + [given == 0] * 4


def test_near_enough_is_touching():
    """Points in contact within the threshold of contact do not pull; others pull as far as to it."""
    scene, x = scene_of(shift=(0.1, 0.05, -0.1))
    costs = [scene.costs(x, 0.5, within)[0] for within in (0.0, 0.05, 0.5)]
    assert costs[0] > costs[1] > costs[2]
    assert costs[2] == 0
    moved = Guidance(object=3.0, human=0.0, feet=0.0, held=0.0, within_m=0.5).corrected(x, scene)
    assert torch.equal(moved, x)


def test_what_is_held_moves_with_the_hand():
    """A box that is carried does not slip; one that trembles in the hand is calmed, and only while the hand touches it."""
    scene, x = scene_of()
    assert scene.costs(x, 0.5)[2] < 1e-5
    first = scene.net.sizes[0]
    trembling = x.clone()
    trembling[:, ::2, first] += 0.1
    before, calm = scene.costs(trembling, 0.5)[2], trembling
    for _ in range(20):
        calm = Guidance(object=0.0, human=0.0, feet=0.0, held=0.3).corrected(calm, scene)
    assert scene.costs(calm, 0.5)[2] < 0.2 * before
    assert torch.equal(calm[..., :first], x[..., :first])
    far = trembling.clone()
    far[..., first + OBJECT_SIZE :] = -0.9
    assert scene.costs(far, 0.5)[2] == 0


@pytest.mark.parametrize("frame", ["own", "window"])
def test_gradients_are_those_of_finite_differences(frame):
    """In float64, along random directions of the body's and the object's pose."""
    scene, x = scene_of(frame, shift=(0.2, 0.05, -0.2), lift=0.05)
    double = lambda part: part.double() if part.is_floating_point() else part  # noqa: E731
    scene = replace(
        scene,
        conditioning=type(scene.conditioning)(*(double(part) for part in scene.conditioning)),
        frame=Rigid(scene.frame.R.double(), scene.frame.t.double()),
    )
    x, step = x.double(), 1e-6
    x.requires_grad_(True)
    for cost in (0, 1, 2):
        (gradient,) = torch.autograd.grad(scene.costs(x, 0.5)[cost], x)
        random = torch.Generator().manual_seed(cost)
        for _ in range(4):
            direction = torch.randn(x.shape, generator=random, dtype=torch.float64)
            direction[..., scene.net.sizes[0] + OBJECT_SIZE :] = 0.0
            there, back = (scene.costs(x.detach() + sign * step * direction, 0.5)[cost] for sign in (1, -1))
            assert (gradient * direction).sum().item() == pytest.approx(
                ((there - back) / (2 * step)).item(), rel=1e-4, abs=1e-8
            )


def test_batch_items_have_their_own_bodies_and_objects():
    one, x = scene_of(shift=(0.1, 0.05, -0.1))
    two, y = scene_of(shift=(-0.1, 0.0, 0.2))
    both = GuidedScene(
        one.net,
        one.features,
        type(one.conditioning)(*(torch.cat(parts) for parts in zip(one.conditioning, two.conditioning))),
        Rigid(torch.cat([one.frame.R, two.frame.R]), torch.cat([one.frame.t, two.frame.t])),
        [*one.surfaces, *two.surfaces],
        [*one.objects, *two.objects],
    )
    together = Guidance().corrected(torch.cat([x, y]), both)
    for part, alone in zip(together.split(1), (Guidance().corrected(x, one), Guidance().corrected(y, two))):
        torch.testing.assert_close(part, alone, atol=1e-6, rtol=0)


@pytest.mark.parametrize("settings", [{}, {"frame": "window"}, {"rewindow": 4}])
def test_a_guided_capture_is_another_one(settings):
    recording = carrying(0.8)
    plain, guided = (
        drawn_echo(guidance=guidance, **settings).capture_scenarios([scenario_of(recording)], [0])[0]
        for guidance in (None, Guidance(threshold=0.0))
    )
    assert guided.R_parent_joint.isfinite().all()
    before, after = (motion.object_motion["box_1"].t_world_body for motion in (plain, guided))
    assert after.isfinite().all()
    assert not torch.allclose(before, after, atol=1e-3)


def test_a_network_without_contacts_is_not_guided():
    echo = drawn_echo(guidance=Guidance(threshold=0.0))
    assert echo.contact_use.guidance is not None
    assert "Guidance" in echo.settings()["guidance"]
    without = replace(echo, model=replace(echo.model, contacts=False))
    assert without.contact_use.guidance is None
    assert without.settings()["guidance"] == "None"
    recording = carrying(0.8)
    unguided = replace(without, contacts=ContactUse(static_threshold=None))
    plain, asked = (one.capture_scenarios([scenario_of(recording)], [0])[0] for one in (unguided, without))
    assert torch.equal(plain.t_world_root, asked.t_world_root)
    assert asked.body_contact_prob is None  # noise, which it never saw in training
    assert echo.capture_scenarios([scenario_of(recording)], [0])[0].body_contact_prob is not None


def test_each_batch_item_is_guided_by_its_own_objects():
    recording = carrying(0.8)
    small = Environment((scene_object("box_1", mesh=box_mesh([0.05, 0.05, 0.05])),))
    echo = drawn_echo(guidance=Guidance(threshold=0.0))
    scenarios = [scenario_of(recording), replace(scenario_of(recording), environment=small)]
    together = echo.capture_scenarios(scenarios, [0, 0])
    for scenario, motion in zip(scenarios, together):
        alone = echo.capture_scenarios([scenario], [0])[0].object_motion["box_1"]
        torch.testing.assert_close(motion.object_motion["box_1"].t_world_body, alone.t_world_body, atol=2e-3, rtol=0)
    assert len(boxes().objects) == 1
