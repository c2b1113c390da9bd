"""Editing captured motion within a manifold until it agrees with what was seen (MocapEvery §3.4, eq. 5).

Each term is a pure function of the edited body; the unknown is the latent z of windows of motion, all of them at once.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.tracking.anchor import anchor

ROUND = 1e-5
"""Squared radians, or m², below which a cue is met: within the noise of detectors a distance counts as if it were
squared, so that nothing is a kink."""
REST_M2_S2 = 1e-4
"""Squared speed up to which a foot counts as at rest: feet that do not move at all would else be a kink that second-order
solvers do not get away from."""
SOLVERS = ("lbfgs", "adam")


class PixelCue(NamedTuple):
    """One joint in the egocentric picture (φ_E)."""

    joint: int
    pixels: Float[Tensor, "batch time 2"]
    confidence: Float[Tensor, "batch time"]
    """0 where it was not seen."""


class PlaceCue(NamedTuple):
    """One joint's place in the world (m), from whatever saw it."""

    joint: int
    t_world: Float[Tensor, "batch time 3"]
    confidence: Float[Tensor, "batch time"]


class PoseCue(NamedTuple):
    """Local joint rotations without the root, as another wearer's camera saw them (φ_T)."""

    R_parent_joint: Float[Tensor, "batch time joint 3 3"]
    confidence: Float[Tensor, "batch time joint"]


class Seen(NamedTuple):
    """Everything that was seen in a batch of windows, and how the wearer's head and camera moved."""

    T_world_head: Rigid
    camera: Camera | None
    T_head_cam: Rigid | None
    pixels: tuple[PixelCue, ...]
    places: tuple[PlaceCue, ...]
    poses: tuple[PoseCue, ...]


class Body(NamedTuple):
    """A batch of windows of motion that hang from the measured heads."""

    R_parent_joint: Float[Tensor, "batch time joint 3 3"]
    T_world_joint: Rigid
    contact: Float[Tensor, "batch time foot"]


@dataclass(frozen=True)
class LatentWeights:
    """Of the terms; all are means over the frames that they are about."""

    pixel: float = 1.0
    """Per radian of view angle."""
    place: float = 1.0
    """Per metre."""
    pose: float = 0.3
    """Per unit of rotation matrices' distance."""
    stay: float = 1.0
    """Of the mean square by which latents move (L_reg, which the document does not spell out)."""
    contact: float = 0.1
    """Per m/s of feet in contact (L_contact)."""


@dataclass(frozen=True)
class LatentSolver:
    """ "lbfgs" (ours) or "adam" (the document: 500 steps at 7e-4 for pixels, 1e-3 for poses)."""

    kind: str = "lbfgs"
    steps: int = 35
    learning_rate: float = 7e-4
    """Of Adam."""

    def __post_init__(self):
        if self.kind not in SOLVERS:
            raise WearcapError(f"no solver {self.kind!r}", expected=f"one of {', '.join(SOLVERS)}")


@dataclass(frozen=True, eq=False)
class LatentSolution:
    """Where the latents ended, and the energy by term after every step."""

    latent: Float[Tensor, "batch channel short"]
    history: list[dict[str, float]] = field(default_factory=list)
    evaluations: int = 0
    """Of the energy and its gradient."""


def anchored_body(skeleton: Skeleton, R_parent_joint: Tensor, contact: Tensor, T_world_head: Rigid) -> Body:
    """A motion whose head is where it was measured."""
    R, T_world_joint = anchor(skeleton, R_parent_joint, T_world_head)
    return Body(R, T_world_joint, contact)


def pixel_error(body: Body, seen: Seen, cue: PixelCue) -> Float[Tensor, "batch time"]:
    """‖μ − π(C, p)‖ over the focal length, so in radians near the axis (eq. 5, φ_E); 0 behind the camera."""
    assert seen.camera is not None
    assert seen.T_head_cam is not None
    T_world_cam = seen.T_world_head @ seen.T_head_cam
    p_cam = (T_world_cam.R.mT @ (body.T_world_joint.t[:, :, cue.joint] - T_world_cam.t)[..., None])[..., 0]
    pixels, _ = seen.camera.project(p_cam)
    focal = pixels.new_tensor([seen.camera.fx, seen.camera.fy])
    ahead = p_cam[..., 2] > 0.05
    return _norm((pixels - cue.pixels) / focal) * cue.confidence * ahead


def place_error(body: Body, cue: PlaceCue) -> Float[Tensor, "batch time"]:
    """Distance (m) of a joint from where it was seen."""
    return _norm(body.T_world_joint.t[:, :, cue.joint] - cue.t_world) * cue.confidence


def pose_error(body: Body, cue: PoseCue) -> Float[Tensor, "batch time"]:
    """Σ_j w_j ‖τ_j − q_j‖ over joints but the root (eq. 5, φ_T), on rotation matrices."""
    wrong = (body.R_parent_joint[:, :, 1:] - cue.R_parent_joint[:, :, 1:]).flatten(-2)
    return (_norm(wrong) * cue.confidence[:, :, 1:]).mean(-1)


def contact_slip(body: Body, feet: list[int], fps: float) -> Float[Tensor, "batch time"]:
    """c · ‖ṗ‖ of the feet (m/s), L_contact."""
    velocity = body.T_world_joint.t[:, :, feet].diff(dim=1) * fps
    speed = _norm(velocity, REST_M2_S2) - REST_M2_S2**0.5
    return (speed * body.contact[:, 1:].clamp(0, 1)).mean(-1)


def energy_terms(
    body: Body,
    seen: Seen,
    moved: Float[Tensor, "batch channel short"],
    feet: list[int],
    fps: float,
    weights: LatentWeights,
) -> dict[str, Float[Tensor, ""]]:
    """L = L_vis + L_reg + L_contact, by term and weighted: means per window, added over windows."""
    terms = {
        "stay": weights.stay * moved.square().mean((1, 2)).sum(),
        "contact": weights.contact * contact_slip(body, feet, fps).mean(1).sum(),
    }
    for name, weight, errors in (
        ("pixel", weights.pixel, [(pixel_error(body, seen, cue), cue.confidence) for cue in seen.pixels]),
        ("place", weights.place, [(place_error(body, cue), cue.confidence) for cue in seen.places]),
        ("pose", weights.pose, [(pose_error(body, cue), cue.confidence.amax(-1)) for cue in seen.poses]),
    ):
        if errors:
            shown = torch.stack([(confidence > 0).sum(1).clamp_min(1) for _, confidence in errors])
            terms[name] = weight * sum(
                ((e.sum(1) / n).sum() for (e, _), n in zip(errors, shown)), torch.zeros(())
            )
    return terms


def solve_latent(
    start: Float[Tensor, "batch channel short"],
    energy: Callable[[Float[Tensor, "batch channel short"]], dict[str, Float[Tensor, ""]]],
    solver: LatentSolver = LatentSolver(),
) -> LatentSolution:
    """Latents that minimise the sum of the energy's terms, from `start` on."""
    latent = start.detach().clone(memory_format=torch.contiguous_format).requires_grad_()
    history: list[dict[str, float]] = []
    evaluations = 0
    if solver.kind == "adam":
        optimizer: torch.optim.Optimizer = torch.optim.Adam([latent], lr=solver.learning_rate)
        rounds = solver.steps
    else:
        optimizer = torch.optim.LBFGS(
            [latent], lr=1.0, max_iter=solver.steps, history_size=20, line_search_fn="strong_wolfe",
            tolerance_grad=1e-7, tolerance_change=1e-7,
        )  # fmt: skip
        rounds = 1

    def closure() -> Tensor:
        nonlocal evaluations
        optimizer.zero_grad()
        terms = energy(latent)
        total = torch.stack(list(terms.values())).sum()
        total.backward()
        evaluations += 1
        history.append({name: value.item() for name, value in terms.items()} | {"total": total.item()})
        return total

    with torch.enable_grad():
        for _ in range(rounds):
            optimizer.step(closure)
    return LatentSolution(latent.detach(), history, evaluations)


def _norm(value: Float[Tensor, "*batch axis"], epsilon: float = ROUND) -> Float[Tensor, "*batch"]:
    return (value.square().sum(-1) + epsilon).sqrt()
