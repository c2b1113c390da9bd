"""HPS (thesis ch. 4): a suit's pose registered in a scanned scene by a head camera, without drift.

A recording goes through the document's steps in order; each is a method that can be called alone:
synchronize → localize → align → initialize → optimize.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.body.anny_body import anny_body
from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.data.prepare.clean import resampled
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import finite_difference
from wearcap.optimize.feet import FootPatches
from wearcap.optimize.hps import HpsData, HpsEnergy, HpsState
from wearcap.optimize.solution import Solution
from wearcap.recording import Motion, Recording
from wearcap.recording.recording import Localization
from wearcap.scene.scan import Scan
from wearcap.sensors.alignment import align_suit, estimate_head_camera, inliers
from wearcap.sensors.initialization import Initialization, InitializationSettings, initialize

Solver = Callable[[HpsEnergy, HpsData], Solution]


@dataclass(frozen=True)
class Evidence:
    """How the optimisation reads contacts and localisation."""

    max_contact_speed: float | None = 0.6
    """Flags of a foot patch that moves faster by the suit itself (m/s) are not believed; None: all are (document)."""
    confident: bool = True
    """Weigh frames by the localisation's confidence, not at all where it was lost; False: all alike (document)."""


@dataclass(eq=False)
class HPS:
    """Registers the suit's motion of a recording with the scene."""

    energy: HpsEnergy
    solver: Solver
    initialization: InitializationSettings = field(default_factory=InitializationSettings)
    evidence: Evidence = field(default_factory=Evidence)
    fps: float = 30.0
    name: str = "hps"

    def __call__(self, recording: Recording, scan: Scan | None = None) -> Motion:
        """The wearer's motion in the scene at `fps`; without a `scan` no foot knows the ground."""
        aligned = self.align(recording)
        start = self.initialize(recording, aligned)
        return self.motion(start, self.optimize(self.problem(recording, aligned, start, scan)))

    def align(self, recording: Recording) -> Motion:
        """The suit's motion at `fps`, turned about gravity and moved into the scene (thesis eq. 4.14, 4.15)."""
        suit, localization, mount = required(recording)
        return align_suit(resampled(suit, self.fps), localization, mount)[0]

    def initialize(self, recording: Recording, aligned: Motion) -> Initialization:
        """The start of the optimisation: the suit carried along the camera's path (thesis §4.2.5, eq. 4.13)."""
        _, localization, mount = required(recording)
        return initialize(aligned, localization, mount.R, mount.t, self.initialization)

    def problem(
        self, recording: Recording, aligned: Motion, start: Initialization, scan: Scan | None,
        R_head_cam: Float[Tensor, "3 3"] | None = None,
    ) -> HpsData:  # fmt: skip
        """What the energy is told: the start, localised cameras, contacts, and the suit's own steps.

        `R_head_cam` is estimated from the frames that are localised (HPS paper eq. 4) where it is not given.
        """
        motion, (_, localization, _) = start.motion, required(recording)
        R_cam, sure = at_frames(localization, motion.timestamps)
        root, head = motion.R_parent_joint[:, 0].double(), motion.joint("head").R.double()
        if R_head_cam is None:
            R_head_cam = estimate_head_camera(head, R_cam, sure)
        if not self.evidence.confident:
            sure = (sure > 0).double()
        body = anny_body(motion.skeleton, recording.shape or None)
        heading = rotation.about_axis(
            "z", (start.yaw_correction[1:] + start.yaw_correction[:-1]).double() / 2
        )
        return HpsData(
            FootPatches.of(body),
            HpsState(rotation.log(motion.R_parent_joint[:, 1:].double()), root, motion.t_world_root.double()),
            R_head_cam, R_cam, sure, sure * start.valid if self.evidence.confident else torch.ones_like(sure),
            believed_contact(aligned, self.evidence.max_contact_speed).double(),
            (heading @ aligned.t_world_root.double().diff(dim=0)[..., None])[..., 0], turns(root), turns(head),
            scan.surface if scan else None,
        )  # fmt: skip

    def optimize(self, data: HpsData) -> Solution:
        """Minimise the energy (thesis eq. 4.1)."""
        return self.solver(self.energy, data)

    def motion(self, start: Initialization, solution: Solution) -> Motion:
        """What was captured; contacts stay the suit's."""
        state = solution.state
        return replace(
            start.motion, R_parent_joint=state.R_parent_joint.float(), t_world_root=state.t_world_root.float(),
            provenance={"pipeline": self.name, "solver": solution.reason},
        )  # fmt: skip


def required(recording: Recording) -> tuple[Motion, Localization, Rigid]:
    """Suit, localisation and nominal mount T_head_cam of a recording. Raises WearcapError naming what it lacks."""
    suit, localization, camera = recording.suit, recording.localization, recording.camera
    if suit is None or localization is None or camera is None:
        missing = [name for name in ("suit", "localization", "camera") if getattr(recording, name) is None]
        raise WearcapError(f"no {' and no '.join(missing)} in this recording", where=recording.name,
                           expected="a suit's motion, a head camera, and where it was localised")  # fmt: skip
    return suit, localization, Rigid(camera.R_head_cam, camera.t_head_cam)


def at_frames(
    localization: Localization, timestamps: Float64[Tensor, "time"]
) -> tuple[Float64[Tensor, "time 3 3"], Float64[Tensor, "time"]]:
    """Orientation and confidence of the nearest localised frame, 0 beyond half a frame or where it is an outlier."""
    times = localization.timestamps
    after = torch.searchsorted(times, timestamps).clamp(1, len(times) - 1)
    nearest = torch.where(times[after] - timestamps < timestamps - times[after - 1], after, after - 1)
    step = max(times.diff().median().item(), timestamps.diff().median().item())
    near = (times[nearest] - timestamps).abs() <= 0.51 * step
    sure = (localization.confidence * inliers(localization))[nearest].double() * near
    return localization.R_world_cam[nearest].double(), sure


def turns(R_world_body: Float[Tensor, "time 3 3"]) -> Float[Tensor, "pair 3 3"]:
    """Turn in the world's axes from each frame to the next."""
    return R_world_body[1:] @ R_world_body[:-1].mT


def believed_contact(suit: Motion, max_speed: float | None) -> Bool[Tensor, "time patch"]:
    """The suit's contact flags, without those of patches that move faster than `max_speed` (m/s) by the suit itself.

    Raises WearcapError when there are none, or fewer than frames.
    """
    if suit.contact_prob is None or len(suit.contact_prob) != len(suit):
        count = "no" if suit.contact_prob is None else f"{len(suit.contact_prob)} frames of"
        raise WearcapError(f"{count} foot contacts for {len(suit)} frames of the suit's pose",
                           expected="one per frame and patch", fix="wearcap.sensors.contacts derives them.")  # fmt: skip
    contact = suit.contact_prob >= 0.5
    if max_speed is None:
        return contact
    patches = site_positions(suit.skeleton, suit.T_world_joint, FOOT_PATCHES)
    return contact & (finite_difference(patches, suit.timestamps).norm(dim=-1) <= max_speed)
