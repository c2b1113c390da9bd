"""Watches that come late or early beside the head, from packets on clocks of their own to what the session gets."""

import time
from dataclasses import asdict

import pytest
import torch

from standing_person import FPS, acting
from watched_walk import drawn_pipeline
from wearcap.apps.live.clocks import AGREEING
from wearcap.apps.live.guided import TURN
from wearcap.apps.live.packets import Packet
from wearcap.apps.live.setup_estimation import SetupEstimation
from wearcap.apps.live.wearer import LiveWearer, Opener
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import about_axis, exp
from wearcap.sensors.imu import synthesize_imu
from wearcap.sensors.samples import HeadSample, WatchSample
from wearcap.systems.mocap_every.stream import MocapEverySession

DEVICES = ("head", "left_wrist", "right_wrist")
CLOCKS_S = {"head": 40.0, "left_wrist": -7e3, "right_wrist": 1.7e9}
"""What each device's clock shows at the beginning."""
LATE_S = {"head": 0.65, "left_wrist": 2.35, "right_wrist": 0.05}
"""Least time that packets take: the left watch seems 1.7 s late beside the head, the right one 0.6 s early."""
PLAN = [("stand", 10.0), ("turn", 8.0), ("stand", 5.0), ("walk", 8.0), ("stand", 1.0)]


class Kept:
    """A session that keeps what it is pushed."""

    fps = FPS

    def __init__(self):
        self.samples = []
        self.dropped, self.refused = [0], [{}]

    def push(self, samples) -> None:
        self.samples += samples[0]

    def poses(self, ended: bool = False) -> list[None]:
        return [None]


def packets(plan, late_s, batch_s: float = 0.0, head_leads_s: float = 0.06):
    """(packet, true time) in the order of arrival; the left watch's come in batches. Arrivals jitter by some ms."""
    motion, random = acting(1.75, plan, head_leads_s=head_leads_s), torch.Generator().manual_seed(2)
    seat, begin_s, found = Rigid(torch.eye(3), torch.tensor([0.09, 0.0, 0.075])), time.monotonic(), []
    for device in DEVICES:
        head, acc = device == "head", None if device == "head" else synthesize_imu(motion, device).acc_world
        T_world_device = motion.joint(device) @ (
            seat if head else Rigid(exp(torch.tensor([0.0, 0.0, 1.5])), 0 * seat.t)
        )
        turn, jitter_s = about_axis("z", torch.tensor(0.0 if head else 1.3)), 0.0
        for k, true_s in enumerate(motion.timestamps.tolist()):
            sent_s = CLOCKS_S[device] + true_s
            pose = T_world_device[k]
            sample = (
                HeadSample(sent_s, pose) if acc is None else WatchSample(sent_s, turn @ pose.R, turn @ acc[k], device)
            )
            if not batch_s or device != "left_wrist" or k % round(batch_s * FPS) == 0:  # what comes at once is in order
                jitter_s = 0.004 * torch.rand((), generator=random).item()
            left_s = true_s if device != "left_wrist" or not batch_s else batch_s * (k // round(batch_s * FPS) + 1)
            arrived_s = begin_s + left_s + late_s[device] + jitter_s
            found.append((Packet("", device, f"clock of {device}", sent_s, arrived_s, sample), true_s))
    return sorted(found, key=lambda each: each[0].arrived_s)


def guided() -> tuple[LiveWearer, Kept]:
    session = Kept()
    minute = lambda setup, guide: SetupEstimation(DEVICES, tracked=False, setup=setup, guided=guide)  # noqa: E731
    wearer = LiveWearer("", Opener(lambda wearer: session, DEVICES, False, False, minute))  # type: ignore[arg-type]
    wearer.guide()
    return wearer, session


def errors_s(wearer: LiveWearer, session: Kept, sent) -> dict[str, torch.Tensor]:
    """Time on the head's clock less true time, of the samples that reach the session, by device."""
    found: dict[str, list[float]] = {device: [] for device in DEVICES}
    truly_s = {id(packet.sample.T_world_device): true_s for packet, true_s in sent if packet.device == "head"}
    for packet, true_s in sent:
        count = len(session.samples)
        wearer.take(packet)
        for sample in session.samples[count:]:
            if isinstance(sample, HeadSample):  # it may have waited for a watch
                found["head"].append(sample.timestamp - CLOCKS_S["head"] - truly_s[id(sample.T_world_device)])
            else:
                found[packet.device].append(sample.timestamp - CLOCKS_S["head"] - true_s)
    return {device: torch.tensor(each) for device, each in found.items()}


@pytest.mark.parametrize("batch_s", [0.0, 1.0])
def test_samples_of_late_and_early_watches_reach_the_session_at_their_time(batch_s):
    wearer, session = guided()
    off = errors_s(wearer, session, packets(PLAN, LATE_S, batch_s))
    assert wearer.stage == "live"
    assert all(
        type(count) is int for count in asdict(wearer.status().counts).values() if count != {}
    )  # a report is JSON
    for device in DEVICES:
        assert len(off[device]) > 50
        assert off[device].abs().max() < 0.1, device
    notes = " ".join(wearer.notes)
    assert " late beside" in notes
    assert " early beside" in notes
    assert not [note for note in wearer.setup.notes if "beside" in note]  # of the clocks that run, not of the set-up


def test_a_session_waits_for_the_latest_watch():
    """Which it would take for silent: with MocapEvery, the head's samples of the same time come when the watch's do."""
    system = drawn_pipeline()
    sessions = []

    def opened(worn):
        sessions.append(MocapEverySession.of_wearers(system, [worn], 0, None))
        return sessions[-1]

    minute = lambda setup, guide: SetupEstimation(DEVICES, tracked=False, setup=setup, guided=guide)  # noqa: E731
    wearer = LiveWearer("", Opener(opened, DEVICES, False, False, minute))
    wearer.guide()
    frames = 0
    for packet, true_s in packets(PLAN, LATE_S):
        wearer.take(packet)
        if wearer.stage == "live":
            frames += sum(len(motion) for motion in wearer.poses(packet.arrived_s))
            last_s = true_s
    assert sessions[0].streams[0].silent == 0
    assert sessions[0].dropped == [0]
    frames += sum(len(motion) for motion in wearer.leave())
    assert frames > 60
    assert last_s > 31.9


def test_clocks_that_agree_are_left_alone():
    wearer, session = guided()
    off = errors_s(wearer, session, packets(PLAN, {"head": 0.05, "left_wrist": 0.04, "right_wrist": 0.06}))
    assert all(each.abs().max() < 0.03 for each in off.values())
    assert sum("left as it is" in note for note in wearer.notes) == 2


def test_a_watch_whose_clock_is_set_anew_counts_as_its_packets_show_again():
    wearer, session = guided()
    sent = packets(PLAN, LATE_S)
    errors_s(wearer, session, sent)
    assert wearer.stage == "live"
    old = next(packet for packet, _ in reversed(sent) if packet.device == "left_wrist")
    for k in range(AGREEING):
        arrived_s = old.arrived_s + (k + 1) / FPS
        wearer.take(old._replace(sent_s=3.0 + k / FPS, arrived_s=arrived_s))
    assert "left_wrist: a clock was set anew" in " ".join(wearer.notes)
    assert wearer.clocks.ours(session.samples[-1].timestamp) == pytest.approx(arrived_s, abs=0.01)


def test_guided_again_what_was_found_before_is_kept():
    """The second turn, of samples that count the first one's offset, finds nothing more."""
    wearer, session = guided()
    sent = packets([*PLAN, *PLAN], LATE_S)
    errors_s(wearer, session, sent[: len(sent) // 2])
    assert wearer.stage == "live"
    wearer.guide()
    off = errors_s(wearer, session, sent[len(sent) // 2 :])
    assert wearer.stage == "live"
    assert all(len(each) > 50 and each.abs().max() < 0.1 for each in off.values())


def test_a_turn_that_is_skipped_leaves_the_clocks_as_their_packets_show():
    wearer, session = guided()
    sent = packets(PLAN, LATE_S)
    at = next(k for k, (packet, _) in enumerate(sent) if packet.arrived_s > sent[0][0].arrived_s + 8.0)
    errors_s(wearer, session, sent[:at])
    assert wearer.first is not None
    assert wearer.first.step is not None
    assert wearer.first.step.name == TURN
    wearer.first.skip()
    off = errors_s(wearer, session, sent[at:])
    assert "was skipped" in " ".join(wearer.notes)
    assert off["left_wrist"].mean() == pytest.approx(1.7, abs=0.02)
    assert off["right_wrist"].mean() == pytest.approx(-0.6, abs=0.02)
