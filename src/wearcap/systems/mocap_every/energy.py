"""Energy of MocapEvery's motion editing: the latent of a motion manifold is optimised to fit visual cues (§3.4, eq. 5).

Each term is a pure function of the edited body. The unknown is the latent z of a batch of motion windows.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import require_choice
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid

CUE_SMOOTHING = 1e-5
"""Smoothing constant of the cue distances √(d² + ε), in rad² or m²: distances within the detectors' noise act
quadratically, so that the energy is differentiable at zero."""
SPEED_SMOOTHING_M2_S2 = 1e-4
"""Smoothing constant of foot speeds (m²/s²): without it the energy has a kink at zero speed, where second-order solvers
get stuck."""
POSE_SMOOTHING = 0.1
"""Smoothing constant of distances between rotation matrices: about the square of what 12° make, a monocular estimator's
error per joint. Within it views hardly pull, so that a capture that is nearer than they are stays."""
SOLVERS = ("lbfgs", "adam")
FIRST_STEP, CURVATURES = 3.0, 10
"""Norm of the first change of a window's latent that L-BFGS tries, and number of steps whose curvature it keeps."""


class Body(NamedTuple):
    """A batch of motion windows, anchored to the measured head poses."""

    R_parent_joint: Float[Tensor, "batch time joint 3 3"]
    T_world_joint: Rigid
    contact: Float[Tensor, "batch time foot"]


class PixelCue(NamedTuple):
    """2D observations of one joint in the egocentric image (φ_E)."""

    joint: int
    pixels: Float[Tensor, "batch time 2"]
    confidence: Float[Tensor, "batch time"]
    """Confidence of each observation; 0 where the joint was not observed."""

    def error(self, body: Body, seen: "Seen") -> Float[Tensor, "batch time"]:
        """Reprojection error ‖μ − π(C, p)‖ over the focal length (rad near the axis; eq. 5, φ_E); 0 behind the camera."""
        assert seen.camera is not None
        assert seen.T_head_cam is not None
        T_world_cam = seen.T_world_head @ seen.T_head_cam
        p_cam = (T_world_cam.R.mT @ (body.T_world_joint.t[:, :, self.joint] - T_world_cam.t)[..., None])[..., 0]
        pixels, _ = seen.camera.project(p_cam)
        focal = pixels.new_tensor([seen.camera.fx, seen.camera.fy])
        ahead = p_cam[..., 2] > 0.05
        return _norm((pixels - self.pixels) / focal) * self.confidence * ahead


class PlaceCue(NamedTuple):
    """3D observations of one joint's position in the world (m), from any source."""

    joint: int
    t_world: Float[Tensor, "batch time 3"]
    confidence: Float[Tensor, "batch time"]

    def error(self, body: Body) -> Float[Tensor, "batch time"]:
        """Distance (m) between the joint and its observed position."""
        return _norm(body.T_world_joint.t[:, :, self.joint] - self.t_world) * self.confidence


class PoseCue(NamedTuple):
    """Local joint rotations observed by another wearer's camera (φ_T); the root is ignored."""

    R_parent_joint: Float[Tensor, "batch time joint 3 3"]
    confidence: Float[Tensor, "batch time joint"]

    def error(self, body: Body) -> Float[Tensor, "batch time"]:
        """Mean of w_j ‖τ_j − q_j‖ over all joints but the root (eq. 5, φ_T), on rotation matrices; quadratic within
        an estimator's errors (ours)."""
        difference = body.R_parent_joint[:, :, 1:] - self.R_parent_joint[:, :, 1:]
        difference = rearrange(difference, "batch time joint row column -> batch time joint (row column)")
        distance = _norm(difference, POSE_SMOOTHING) - POSE_SMOOTHING**0.5
        return (distance * self.confidence[:, :, 1:]).mean(-1)


class Seen(NamedTuple):
    """All observations of a batch of windows, with the poses of the wearer's head and camera."""

    T_world_head: Rigid
    camera: Camera | None
    T_head_cam: Rigid | None
    pixels: tuple[PixelCue, ...]
    places: tuple[PlaceCue, ...]
    poses: tuple[PoseCue, ...]


@dataclass(frozen=True)
class LatentWeights:
    """Weights of the energy terms; each term is a mean over the frames that it applies to."""

    pixel: float = 1.0
    """Weight of `PixelCue.error`, per radian of view angle."""
    place: float = 1.0
    """Weight of `PlaceCue.error`, per metre."""
    pose: float = 3.0
    """Weight of `PoseCue.error`, per unit of distance between rotation matrices."""
    stay: float = 1.0
    """Weight of the latents' mean squared change from their start (L_reg, which the paper does not define)."""
    contact: float = 0.1
    """Weight of `contact_slip` (L_contact), per m/s."""


@dataclass(frozen=True)
class LatentSolver:
    """Optimiser of the latents."""

    kind: str = "lbfgs"
    """"lbfgs" (ours) or "adam" (the paper: 500 steps, learning rate 7e-4 for pixels and 1e-3 for poses)."""
    steps: int = 35
    learning_rate: float = 7e-4
    """Learning rate of Adam."""

    def __post_init__(self):
        require_choice(self.kind, SOLVERS, f"no solver {self.kind!r}")


@dataclass(frozen=True, eq=False)
class LatentSolution:
    """Optimised latents, and the energy by term (summed over windows) after every evaluation."""

    latent: Float[Tensor, "batch channel short"]
    history: list[dict[str, float]] = field(default_factory=list)


def contact_slip(body: Body, feet: list[int], fps: float) -> Float[Tensor, "batch time"]:
    """L_contact = c · ‖ṗ‖, the speed (m/s) of feet in contact."""
    velocity = body.T_world_joint.t[:, :, feet].diff(dim=1) * fps
    speed = _norm(velocity, SPEED_SMOOTHING_M2_S2) - SPEED_SMOOTHING_M2_S2**0.5
    return (speed * body.contact[:, 1:].clamp(0, 1)).mean(-1)


def energy_terms(
    body: Body,
    seen: Seen,
    moved: Float[Tensor, "batch channel short"],
    feet: list[int],
    fps: float,
    weights: LatentWeights,
) -> dict[str, Float[Tensor, "batch"]]:
    """Weighted terms of L = L_vis + L_reg + L_contact of each window.

    `moved` is the latents' change from their start.
    """
    terms = {
        "stay": weights.stay * moved.square().mean((1, 2)),
        "contact": weights.contact * contact_slip(body, feet, fps).mean(1),
    }
    for name, weight, errors in (
        ("pixel", weights.pixel, [(cue.error(body, seen), cue.confidence) for cue in seen.pixels]),
        ("place", weights.place, [(cue.error(body), cue.confidence) for cue in seen.places]),
        ("pose", weights.pose, [(cue.error(body), cue.confidence.amax(-1)) for cue in seen.poses]),
    ):
        if errors:
            observed = torch.stack([(confidence > 0).sum(1).clamp_min(1) for _, confidence in errors])
            terms[name] = weight * torch.stack([e.sum(1) / n for (e, _), n in zip(errors, observed)]).sum(0)
    return terms


def solve_latent(
    start: Float[Tensor, "batch channel short"],
    energy: Callable[[Float[Tensor, "batch channel short"]], dict[str, Float[Tensor, "batch"]]],
    solver: LatentSolver = LatentSolver(),
) -> LatentSolution:
    """Minimise the sum of the energy's terms of each window over its latent, starting at `start`."""

    def evaluate(latent: Tensor) -> _Evaluation:
        with torch.enable_grad():
            terms = energy(latent.requires_grad_())
            total = torch.stack(list(terms.values())).sum(0)
            (gradient,) = torch.autograd.grad(total.sum(), latent)
        return _Evaluation(latent.detach(), {k: v.detach() for k, v in terms.items()}, total.detach(), gradient)

    latent = start.detach().clone(memory_format=torch.contiguous_format)
    evaluations = _adam(latent, evaluate, solver) if solver.kind == "adam" else _lbfgs(latent, evaluate, solver.steps)
    history = []
    for last in evaluations:
        latent = last.latent
        sums = {name: value.sum().item() for name, value in last.terms.items()}
        history.append(sums | {"total": last.total.sum().item()})
    return LatentSolution(latent, history)


class _Evaluation(NamedTuple):
    """Energy of each window at its latent."""

    latent: Float[Tensor, "batch channel short"]
    terms: dict[str, Float[Tensor, "batch"]]
    total: Float[Tensor, "batch"]
    gradient: Float[Tensor, "batch channel short"]


def _adam(
    latent: Float[Tensor, "batch channel short"], evaluate: Callable[[Tensor], _Evaluation], solver: LatentSolver
) -> Iterator[_Evaluation]:
    """Each step's evaluation, and the last latent's."""
    optimizer = torch.optim.Adam([latent], lr=solver.learning_rate)
    for _ in range(solver.steps):
        before = evaluate(latent.detach().clone())
        yield before
        latent.grad = before.gradient
        optimizer.step()
    yield evaluate(latent)


def _lbfgs(
    start: Float[Tensor, "batch channel short"], evaluate: Callable[[Tensor], _Evaluation], steps: int
) -> Iterator[_Evaluation]:
    """The state after each evaluation of an L-BFGS of each window, in one batch (ours).

    Windows do not depend on each other, so each has its own curvature and step length. Where a step does not decrease
    a window's energy, that window tries a shorter one in the same evaluation in which the others take their next.
    """
    now = evaluate(start)
    yield now
    scale = FIRST_STEP / _dot(now.gradient, now.gradient).sqrt().clamp_min(1e-12)
    length, direction, pairs = torch.ones_like(scale), -scale * now.gradient, deque(maxlen=CURVATURES)
    for _ in range(steps - 1):
        tried = evaluate(now.latent + length * direction)
        enough = now.total + 1e-4 * (length * _dot(now.gradient, direction)).flatten()
        less = tried.total <= enough  # False where an energy is not finite
        there = less[:, None, None]
        step = torch.where(there, tried.latent - now.latent, 0.0)
        change = torch.where(there, tried.gradient - now.gradient, 0.0)
        now = _Evaluation(
            now.latent + step,
            {name: torch.where(less, tried.terms[name], value) for name, value in now.terms.items()},
            torch.where(less, tried.total, now.total),
            now.gradient + change,
        )
        yield now
        along, square = _dot(step, change), _dot(change, change)
        curved = along > 1e-10 * square
        pairs.append((step, change, torch.where(curved, 1 / along, 0.0)))
        scale = torch.where(curved, along / square, scale)
        direction = _newton(now.gradient, scale, pairs)
        direction = torch.where(_dot(now.gradient, direction) < 0, direction, -scale * now.gradient)
        length = torch.where(there, 1.0, 0.3 * length)


def _newton(gradient: Tensor, scale: Tensor, pairs: Iterable[tuple[Tensor, Tensor, Tensor]]) -> Tensor:
    """The two-loop recursion (Nocedal 1980) per window: -H g, where `scale` times the identity is the first H."""
    direction, shares = -gradient, []
    for step, change, inverse in reversed(list(pairs)):
        shares.append(inverse * _dot(step, direction))
        direction = direction - shares[-1] * change
    direction = scale * direction
    for (step, change, inverse), share in zip(pairs, reversed(shares)):
        direction = direction + (share - inverse * _dot(change, direction)) * step
    return direction


def _dot(
    a: Float[Tensor, "batch channel short"], b: Float[Tensor, "batch channel short"]
) -> Float[Tensor, "batch 1 1"]:
    return (a * b).sum((1, 2), keepdim=True)


def _norm(value: Float[Tensor, "*batch axis"], epsilon: float = CUE_SMOOTHING) -> Float[Tensor, "*batch"]:
    """Norm over the last axis, smoothed at zero."""
    return (value.square().sum(-1) + epsilon).sqrt()
