"""The energy of HPS (thesis eq. 4.1–4.12): data of a recording, unknowns, and the terms that relate them."""

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.surface import SurfaceIndex
from wearcap.optimize import costs
from wearcap.optimize.costs import Loss
from wearcap.optimize.feet import FootPatches

TERMS = (
    "self",
    "contact",
    "contact_plane",
    "slide",
    "translation_smooth",
    "root_smooth",
    "head_smooth",
    "pose",
    "hold",
    "translation_step",
    "root_step",
    "head_step",
    "pose_step",
)
"""Names of the terms, as configs weight them; each is a function of `costs`."""

SURFACE_REACH_M = 0.5
"""Distance (m) to the nearest scanned point above which a foot has no scene below it."""
LEAST_UPRIGHT = 0.7
"""Least vertical component of a plane's normal that a foot may stand on (45°): excludes walls beside gaps in the
floor."""


@dataclass(frozen=True)
class HpsEnergy:
    """E = Σ weight · mean of ρ(residual), by term; terms without an entry are left out.

    Raises WearcapError for a term that does not exist or a negative weight.
    """

    weights: dict[str, float]
    losses: dict[str, Loss] = field(default_factory=dict)
    """Loss by term; terms without an entry use the thesis's norm."""

    def __post_init__(self):
        for name in (*self.weights, *self.losses):
            if name not in TERMS:
                raise WearcapError(f"HPS has no term {name!r}", expected=f"one of {', '.join(TERMS)}")
        if any(not weight >= 0 for weight in self.weights.values()):
            raise WearcapError("a negative weight of a term", expected="zero or more")

    def weight(self, name: str) -> float:
        return self.weights.get(name, 0.0)

    def loss(self, name: str) -> Loss:
        return self.losses.get(name, Loss())


@dataclass(frozen=True, eq=False)
class HpsState:
    """The unknowns: axis-angles of all joints but the root (rad), and the root's pose in the world (float64, m)."""

    theta: Float[Tensor, "time joint 3"]
    R_world_root: Float[Tensor, "time 3 3"]
    t_world_root: Float[Tensor, "time 3"]

    def __len__(self) -> int:
        return len(self.theta)

    def __getitem__(self, frames: slice) -> "HpsState":
        return HpsState(self.theta[frames], self.R_world_root[frames], self.t_world_root[frames])

    @property
    def R_parent_joint(self) -> Float[Tensor, "time joint 3 3"]:
        return torch.cat([self.R_world_root[:, None], rotation.exp(self.theta)], 1)


@dataclass(frozen=True, eq=False)
class HpsData:
    """Sensor data and initialisation, frame by frame at one rate (float64; m, rad)."""

    patches: FootPatches
    start: HpsState
    """Initial state (thesis §4.2.5); its theta is the suit's pose θ^I."""
    R_head_cam: Float[Tensor, "3 3"]
    R_world_cam: Float[Tensor, "time 3 3"]
    """Localised camera orientations."""
    cam_confidence: Float[Tensor, "time"]
    """Weight of each frame's `self` term: 0 where the camera was not localised."""
    hold_confidence: Float[Tensor, "time"]
    """Weight of each frame's `hold` term, which attracts the root to its initial translation."""
    contact: Float[Tensor, "time patch"]
    t_step: Float[Tensor, "pair 3"]
    """Root displacements per frame measured by the suit, rotated into the scene (m)."""
    R_root_step: Float[Tensor, "pair 3 3"]
    """Root rotations per frame measured by the suit, in world axes."""
    R_head_step: Float[Tensor, "pair 3 3"]
    """Head rotations per frame measured by the suit, in world axes."""
    surface: SurfaceIndex | None = None
    """Surface of the scan; None: without scene."""

    def __len__(self) -> int:
        return len(self.start)

    def __getitem__(self, frames: slice) -> "HpsData":
        """Frames start…stop-1 (no step)."""
        begin, stop, _ = frames.indices(len(self))
        pairs = slice(begin, max(stop - 1, begin))
        return replace(
            self,
            start=self.start[frames],
            R_world_cam=self.R_world_cam[frames],
            cam_confidence=self.cam_confidence[frames],
            hold_confidence=self.hold_confidence[frames],
            contact=self.contact[frames],
            t_step=self.t_step[pairs],
            R_root_step=self.R_root_step[pairs],
            R_head_step=self.R_head_step[pairs],
        )

    def to(self, dtype: torch.dtype) -> "HpsData":
        """All tensors in another precision; the surface is unchanged."""
        tensors = {name: value.to(dtype) for name, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, start=HpsState(*(part.to(dtype) for part in vars(self.start).values())), **tensors)

    def pose(self, state: HpsState) -> Rigid:
        """World poses of all joints in a state."""
        return forward_kinematics(self.patches.body.skeleton, state.R_parent_joint, state.t_world_root)


@dataclass(frozen=True, eq=False)
class Ground:
    """Nearest scene point v(n) of each patch vertex (eq. 4.6), and the local plane; `found` is 1 where both exist,
    else 0."""

    point: Float[Tensor, "time vertex 3"]
    origin: Float[Tensor, "time vertex 3"]
    normal: Float[Tensor, "time vertex 3"]
    found: Float[Tensor, "time vertex"]


def find_ground(data: HpsData, points: Float[Tensor, "time vertex 3"], energy: HpsEnergy) -> Ground:
    """Query the scene below patch vertices in contact (m, world), as far as the energy needs it.

    Each patch has one plane, that below its centroid. `found` is 0 everywhere without a scene.
    """
    if data.surface is None or not (energy.weight("contact") or energy.weight("contact_plane")):
        none = torch.zeros_like(points.detach())
        return Ground(none, none, none, none[..., 0])
    dtype, points = points.dtype, points.detach().double()
    stands, patch = data.contact > 0, data.patches.patch
    point, origin, normal = points.clone(), torch.zeros_like(points), torch.zeros_like(points)
    found = stands[:, patch].double()
    if energy.weight("contact"):
        seek = stands[:, patch]
        point[seek] = torch.from_numpy(data.surface.nearest_points(points[seek].numpy(), SURFACE_REACH_M))
        found *= point.isfinite().all(-1)
    if energy.weight("contact_plane"):
        where, up = (torch.zeros(*stands.shape, 3, dtype=torch.float64) for _ in range(2))
        queries = data.patches.middles(points)[stands].numpy()
        where[stands], up[stands] = map(torch.from_numpy, data.surface.plane(queries, reach_m=SURFACE_REACH_M))
        origin, normal = where[:, patch], up[:, patch]
        found *= normal[..., 2] > LEAST_UPRIGHT  # False where no plane was found (NaN)
    parts = (point.nan_to_num(), origin.nan_to_num(), normal.nan_to_num(), found)
    return Ground(*(part.to(dtype) for part in parts))


def energy_terms(
    energy: HpsEnergy, data: HpsData, state: HpsState, ground: Ground | None = None, full_mesh: bool = False
) -> dict[str, Float[Tensor, ""]]:
    """Weighted terms of eq. 4.1, differentiable in the state.

    `ground` None: queried for this state. `full_mesh` skins the whole body and takes the patches from it, as the
    thesis does, with the same result.
    """
    T_world_joint = data.pose(state)
    head = data.patches.body.skeleton.index("head")
    legs = [joint - 1 for leg in data.patches.legs for joint in leg]
    points = _patch_points(data, T_world_joint, full_mesh)
    if ground is None:
        ground = find_ground(data, points, energy)
    stands = data.patches.share(data.contact) / 4
    stays = data.patches.share(data.contact[1:] * data.contact[:-1]) / 4
    R_head, R_root, t = T_world_joint.R[:, head], state.R_world_root, state.t_world_root
    same = torch.eye(3).to(R_root).expand(len(data) - 1, 3, 3)
    elements = {
        "self": lambda: (costs.head_orientation(R_head, data.R_head_cam, data.R_world_cam), data.cam_confidence),
        "contact": lambda: (costs.foot_contact(points, ground.point), stands * ground.found),
        "contact_plane": lambda: (costs.foot_plane(points, ground.origin, ground.normal), stands * ground.found),
        "slide": lambda: (costs.foot_slide(points), stays),
        "translation_smooth": lambda: (costs.translation_step(t, torch.zeros_like(t[1:])), None),
        "root_smooth": lambda: (costs.rotation_step(R_root, same), None),
        "head_smooth": lambda: (costs.rotation_step(R_head, same), None),
        "pose": lambda: (costs.pose_prior(state.theta, data.start.theta), None),
        "hold": lambda: (costs.translation_hold(t, data.start.t_world_root), data.hold_confidence),
        "translation_step": lambda: (costs.translation_step(t, data.t_step), None),
        "root_step": lambda: (costs.rotation_step(R_root, data.R_root_step), None),
        "head_step": lambda: (costs.rotation_step(R_head, data.R_head_step), None),
        "pose_step": lambda: (costs.pose_step(state.theta[:, legs], data.start.theta[:, legs]), None),
    }
    terms = {}
    for name, weight in energy.weights.items():
        if weight == 0:
            continue
        residual, share_of = elements[name]()
        value = energy.loss(name)(residual)
        value = value if share_of is None else value * share_of
        terms[name] = weight * value.sum() / max(len(residual), 1)
    return terms


def _patch_points(data: HpsData, T_world_joint: Rigid, full_mesh: bool) -> Float[Tensor, "time vertex 3"]:
    if full_mesh:
        return data.patches.body.vertices(T_world_joint)[:, data.patches.vertex]
    return data.patches.points(T_world_joint)
