"""ECHO on whole recordings: observations are kept, the frame of reference does not matter, batch items are
independent."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.spatial import KDTree

from carried_box import FPS, GRIP, WINDOW, boxes, carrying, drawn_echo, scenario_of, small_features, with_settings
from wearcap.body.contact_points import BODY_POINTS
from wearcap.diffusion.process import add_noise
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording import Motion
from wearcap.systems.echo.contacts import Guidance
from wearcap.systems.echo.features import CONTACTS, Body
from wearcap.systems.echo.observations import Observed, batch_item_of
from wearcap.systems.echo.pipeline import Echo
from wearcap.systems.echo.queue import Conditioning, EchoQueue
from wearcap.systems.echo.windows import AveragedWindows, Rewindow
from wearcap.tracking.head_path import head_path
from wearcap.tracking.wrists import UNSEEN_S

TWO = (("box_1", "left", 0.1, 0.35), ("box_2", "right", 0.6, 0.8))
FRAMES = ("own", "window", "world")
AVERAGED = {"rewindow": 3, "rewindow_steps": 1, "average": True}
MIRRORED = AVERAGED | {"mirror_average": True}


def batch_item(echo: Echo, scenario):
    return batch_item_of(scenario, head_path(scenario.recording, echo.model.skeleton, echo.fps), echo.reader())


def everything(recording) -> Observed:
    """Ground truth of all modalities at every frame; contacts in a pattern."""
    motion, count = recording.motion, len(recording.motion)
    contact = (torch.arange(count)[:, None] + torch.arange(CONTACTS)) % 3 == 0
    return Observed(motion, recording.object_motion, motion.timestamps, contact.float())


def assert_true(motion: Motion, recording, scenario, atol: float = 2e-4) -> None:
    true = recording.motion
    torch.testing.assert_close(motion.R_parent_joint, true.R_parent_joint, atol=atol, rtol=0)
    torch.testing.assert_close(motion.t_world_root, true.t_world_root, atol=atol, rtol=0)
    for span in scenario.active_objects:
        active = (true.timestamps >= span.start_s) & (true.timestamps < span.stop_s)
        found, given = motion.object_motion[span.object], recording.object_motion[span.object]
        torch.testing.assert_close(found.t_world_body[active], given.t_world_body[active], atol=atol, rtol=0)
        torch.testing.assert_close(found.R_world_body[active], given.R_world_body[active], atol=atol, rtol=0)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("settings", [{}, {"rewindow": 3}, AVERAGED, MIRRORED])
def test_what_is_observed_comes_out_as_it_is(frame, settings):
    recording = carrying(1.0, carried=TWO)
    scenario = scenario_of(recording, TWO, observed=everything(recording))
    echo = drawn_echo(frame, anchor=False, **settings)
    motion = echo.capture_scenarios([scenario], [0])[0]
    assert_true(motion, recording, scenario)
    contact = scenario.observed.contact
    torch.testing.assert_close(motion.contact_prob, contact[:, BODY_POINTS:], atol=1e-5, rtol=0)
    active = batch_item(echo, scenario).conditioning.has_object[0, :, None]
    torch.testing.assert_close(motion.body_contact_prob, contact[:, :BODY_POINTS] * active, atol=1e-5, rtol=0)


@pytest.mark.parametrize("modality", range(3))
def test_observed_frames_of_one_modality_enter_at_level_0(modality):
    recording, take = carrying(1.2), torch.tensor([4, 17, 30])
    all_of_it, times = everything(recording), recording.motion.timestamps[take]
    motion = replace(
        recording.motion,
        timestamps=times,
        R_parent_joint=recording.motion.R_parent_joint[take],
        t_world_root=recording.motion.t_world_root[take],
    )
    seen = (
        Observed(motion),
        Observed(object_motion={name: track[take] for name, track in recording.object_motion.items()}),
        Observed(contact_times=times, contact=all_of_it.contact[take]),
    )[modality]
    echo, given = drawn_echo(anchor=False), []
    denoiser = echo.denoiser

    def watched(queue, conditioning, frame):
        denoise, corrections = denoiser(queue, conditioning, frame)

        def look(x, level):
            given.append((level, conditioning.is_observed))
            return denoise(x, level)

        return look, corrections

    echo.denoiser = watched
    found = echo.capture_scenarios([scenario_of(recording, margin_s=3.0, observed=seen)], [0])[0]
    plain = drawn_echo(anchor=False).capture_scenarios([scenario_of(recording, margin_s=3.0)], [0])[0]
    for level, observed_parts in given:
        assert (level[observed_parts] == 0).all()
        assert not observed_parts[..., [k for k in range(3) if k != modality]].any()
    pairs = [
        (found.t_world_root, plain.t_world_root, recording.motion.t_world_root),
        (
            *(m.object_motion["box_1"].t_world_body for m in (found, plain)),
            recording.object_motion["box_1"].t_world_body,
        ),
        (found.contact_prob, plain.contact_prob, all_of_it.contact[:, BODY_POINTS:]),
    ]
    value, without, true = pairs[modality]
    torch.testing.assert_close(value[take], true[take], atol=2e-4, rtol=0)
    assert (without[take] - true[take]).abs().max() > 0.01
    others = torch.ones(len(value), dtype=torch.bool)
    others[take] = False
    assert not torch.allclose(value[others], without[others], atol=1e-5), "its neighbours hear of it"


def truth_of(echo: Echo, conditioning: Conditioning, frame: Rigid) -> torch.Tensor:
    """x0 in coordinates of the frame, from the observed values of the conditioning."""
    body = echo.model.features.encode_body(Body(conditioning.R_parent_joint, conditioning.t_world_root), frame)
    scene_object = echo.model.features.encode_object(
        Rigid(conditioning.R_world_object, conditioning.t_world_object), frame
    )
    return echo.model.net.motion_normalizer(torch.cat([body, scene_object, 2 * conditioning.contact - 1], -1))


class Knowing(Echo):
    """A pipeline with a perfect denoiser."""

    def denoiser(self, queue, conditioning, frame):
        truth = truth_of(self, conditioning, frame)
        observed_parts = queue.seen if hasattr(queue, "seen") else []

        def denoise(x, level):
            observed_parts.append(torch.where(queue.conveyor.wide(level) == 0, (x - truth).abs(), 0.0))
            return truth

        return denoise, []


def knowing(frame: str, **settings) -> Echo:
    return with_settings(drawn_echo(frame).model, Knowing, **{"per_frame": 2, "anchor": False} | settings)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        (EchoQueue, {}),
        (EchoQueue, {"step": "redraw"}),
        (Rewindow, {"rewindow": 3}),
        (AveragedWindows, {"rewindow": 3, "average": True}),
    ],
)
def test_a_perfect_denoiser_gives_the_ground_truth_in_any_frame(frame, kind, settings):
    """Clean frames stay the ground truth while the window's frame of reference moves."""
    recording = carrying(1.0, carried=TWO)
    echo = knowing(frame, **settings)
    conditioning = batch_item(echo, scenario_of(recording, TWO, observed=everything(recording))).conditioning
    conditioning = conditioning._replace(is_observed=torch.zeros_like(conditioning.is_observed))
    queue = echo.queue([echo.model.skeleton], [0], [{}], [[]])
    assert type(queue) is kind
    queue.seen = []
    outputs = queue.run(conditioning)
    torch.testing.assert_close(outputs.t_world_root, conditioning.t_world_root, atol=2e-4, rtol=0)
    torch.testing.assert_close(outputs.R_parent_joint, conditioning.R_parent_joint, atol=2e-4, rtol=0)
    there = conditioning.has_object
    torch.testing.assert_close(outputs.t_world_object[there], conditioning.t_world_object[there], atol=2e-4, rtol=0)
    torch.testing.assert_close(outputs.R_world_object[there], conditioning.R_world_object[there], atol=2e-4, rtol=0)
    assert max(part.max() for part in queue.seen) < 5e-3, "clean frames are the ground truth"


def test_noised_frames_are_re_expressed_when_the_window_advances():
    """z' = A z + √ᾱ b equals encoding in the new frame with rotated noise."""
    echo = drawn_echo("window")
    queue, recording = EchoQueue(echo, [echo.model.skeleton], [0]), carrying(1.6)
    conditioning = batch_item(echo, scenario_of(recording, margin_s=5.0, observed=everything(recording))).conditioning
    before, queue.frames = (conditioning.frames(slice(0, WINDOW)), conditioning.frames(slice(5, 5 + WINDOW)))
    old, new = (echo.model.features.canonical(part.points) for part in (before, queue.frames))
    queue.conveyor.age = torch.arange(WINDOW).flip(0)
    queue.conveyor.level = torch.rand(1, WINDOW, 3)
    level = echo.model.net.per_feature(queue.conveyor.level)
    noise = torch.randn(1, WINDOW, sum(echo.model.net.sizes))
    queue.conveyor.x = add_noise(truth_of(echo, queue.frames, old), noise, level, echo.model.schedule)
    turned, change = noise.clone(), new.R.mT @ old.R
    first = echo.model.net.sizes[0]
    for at in (0, 3, 6, first, first + 3, first + 6):
        turned[..., at : at + 3] = (change @ noise[..., at : at + 3, None])[..., 0]
    expected = add_noise(truth_of(echo, queue.frames, new), turned, level, echo.model.schedule)
    found = queue._reexpressed(queue.conveyor.x, new.inverse() @ old, queue.conveyor.level, queue.frames)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)
    assert (new.t - old.t).norm() > 0.1


@pytest.mark.parametrize("settings", [{}, {"frame": "window"}, {"rewindow": 3}, AVERAGED, MIRRORED, {"per_frame": 2}])
def test_batch_items_are_independent(settings):
    echo = drawn_echo(**settings)
    scenarios = [scenario_of(carrying(0.9)), scenario_of(carrying(0.7, carried=TWO[1:]), TWO[1:])]
    together = echo.capture_scenarios(scenarios, [3, 4])
    for scenario, seed, motion in zip(scenarios, (3, 4), together):
        alone = echo.capture_scenarios([scenario], [seed])[0]
        torch.testing.assert_close(motion.T_world_joint.t, alone.T_world_joint.t, atol=1e-3, rtol=0)
        torch.testing.assert_close(motion.body_contact_prob, alone.body_contact_prob, atol=1e-3, rtol=0)
        assert set(motion.object_motion or {}) == set(alone.object_motion or {})


def test_a_seed_determines_the_sample():
    echo, scenario = drawn_echo(), scenario_of(carrying(0.9))
    one, two, other = echo.capture_scenarios([scenario] * 3, [1, 1, 2])
    torch.testing.assert_close(one.R_parent_joint, two.R_parent_joint, atol=1e-4, rtol=0)
    assert not torch.allclose(one.R_parent_joint, other.R_parent_joint, atol=1e-3)


@pytest.mark.parametrize("seconds", [0.55, 1.1])
@pytest.mark.parametrize("settings", [{}, {"rewindow": 3}, {"rewindow": 8}, AVERAGED, AVERAGED | {"rewindow": 8}])
def test_every_frame_is_output_however_short_the_recording(seconds, settings):
    recording = carrying(seconds)
    motion = drawn_echo(**settings).capture([recording], [0])[0].motion
    assert torch.equal(motion.timestamps, recording.motion.timestamps)
    assert motion.R_parent_joint.isfinite().all()
    assert motion.object_motion is None


def test_windows_that_would_leave_frames_out_are_refused():
    with pytest.raises(WearcapError, match=r"advance by 9.*Expected 1 to 8"):
        drawn_echo(rewindow=9)


def test_averaged_windows_of_a_short_network_advance_by_what_it_has():
    recording = carrying(1.0)
    wide, most = (
        drawn_echo(**AVERAGED | {"rewindow": stride}).capture([recording], [0])[0].motion for stride in (14, 4)
    )
    assert torch.equal(wide.R_parent_joint, most.R_parent_joint)
    assert wide.provenance["rewindow"] == "4"
    with pytest.raises(WearcapError, match=r"advance by 0.*Expected 1 to 8"):
        drawn_echo(**AVERAGED | {"rewindow": 0})


def test_windows_take_as_many_steps_as_asked_for(monkeypatch):
    echo, taken = drawn_echo(rewindow=3), []
    given = replace(echo, sampling=replace(echo.sampling, rewindow_steps=2))
    conveyor = replace(echo, sampling=replace(echo.sampling, rewindow_steps=echo.rolling.steps))
    recording = carrying(1.0)
    whole = echo.capture([recording], [0])[0].motion
    assert torch.equal(conveyor.capture([recording], [0])[0].motion.R_parent_joint, whole.R_parent_joint)

    def counted(self, queue, conditioning, frame):
        denoise, corrections = denoiser(self, queue, conditioning, frame)
        return lambda x, level: taken.append(1) or denoise(x, level), corrections

    denoiser = Echo.denoiser
    monkeypatch.setattr(Echo, "denoiser", counted)
    motion = given.capture([recording], [0])[0].motion
    assert len(taken) == 2 * math.ceil(len(motion) / 3)
    assert not torch.allclose(motion.R_parent_joint, whole.R_parent_joint, atol=1e-3)


@pytest.fixture
def counting(monkeypatch) -> tuple[AveragedWindows, Conditioning]:
    """An empty queue whose windows predict a root at x = 0 m, 1 m, 2 m …, one after the other, and 40 frames for it."""
    echo, drawn = drawn_echo("world", **AVERAGED), []
    window, size = AveragedWindows.window, sum(echo.model.net.sizes)

    def placed(self, conditioning, before):
        x = torch.zeros_like(window(self, conditioning, before))
        x[..., 0], x[..., 3], x[..., 7] = len(drawn), 1.0, 1.0
        drawn.append(x.shape[1])
        return x

    monkeypatch.setattr(AveragedWindows, "window", placed)
    echo.model.net.motion_normalizer.set(torch.zeros(size), torch.ones(size))
    queue = echo.queue([echo.model.skeleton], [0], [{}], [[]])
    assert isinstance(queue, AveragedWindows)
    return queue, batch_item(echo, scenario_of(carrying(40 / FPS))).conditioning


def test_the_mean_of_windows_weighs_by_the_distance_from_their_ends(counting):
    queue, conditioning = counting
    root = queue.run(conditioning).t_world_root[0, :, 0]
    lookahead, expected = queue.rolling.ramp - queue.stride, torch.zeros(40)
    for frame in range(40):
        total = 0.0
        for k in range(20):
            stop = 3 * (k + 1)  # frames that have arrived
            start = max(0, stop - WINDOW)
            if not start <= frame < stop or frame < stop - 3 - lookahead:
                continue
            behind = frame - start + 1 if start else WINDOW
            ahead = stop - frame if stop <= 40 else WINDOW  # the capture has ended
            weight = min(behind, ahead, WINDOW // 2) ** 2
            expected[frame] += weight * k
            total += weight
        expected[frame] /= total
    torch.testing.assert_close(root, expected, atol=1e-4, rtol=0)


def test_what_was_predicted_before_a_head_pose_was_corrected_does_not_count(counting):
    """That of frame 13 is corrected when windows k = 4 (of 15 frames) have predicted it; those that end with 18 and 21 follow."""
    queue, conditioning = counting
    found = []
    for k in range(40):
        queue.push(conditioning.frames(slice(k, k + 1)))
        found += [] if (final := queue.take()) is None else final[1].t_world_root[0, :, 0].tolist()
        if k == 14:
            points = queue.frames.t_world_point.clone()
            points[:, 13] += 0.1
            queue.frames = queue.frames._replace(t_world_point=points)
    assert found[13] == pytest.approx((5**2 * 5 + 8**2 * 6) / (5**2 + 8**2), abs=1e-4)
    assert found[12] < 5.5, "windows before count for its neighbours"


@pytest.mark.parametrize("guidance", [None, Guidance(object=2.0)])
def test_a_mirrored_wearer_moves_as_the_mirrored_motion(guidance):
    """Without the mirrored windows, left and right differ. Meshes of objects are mirrored, too."""
    recording, apart = carrying(1.0, carried=TWO), {}
    observed = replace(everything(recording), motion=None, object_motion={})
    for name, settings in (("alone", AVERAGED), ("averaged", MIRRORED)):
        echo = drawn_echo(**settings, guidance=guidance)
        item = batch_item(echo, scenario_of(recording, TWO, observed=observed))
        seen = torch.arange(item.conditioning.valid.shape[1]) % 7 == 0
        whole = item.conditioning._replace(is_observed=item.conditioning.is_observed & seen[:, None])
        found = []
        for mirrored in (False, True):
            queue = echo.queue([echo.model.skeleton], [0], [{}], [item.objects])
            if mirrored and queue.guided is not None:
                surfaces, trees = (part[:1] for part in queue.guided)
                queue.guide((surfaces, [[KDTree(tree.data * [1.0, -1.0, 1.0]) for tree in mine] for mine in trees]))
            found.append(queue.run(whole.mirrored(echo.model.skeleton) if mirrored else whole))
        one, other = found[0], found[1].mirrored(echo.model.skeleton)
        apart[name] = max((a - b).abs().max().item() for a, b in zip(one, other))
    assert apart["averaged"] < 1e-3
    assert apart["alone"] > 0.1


def test_averaged_windows_have_the_latency_of_a_conveyor():
    echo, recording = drawn_echo(**AVERAGED), carrying(1.0)
    conditioning = batch_item(echo, scenario_of(recording)).conditioning
    queue, final = echo.queue([echo.model.skeleton], [0], [{}], [[]]), []
    for k in range(30):
        queue.push(conditioning.frames(slice(k, k + 1)))
        final.append(0 if (found := queue.take()) is None else found[1].t_world_root.shape[1])
        assert queue.frames.valid.shape[1] <= WINDOW
    latest = [first for first, count in zip(torch.tensor(final).cumsum(0).tolist(), final) if count]
    assert set(final) == {0, 1, 3}, "the first window has one frame that is old enough"
    assert latest == [k + 1 - (8 - 3) for k, count in enumerate(final) if count]
    assert echo.latency_s == pytest.approx(7 / FPS)


@pytest.mark.parametrize("settings", [{"rewindow_steps": 4}, {"rewindow": 3, "rewindow_steps": 0}])
def test_steps_of_windows_need_windows(settings):
    with pytest.raises(WearcapError, match="rewindow_steps=.*Expected at least one step"):
        drawn_echo(**settings)


def test_redrawn_noise_needs_the_conveyor():
    with pytest.raises(WearcapError, match="step=redraw with windows.*Expected step=posterior"):
        drawn_echo(rewindow=3, step="redraw")


def test_the_body_is_anchored_to_the_measured_head():
    recording = carrying(1.0)
    motion = drawn_echo().capture([recording], [0])[0].motion
    head, true = motion.joint("head"), recording.motion.joint("head")
    torch.testing.assert_close(head.t, true.t, atol=1e-4, rtol=0)
    torch.testing.assert_close(head.R, true.R, atol=1e-4, rtol=0)
    standing = drawn_echo(anchor=False).capture([recording], [0])[0].motion
    assert not torch.allclose(standing.joint("head").t, true.t, atol=1e-2)


def test_an_observed_body_is_not_anchored():
    recording = carrying(1.0)
    truth, device = recording.motion, recording.head
    seen = replace(
        truth,
        timestamps=truth.timestamps[9:10],
        R_parent_joint=truth.R_parent_joint[9:10],
        t_world_root=truth.t_world_root[9:10],
    )
    off = replace(recording, head=replace(device, t_world_device=device.t_world_device + 0.02))
    motion = drawn_echo().capture_scenarios([scenario_of(off, observed=Observed(seen))], [0])[0]
    torch.testing.assert_close(motion.T_world_joint.t[9:10], seen.T_world_joint.t, atol=1e-4, rtol=0)
    head, true = motion.joint("head").t, recording.motion.joint("head").t
    torch.testing.assert_close(head[10:], true[10:] + 0.02, atol=1e-4, rtol=0)


def test_objects_are_static_between_the_times_they_are_active():
    recording = carrying(1.2, carried=TWO)
    scenario = scenario_of(recording, TWO)
    motion = drawn_echo().capture_scenarios([scenario], [0])[0]
    for span in scenario.active_objects:
        track, time = motion.object_motion[span.object], motion.timestamps
        assert torch.equal(track.timestamps, time)
        before, behind = track.t_world_body[time < span.start_s], track.t_world_body[time >= span.stop_s]
        active = track.t_world_body[(time >= span.start_s) & (time < span.stop_s)]
        assert (before == active[:1]).all()
        assert (behind == active[-1:]).all()
        assert (active.diff(dim=0).norm(dim=-1) > 0).all()
    idle = torch.ones(len(motion), dtype=torch.bool)
    for span in scenario.active_objects:
        idle &= (motion.timestamps < span.start_s) | (motion.timestamps >= span.stop_s)
    assert not motion.body_contact_prob[idle].any()


def with_gap(recording, first: int, stop: int):
    head = recording.head
    keep = [k for k in range(len(head.timestamps)) if not first <= k < stop]
    return replace(
        recording,
        head=replace(
            head,
            timestamps=head.timestamps[keep],
            R_world_device=head.R_world_device[keep],
            t_world_device=head.t_world_device[keep],
        ),
    )


def test_after_a_gap_of_the_head_the_capture_restarts():
    whole = carrying(2.5)
    broken = with_gap(whole, 25, 55)
    echo = drawn_echo()
    motion = echo.capture([broken], [5])[0].motion
    assert len(motion) == 75
    assert (motion.R_parent_joint[25:55, 1] == motion.R_parent_joint[24, 1]).all(), "as before"
    cut = replace(
        whole,
        head=replace(
            whole.head,
            timestamps=whole.head.timestamps[:25],
            R_world_device=whole.head.R_world_device[:25],
            t_world_device=whole.head.t_world_device[:25],
        ),
    )
    first = echo.capture([cut], [5])[0].motion
    torch.testing.assert_close(motion.R_parent_joint[:25], first.R_parent_joint, atol=1e-4, rtol=0)


def test_the_latency_is_the_ramp():
    echo, recording = drawn_echo(), carrying(1.0)
    assert echo.latency_s == pytest.approx(7 / FPS)
    queue, conditioning = (
        EchoQueue(echo, [echo.model.skeleton], [0]),
        batch_item(echo, scenario_of(recording)).conditioning,
    )
    given = []
    for k in range(30):
        queue.push(conditioning.frames(slice(k, k + 1)))
        given.append(queue.take() is not None)
    assert given == [False] * 7 + [True] * 23


def test_a_queues_memory_is_bounded():
    echo = drawn_echo()
    queue, conditioning = (
        EchoQueue(echo, [echo.model.skeleton], [0]),
        batch_item(echo, scenario_of(carrying(2.0))).conditioning,
    )
    for k in range(60):
        queue.push(conditioning.frames(slice(k, k + 1)))
        assert queue.frames.valid.shape[1] == queue.conveyor.x.shape[1] <= WINDOW


def test_acts_may_be_listed():
    recording, environment = carrying(1.5), boxes()
    spans = [{"object": "box_1", "start_s": 0.9, "stop_s": 1.2}, {"object": "box_1", "start_s": 0.2, "stop_s": 0.4}]
    found = drawn_echo(active_objects=spans).scenario(recording, environment).active_objects
    assert [span.start_s for span in found] == [0.2, 0.9]
    assert drawn_echo(active_objects="none").scenario(recording, environment).active_objects == ()
    assert [span.object for span in drawn_echo().scenario(recording, environment).active_objects] == ["box_1"]
    assert drawn_echo().scenario(carrying(1.0, carried=()), None).active_objects == ()


def test_interactions_name_the_active_object_without_its_poses():
    recording = replace(carrying(1.5), object_motion={})
    assert [span.object for span in drawn_echo().scenario(recording, boxes()).active_objects] == ["box_1"]
    assert drawn_echo().scenario(replace(recording, interactions=None), boxes()).active_objects == ()


@pytest.mark.parametrize("wrong", ["guess", [{"object": "a"}], [{"object": "a", "start_s": 0.0, "end_s": 1.0}]])
def test_invalid_acts_are_refused(wrong):
    with pytest.raises(WearcapError, match="active_objects.*Expected .*a list of {object, start_s, stop_s}"):
        drawn_echo(active_objects=wrong)


def tracked(recording, **changes):
    """The recording with wrists from controllers at another rate, in place of the ground truth."""
    motion = carrying(recording.motion.timestamps[-1].item() + 0.1, fps=90.0).motion
    tracks = {}
    for joint in ("left_wrist", "right_wrist"):
        T = motion.joint(joint)
        tracks[joint] = Trajectory(motion.timestamps, T.R, T.t)
    return replace(recording, tracked=tracks | changes)


def test_wrists_of_controllers_are_as_good_as_true_ones():
    recording = carrying(1.0)
    echo = drawn_echo()
    one, two = (
        batch_item(echo, scenario_of(each)).conditioning
        for each in (recording, replace(tracked(recording), motion=None))
    )
    torch.testing.assert_close(one.t_world_point, two.t_world_point, atol=1e-4, rtol=0)
    torch.testing.assert_close(one.R_world_point, two.R_world_point, atol=1e-4, rtol=0)


def test_a_network_that_knows_gaps_takes_wrists_that_come_and_go():
    recording, features = carrying(1.0), small_features(gaps=True)
    known, late = tracked(recording), {}
    for joint, kept in (("left_wrist", slice(45, None)), ("right_wrist", slice(0, 30))):
        late[joint] = known.tracked[joint][kept]
    for tracks in (late, {"left_wrist": late["left_wrist"]}):
        given = replace(recording, tracked=tracks, motion=None)
        seen = batch_item(drawn_echo(features=features), scenario_of(given)).conditioning.seen[0]
        assert seen[:, 0].all()
        assert seen[:, 1].nonzero()[:, 0].tolist() == [*range(15, len(seen))]
        assert seen[:, 2].sum() == (1 + int(30 * (29 / 90 + UNSEEN_S)) if len(tracks) == 2 else 0)
        motion = drawn_echo(features=features)(given)
        assert motion.T_world_joint.t.isfinite().all()
    with pytest.raises(WearcapError, match="only left_wrist is tracked"):
        drawn_echo()(given)


def test_observations_may_be_in_double_precision():
    recording = carrying(1.0, carried=TWO)
    seen = everything(recording)
    motion = replace(
        recording.motion,
        R_parent_joint=recording.motion.R_parent_joint.double(),
        t_world_root=recording.motion.t_world_root.double(),
    )
    tracks = {
        name: Trajectory(track.timestamps, track.R_world_body.double(), track.t_world_body.double())
        for name, track in recording.object_motion.items()
    }
    echo = drawn_echo(anchor=False)
    one, two = (
        batch_item(echo, scenario_of(recording, TWO, observed=each)).conditioning
        for each in (seen, replace(seen, motion=motion, object_motion=tracks))
    )
    torch.testing.assert_close(one.t_world_object, two.t_world_object)
    torch.testing.assert_close(one.R_parent_joint, two.R_parent_joint)


def test_the_grip_of_these_tests_is_no_identity():
    assert not torch.allclose(GRIP.R, rotation.about_axis("z", torch.zeros(())), atol=0.1)
