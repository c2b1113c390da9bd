"""Energy of MocapEvery's motion editing: the latent of a motion manifold is optimised to fit visual cues (§3.4, eq. 5).

Each term is a pure function of the edited body. The unknown is the latent z of a batch of motion windows.
"""

from collections.abc import Callable
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
SOLVERS = ("lbfgs", "adam")


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
        """Σ_j w_j ‖τ_j − q_j‖ over all joints but the root (eq. 5, φ_T), on rotation matrices."""
        difference = body.R_parent_joint[:, :, 1:] - self.R_parent_joint[:, :, 1:]
        distance = _norm(rearrange(difference, "batch time joint row column -> batch time joint (row column)"))
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
    pose: float = 0.3
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
    """Optimised latents, and the energy by term at every evaluation."""

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
) -> dict[str, Float[Tensor, ""]]:
    """Weighted terms of L = L_vis + L_reg + L_contact: means per window, summed over windows.

    `moved` is the latents' change from their start.
    """
    terms = {
        "stay": weights.stay * moved.square().mean((1, 2)).sum(),
        "contact": weights.contact * contact_slip(body, feet, fps).mean(1).sum(),
    }
    for name, weight, errors in (
        ("pixel", weights.pixel, [(cue.error(body, seen), cue.confidence) for cue in seen.pixels]),
        ("place", weights.place, [(cue.error(body), cue.confidence) for cue in seen.places]),
        ("pose", weights.pose, [(cue.error(body), cue.confidence.amax(-1)) for cue in seen.poses]),
    ):
        if errors:
            observed = torch.stack([(confidence > 0).sum(1).clamp_min(1) for _, confidence in errors])
            terms[name] = weight * sum(((e.sum(1) / n).sum() for (e, _), n in zip(errors, observed)), torch.zeros(()))
    return terms


def solve_latent(
    start: Float[Tensor, "batch channel short"],
    energy: Callable[[Float[Tensor, "batch channel short"]], dict[str, Float[Tensor, ""]]],
    solver: LatentSolver = LatentSolver(),
) -> LatentSolution:
    """Minimise the sum of the energy's terms over the latents, starting at `start`."""
    latent = start.detach().clone(memory_format=torch.contiguous_format).requires_grad_()
    history: list[dict[str, float]] = []
    if solver.kind == "adam":
        optimizer: torch.optim.Optimizer = torch.optim.Adam([latent], lr=solver.learning_rate)
        iterations = solver.steps
    else:
        optimizer = torch.optim.LBFGS(
            [latent],
            lr=1.0,
            max_iter=solver.steps,
            history_size=20,
            line_search_fn="strong_wolfe",
            tolerance_grad=1e-7,
            tolerance_change=1e-7,
        )
        iterations = 1

    def closure() -> Tensor:
        optimizer.zero_grad()
        terms = energy(latent)
        total = torch.stack(list(terms.values())).sum()
        total.backward()
        history.append({name: value.item() for name, value in terms.items()} | {"total": total.item()})
        return total

    with torch.enable_grad():
        for _ in range(iterations):
            optimizer.step(closure)
    return LatentSolution(latent.detach(), history)


def _norm(value: Float[Tensor, "*batch axis"], epsilon: float = CUE_SMOOTHING) -> Float[Tensor, "*batch"]:
    """Norm over the last axis, smoothed at zero."""
    return (value.square().sum(-1) + epsilon).sqrt()
