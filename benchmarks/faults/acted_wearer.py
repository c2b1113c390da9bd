"""A simulated wearer who does what the live page asks for, and devices that send it over loopback sockets in real time.

The simulator's acts begin and end standing; each is moved to where the wearer stands and blended into. What is sent is
sampled from the acted motion, which is kept as the truth.
"""

import json
import math
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder
from torch import Tensor

from wearcap.apps.live.setup import hand_seat
from wearcap.body.skeleton import WRISTS
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import about_axis, quat_wxyz_from_matrix
from wearcap.recording import Motion
from wearcap.recording.timing import joined
from wearcap.sensors.imu import acceleration
from wearsim.people.person import Person, draw_person
from wearsim.people.plan import Plan
from wearsim.people.track import ease
from wearsim.people.walking import turn_to, walk_along
from wearsim.people.wearer import TAIL_S, perform

TICKS_HZ, HEAD_HZ, WATCH_HZ = 300, 60, 100
CHUNK = 30
"""Ticks that are acted at once: what the page asks for is done a tenth of a second later at the soonest."""
BLEND_S = 0.5
ACC_TICKS = 6
"""Half the span over which acceleration is measured."""
WALK_M = 4.5
G_M_S2 = 9.80665
STAND = "stand"
ACTS = {
    "Stand still": STAND,
    "Let your arms hang": STAND,
    "Raise your left hand": "raise",
    "Walk some steps forward": "walk",
    "Turn on the spot": "turn",
}
"""What is done of each sentence of the page, by the sentence's beginning."""
WATCHES = ("watch-7", "watch-4")
"""What the watches call themselves: it tells nothing of their sides."""
CLOCKS_S = {"watch-7": -51.3, "watch-4": 7200.7}
"""What the watches' clocks show when the head's shows 0."""
HAND_UP = (0.25, 0.08, 0.85, 0.5, 0.0, 0.0)
"""A raised left hand, as `HandScore.pose`."""


def act_of(text: str) -> str | None:
    """What the page asks for; None where no known sentence is in its text."""
    return next((act for sentence, act in ACTS.items() if sentence in text), None)


class _OpenFloor:
    """A level floor without end."""

    @staticmethod
    def floor_height(points_xy: np.ndarray, from_z: np.ndarray) -> np.ndarray:
        return np.zeros(np.shape(points_xy)[:-1])


def acts_of(person: Person, seed: int) -> dict[str, Motion]:
    """Each act at `TICKS_HZ`, from standing to standing, the arms hanging and the head level."""
    rng = np.random.default_rng(seed)
    plans = {name: Plan(person, np.zeros(3), 0.0, _OpenFloor.floor_height) for name in (STAND, "raise", "turn", "walk")}
    for plan in plans.values():
        plan.time = 0.4
    plans[STAND].time = 8.0
    plans["raise"].hands["left"].take(HAND_UP, (0.4, 1.3), (4.0, 4.9))
    plans["raise"].time = 5.2
    for heading in (1.3, 0.0, 1.3, 0.0):
        turn_to(plans["turn"], heading, rng)
        plans["turn"].time += 0.4
    for there, back in ((WALK_M, 0.0), (0.0, WALK_M)):
        path = np.zeros((46, 3))
        path[:, 0] = np.linspace(back, there, len(path))
        walk_along(plans["walk"], path, rng, 1.15)
        plans["walk"].time += 0.5
        turn_to(plans["walk"], math.pi if there else 0.0, rng)
        plans["walk"].time += 0.5
    found = {}
    for name, plan in plans.items():
        duration, plan.time = plan.time + 0.5, plan.time + 0.5 + TAIL_S
        motion = perform(plan, _OpenFloor(), rng, duration, float(TICKS_HZ)).motion  # pyright: ignore[reportArgumentType]
        found[name] = motion.sliced(0, len(motion) // CHUNK * CHUNK)
    return found


class Actor:
    """Goes from act to act. `asked` may be set at any time; an act that was begun is done to its end."""

    def __init__(self, height_m: float, seed: int):
        """A person of about this height (m): the next one that the seed draws."""
        rng = np.random.default_rng(seed)
        people = (draw_person("acted", rng) for _ in range(10_000))
        self.person = next(one for one in people if abs(one.skeleton.stature - height_m) < 0.01)
        self.acts = acts_of(self.person, seed)
        self.asked = self.doing = STAND
        self.done: list[Motion] = []
        """The acted motion, in pieces of `CHUNK` ticks."""
        self._tick, self._step = 0, CHUNK
        self._place = Rigid(about_axis("z", torch.tensor(0.6)), torch.tensor([0.8, -0.5, 0.0]))
        self._left: tuple[Tensor, Tensor] | None = None
        """Rotations and root that are blended out of."""

    @property
    def motion(self) -> Motion:
        whole = joined(self.done)
        assert whole is not None
        return whole

    def go_on(self) -> Motion:
        """The next `CHUNK` ticks."""
        act = self.acts[self.doing]
        ended = not 0 <= self._tick + min(self._step, 0) < len(act)
        if self.doing == STAND and self.asked == STAND and ended:
            self._step = -self._step  # forth and back
        elif (self.doing == STAND and self.asked != STAND) or ended:
            self._change()
            act = self.acts[self.doing]
        start = self._tick + min(self._step, 0)
        ticks = torch.arange(start, start + CHUNK)
        first = ticks[0].item() if self._step > 0 else None
        R, t = act.R_parent_joint[ticks], act.t_world_root[ticks]
        if self._step < 0:
            R, t = R.flip(0), t.flip(0)
        self._tick += self._step
        R = torch.cat([(self._place.R @ R[:, 0])[:, None], R[:, 1:]], 1)
        R, t = self._blended(R, t @ self._place.R.T + self._place.t, first)
        begin = len(self.done) * CHUNK
        times = torch.arange(begin, begin + CHUNK, dtype=torch.float64) / TICKS_HZ
        self.done.append(Motion(times, act.skeleton, R, t))
        return self.done[-1]

    def _change(self) -> None:
        """Begin the act that is asked for, where the wearer stands."""
        self.doing = self.asked
        self._tick, self._step = 0, CHUNK
        act, last = self.acts[self.doing], self.done[-1]
        self._left = last.R_parent_joint[-1], last.t_world_root[-1]
        yaw = rotation.yaw_of(self._left[0][0]) - rotation.yaw_of(act.R_parent_joint[0, 0])
        R = about_axis("z", yaw)
        feet, stand = (_between_feet(each) for each in (last.sliced(CHUNK - 1, CHUNK), act.sliced(0, 1)))
        self._place = Rigid(R, (feet - R @ stand) * torch.tensor([1.0, 1.0, 0.0]))

    def _blended(self, R: Tensor, t: Tensor, first: int | None) -> tuple[Tensor, Tensor]:
        """The first `BLEND_S` of an act, blended out of where the wearer was."""
        if self._left is None or first is None or first >= BLEND_S * TICKS_HZ:
            self._left = None
            return R, t
        share = torch.from_numpy(ease((first + np.arange(CHUNK)) / (BLEND_S * TICKS_HZ))).float()
        R_left, t_left = self._left
        turn = rotation.log(R_left.mT @ R)
        return R_left @ rotation.exp(share[:, None, None] * turn), t_left + share[:, None] * (t - t_left)


def _between_feet(motion: Motion) -> Float[Tensor, "3"]:
    """Middle between the ankles (m) in a motion of one frame."""
    ankles = motion.skeleton.indices("left_ankle", "right_ankle")
    return motion.T_world_joint.t[0, ankles].mean(0)


@dataclass(frozen=True)
class Worn:
    """How the devices are worn."""

    T_head_device: Rigid
    T_wrist_device: tuple[Rigid, Rigid]
    """Of watches or controllers, left and right."""
    yaw_rad: tuple[float, float] = (0.0, 0.0)
    """Turn from each watch's own world to the head's."""

    @classmethod
    def of(cls, person: Person, watches: bool) -> "Worn":
        """A headset that is tilted by 5°; watches off their nominal place by some 10°, or held controllers."""
        head = Rigid(about_axis("y", torch.tensor(math.radians(5.0))), person.t_head_device)
        if not watches:
            seats = [hand_seat(joint, "grip") for joint in WRISTS]
            return cls(head, tuple(Rigid(seat.R_joint_device, seat.t_joint_device) for seat in seats))  # pyright: ignore[reportArgumentType]
        mounts = (rotation.exp(torch.tensor([0.0, 0.0, 1.45])), rotation.exp(torch.tensor([0.1, 0.0, 1.7])))
        return cls(head, tuple(Rigid(R, torch.zeros(3)) for R in mounts), (2.0, -1.1))  # pyright: ignore[reportArgumentType]


class Sender(threading.Thread):
    """Sends what the devices measure of the actor, in real time, until `stopped`."""

    def __init__(self, actor: Actor, ports: tuple[int, ...], watches: bool, slow: float = 1.0, seed: int = 0):
        """`ports`: of head, left and right watch; of a tracked head and hands, one. All goes `slow` times slower."""
        super().__init__(daemon=True)
        self.actor, self.ports, self.watches, self.slow = actor, ports, watches, slow
        self.worn = Worn.of(actor.person, watches)
        self.stopped = threading.Event()
        self.sent = 0
        self._random = torch.Generator().manual_seed(seed)
        self._kept: list[Rigid] = []
        """Head and wrists, "time joint", in the newest pieces."""

    def run(self) -> None:
        out, begun_s = socket.socket(type=socket.SOCK_DGRAM), time.monotonic()
        waiting: list[tuple[int, int, bytes]] = []
        while not self.stopped.is_set():
            now = (time.monotonic() - begun_s) * TICKS_HZ / self.slow
            while not waiting or waiting[-1][0] < now + CHUNK:
                waiting += sorted(self._messages(self.actor.go_on()))
            due = [one for one in waiting if one[0] <= now]
            waiting = waiting[len(due) :]
            for _, port, message in due:
                out.sendto(message, ("127.0.0.1", port))
                self.sent += 1
            time.sleep(0.004 * self.slow)

    def _messages(self, motion: Motion) -> Iterator[tuple[int, int, bytes]]:
        """(tick, port, message) of the newest ticks whose acceleration is known."""
        worn = motion.skeleton.indices("head", *WRISTS)
        joints = motion.T_world_joint
        self._kept = [*self._kept, Rigid(joints.R[:, worn], joints.t[:, worn])][-3:]
        R, t = (torch.cat([getattr(each, name) for each in self._kept]) for name in ("R", "t"))
        first = round(motion.timestamps[-1].item() * TICKS_HZ) + 1 - len(t)
        stop = first + len(t) - ACC_TICKS
        start = first if len(self._kept) == 1 else stop - CHUNK
        seats = (self.worn.T_head_device, *self.worn.T_wrist_device)
        devices = [self._noisy(Rigid(R[:, k], t[:, k]) @ seat) for k, seat in enumerate(seats)]
        for tick in _every(HEAD_HZ, start, stop):
            poses = [(device.t[tick - first], device.R[tick - first]) for device in devices]
            message = head_json if self.watches else vmc_bundle
            yield tick, self.ports[0], message(tick / TICKS_HZ, *poses[: 1 if self.watches else 3])
        for k, name in enumerate(WATCHES if self.watches else (), start=1):
            turn = about_axis("z", torch.tensor(-self.worn.yaw_rad[k - 1]))  # from the head's world to the watch's own
            noise = 0.05 * torch.randn(t[:, k].shape, generator=self._random)
            acc = acceleration(t[:, k], float(TICKS_HZ), ACC_TICKS) @ turn.T + noise
            ticks = _every(WATCH_HZ, start, stop)
            chosen = torch.tensor(ticks) - first
            for tick, values in zip(ticks, sensor_log(turn @ devices[k].R[chosen], acc[chosen]), strict=True):
                about = {"deviceID": name, "motionTimestamp_sinceReboot": tick / TICKS_HZ + CLOCKS_S[name]}
                yield tick, self.ports[k], json.dumps(about | values).encode()

    def _noisy(self, pose: Rigid) -> Rigid:
        turn = rotation.exp(math.radians(0.2) * torch.randn(*pose.t.shape, generator=self._random))
        return Rigid(pose.R @ turn, pose.t + 0.001 * torch.randn(*pose.t.shape, generator=self._random))


def _every(hz: int, start: int, stop: int) -> range:
    """Ticks of a device's samples."""
    step = TICKS_HZ // hz
    return range(-(-start // step) * step, stop, step)


def head_json(at_s: float, head: tuple[Tensor, Tensor]) -> bytes:
    """A head's position and rotation as wearcap's own JSON."""
    wxyz = quat_wxyz_from_matrix(head[1].double()).tolist()
    return json.dumps({"device": "head", "time": at_s, "position": head[0].tolist(), "rotation_wxyz": wxyz}).encode()


def sensor_log(R: Float[Tensor, "time 3 3"], acc: Float[Tensor, "time 3"]) -> list[dict[str, float]]:
    """Samples of a watch in its own world as SensorLog sends them: gravity and acceleration in g, reversed."""
    columns = {
        **dict(zip((f"motionQuaternion{axis}" for axis in "WXYZ"), quat_wxyz_from_matrix(R.double()).T.tolist())),
        **dict(zip((f"motionGravity{axis}" for axis in "XYZ"), (-R[:, 2]).T.tolist())),
        **dict(
            zip(
                (f"motionUserAcceleration{axis}" for axis in "XYZ"),
                (-(R.mT @ acc[..., None])[..., 0] / G_M_S2).T.tolist(),
            )
        ),
    }
    return [dict(zip(columns, row)) for row in zip(*columns.values())]


def vmc_bundle(at_s: float, *poses: tuple[Tensor, Tensor]) -> bytes:
    """Head and two controllers by the VMC protocol, in Unity's axes (left-handed, y up, z forward)."""
    built, timed = OscBundleBuilder(IMMEDIATELY), OscMessageBuilder("/VMC/Ext/T")  # pyright: ignore[reportArgumentType]
    timed.add_arg(float(at_s))
    built.add_content(timed.build())  # pyright: ignore[reportArgumentType]
    devices = (("Hmd", "HMD"), ("Con", "LeftHand"), ("Con", "RightHand"))
    quaternions = quat_wxyz_from_matrix(torch.stack([R for _, R in poses]).double()).tolist()
    for (kind, serial), (place, _), (w, a, b, c) in zip(devices, poses, quaternions, strict=True):
        x, y, z = place.tolist()
        message = OscMessageBuilder(f"/VMC/Ext/{kind}/Pos")
        for value in (serial, -y, z, x, b, -c, -a, w):
            message.add_arg(value)
        built.add_content(message.build())  # pyright: ignore[reportArgumentType]
    return built.build().dgram
