"""HPS (thesis ch. 4): registers a suit's motion in a scanned scene by a head camera, without drift.

The steps of the thesis in order: synchronize → localize → align → initialize → optimize, and ours before the last one:
constants. Each can be called alone, and is a stage whose result can be cached.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.anny_body import anny_body
from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, finite_difference, resample
from wearcap.recording import Motion, Recording
from wearcap.recording.recording import Localization
from wearcap.recording.timing import resampled
from wearcap.runtime.needs import CAMERA, CONTACTS, LOCALIZATION, SCAN, SUIT, Need
from wearcap.runtime.stages import Stage, StagedSystem
from wearcap.runtime.system import CaptureInput
from wearcap.scene.scan import Scan
from wearcap.sensors.contacts import contacts_from_motion
from wearcap.sensors.initialization import (
    Initialization,
    InitializationSettings,
    align_suit,
    estimate_head_camera,
    initialize,
    inliers,
    yaw_between,
)
from wearcap.systems.hps.camera import (
    Localize,
    MapLocalization,
    Synchronization,
    camera_report,
    camera_stages,
    on_one_clock,
)
from wearcap.systems.hps.constants import Constants, ConstantsPrior, estimate_constants, segments, with_constants
from wearcap.systems.hps.energy import FootPatches, HpsData, HpsEnergy, HpsState, Solution, SuitSteps

Solver = Callable[[HpsEnergy, HpsData], Solution]


@dataclass(frozen=True)
class Evidence:
    """How much the optimisation trusts the suit's contacts and the localisation."""

    max_contact_speed: float | None = 0.35
    """Largest speed (m/s, in the suit's motion) at which a foot patch's contact is used; None: all are (thesis)."""
    confident: bool = True
    """Whether frames are weighted by the localisation's confidence (0 where it failed); False: all alike (thesis)."""


@dataclass(eq=False)
class HPS(StagedSystem):
    """Registers the suit's motion of a recording with the scene."""

    energy: HpsEnergy
    solver: Solver
    initialization: InitializationSettings = field(default_factory=InitializationSettings)
    evidence: Evidence = field(default_factory=Evidence)
    constants: ConstantsPrior | None = None
    """Constants that are estimated with the motion; None: the suit's body and the nominal mount (thesis)."""
    fps: float = 30.0
    name: str = "hps"
    synchronization: Synchronization = field(default_factory=Synchronization)
    localization: Localize = field(default_factory=MapLocalization)

    required = (SUIT, CONTACTS, CAMERA, LOCALIZATION, SCAN)

    def needs(self) -> tuple[Need, ...]:
        """All that is required: poses or pictures with this pipeline's map, and the scan only where the energy reads it."""

        def localizable(source: CaptureInput) -> bool:
            try:
                self.localization.reads(source.recording, source.folder or Path())
            except WearcapError:
                return False
            return True

        found = (replace(need, has=localizable) if need is LOCALIZATION else need for need in self.required)
        return tuple(need for need in found if need is not SCAN or self.energy.reading("on_ground"))

    @property
    def latency_s(self) -> float:
        """Longest time between a frame and its final pose (s), with the default settings of a stream."""
        settings = self._room("stream", "captures streams").StreamSettings()
        return settings.lag_s + settings.advance_s

    def stages(self, source: CaptureInput) -> list[Stage]:
        """The steps from a recording to the solution. Raises WearcapError without suit, head camera, localisation or
        map, or a scan where the energy asks for one."""
        recording = source.recording
        require(recording, "suit", "camera")
        first = camera_stages(source, self.synchronization, self.localization)
        self.require_scan(source.scan, recording.name)
        before = ("synchronize", "localize", "align", "initialize")
        scan = functools.cache(source.read_scan)

        def problem(done: dict[str, Any]) -> HpsData:
            return self.problem(on_one_clock(recording, done), done["align"], done["initialize"], scan())

        def inputs() -> tuple[Any, ...]:
            weights = (self.energy, self.solver, self.evidence, self.constants)
            return *weights, source.scan, source.metres_per_unit, recording.shape

        body = (recording.suit, *mount(recording))
        return [
            *first,
            Stage(
                "align",
                lambda done: self.align(on_one_clock(recording, done)),
                lambda: (self.fps, self.initialization.tilt, *body),
                ("synchronize", "localize"),
            ),
            Stage(
                "initialize",
                lambda done: self.initialize(on_one_clock(recording, done), done["align"]),
                lambda: (self.initialization, *mount(recording)),
                ("synchronize", "localize", "align"),
                (Initialization,),
            ),
            *(
                [Stage("constants", lambda done: self.estimate(problem(done)), inputs, before, (Constants,))]
                if self.constants
                else []
            ),
            Stage(
                "optimize",
                lambda done: self.optimize(problem(done), done.get("constants")),
                inputs,
                (*before, "constants") if self.constants else before,
                (Solution, HpsState),
            ),
        ]

    def require_scan(self, scan: Path | Scan | None, where: str) -> None:
        """Raise WearcapError when a term of the energy needs a scan and there is none."""
        terms = self.energy.reading("on_ground")
        if scan is None and terms:
            what = f"no scan of the scene, which the energy's term {' and '.join(terms)} needs"
            expected = "a recording that names its scan, or scene=FOLDER"
            fix = "Without one: pipeline=paper/hps_without_scene."
            raise WearcapError(what, where=where, expected=expected, fix=fix)

    def motion_of(self, results: dict[str, Any]) -> Motion | None:
        """Motion after the last stage that was run: aligned, initial or optimised."""
        if "optimize" in results:
            return self.motion(results["initialize"], results["optimize"], results.get("constants"))
        return results["initialize"].motion if "initialize" in results else results.get("align")

    def report(self, source: CaptureInput, results: dict[str, Any]) -> dict[str, Any]:
        """Clock, share of localised frames, alignment angle, estimated constants, energy by term and iteration, and the
        stopping reason."""
        about = camera_report(results)
        if "align" in results:
            assert source.recording.suit is not None
            angle, _ = yaw_between(source.recording.suit.R_parent_joint[0, 0], results["align"].R_parent_joint[0, 0])
            about["alignment_deg"] = angle.rad2deg().item()
        if "constants" in results:
            constants, skeleton = results["constants"], results["initialize"].motion.skeleton
            about |= {"bone_scale": constants.scale, "mount_moved_cm": (100 * constants.t_mount).tolist()}
            turned = constants.turns.rad2deg().tolist()
            names = (skeleton.joint_names[joint] for joint in segments(skeleton))
            about |= {"legs_longer_cm": 100 * constants.height_m, "segments_turned_deg": dict(zip(names, turned))}
        if "optimize" in results:
            about |= {"stopped": results["optimize"].reason, "energy": results["optimize"].history}
        return about

    def align(self, recording: Recording) -> Motion:
        """The suit's motion at `fps`, rotated about gravity and moved into the scene (thesis eq. 4.14, 4.15)."""
        suit, localization, T_head_cam = required(recording)
        return align_suit(resampled(suit, self.fps), localization, T_head_cam, tilt=self.initialization.tilt)[0]

    def initialize(self, recording: Recording, aligned: Motion) -> Initialization:
        """Initial state of the optimisation: the suit's pose on the camera's path (thesis §4.2.5, eq. 4.13)."""
        _, localization, T_head_cam = required(recording)
        return initialize(aligned, localization, T_head_cam.R, T_head_cam.t, self.initialization)

    def problem(
        self,
        recording: Recording,
        aligned: Motion,
        start: Initialization,
        scan: Scan | None,
        R_head_cam: Float[Tensor, "3 3"] | None = None,
    ) -> HpsData:
        """Data of the energy: initial state, localised cameras, contacts, the suit's motion from frame to frame, and
        `R_head_cam`, estimated from the localised frames (HPS paper eq. 4) unless it is given.

        Contacts are the suit's flags, or follow from its feet's speed where it has none; without patches that move faster
        than `max_contact_speed`. Raises WearcapError when there is not one per frame.
        """
        motion = start.motion
        require(recording, "localization")
        assert recording.localization is not None
        R_cam, sure = at_frames(recording.localization, motion)
        root, head = motion.R_parent_joint[:, 0].double(), motion.joint("head").R.double()
        if R_head_cam is None:
            R_head_cam = estimate_head_camera(head, R_cam, sure)
        if not self.evidence.confident:
            sure = (sure > 0).double()
        body = anny_body(motion.skeleton, recording.shape or None)
        contact = contacts_from_motion(aligned) if aligned.contact_prob is None else aligned.contact_prob >= 0.5
        if len(contact) != len(aligned):
            what = f"{len(contact)} frames of foot contacts for {len(aligned)} frames of the suit's pose"
            raise WearcapError(what, expected="one per frame and patch")
        if self.evidence.max_contact_speed is not None:
            patches = site_positions(aligned.skeleton, aligned.T_world_joint, FOOT_PATCHES)
            speed = finite_difference(patches, aligned.timestamps).norm(dim=-1)
            contact &= speed <= self.evidence.max_contact_speed
        return HpsData(
            FootPatches.of(body),
            HpsState(rotation.log(motion.R_parent_joint[:, 1:].double()), root, motion.t_world_root.double()),
            R_head_cam,
            R_cam,
            sure,
            sure * start.valid if self.evidence.confident else torch.ones_like(sure),
            contact.double(),
            SuitSteps(start.root_step.double(), turns(root), turns(head)),
            scan.surface if scan else None,
        )

    def estimate(self, data: HpsData) -> Constants:
        """Constants of the recording (ours)."""
        assert self.constants is not None
        return estimate_constants(self.energy, data, self.solver, self.fps, self.constants)

    def optimize(self, data: HpsData, constants: Constants | None = None) -> Solution:
        """Minimise the energy (thesis eq. 4.1)."""
        return self.solver(self.energy, with_constants(data, constants) if constants else data)

    def motion(self, start: Initialization, solution: Solution, constants: Constants | None = None) -> Motion:
        """Captured motion of a solution; foot contacts are those of the suit."""
        state, skeleton = solution.state, start.motion.skeleton
        return replace(
            start.motion,
            skeleton=constants.skeleton(skeleton) if constants else skeleton,
            R_parent_joint=state.R_parent_joint.float(),
            t_world_root=state.t_world_root.float(),
            provenance={"pipeline": self.name, "solver": solution.reason},
        )


def required(recording: Recording) -> tuple[Motion, Localization, Rigid]:
    """Suit, localisation and nominal mount T_head_cam of a recording. Raises WearcapError that names missing parts."""
    require(recording, "suit", "localization", "camera")
    assert recording.suit is not None
    assert recording.localization is not None
    return recording.suit, recording.localization, Rigid(*mount(recording))


def require(recording: Recording, *names: str) -> None:
    """Raise WearcapError unless the recording has all of these parts."""
    missing = [name for name in names if getattr(recording, name) is None]
    if missing:
        expected = "a suit's motion, a head camera, and where it was localised"
        raise WearcapError(f"no {' and no '.join(missing)} in this recording", where=recording.name, expected=expected)


def mount(recording: Recording) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """Nominal orientation and position (m) of the camera in the head's frame."""
    assert recording.camera is not None
    return recording.camera.R_head_cam, recording.camera.t_head_cam


def at_frames(
    localization: Localization, motion: Motion
) -> tuple[Float64[Tensor, "time 3 3"], Float64[Tensor, "time"]]:
    """Orientation and confidence of the nearest localised frame; confidence is 0 beyond half a frame and at outliers.

    The orientation is propagated from its own time to the motion's frame by the rotation of the motion's head, which
    matters where localisation is sparser than the motion's frames.
    """
    times, timestamps = localization.timestamps.contiguous(), motion.timestamps.contiguous()
    after = torch.searchsorted(times, timestamps).clamp(1, len(times) - 1)
    nearest = torch.where(times[after] - timestamps < timestamps - times[after - 1], after, after - 1)
    step = max(times.diff().median().item(), timestamps.diff().median().item())
    near = (times[nearest] - timestamps).abs() <= 0.51 * step
    sure = (localization.confidence * inliers(localization))[nearest].double() * near
    head = motion.joint("head")
    then = resample(Trajectory(timestamps, head.R, head.t), times.clamp(timestamps[0], timestamps[-1]))
    carried = head.R.double() @ then.R_world_body[nearest].double().mT
    return carried @ localization.R_world_cam[nearest].double(), sure


def turns(R_world_body: Float[Tensor, "time 3 3"]) -> Float[Tensor, "pair 3 3"]:
    """Rotation in world axes from each frame to the next."""
    return R_world_body[1:] @ R_world_body[:-1].mT
