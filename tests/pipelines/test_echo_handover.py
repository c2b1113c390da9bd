"""Objects in the hand are where the tracked wrist has them, others where they are in the canonical frame, without jumps."""

from dataclasses import replace

import pytest
import torch

from carried_box import carrying, drawn_echo, scenario_of, small_features
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.systems.echo.features import CONTACTS, HANDS, OBJECT_SIZE
from wearcap.systems.echo.handover import FADE, HandOver, in_hand
from wearcap.systems.echo.observations import Observed, batch_item_of
from wearcap.systems.echo.queue import Conditioning
from wearcap.tracking.head_path import head_path

FRAMES, HELD = 40, slice(12, 30)
AWAY_M = 0.2
"""How far off the object is in the canonical frame's channels."""
AVERAGED = {"context": 4, "rewindow": 6, "rewindow_steps": 1, "average": True, "mirror_average": True}


def contact_of(wrist: str, held: slice = HELD, frames: int = FRAMES) -> torch.Tensor:
    contact = torch.zeros(1, frames, CONTACTS)
    contact[:, held, HANDS[wrist].start + 2] = 1.0
    return contact


def window(*holding: str) -> tuple[HandOver, torch.Tensor, Rigid]:
    """A box beside the left wrist as x̂0, right in the wrists' axes, wrong in the canonical frame, and its true poses."""
    recording, echo = carrying(2.0), drawn_echo(features=small_features(object_in_wrists=True))
    scenario = scenario_of(recording, margin_s=9.0, observed=Observed(object_motion=recording.object_motion))
    path = head_path(recording, echo.model.skeleton, echo.fps)
    given = batch_item_of(scenario, path, echo.reader()).conditioning.frames(slice(0, FRAMES))
    box = Rigid(given.R_world_object, given.t_world_object)
    given = given._replace(is_observed=torch.zeros_like(given.is_observed))
    features, net, at = echo.model.features, echo.model.net, echo.model.features.canonical(given.points)
    value = features.encode_object(box, *features.object_frames(given.points, at))
    value[..., 0] += AWAY_M
    contact = sum((contact_of(wrist) for wrist in holding), torch.zeros(1, FRAMES, CONTACTS))
    raw = torch.cat([torch.zeros(1, FRAMES, net.sizes[0]), value, 2 * contact - 1], -1)
    return HandOver(net, features, given, at), net.motion_normalizer(raw), box


def misses(scene: HandOver, x0_hat: torch.Tensor, box: Rigid) -> torch.Tensor:
    """Distances (m) of the object to where it truly is."""
    raw = scene.net.motion_normalizer.inverse(x0_hat).split(scene.net.sizes, -1)[1]
    T = scene.features.decode_object(raw[..., :OBJECT_SIZE], scene.frame)
    torch.testing.assert_close(T.R, box.R, atol=1e-4, rtol=0)
    return (T.t - box.t).norm(dim=-1)[0]


@pytest.mark.parametrize("holding", [("left_wrist",), ("right_wrist",), ("left_wrist", "right_wrist")])
def test_a_held_object_is_where_the_wrist_has_it(holding):
    scene, x, box = window(*holding)
    corrected = scene.corrected(x)
    away = misses(scene, corrected, box)
    assert (away[HELD][FADE:-FADE] < 1e-4).all()
    torch.testing.assert_close(away[: HELD.start], torch.full((HELD.start,), AWAY_M), atol=1e-4, rtol=0)
    torch.testing.assert_close(away[HELD.stop :], torch.full((FRAMES - HELD.stop,), AWAY_M), atol=1e-4, rtol=0)
    assert away.diff().abs().max() < 0.3 * AWAY_M, "it is handed over softly"
    own = slice(scene.net.sizes[0], scene.net.sizes[0] + OBJECT_SIZE)
    corrected[..., own] = x[..., own]
    assert torch.equal(corrected, x), "nothing else changes"


def test_observed_contacts_say_who_holds_it():
    scene, x, box = window()
    torch.testing.assert_close(misses(scene, scene.corrected(x), box), torch.full((FRAMES,), AWAY_M), atol=1e-4, rtol=0)
    is_observed = scene.conditioning.is_observed.clone()
    is_observed[..., 2] = True
    with_contact = scene.conditioning._replace(contact=contact_of("left_wrist"), is_observed=is_observed)
    assert (misses(scene, replace(scene, conditioning=with_contact).corrected(x), box)[HELD][FADE:-FADE] < 1e-4).all()
    without_object: Conditioning = with_contact._replace(has_object=torch.zeros_like(with_contact.has_object))
    torch.testing.assert_close(replace(scene, conditioning=without_object).corrected(x), x, atol=1e-5, rtol=0)


def test_a_contact_goes_on_beyond_the_windows_ends_and_padding():
    yes = torch.ones(1, FRAMES, dtype=torch.bool)
    contact = contact_of("right_wrist", slice(0, FRAMES))
    assert torch.equal(in_hand(contact, yes, yes)[0], torch.tensor([0.0, 1.0]).expand(FRAMES, 2))
    valid = yes.clone()
    valid[:, 25:] = False
    contact[:, 25:] = 0.0
    assert torch.equal(in_hand(contact, yes, valid)[0, :25], torch.tensor([0.0, 1.0]).expand(25, 2))
    contact[:, 20:25] = 0.0
    assert (in_hand(contact, yes, valid)[0, 20:25] == 0).all(), "padding is no contact"


@pytest.mark.parametrize("settings", [{}, AVERAGED], ids=["conveyor", "averaged"])
@pytest.mark.parametrize("frame", ["own", "window"])
def test_recordings_are_captured(frame, settings):
    recording = carrying(0.9)
    echo = drawn_echo(features=small_features(frame, object_in_wrists=True), **settings)
    true = recording.object_motion["box_1"]
    seen = Trajectory(*(part[:10] for part in (true.timestamps, true.R_world_body, true.t_world_body)))
    scenario = scenario_of(recording, margin_s=9.0, observed=Observed(object_motion={"box_1": seen}))
    found = echo.capture_scenarios([scenario], [0])[0].object_motion["box_1"].t_world_body
    assert found.isfinite().all()
    torch.testing.assert_close(found[:10], seen.t_world_body.float(), atol=1e-3, rtol=0)
