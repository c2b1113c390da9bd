"""Arms: swing against the legs, held postures, hands that reach for points and objects, and the trunk's help."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.geometry import rotation
from wearsim.handling.grips import Hold
from wearsim.people.plan import LEFT_SIGN, SIDES, Plan
from wearsim.people.posture import HELP, Stance, Trunk
from wearsim.people.track import blur, ease, lower_envelope, wander

STRAIGHT = 0.9995
"""A limb straightens to this share of its length; the rest keeps knee and elbow from snapping."""
AROUND_S, TRACE = 0.7, 0.01
"""Time around a grip in which its place already has a little weight (s), against jumps, and that weight."""
ELBOW_POLE = torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64)
"""Side of the upper arm, in its rest axes, to which the bent elbow points."""

SWIVELS = (-0.25, 0.05, 0.35, 0.65, 0.95, 1.25)
"""Candidate swivels of the elbow about the shoulder-wrist line (rad): 0 points down, positive lifts outwards."""
YAWS = (-0.70, -0.42, -0.14, 0.14, 0.42, 0.70)
"""Candidate yaws of the hand about the palm's normal, relative to the direction that the grip prefers (rad)."""
HABIT = 0.2
"""Swivel without any cost (rad)."""
EASE = {"twist": 0.8, "flexion": 0.65, "deviation": 0.30, "swivel": 0.7, "yaw": 0.5}
"""Scale of the cost of each angle (rad)."""
LIMITS = {"twist": 1.40, "flexion": 1.15, "deviation": 0.50}
"""Joint limits in both directions (rad): turn of the forearm from thumb-up, flexion of the wrist, and its deviation."""
STRETCHED = 0.985
SPACING_S, SMOOTH_S = 0.05, 0.15
SHARPNESS = 3.0

REACH = 0.955
"""Share of the arm's length from which on the trunk helps."""
EASY = np.array([0.36, 0.10, 0.24, 0.04, 0.09, 0.06])
"""Ease of using each of `HELP` (rad, m)."""
LOW_EASY, LOW_M, LOW_BY_M = 0.13, 0.78, 0.40
"""Knees bend more readily (m) for goals that are lower above the floor than the first by up to the second (m)."""
MOST = np.array([0.9, 0.3, 0.6, 0.45, 0.30, 0.20])
ENVELOPE_S = 0.30
ROUNDS, SMOOTH_ROUNDS, EAGER = 6, 3, 1.2


def two_bone(
    upper: Float[Tensor, "3"],
    lower: Float[Tensor, "3"],
    hinge: Float[Tensor, "3"],
    target: Float[Tensor, "time 3"],
    pole: Float[Tensor, "time 3"],
) -> tuple[Float[Tensor, "time 3 3"], Float[Tensor, "time"]]:
    """Rotation of the upper bone in the world and bend (rad) of the hinge that bring a limb's end to `target`.

    `upper` and `lower` are the bones' offsets in the rest pose, `hinge` the unit axis that bends the limb, all in the
    rest axes; `target` is the limb's end seen from its root and `pole` the side to which the middle joint points, both
    in the world. A target out of reach is approached along its direction. |upper + R(bend) lower| = |target| is
    solved in closed form: A cos bend + B sin bend = K.
    """
    along = upper @ hinge * (lower @ hinge)
    A = upper @ lower - along
    B = upper @ torch.linalg.cross(hinge, lower)
    size, phase = torch.sqrt(A * A + B * B), torch.atan2(B, A)
    straight = torch.sqrt(upper @ upper + lower @ lower + 2 * (along + size))
    distance = target.norm(dim=-1).clamp(max=STRAIGHT * straight)
    K = (distance**2 - upper @ upper - lower @ lower) / 2 - along
    bend = phase + torch.acos((K / size).clamp(-1.0, 1.0))
    end = upper + (rotation.exp(bend[:, None] * hinge) @ lower[:, None])[..., 0]

    def frame(first: Tensor, second: Tensor) -> Tensor:
        second = second - (second * first).sum(-1, keepdim=True) * first
        second = torch.nn.functional.normalize(second, dim=-1)
        return torch.stack([first, second, torch.linalg.cross(first, second)], -1)

    toward = torch.nn.functional.normalize(target, dim=-1)
    R_world = frame(toward, torch.nn.functional.normalize(torch.linalg.cross(pole, toward), dim=-1))
    R_rest = frame(torch.nn.functional.normalize(end, dim=-1), hinge.expand_as(end))
    return R_world @ R_rest.transpose(-1, -2), bend


@dataclass(frozen=True)
class _ArmBones:
    """Offsets of elbow and wrist in the rest pose, and the hinge axis of the elbow, in float64."""

    upper: Float[Tensor, "3"]
    fore: Float[Tensor, "3"]
    hinge: Float[Tensor, "3"]
    palm: Float[Tensor, "3"]
    """Position of the palm relative to the wrist (m)."""
    sign: float

    @classmethod
    def of(cls, plan: Plan, side: str) -> "_ArmBones":
        """One arm of the plan's wearer."""
        upper, fore = plan.bones(f"{side}_elbow", f"{side}_wrist")
        sign = LEFT_SIGN[side]
        hinge = torch.tensor([0.0, 0.0, -sign], dtype=torch.float64)
        palm = torch.tensor(plan.skeleton.sites[f"{side}_palm"].t_joint_site, dtype=torch.float64)
        return cls(upper, fore, hinge, palm, sign)

    @property
    def axis(self) -> Float[Tensor, "3"]:
        """Unit vector along the forearm."""
        return self.fore / self.fore.norm()

    @property
    def length(self) -> float:
        return float(self.upper.norm() + self.fore.norm())

    def pole(self, swivel: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3"]:
        """Side to which the elbow points, in the chest's axes."""
        return torch.stack([torch.full_like(swivel, -0.35), self.sign * swivel.sin(), -swivel.cos()], -1)

    def strain(
        self, hold: Hold, R_world_chest: Tensor, shoulder: Tensor, swivel: Tensor, yaw: Tensor
    ) -> Float[Tensor, "pick time"]:
        """Discomfort of candidate swivels and yaws: squared angles in units of `EASE`, and penalties beyond the limits."""
        hand = hold.hand(self.sign, yaw)
        wrist = hold.palm - hand @ self.palm - shoulder
        pole = _rotate(R_world_chest, self.pole(swivel))
        R_upper, flexion = two_bone(self.upper, self.fore, self.hinge, wrist.reshape(-1, 3), pole.reshape(-1, 3))
        R_forearm = (R_upper @ rotation.exp(flexion[:, None] * self.hinge)).reshape(*swivel.shape, 3, 3)
        turn, bend = forearm_and_wrist(R_forearm, hand, self.axis)
        strain = ((swivel - HABIT) / EASE["swivel"]) ** 2 + (yaw / EASE["yaw"]) ** 2
        for name, angle in {"twist": turn, "flexion": bend[..., 0], "deviation": bend[..., 2]}.items():
            strain = strain + (angle / EASE[name]) ** 2 + (10 * (angle.abs() - LIMITS[name]).clamp(min=0)) ** 2
        far = wrist.norm(dim=-1) / self.length - STRETCHED
        return strain + (far.clamp(min=0) / 0.01) ** 2


@dataclass(frozen=True)
class _ArmPosture:
    """A hold with the arm posture chosen for it."""

    wrist: Float[Tensor, "time 3"]
    hand: Float[Tensor, "time 3 3"]
    swivel: Float[Tensor, "time"]

    @classmethod
    def easiest(
        cls,
        bones: _ArmBones,
        hold: Hold,
        R_world_chest: Float[Tensor, "time 3 3"],
        shoulder: Float[Tensor, "time 3"],
        fps: float,
    ) -> "_ArmPosture":
        """Choose elbow swivel and hand yaw over time: the softly least strained of a grid of both, smooth in time."""
        count = len(shoulder)
        some = np.unique(np.linspace(0, count - 1, max(int(count / fps / SPACING_S), 2)).round().astype(int))
        swivels, yaws = (torch.tensor(v, dtype=torch.float64) for v in (SWIVELS, YAWS))
        grid = torch.cartesian_prod(swivels, yaws)[:, :, None].expand(-1, -1, len(some))
        part = Hold(hold.palm[some], hold.normal[some], hold.fingers[some])
        strain = bones.strain(part, R_world_chest[some], shoulder[some], grid[:, 0], grid[:, 1])
        share = torch.softmax(-SHARPNESS * strain, 0)
        chosen = (share[:, None] * grid).sum(0).numpy()
        full = np.stack([np.interp(np.arange(count), some, row) for row in chosen], 1)
        swivel, yaw = torch.from_numpy(blur(full, SMOOTH_S, fps)).unbind(-1)
        hand = hold.hand(bones.sign, yaw)
        return cls(hold.palm - hand @ bones.palm, hand, swivel)


def forearm_and_wrist(
    R_forearm: Float[Tensor, "*batch 3 3"], R_hand: Float[Tensor, "*batch 3 3"], axis: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
    """Turn of the forearm about its axis (rad) and bend of the wrist (rotation vector, in the turned forearm's axes).

    R_hand = R_forearm · exp(turn axis) · exp(bend) with the bend perpendicular to the axis.
    """
    between = R_forearm.transpose(-1, -2) @ R_hand
    quat = rotation.quat_wxyz_from_matrix(between)
    turn = 2 * torch.atan2(quat[..., 1:] @ axis, quat[..., 0])
    return turn, rotation.log(rotation.exp(-turn[..., None] * axis) @ between)


def _rotate(R: Tensor, vector: Tensor) -> Tensor:
    return (R @ vector[..., None])[..., 0]


def arm_motion(
    trunk: Trunk, side: str, running: Float[np.ndarray, "time"], rng: np.random.Generator
) -> dict[str, Float[Tensor, "time 3 3"]]:
    """World rotations of one arm's joints. The wrist's path is mixed in space between swing, posture and goal.

    `running` is 1 where the wearer runs, smooth between.
    """
    plan, times, fps = trunk.stance.feet.plan, trunk.stance.feet.times, trunk.stance.feet.fps
    hand, bones, chest = plan.hands[side], _ArmBones.of(plan, side), trunk.chest
    sign, lower, hinge, length = bones.sign, bones.upper, bones.hinge, bones.length
    pose = hand.pose.sample(times)
    pose_weight = torch.from_numpy(hand.pose_weight.sample(times))
    goal = torch.from_numpy(hand.goal.sample(times))
    goal_weight = torch.from_numpy(hand.goal_weight.sample(times))

    R_swing, bend = _swing(trunk, sign, running, rng)
    held, held_weight, _ = _held_wrist(trunk, side)
    aim = goal + (held_weight > 0)[:, None] * (held - goal)
    R_collar, at_shoulder = _shoulder_girdle(trunk, side, aim, torch.maximum(goal_weight[:, 0], held_weight))

    R_upper = chest.R @ R_swing
    wrist = _rotate(R_upper, lower + _rotate(rotation.exp(bend[:, None] * hinge), bones.fore.expand(len(times), 3)))
    mirror = torch.tensor([1.0, sign, 1.0], dtype=torch.float64)
    posed = torch.from_numpy(pose[:, :3].copy()) * mirror * length
    out = bones.pole(torch.from_numpy(pose[:, 3].copy()))
    pole = R_upper @ ELBOW_POLE
    wrist = wrist + pose_weight * (_rotate(chest.R, posed) - wrist)
    wrist = wrist + goal_weight * (goal - at_shoulder - wrist)
    pole = pole + torch.maximum(pose_weight, goal_weight) * (_rotate(chest.R, out) - pole)
    grips = []
    for grip in plan.grips[side]:
        part = slice(*np.searchsorted(times, (grip.start_s, grip.stop_s)).tolist())
        if part.start < part.stop:
            share, hold = torch.from_numpy(grip.weight(times[part])), grip.hold(times[part], chest[part])
            taken = _ArmPosture.easiest(bones, hold, chest.R[part], at_shoulder[part], fps)
            grips.append((part, share, taken))
            wrist[part] += share[:, None] * (taken.wrist - at_shoulder[part] - wrist[part])
            pole[part] += share[:, None] * (_rotate(chest.R[part], bones.pole(taken.swivel)) - pole[part])
    # the wrist keeps so far off the shoulder that the elbow bends no more than about 150 degrees
    distance = wrist.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    wrist = wrist * (distance.clamp(min=0.27 * length) / distance)
    R_shoulder, flexion = two_bone(lower, bones.fore, hinge, wrist, pole)

    relaxed = wander(rng, len(times), 3, 3.0, 0.05, fps)
    turn = pose_weight[:, 0] * torch.from_numpy(pose[:, 4].copy()) + torch.from_numpy(relaxed[:, 0])
    fold = pose_weight[:, 0] * torch.from_numpy(pose[:, 5].copy()) + torch.from_numpy(relaxed[:, 1] + 0.06)
    R_forearm = R_shoulder @ rotation.exp(flexion[:, None] * hinge)
    # the forearm's turn and the wrist's bend: at ease, or as the grips have them
    R_hand = rotation.exp(0.3 * sign * turn[:, None] * bones.axis) @ rotation.about_axis("x", -sign * fold)
    turn = 0.7 * sign * turn
    for part, share, taken in grips:
        wanted_turn, wanted_bend = forearm_and_wrist(R_forearm[part], taken.hand, bones.axis)
        turn[part] += share * (wanted_turn - turn[part])
        R_hand[part] = rotation.exp(torch.lerp(rotation.log(R_hand[part]), wanted_bend, share[:, None]))
    R_elbow = R_forearm @ rotation.exp(turn[:, None] * bones.axis)
    return {"collar": R_collar, "shoulder": R_shoulder, "elbow": R_elbow, "wrist": R_elbow @ R_hand}


def _swing(trunk: Trunk, sign: float, running: np.ndarray, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Rotation of the hanging upper arm in the chest, and the elbow's bend (rad)."""
    stance, style = trunk.stance, trunk.stance.feet.plan.style
    fps, stride = stance.feet.fps, stance.stride
    gain = style.arms.swing * (1.0 + sign * style.arms.symmetry)
    delayed = np.concatenate([np.full(round(0.04 * fps), stride[0]), stride])[: len(stride)]
    ahead = -sign * blur(delayed, 0.07, fps)
    slow = wander(rng, len(stride), 4, 4.0, 0.03, fps)
    walk, run = 1.0 - running, running
    swing = gain * ahead * (walk + 0.75 * run) + 0.05 - 0.30 * run + slow[:, 0]
    swing += 0.9 * (trunk.chest_angles[:, 1] - style.posture.slouch)  # gravity pulls them down when the trunk leans
    abduction = style.arms.abduction + 0.05 * run + slow[:, 1]
    turn = style.arms.turn + 0.25 * run + slow[:, 2]
    elbow = style.arms.elbow + walk * 0.07 * np.clip(stance.speed, 0.0, 2.0) + 1.15 * run + slow[:, 3]
    forwards = 0.08 * np.logaddexp(0.0, swing / 0.08)  # decays smoothly to zero where the swing is backward
    elbow = elbow + (1.15 * walk + 0.25 * run) * forwards
    angles = [torch.from_numpy(np.ascontiguousarray(a)) for a in (swing, abduction, turn, elbow)]
    about = rotation.about_axis
    hang = about("x", -sign * (np.pi / 2 - angles[1]))
    return about("y", -angles[0]) @ hang @ about("y", angles[2]), angles[3].clamp(min=0.06)


def _shoulder_girdle(
    trunk: Trunk, side: str, goal: Float[Tensor, "time 3"], weight: Float[Tensor, "time"]
) -> tuple[Float[Tensor, "time 3 3"], Float[Tensor, "time 3"]]:
    """Rotation of the collar bone, and the position to which it carries the shoulder (m).

    The girdle rises and comes forward with a hand that is drawn to a goal in the world, the more the farther it goes;
    a trace of it moves with the swing.
    """
    plan, chest, sign = trunk.stance.feet.plan, trunk.chest, LEFT_SIGN[side]
    collar, shoulder = plan.bones(f"{side}_collar", f"{side}_shoulder")
    at_collar = chest.t + (chest.R @ collar)
    reach = (_rotate(chest.R.transpose(-1, -2), goal - at_collar) - shoulder) / _ArmBones.of(plan, side).length
    distance = reach.norm(dim=-1).clamp(min=1e-3)
    steep = (reach[:, 2] / distance).numpy()
    far = torch.from_numpy(ease((distance.numpy() - 0.65) / 0.5))
    lift = weight * torch.from_numpy(0.38 * ease((steep + 0.7) / 1.7)) * (0.4 + 0.6 * far)
    front = weight * 0.28 * far * (reach[:, 0] / distance).clamp(-1.0, 1.0)
    front = front - sign * 0.05 * torch.from_numpy(trunk.stance.stride)
    R_collar = chest.R @ (rotation.about_axis("z", -sign * front) @ rotation.about_axis("x", sign * lift))
    return R_collar, at_collar + R_collar @ shoulder


def _held_wrist(
    trunk: Trunk, side: str
) -> tuple[Float[Tensor, "time 3"], Float[Tensor, "time"], Float[Tensor, "time"]]:
    """Wrist goals that follow from the grips of one side, with the hand turned as the grips prefer.

    The approximate wrist position in the world (m; the chest's where nothing is held), the weight of the grip, 0…1,
    and the same weight rising `AROUND_S` earlier and falling as much later.
    """
    plan, times, chest = trunk.stance.feet.plan, trunk.stance.feet.times, trunk.chest
    bones = _ArmBones.of(plan, side)
    wrist, free = torch.zeros_like(chest.t), torch.ones(2, len(times), dtype=torch.float64)
    total = torch.full_like(free[0], 1e-12)
    for grip in plan.grips[side]:
        part = slice(*np.searchsorted(times, (grip.start_s - AROUND_S, grip.stop_s + AROUND_S)).tolist())
        hold = grip.hold(np.clip(times[part], grip.start_s, grip.stop_s), chest[part])
        hand = hold.hand(bones.sign, torch.zeros(len(hold.palm), dtype=torch.float64))
        longer = replace(grip, reach_s=grip.reach_s + AROUND_S, return_s=grip.return_s + AROUND_S)
        weights = torch.from_numpy(np.stack([each.weight(times[part]) for each in (grip, longer)]))
        share = weights[0] + TRACE * weights[1]
        wrist[part] += share[:, None] * (hold.palm - hand @ bones.palm)
        total[part] += share
        free[:, part] *= 1.0 - weights
    weight, near = 1.0 - free
    return torch.where((total < 1e-9)[:, None], chest.t, wrist / total[:, None]), weight, near


def reach_help(stance: Stance) -> Float[np.ndarray, "time 6"] | None:
    """Additional trunk motion for gripping hands whose goals are beyond the arms' reach; None where nothing is held.

    Columns are `HELP`, smooth. Each moment's lack of reach is shared among the trunk's degrees of freedom by least
    squares (each weighted by its ease), in rounds, since reach is not linear; smooth curves cover the result, and a
    few more rounds, with smooth lacks, cover what these leave open.
    """
    plan, times, fps = stance.feet.plan, stance.feet.times, stance.feet.fps
    if not any(plan.grips.values()):
        return None
    wanted = np.zeros((len(times), len(HELP)))
    crouch = plan.crouch.sample(times)[:, 0]
    easy = np.tile(EASY, (len(times), 1))
    trunk, low = Trunk.over(stance), np.zeros(len(times))
    floor = np.minimum(stance.feet.left.ground[:, 2], stance.feet.right.ground[:, 2])
    for side in SIDES:
        wrist, _, near = _held_wrist(trunk, side)
        low = np.maximum(low, ease((LOW_M - (wrist[:, 2].numpy() - floor)) / LOW_BY_M) * near.numpy())
    easy[:, 3] += LOW_EASY * blur(low, ENVELOPE_S, fps)
    for number in range(ROUNDS + SMOOTH_ROUNDS):
        smooth = number >= ROUNDS
        if number == ROUNDS:
            wanted = _covering(np.maximum(wanted, 0.0), fps) - _covering(np.maximum(-wanted, 0.0), fps)
        trunk = Trunk.over(stance, MOST * np.tanh(wanted / MOST))
        lacks, gains = (np.stack(both, 1) for both in zip(*(_lack(trunk, side, smooth) for side in SIDES)))
        if smooth and lacks.max() < 1e-4:
            break
        # the least effort that brings both hands within reach: W² Gᵀ (G W² Gᵀ + ε)⁻¹ lack
        weighed = gains * easy[:, None] ** 2
        normal = weighed @ gains.transpose(0, 2, 1) + 4e-4 * np.eye(2)
        step = (weighed * np.linalg.solve(normal, lacks[..., None])).sum(1)
        step[:, 3] = np.maximum(step[:, 3], -crouch - wanted[:, 3])
        wanted = wanted + EAGER * step
    return MOST * np.tanh(wanted / MOST)


def _covering(need: Float[np.ndarray, "time column"], fps: float) -> Float[np.ndarray, "time column"]:
    """Smooth curves that are nowhere below the needs."""
    return np.stack([-lower_envelope(-column, ENVELOPE_S, fps) for column in need.T], 1)


def _lack(trunk: Trunk, side: str, smooth: bool) -> tuple[Float[np.ndarray, "time"], Float[np.ndarray, "time 6"]]:
    """Distance (m) by which a hand's goal is out of reach, and how much nearer each of `HELP` brings the shoulder."""
    plan, heading = trunk.stance.feet.plan, trunk.stance.heading
    wrist, weight, near = _held_wrist(trunk, side)
    _, at_shoulder = _shoulder_girdle(trunk, side, wrist, weight)
    offset = wrist - at_shoulder
    distance = offset.norm(dim=-1)
    lack = ((distance - REACH * _ArmBones.of(plan, side).length).clamp(min=0) * weight).numpy()
    toward = (offset / distance[:, None].clamp(min=1e-6)).numpy()
    if smooth:
        lack = _covering(lack[:, None], trunk.stance.feet.fps)[:, 0]
    # lever arms of pelvis and chest: the shoulder's motion per unit of each of HELP
    zero = np.zeros_like(heading)
    ahead = np.stack([np.cos(heading), np.sin(heading), zero], 1)
    left = np.stack([-ahead[:, 1], ahead[:, 0], zero], 1)
    up = np.stack([zero, zero, zero + 1.0], 1)
    chest = trunk.chest.t.numpy()
    above, low = at_shoulder.numpy() - chest, chest - trunk.pelvis
    turns = [(left, 0.72, -0.26 * plan.hip_height), (ahead, 0.6, 0.0), (up, 0.65, 0.0)]
    moves = [np.cross(axis, above + share * low) + back * ahead for axis, share, back in turns]
    gains = np.stack([(move * toward).sum(1) for move in (*moves, -up, ahead, left)], 1)
    # a hand within reach should have little weight against the other hand's needs
    counts = near.numpy() * (0.12 + 0.88 * ease(lack / 0.06))
    return counts * lack, counts[:, None] * gains
