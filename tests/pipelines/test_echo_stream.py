"""Streaming ECHO: the same motion and objects as a whole capture; late input counts while its frames are not final."""

from dataclasses import replace

import pytest
import torch

from carried_box import CARRIED, boxes, carrying, drawn_echo, scenario_of, scene_object
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion
from wearcap.recording.active_objects import active_at
from wearcap.recording.timing import joined
from wearcap.runtime.wearer import Wearer
from wearcap.scene.objects import Environment
from wearcap.systems.echo.stream import EchoStream
from wearcap.tracking.floor import CARRIED as HEAD_CARRIED

TWO = (("box_1", "left", 0.1, 0.4), ("box_2", "right", 0.7, 0.9))
WRISTS = ("left_wrist", "right_wrist")
AVERAGED = {"rewindow": 3, "rewindow_steps": 1, "average": True}
NAN = Rigid(torch.full((3, 3), torch.nan), torch.zeros(3))


def wearer(recording, **changes) -> Wearer:
    head = recording.head
    return Wearer(recording.skeleton, head.R_head_device, head.t_head_device, **{"floor_m": 0.0} | changes)


def feed(session: EchoStream, recording, frame: int, wrists=WRISTS) -> None:
    head = recording.head
    time = head.timestamps[frame].item()
    session.head(time, head.T_world_device[frame])
    for joint in wrists:
        session.wrist(joint, time, recording.motion.joint(joint)[frame])


def streamed(session: EchoStream, recording, before=None, frames=None, wrists=WRISTS) -> tuple[Motion, list[int]]:
    """The joined poses, and how many had come out after each frame; `before(frame)` happens first."""
    parts, counts = [], []
    for frame in frames or range(len(recording.motion)):
        if before is not None:
            before(frame)
        feed(session, recording, frame, wrists)
        parts.append(session.poses())
        counts.append(sum(len(part) for part in parts if part is not None))
    parts.append(session.poses(ended=True))
    return joined([part for part in parts if part is not None]), counts


def activate_objects(session: EchoStream, scenario) -> None:
    for span in scenario.active_objects:
        session.activate(span.object, span.start_s)
        session.activate(None, span.stop_s)


def assert_same(motion: Motion, whole: Motion, scenario) -> None:
    torch.testing.assert_close(motion.timestamps, whole.timestamps, atol=1e-6, rtol=0)
    torch.testing.assert_close(motion.T_world_joint.t, whole.T_world_joint.t, atol=1e-3, rtol=0)
    for name in ("contact_prob", "body_contact_prob"):
        torch.testing.assert_close(getattr(motion, name), getattr(whole, name), atol=1e-3, rtol=0)
    for span in scenario.active_objects:
        active = active_at([span], [span.object], whole.timestamps) == 0
        found, given = motion.object_motion[span.object], whole.object_motion[span.object]
        torch.testing.assert_close(found.t_world_body, given.t_world_body[active], atol=1e-3, rtol=0)
        torch.testing.assert_close(found.R_world_body, given.R_world_body[active], atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    "settings", [{}, {"frame": "window"}, {"anchor": False}, {"per_frame": 2, "context": 0}, {"placed": True}]
)
def test_a_stream_equals_a_capture_of_the_whole_recording(settings):
    """Two objects, one after the other, with nothing between."""
    recording, echo = carrying(1.2, carried=TWO), drawn_echo(**settings)
    scenario = replace(scenario_of(recording, TWO), placed=echo.placed)
    session = EchoStream(echo, wearer(recording), boxes(TWO), seed=3)
    activate_objects(session, scenario)
    motion, counts = streamed(session, recording)
    assert_same(motion, echo.capture_scenarios([scenario], [3])[0], scenario)
    latency = round(echo.latency_s * echo.fps)
    assert counts == [max(0, k - latency) + (k >= latency) for k in range(len(counts))]
    assert session.dropped == session.silent == 0


@pytest.mark.parametrize(
    "settings", [{}, {"frame": "window"}, {"anchor": False}, {"placed": True}, {"mirror_average": True}]
)
def test_a_stream_of_averaged_windows_equals_a_capture_of_the_whole_recording(settings):
    recording, echo = carrying(1.2, carried=TWO), drawn_echo(**AVERAGED, **settings)
    scenario = replace(scenario_of(recording, TWO), placed=echo.placed)
    session = EchoStream(echo, wearer(recording), boxes(TWO), seed=3)
    activate_objects(session, scenario)
    motion, counts = streamed(session, recording)
    assert_same(motion, echo.capture_scenarios([scenario], [3])[0], scenario)
    assert all(0 <= k + 1 - count <= round(echo.latency_s * echo.fps) + 1 for k, count in enumerate(counts))


def test_averaged_windows_forget_what_they_predicted_before_an_object_was_seen():
    """The object's pose arrives after windows have predicted that frame."""
    recording = carrying(1.2)
    echo = drawn_echo(**AVERAGED, anchor=False)
    session = EchoStream(echo, wearer(recording), boxes(), seed=3)
    activate_objects(session, scenario_of(recording))
    track, at = recording.object_motion["box_1"], 15
    time = recording.motion.timestamps[at].item()
    seen = Rigid(track.R_world_body[at], track.t_world_body[at])
    motion, _ = streamed(session, recording, lambda k: session.see_object("box_1", time, seen) if k == at + 4 else None)
    found = motion.object_motion["box_1"]
    k = int((found.timestamps - time).abs().argmin())
    torch.testing.assert_close(found.t_world_body[k], seen.t, atol=1e-4, rtol=0)


def test_objects_in_a_stream_are_static_from_their_first_contact_on():
    """Frames before the first contact are final before it is detected; afterwards the object moves only while
    touched."""
    recording = carrying(1.2, carried=TWO)
    scenario = scenario_of(recording, TWO)
    drawn = drawn_echo().capture_scenarios([scenario], [3])[0]
    likely = drawn.body_contact_prob.amax(1)
    threshold = likely[likely > 0].median().item()
    session = EchoStream(drawn_echo(static_threshold=threshold), wearer(recording), boxes(TWO), seed=3)
    activate_objects(session, scenario)
    motion, _ = streamed(session, recording)
    for span in scenario.active_objects:
        active = (active_at([span], [span.object], drawn.timestamps) == 0).nonzero()[:, 0]
        touched = likely[active] >= threshold
        first = int(touched.nonzero()[0])
        assert not touched[first:].all()
        found = motion.object_motion[span.object].t_world_body
        path = drawn.object_motion[span.object].t_world_body[active]
        torch.testing.assert_close(found[: first + 1], path[: first + 1], atol=1e-3, rtol=0)
        moves = found.diff(dim=0).norm(dim=1) > 1e-6
        assert not (moves & ~touched[1:])[first:].any()
        assert (moves & touched[1:])[first:].any()


def test_a_human_alone_needs_no_objects():
    recording, echo = carrying(1.0), drawn_echo()
    motion, _ = streamed(EchoStream(echo, wearer(recording), seed=1), recording)
    whole = echo.capture([recording], [1])[0].motion
    torch.testing.assert_close(motion.T_world_joint.t, whole.T_world_joint.t, atol=1e-3, rtol=0)
    assert motion.object_motion is None


@pytest.mark.parametrize(("late", "settings"), [(0, {}), (3, {}), (6, {}), (0, AVERAGED), (3, AVERAGED)])
def test_an_object_may_be_activated_until_its_frames_are_final(late, settings):
    """The span begins at frame 20; frames that were output already do not change."""
    recording, echo = carrying(1.4), drawn_echo(**settings)
    session = EchoStream(echo, wearer(recording), boxes(), seed=3)
    start = recording.motion.timestamps[20].item()
    motion, _ = streamed(
        session, recording, lambda frame: session.activate("box_1", start) if frame == 21 + late else None
    )
    track = motion.object_motion["box_1"]
    assert track.timestamps[0].item() == pytest.approx(start, abs=1e-6)
    assert len(track) == len(motion) - 20
    assert track.t_world_body.isfinite().all()


@pytest.mark.parametrize(("final", "settings"), [(18, {}), (19, AVERAGED)])
def test_what_is_final_stays_as_it_was(final, settings):
    recording, echo = carrying(1.4), drawn_echo(**settings)
    session = EchoStream(echo, wearer(recording), boxes(), seed=3)
    motion, _ = streamed(session, recording, lambda frame: session.activate("box_1", 0.0) if frame == 25 else None)
    alone = echo.capture([recording], [3])[0].motion
    torch.testing.assert_close(motion.T_world_joint.t[:final], alone.T_world_joint.t[:final], atol=1e-3, rtol=0)
    assert motion.object_motion["box_1"].timestamps[0].item() == pytest.approx(final / 30, abs=1e-6)


def test_an_observed_object_is_at_its_observed_pose():
    recording, echo = carrying(1.4), drawn_echo(anchor=False)
    session = EchoStream(echo, wearer(recording), boxes(), seed=3)
    session.activate("box_1", 0.0)
    track = recording.object_motion["box_1"]

    def look(frame: int) -> None:
        if frame in (14, 30):  # the pose of four frames ago has been found
            session.see_object("box_1", track.timestamps[frame - 4].item(), track.T_world_body[frame - 4])

    motion, _ = streamed(session, recording, look)
    found = motion.object_motion["box_1"]
    for frame in (10, 26):
        torch.testing.assert_close(found.t_world_body[frame], track.t_world_body[frame], atol=1e-4, rtol=0)
        torch.testing.assert_close(found.R_world_body[frame], track.R_world_body[frame], atol=1e-4, rtol=0)
    assert (found.t_world_body[18] - track.t_world_body[18]).norm() > 0.01


@pytest.mark.parametrize("settings", [{}, AVERAGED])
def test_the_observation_nearest_in_time_counts(settings):
    recording, echo = carrying(1.0), drawn_echo(anchor=False, **settings)
    session = EchoStream(echo, wearer(recording), boxes(), seed=3)
    session.activate("box_1", 0.0)
    track = recording.object_motion["box_1"]
    away = Rigid(torch.eye(3), torch.full((3,), 5.0))

    def look(frame: int) -> None:
        if frame == 14:
            time = track.timestamps[10].item()
            for shift, pose in ((-0.015, away), (0.0, track.T_world_body[10]), (0.015, away)):
                session.see_object("box_1", time + shift, pose)

    motion, _ = streamed(session, recording, look)
    found = motion.object_motion["box_1"].t_world_body[10]
    torch.testing.assert_close(found, track.t_world_body[10], atol=1e-4, rtol=0)


def test_observations_of_one_object_do_not_apply_to_another():
    recording, echo = carrying(1.4, carried=TWO), drawn_echo(anchor=False)
    session = EchoStream(echo, wearer(recording), boxes(TWO), seed=3)
    session.activate("box_1", 0.0)
    far = Rigid(torch.eye(3), torch.tensor([50.0, 0.0, 0.0]))

    def happen(frame: int) -> None:
        if frame == 20:
            session.see_object("box_1", 18 / 30, far)
        if frame == 21:
            session.activate("box_2", 15 / 30)

    motion, _ = streamed(session, recording, happen)
    assert motion.object_motion["box_2"].t_world_body.abs().max() < 20


@pytest.mark.parametrize("broken", [NAN, Rigid(torch.eye(3), torch.tensor([0.0, torch.inf, 0.0]))])
def test_what_is_not_finite_is_left_out(broken):
    recording, echo = carrying(1.0), drawn_echo()
    session = EchoStream(echo, wearer(recording), boxes(), seed=3)
    session.activate("box_1", 0.0)

    def happen(frame: int) -> None:
        time = frame / 30
        if frame in (5, 12):
            session.head(time - 0.01, broken)
            session.head(float("nan"), recording.head.T_world_device[frame])
            session.wrist("left_wrist", time - 0.01, broken)
            session.wrist("left_wrist", float("nan"), recording.motion.joint("left_wrist")[frame])
            session.see_object("box_1", time - 2 / 30, broken)
            session.see_object("box_1", float("nan"), Rigid.identity())

    motion, _ = streamed(session, recording, happen)
    plain = EchoStream(echo, wearer(recording), boxes(), seed=3)
    plain.activate("box_1", 0.0)
    expected, _ = streamed(plain, recording)
    torch.testing.assert_close(motion.T_world_joint.t, expected.T_world_joint.t, atol=1e-3, rtol=0)
    assert session.dropped == 4


def test_wrists_may_come_late_and_in_any_order():
    recording, echo = carrying(1.4), drawn_echo()
    session, parts = EchoStream(echo, wearer(recording), seed=3), []
    count = len(recording.motion)
    for frame in range(count):
        feed(session, recording, frame, ())
        if frame % 6 == 5 or frame == count - 1:
            for back in reversed(range(frame - frame % 6, frame + 1)):
                for joint in WRISTS:
                    session.wrist(joint, back / 30, recording.motion.joint(joint)[back])
        parts.append(session.poses())
    parts.append(session.poses(ended=True))
    motion = joined([part for part in parts if part is not None])
    whole = echo.capture([recording], [3])[0].motion
    torch.testing.assert_close(motion.T_world_joint.t, whole.T_world_joint.t, atol=1e-3, rtol=0)
    assert session.silent == 0


def test_a_pose_that_comes_twice_is_left_out_however_late():
    recording, echo = carrying(1.0), drawn_echo()
    session = EchoStream(echo, wearer(recording), seed=3)

    def repeat(frame: int) -> None:
        if frame > 8:
            session.wrist("left_wrist", (frame - 8) / 30, recording.motion.joint("left_wrist")[frame - 8])

    fine = recording.motion.timestamps + 0.01  # between two wrists' poses
    shifted = replace(recording, head=replace(recording.head, timestamps=fine))
    parts = []
    for frame in range(len(fine)):
        repeat(frame)
        session.head(fine[frame].item(), shifted.head.T_world_device[frame])
        for joint in WRISTS:
            session.wrist(joint, frame / 30, recording.motion.joint(joint)[frame])
        parts.append(session.poses())
    parts.append(session.poses(ended=True))
    assert joined([part for part in parts if part is not None]).R_parent_joint.isfinite().all()


def test_a_silent_wrist_is_counted_and_does_not_block():
    recording = carrying(2.0)
    session = EchoStream(drawn_echo(), wearer(recording), seed=3)
    motion, _ = streamed(session, recording, wrists=("left_wrist",))
    assert len(motion) == len(recording.motion)
    assert session.silent == len(motion)
    assert motion.R_parent_joint.isfinite().all()


def test_after_a_gap_it_restarts_as_the_whole_capture_does():
    recording, echo = carrying(3.0), drawn_echo()
    keep = [*range(30), *range(60, 90)]
    head = recording.head
    observed = replace(
        recording,
        head=replace(
            head,
            timestamps=head.timestamps[keep],
            R_world_device=head.R_world_device[keep],
            t_world_device=head.t_world_device[keep],
        ),
    )
    session = EchoStream(echo, wearer(recording), seed=5)
    parts = []
    for frame in range(90):
        time = frame / 30
        if frame in keep:
            session.head(time, head.T_world_device[frame])
        for joint in WRISTS:
            session.wrist(joint, time, recording.motion.joint(joint)[frame])
        parts.append(session.poses())
    parts.append(session.poses(ended=True))
    motion = joined([part for part in parts if part is not None])
    whole = echo.capture([observed], [5])[0].motion
    torch.testing.assert_close(motion.timestamps, whole.timestamps[keep], atol=1e-6, rtol=0)
    torch.testing.assert_close(motion.T_world_joint.t, whole.T_world_joint.t[keep], atol=1e-3, rtol=0)


def test_a_lost_head_does_not_block_output():
    recording = carrying(2.0)
    session = EchoStream(drawn_echo(), wearer(recording), seed=5)
    count = 0
    for frame in range(60):
        head = recording.head.T_world_device[frame] if frame < 30 else None
        session.head(frame / 30, head)
        for joint in WRISTS:
            session.wrist(joint, frame / 30, recording.motion.joint(joint)[frame])
        outputs = session.poses()
        count += 0 if outputs is None else len(outputs)
    assert count >= 30
    assert session.windows.pending == 0
    assert session.poses(ended=True) is None


def test_a_streams_memory_is_bounded():
    recording, echo = carrying(2.0), drawn_echo()
    session = EchoStream(echo, wearer(recording), boxes(), seed=3)
    sizes = []
    for lap in range(4):
        for frame in range(40):
            time = 4 / 3 * lap + frame / 30
            session.head(time, recording.head.T_world_device[frame])
            for joint in WRISTS:
                session.wrist(joint, time, recording.motion.joint(joint)[frame])
            if frame % 10 == 0:
                session.activate("box_1" if frame % 20 else None, time)
                session.see_object("box_1", time, recording.object_motion["box_1"].T_world_body[frame])
            session.poses()
        sizes.append(
            (
                *(len(part) for part in session._wrists.samples.values()),
                len(session._objects.changes),
                len(session._objects.seen),
                session.windows.pending,
                len(session._chunks),
            )
        )
    assert sizes[3] == sizes[1]


def at(time_s: float) -> torch.Tensor:
    return torch.tensor([time_s], dtype=torch.float64)


def test_the_floor_follows_from_a_standing_wearer():
    recording = carrying(0.6)
    session = EchoStream(drawn_echo(), wearer(recording, floor_m=None), seed=0)
    streamed(session, recording)
    floor = (
        session.windows.frames.floor_height
        if session.windows
        else session._frame(at(1.0), recording.motion.joint("head")[:1]).floor_height
    )
    assert floor[0, -1].item() == pytest.approx(0.0, abs=0.1)


def test_the_floor_is_found_after_sitting_and_standing_up():
    recording = carrying(0.6)
    session = EchoStream(drawn_echo(), wearer(recording, floor_m=None), seed=0)
    head, low = recording.motion.joint("head")[:1], torch.tensor([0.0, 0.0, 0.5])
    sitting = [session._frame(at(k / 30), Rigid(head.R, head.t - low)).floor_height.item() for k in range(30)]
    standing = [session._frame(at(1 + k / 30), head).floor_height.item() for k in range(60)]
    assert sitting == pytest.approx([standing[-1] - 0.5] * 30, abs=1e-3)
    carried_m = HEAD_CARRIED * recording.skeleton.height_of("head")
    assert standing[-1] == pytest.approx(head.t[0, 2].item() - carried_m, abs=1e-3)


def test_unknown_names_are_refused():
    session = EchoStream(drawn_echo(), Wearer(carrying(0.6).skeleton), boxes())
    for call in (lambda: session.activate("ghost", 0.0), lambda: session.see_object("ghost", 0.0, Rigid.identity())):
        with pytest.raises(WearcapError, match="no object 'ghost'. Expected one of box_1"):
            call()
    with pytest.raises(WearcapError, match="no tracked joint 'nose'. Expected left_wrist or right_wrist"):
        session.wrist("nose", 0.0, Rigid.identity())


def test_objects_that_cannot_be_used_are_refused_when_they_are_named():
    mesh = boxes(CARRIED).by_name("box_1").mesh
    huge = Mesh(mesh.vertices * 1000, mesh.faces, mesh.color)
    surroundings = Environment((scene_object("a", mesh=huge), scene_object("b", "piano")))
    session = EchoStream(drawn_echo(), Wearer(carrying(0.6).skeleton), surroundings)
    with pytest.raises(WearcapError, match="object 'a': .*looks like millimetres"):
        session.activate("a", 0.0)
    with pytest.raises(WearcapError, match="has no object class 'piano'"):
        session.activate("b", 0.0)
    with pytest.raises(WearcapError, match="no object 'c'"):
        session.activate("c", 0.0)


def test_windows_that_inpaint_their_overlap_are_no_stream():
    with pytest.raises(WearcapError, match="rewindow=3. Expected average=true, or a conveyor"):
        EchoStream(drawn_echo(rewindow=3), Wearer(carrying(0.6).skeleton))
