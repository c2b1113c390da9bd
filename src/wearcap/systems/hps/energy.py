"""The energy of HPS (thesis eq. 4.1–4.12): one table of its terms, the unknowns, and the data of a recording."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.model import FOOT_REGIONS, BodyModel
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.surface import SurfaceIndex
from wearcap.optimize.losses import Loss
from wearcap.systems.hps import costs


@dataclass(frozen=True)
class Term:
    """One row of the energy: what a term measures, on which values, and how far it reaches over time."""

    cost: Callable[..., Tensor]
    """Residuals of all frames (or pairs of frames), a pure function of `costs`."""
    inputs: tuple[str, ...]
    """Arguments of `cost`: names of `state_values`, the first one, and of `data_values`."""
    reach: int
    """Number of consecutive frames on which a residual depends: 1, or 2 (the first is then that of frames 0 and 1)."""
    share: str = "ones"
    """Name in `data_values` of the factor of each residual's energy, of the residuals' shape; "ones": no factor."""
    expected: tuple[str, ...] = ()
    """For a cost that measures how far its first input is from an expected value or step: the name of that value in
    `data_values`, then that of the only direction measured, if there is one. The derivative is then known; a cost
    without an expected value is differentiated automatically."""


TERMS = {
    "self": Term(
        costs.head_orientation, ("R_head", "R_head_cam", "R_world_cam"), 1, "cam_confidence", ("R_localized_head",)
    ),
    "contact": Term(costs.position_offset, ("soles", "ground_point"), 1, "on_ground", ("ground_point",)),
    "contact_plane": Term(
        costs.plane_distance,
        ("soles", "ground_origin", "ground_normal"),
        1,
        "on_ground",
        ("ground_origin", "ground_normal"),
    ),
    "slide": Term(costs.position_step, ("soles", "no_slide"), 2, "stays", ("no_slide",)),
    "translation_smooth": Term(costs.position_step, ("t_root", "no_step"), 2, expected=("no_step",)),
    "root_smooth": Term(costs.rotation_step, ("R_root", "no_turn"), 2, expected=("no_turn",)),
    "head_smooth": Term(costs.rotation_step, ("R_head", "no_turn"), 2, expected=("no_turn",)),
    "pose": Term(costs.pose_offset, ("theta", "theta_imu"), 1, expected=("theta_imu",)),
    "root": Term(costs.rotation_offset, ("R_root", "R_root_start"), 1, expected=("R_root_start",)),
    "hold": Term(costs.position_offset, ("t_root", "t_start"), 1, "hold_confidence", ("t_start",)),
    "translation_step": Term(costs.position_step, ("t_root", "t_step"), 2, expected=("t_step",)),
    "root_step": Term(costs.rotation_step, ("R_root", "R_root_step"), 2, expected=("R_root_step",)),
    "head_step": Term(costs.rotation_step, ("R_head", "R_head_step"), 2, expected=("R_head_step",)),
    "pose_step": Term(costs.pose_step, ("theta_legs", "theta_legs_imu"), 2, expected=("theta_legs_imu",)),
}
"""The terms by name, as configs weight them: E = Σ weight · mean of share · ρ(residual)."""

PATCH_VERTICES = 10
SURFACE_REACH_M = 0.5
"""Distance (m) to the nearest scanned point above which a foot has no scene below it."""
LEAST_UPRIGHT = 0.7
"""Least vertical component of the normal of a plane to stand on (45°): no walls beside gaps in the floor."""


@dataclass(frozen=True)
class HpsEnergy:
    """E = Σ weight · mean of ρ(residual), by term; terms without an entry are left out. Raises WearcapError for a term
    that does not exist or a negative weight."""

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
        return self.losses.get(name, Loss("norm"))

    def reading(self, value: str) -> list[str]:
        """Names of the weighted terms that read a value of `data_values`."""
        rows = [name for name, weight in self.weights.items() if weight > 0]
        return [name for name in rows if value in (*TERMS[name].inputs, TERMS[name].share)]


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
class FootPatches:
    """Vertices of the patches (B_k of thesis eq. 4.6), skinned without the rest of the body: 40, not thousands."""

    body: BodyModel
    vertex: Int64[Tensor, "vertex"]
    patch: Int64[Tensor, "vertex"]
    """Index in `FOOT_PATCHES` of each vertex's patch."""

    @classmethod
    def of(cls, body: BodyModel) -> "FootPatches":
        """Choose `PATCH_VERTICES` vertices of each region by farthest-point sampling (all of a smaller region)."""
        chosen = []
        for name in FOOT_REGIONS.values():
            region = body.regions[name]
            points = body.rest_vertices[region]
            picked = [int((points - points.mean(0)).norm(dim=1).argmax())]
            while len(picked) < min(PATCH_VERTICES, len(region)):
                picked.append(int(torch.cdist(points, points[picked]).min(1).values.argmax()))
            chosen.append(region[picked])
        patch = torch.cat([torch.full((len(v),), k) for k, v in enumerate(chosen)])
        return cls(body, torch.cat(chosen), patch)

    @property
    def legs(self) -> list[list[int]]:
        """Joints of the left and the right leg, from hip to toe; the patches are skinned to the last two."""
        skeleton = self.body.skeleton
        return [skeleton.ancestors(skeleton.index(f"{side}_toe"))[-2::-1] for side in ("left", "right")]

    def share(self, contact: Float[Tensor, "*batch patch"]) -> Float[Tensor, "*batch vertex"]:
        """Contact of each vertex's patch over its number of vertices, so that sums over vertices are patch means."""
        size = torch.bincount(self.patch, minlength=len(FOOT_REGIONS)).to(contact)
        return (contact / size)[..., self.patch]

    def middles(self, points: Float[Tensor, "time vertex 3"]) -> Float[Tensor, "time patch 3"]:
        """Mean position of each patch's vertices."""
        one = torch.nn.functional.one_hot(self.patch, len(FOOT_REGIONS)).to(points)
        return torch.einsum("tvi,vp->tpi", points, one / one.sum(0))

    @cached_property
    def soles(self) -> BodyModel:
        """Body model that consists of the patches only."""
        whole = self.body
        blend = None if whole.pose_blend is None else whole.pose_blend[:, self.vertex]
        return BodyModel(
            whole.skeleton,
            whole.rest_vertices[self.vertex],
            whole.faces[:0],
            whole.skin_joints[self.vertex],
            whole.skin_weights[self.vertex],
            pose_blend=blend,
        )


@dataclass(frozen=True, eq=False)
class SuitSteps:
    """Motion from each frame to the next as the suit measured it, in world axes (float64)."""

    t_step: Float[Tensor, "pair 3"]
    """Displacements of the root, rotated into the scene (m)."""
    R_root_step: Float[Tensor, "pair 3 3"]
    R_head_step: Float[Tensor, "pair 3 3"]


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
    steps: SuitSteps
    surface: SurfaceIndex | None = None
    """Surface of the scan; None: without scan."""
    floor_height: Float[Tensor, "time"] | None = None
    """Height (m) of the level floor below each frame, which stands in for the scan; None: without floor."""

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
            floor_height=None if self.floor_height is None else self.floor_height[frames],
            steps=SuitSteps(*(part[pairs] for part in vars(self.steps).values())),
        )

    def to(self, dtype: torch.dtype) -> "HpsData":
        """All tensors in another precision; the surface is unchanged."""
        tensors = {name: value.to(dtype) for name, value in vars(self).items() if isinstance(value, Tensor)}
        start, steps = ([part.to(dtype) for part in vars(group).values()] for group in (self.start, self.steps))
        return replace(self, start=HpsState(*start), steps=SuitSteps(*steps), **tensors)


_GROUND = ("ground_point", "ground_origin", "ground_normal", "ground_found")


def find_ground(data: HpsData, points: Float[Tensor, "time vertex 3"], energy: HpsEnergy) -> dict[str, Tensor]:
    """Query the scene below patch vertices in contact (m, world), as far as the energy needs it.

    Returns by name the nearest scene point v(n) of each vertex (eq. 4.6), origin and normal of the plane below its
    patch's centroid, and "ground_found": 1 where these exist, else 0; without scan and floor it is 0 everywhere.
    """
    if data.floor_height is not None:
        return _level_ground(data.floor_height, points.detach())
    to_point, to_plane = energy.reading("ground_point"), energy.reading("ground_normal")
    if data.surface is None or not (to_point or to_plane):
        none = torch.zeros_like(points.detach())
        return dict(zip(_GROUND, (none, none, none, none[..., 0])))
    dtype, points = points.dtype, points.detach().double()
    stands, patch = data.contact > 0, data.patches.patch
    point, origin, normal = points.clone(), torch.zeros_like(points), torch.zeros_like(points)
    found = stands[:, patch].double()
    if to_point:
        seek = stands[:, patch]
        point[seek] = torch.from_numpy(data.surface.nearest(points[seek].numpy(), SURFACE_REACH_M)[1])
        found *= point.isfinite().all(-1)
    if to_plane:
        where, up = (torch.zeros(*stands.shape, 3, dtype=torch.float64) for _ in range(2))
        queries = data.patches.middles(points)[stands].numpy()
        where[stands], up[stands] = map(torch.from_numpy, data.surface.plane(queries, reach_m=SURFACE_REACH_M))
        origin, normal = where[:, patch], up[:, patch]
        found *= normal[..., 2] > LEAST_UPRIGHT  # False where no plane was found (NaN)
    parts = (point.nan_to_num(), origin.nan_to_num(), normal.nan_to_num(), found)
    return {name: part.to(dtype) for name, part in zip(_GROUND, parts)}


def _level_ground(height: Float[Tensor, "time"], points: Float[Tensor, "time vertex 3"]) -> dict[str, Tensor]:
    """As `find_ground`, on a floor that is level in each frame."""
    below, up = points.clone(), torch.zeros_like(points)
    below[..., 2], up[..., 2] = height[:, None], 1
    found = ((points - below).abs().amax(-1) <= SURFACE_REACH_M).to(points)
    return dict(zip(_GROUND, (below, below, up, found)))


def data_values(data: HpsData, ground: dict[str, Tensor]) -> dict[str, Tensor]:
    """Values by name that do not depend on the state: those of `HpsData` and `find_ground`, and what terms derive from
    them."""
    contact, patches = data.contact, data.patches
    t, theta_imu, soles = data.start.t_world_root, data.start.theta, ground["ground_point"]
    derived = {
        "ones": torch.ones_like(t[:, 0]),
        "t_start": t,
        "R_root_start": data.start.R_world_root,
        "theta_imu": theta_imu,
        "theta_legs_imu": theta_imu[:, _leg_columns(patches)],
        "R_localized_head": data.R_world_cam @ data.R_head_cam.T,
        **ground,
        "on_ground": patches.share(contact) / 4 * ground["ground_found"],
        "stays": patches.share(contact[1:] * contact[:-1]) / 4,
        "no_slide": torch.zeros_like(soles[1:]),
        "no_step": torch.zeros_like(t[1:]),
        "no_turn": torch.eye(3).to(t).expand(len(data) - 1, 3, 3),
    }
    return {name: value for name, value in vars(data).items() if isinstance(value, Tensor)} | vars(data.steps) | derived


def state_values(data: HpsData, state: HpsState, full_mesh: bool = False) -> dict[str, Tensor]:
    """Values by name that depend on the state: translations t, rotations R (world), axis-angles θ, patch vertices.
    `full_mesh` skins the whole body and takes the patches from it, as the thesis does, with the same result."""
    patches = data.patches
    T_world_joint = forward_kinematics(patches.body.skeleton, state.R_parent_joint, state.t_world_root)
    whole = patches.body.vertices(T_world_joint)[:, patches.vertex] if full_mesh else None
    return {
        "t_root": state.t_world_root,
        "R_root": state.R_world_root,
        "R_head": T_world_joint.R[:, patches.body.skeleton.index("head")],
        "theta": state.theta,
        "theta_legs": state.theta[:, _leg_columns(patches)],
        "soles": patches.soles.vertices(T_world_joint) if whole is None else whole,
    }


def energy_terms(
    energy: HpsEnergy, data: HpsData, state: HpsState, full_mesh: bool = False
) -> dict[str, Float[Tensor, ""]]:
    """Weighted terms of eq. 4.1, differentiable in the state; the scene below the feet is queried for this state."""
    of_state = state_values(data, state, full_mesh)
    return energy_of(energy, of_state | data_values(data, find_ground(data, of_state["soles"], energy)))


def energy_of(energy: HpsEnergy, values: dict[str, Tensor]) -> dict[str, Float[Tensor, ""]]:
    """Weighted terms of eq. 4.1 of the values of a state and its data, by name."""
    terms = {}
    for name, weight in energy.weights.items():
        if weight == 0:
            continue
        term = TERMS[name]
        residual = term.cost(*(values[value] for value in term.inputs))
        rho = energy.loss(name)(residual)
        rho = rho if term.share == "ones" else rho * values[term.share]
        terms[name] = weight * rho.sum() / max(len(residual), 1)
    return terms


def _leg_columns(patches: FootPatches) -> list[int]:
    """Columns of θ that are the legs' joints, the left leg's first."""
    return [joint - 1 for leg in patches.legs for joint in leg]


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of a solver: final state, energy history and stopping reason."""

    state: HpsState
    history: list[dict[str, float]] = field(default_factory=list)
    """Energy by term and in "total", one entry per iteration (mean over windows or stretches)."""
    reason: str = ""
    """Why the solver stopped."""
