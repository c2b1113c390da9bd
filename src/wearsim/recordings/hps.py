"""Simulated HPS recordings: long sessions in a site, recorded by a suit, wrist sensors and a head camera.

A session follows the protocol of the HPS thesis' evaluation (§4.5). At a capture spot the wearer claps, stands in an
A-pose, walks about and leans on the table; then goes through the site and comes back after given distances to do the
same again.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import torch

from wearcap.errors import WearcapError
from wearcap.recording.motion import Motion
from wearcap.recording.recording import ImuStream, Intervals, Recording
from wearcap.sensors.imu import ImuNoise, synthesize_imu
from wearsim.people.actions import ACTIVITIES, FREE_M, follow, path_length
from wearsim.people.person import Person
from wearsim.people.plan import LEFT_SIGN, SIDES, Plan
from wearsim.people.walking import turn_to
from wearsim.people.wearer import TAIL_S, SimulatedMotion, perform
from wearsim.places.world import CaptureSpot, World
from wearsim.recordings.localization_noise import LocalizationNoise, by_gravity, localize_statistically
from wearsim.recordings.simulate import POOLS, drawn_person, seeded, with_truth, world_of
from wearsim.rendering.head_camera import HEAD_CAMERA_TRUTH, HeadCameraConfig, head_camera, view_texture
from wearsim.sensors.suit import SuitNoise, suit_motion

CLAP_WIDTH_S = 0.011
"""Deviation of the shock of two palms, as a wrist's sensor measures it."""
SITES = {"train": 8, "val": 3, "test": 5}
"""Sites of each split, fewer than flats: each needs a scan and photos."""
A_POSE = (0.02, 0.46, -0.84, 0.2, 0.0, 0.0)
"""Hand's pose channel (`HandScore.pose`): the arm hangs 30° off the body."""
CLAP_HEIGHT, CLAP_AHEAD = 0.02, 0.62
"""Wrist positions when the palms meet, from the shoulders, as shares of the arm's length: in front of the face."""
PALMS_M, APART_M = 0.045, 0.13
"""Distance of each wrist from the middle when the palms meet, and the additional distance before."""
IDLE = ("stand", "look_around", "gesture", "hold", "crouch", "turn")
"""Activities between walks, now and then."""
IDLE_SHARE = 0.3


@dataclass(frozen=True)
class Protocol:
    """Course of a session."""

    returns_m: tuple[float, ...] = (70.0, 200.0, 380.0)
    """Travelled distances after which the wearer is back at the spot, besides the start."""
    end_m: float = 410.0
    """The recording ends, at the spot, when about this distance is travelled."""
    stand_s: float = 3.0
    move_s: float = 10.0
    claps: int = 3
    clap_every_s: float = 240.0
    """Claps come at the start, at the end, and at the first stop after this time."""


@dataclass(frozen=True)
class HpsConfig(HeadCameraConfig):
    """Settings of a simulated recording."""

    fps: float = 60.0
    """Frame rate of suit and wrist sensors."""
    protocol: Protocol = field(default_factory=Protocol)
    suit: SuitNoise = field(default_factory=SuitNoise)
    imu: ImuNoise = field(default_factory=ImuNoise)
    localization: LocalizationNoise | None = field(default_factory=LocalizationNoise)
    """Noise of the localisation; None: it is to be found from the video."""
    clap_acc: tuple[float, float] = (30.0, 60.0)
    """Range of the palms' shock (m/s²)."""

    def __post_init__(self):
        super().__post_init__()
        if self.fps < 30:
            raise WearcapError(f"{self.fps} Hz of the suit", expected="30 Hz or more")


@dataclass(frozen=True)
class Simulated:
    """A recording, and the motion, with its claps, and world that it was made from."""

    recording: Recording
    motion: SimulatedMotion
    claps_s: list[float]
    world: World
    clock: tuple[float, float]
    """Clock of the camera: its lead over the suit's at the suit's zero (s), and its drift (ms per hour)."""

    def to_camera(self, suit_s: float) -> float:
        """Time of the camera's clock at a time of the suit's."""
        return suit_s * (1 + self.clock[1] / 3.6e6) + self.clock[0]


def simulate_hps(config: HpsConfig, name: str, split: str, seed: int, world: World | None = None) -> Simulated:
    """The recording of a seed; without a world, in the split's site of the same number.

    Streams of the suit run on its clock, the camera's and its localisation on the camera's. True are `motion`,
    `contacts`, `floor`, `intervals` ("stand" and "move" at the capture spot, by distance travelled), the camera's
    poses (`HEAD_CAMERA_TRUTH`); and in the motion's provenance the clock's offset and drift and the claps' times.
    """
    rng = seeded(5, split, seed)
    person = drawn_person(split, rng)
    world = world or world_of(split, seed % min(SITES[split], POOLS[split][1]), "site")
    session = _Session(world, person, rng, config.protocol)
    simulated, intervals = session.simulated(config.fps)
    motion, claps_s = simulated.motion, session.clap_times
    suit = suit_motion(motion, simulated.contact, config.suit, rng)
    strength = rng.uniform(*config.clap_acc, len(claps_s))
    imu = {}
    for side in SIDES:
        stream = synthesize_imu(motion, f"{side}_wrist", noise=config.imu, rng=rng, n=1)
        imu[f"{side}_wrist"] = _shaken_by_claps(stream, motion, claps_s, strength)
    camera, path, clock = head_camera(motion, person.t_head_device, config, rng)
    localization = None
    if config.localization is not None:
        texture = view_texture(world, path, max(1, round(config.camera_fps / 2)))
        localization = localize_statistically(path, config.localization, rng, texture)
        suit = by_gravity(suit, config.localization.map, rng)
    about = {
        "claps_s": " ".join(f"{time:.4f}" for time in claps_s),
        "camera_clock_offset_s": f"{clock[0]:.6f}",
        "camera_clock_drift_ms_per_h": f"{clock[1]:.3f}",
    }
    documented = replace(motion, provenance=motion.provenance | about)
    recording = with_truth(
        replace(simulated, motion=documented),
        person,
        name,
        world.name,
        "session",
        imu=imu,
        suit=suit,
        camera=camera,
        localization=localization,
        object_motion={HEAD_CAMERA_TRUTH: path},
        intervals=intervals,
    )
    return Simulated(recording, simulated, claps_s, world, clock)


def _shaken_by_claps(stream: ImuStream, motion: Motion, claps_s: list[float], strength: np.ndarray) -> ImuStream:
    """Readings of a wrist's sensor; palms that meet push the wrists apart for some hundredths of a second."""
    own, other = (f"{side}_wrist" for side in (SIDES if stream.joint == "left_wrist" else SIDES[::-1]))
    apart = motion.joint(own).t - motion.joint(other).t
    apart = apart / apart.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    times = stream.timestamps[:, None] - torch.tensor(claps_s, dtype=torch.float64)
    pulse = (torch.exp(-0.5 * (times / CLAP_WIDTH_S) ** 2) * torch.from_numpy(strength)).sum(1).float()
    shock = pulse[:, None] * apart
    assert stream.acc_world is not None
    assert stream.acc_imu is not None
    R = motion.joint(own).R
    return replace(
        stream,
        acc_world=stream.acc_world + shock,
        acc_imu=stream.acc_imu + (R.transpose(-1, -2) @ shock[..., None])[..., 0],
    )


class _Session:
    """The plan in the making, and the distance walked so far."""

    def __init__(self, world: World, person: Person, rng: np.random.Generator, protocol: Protocol):
        self.world, self.rng, self.protocol = world, rng, protocol
        self.spot: CaptureSpot = world.places.spots[0]
        self.home = np.array(self.spot.position)
        self.plan = Plan(person, self.home.copy(), self.spot.heading, world.floor_height)
        self.plan.time = 0.8
        self.travelled = 0.0
        self.stretches: list[tuple[float, float, str]] = []
        self.clap_times: list[float] = []
        self._length_home = world.navigation.lengths_from(self.home)

    def simulated(self, fps: float) -> tuple[SimulatedMotion, Intervals]:
        """The whole session, at the world's first capture spot, and its stretches there ("stand" and "move")."""
        self.visit()
        for distance in self.protocol.returns_m:
            self.wander(distance)
            self.go_home()
            self.visit()
        self.wander(self.protocol.end_m)
        self.go_home()
        self.clap()
        plan = self.plan
        plan.time += 1.0
        duration = plan.time
        ACTIVITIES["stand"].act(plan, self.world, self.rng)
        plan.time = max(plan.time, duration + TAIL_S)
        simulated = perform(plan, self.world, self.rng, duration, fps)
        path_so_far = simulated.motion.t_world_root[:, :2].diff(dim=0).norm(dim=-1).cumsum(0).numpy()
        starts, stops, names = zip(*self.stretches)
        travelled = np.interp(starts, simulated.motion.timestamps.numpy()[1:], path_so_far)
        spans = (torch.tensor(ends, dtype=torch.float64) for ends in (starts, stops))
        return simulated, Intervals(*spans, torch.from_numpy(travelled).float(), names)

    def walk(self, goal: np.ndarray, heading: float | None = None) -> bool:
        path = self.world.plan_path(self.plan.position, goal, self.rng)
        if path is None:
            return False
        start = self.plan.time
        follow(self.plan, self.world, self.rng, path, heading)
        self.plan.label(start, "walk")
        self.travelled += path_length(path)
        return True

    def wander(self, until_m: float) -> None:
        """Walk from place to place as long as the path home leaves room for it."""
        points = self.world.navigation.node_points
        free = (self.world.navigation.clearance_at(points) > FREE_M) & ~self.world.on_stairs(points)
        while True:
            there = self.world.navigation.lengths_from(self.plan.position)
            left = until_m - self.travelled
            fits = np.flatnonzero(free & (there > 2.5) & (there + self._length_home < left + 1.5))
            if not len(fits):
                return
            # the last walk before home uses up what is left; others go anywhere
            total = there[fits] + self._length_home[fits]
            last = fits[total > left - 3.0] if left < 1.6 * total.max() else fits
            goal = points[self.rng.choice(last if len(last) else fits)]
            if not self.walk(goal) or self.rng.random() < IDLE_SHARE:
                start, name = self.plan.time, str(self.rng.choice(IDLE))
                ACTIVITIES[name].act(self.plan, self.world, self.rng)
                self.plan.label(start, name)

    def go_home(self) -> None:
        self.walk(self.home, self.spot.heading)

    def visit(self) -> None:
        """Activities at the spot: claps where due, the A-pose, moving about."""
        if not self.clap_times or self.plan.time - self.clap_times[-1] > self.protocol.clap_every_s:
            self.clap()
        self.stand()
        self.move_about()

    def clap(self) -> None:
        """Raise the hands and clap; palms meet at `clap_times`."""
        plan, rng, start = self.plan, self.rng, self.plan.time
        wide = float(plan.skeleton.t_parent_joint[plan.skeleton.indices("left_collar", "left_shoulder"), 1].sum())
        pose = lambda gap: (CLAP_AHEAD, (gap - wide) / plan.arm_length, CLAP_HEIGHT, 0.5, 0.0, 0.0)  # noqa: E731
        raise_s = 0.8
        time = start + raise_s + 0.2
        hands = [plan.hands[side] for side in SIDES]
        for hand in hands:
            hand.pose.move(start, start, pose(PALMS_M + APART_M))
            hand.pose_weight.move(start, start + raise_s, 1.0)
        for _ in range(self.protocol.claps):
            quick = float(rng.uniform(0.22, 0.28))
            for hand in hands:
                hand.pose.move(time, time + quick, pose(PALMS_M))
                hand.pose.move(time + quick + 0.05, time + quick + 0.55, pose(PALMS_M + APART_M))
            self.clap_times.append(time + quick)
            time += float(rng.uniform(0.95, 1.25))
        for hand in hands:
            hand.pose_weight.move(time, time + raise_s, 0.0)
        plan.time = time + raise_s + 0.3
        plan.label(start, "clap")

    def stand(self) -> None:
        """Hold an A-pose."""
        plan, start, rise = self.plan, self.plan.time, 0.9
        stop = start + rise + 0.2 + self.protocol.stand_s
        for side in SIDES:
            plan.hands[side].take(A_POSE, (start, start + rise), (stop, stop + rise))
        self.stretches.append((start + rise + 0.2, stop, "stand"))
        plan.time = stop + rise + 0.1
        plan.label(start, "stand")

    def move_about(self) -> None:
        """Step about within the spot, lean on the table, and come back to the middle."""
        plan, start = self.plan, self.plan.time
        ahead = np.array([np.cos(self.spot.heading), np.sin(self.spot.heading)])
        side = np.array([-ahead[1], ahead[0]]) * self.rng.choice([-1.0, 1.0])
        far = 0.28 * self.spot.size
        at_table = self.home.copy()
        at_table[:2] += (self.spot.table_m - 0.32) * ahead
        self.walk(at_table, self.spot.heading)
        self._lean(ahead)
        for off in (side * far, -ahead * far, -side * far):
            if plan.time - start < self.protocol.move_s:
                self.walk(self.home + np.append(off, 0.0))
        self.walk(self.home, self.spot.heading)
        self.stretches.append((start, plan.time, "move"))

    def _lean(self, ahead: np.ndarray) -> None:
        """Put both hands on the table, lean over it, and rise again."""
        plan, start = self.plan, self.plan.time
        across = np.array([-ahead[1], ahead[0]])
        out, pause, back = 0.9, float(self.rng.uniform(1.2, 2.2)), 0.9
        there, home = (start, start + out), (start + out + pause, start + out + pause + back)
        for hand_side in SIDES:
            place = self.home[:2] + (self.spot.table_m + 0.06) * ahead + LEFT_SIGN[hand_side] * 0.22 * across
            height = self.home[2] + self.spot.table_z + 0.07
            plan.hands[hand_side].go_for(np.append(place, height), there, home)
        plan.lean.visit((0.5, 0.0, 0.0), there, home)
        plan.time = start + out + pause + back + 0.2
        turn_to(plan, plan.heading + 1.2 * float(self.rng.choice([-1.0, 1.0])), self.rng)
        plan.label(start, "lean")
