"""`refine=hps`: HPS's energy over a motion that a learned system predicted, which stands in the suit's place.

The measured head is the localised camera, the scan or else a level floor is the scene, contacts are the predicted ones.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FEET, FOOT_PATCHES
from wearcap.recording import Motion
from wearcap.recording.recording import Localization
from wearcap.runtime.system import Captured, CaptureInput
from wearcap.sensors.initialization import Initialization
from wearcap.systems.hps.energy import FootPatches, HpsEnergy
from wearcap.systems.hps.pipeline import HPS, Evidence, Solver
from wearcap.tracking.anchor import anchored_to_head
from wearcap.tracking.floor import floor_from_points
from wearcap.tracking.head_path import HeadPath, head_path


@dataclass(frozen=True)
class HpsRefinement:
    """Registers predicted motion with the head, the floor and its own contacts, as HPS registers a suit's."""

    energy: HpsEnergy
    solver: Solver
    evidence: Evidence
    head_floor: float
    """Share of the ground's weight that a floor has which the head's path alone tells."""
    lifted_m: float
    """Height (m) above its foot's lower patch at which a patch does not stand: networks predict contact of whole feet."""

    def __call__(self, motion: Motion, source: CaptureInput) -> Captured:
        """The motion at the least energy, and its energies by term and iteration.

        Raises WearcapError for a recording without head poses, or with a scan that cannot be read.
        """
        recording, scan = source.recording, source.read_scan()
        path = head_path(recording, motion.skeleton, motion.fps)
        seen = floor_from_points(recording.points, path.T_world_head.t, path.stature)
        energy = self.energy if scan or seen is not None else self.doubting_floor
        hps, start = HPS(energy, self.solver, evidence=self.evidence), initialized(motion, path)
        head = Localization(path.timestamps, path.T_world_head.R, path.T_world_head.t, start.valid.float())
        suit = replace(motion, contact_prob=self.contact_prob(motion))
        data = hps.problem(replace(recording, localization=head), suit, start, scan, torch.eye(3).double())
        if scan is None:
            floor = path.floor_height if seen is None else seen
            data = replace(data, floor_height=(floor + sole_height(data.patches)).double())
        solution = hps.optimize(data)
        provenance = motion.provenance | {"refine": "hps", "solver": solution.reason}
        refined = replace(hps.motion(start, solution), provenance=provenance)
        return Captured(refined, {"stopped": solution.reason, "energy": solution.history})

    @property
    def doubting_floor(self) -> HpsEnergy:
        """The energy above a floor that the head's path alone tells."""
        weights = {name: self.head_floor * self.energy.weight(name) for name in self.energy.reading("on_ground")}
        return replace(self.energy, weights=self.energy.weights | weights)

    def contact_prob(self, motion: Motion) -> Float[Tensor, "time patch"] | None:
        """Predicted contacts without lifted patches; None where none are predicted: they follow from the feet's speed."""
        if motion.contact_prob is None:
            return None
        height = site_positions(motion.skeleton, motion.T_world_joint, FOOT_PATCHES)[..., 2].unflatten(-1, (FEET, -1))
        low = height - height.amin(-1, keepdim=True) < self.lifted_m
        return motion.contact_prob * low.flatten(-2)


def initialized(motion: Motion, path: HeadPath) -> Initialization:
    """The motion whose head is where it was measured (as thesis eq. 4.13); frames in gaps of the path are not valid."""
    moved = anchored_to_head(motion, path.T_world_head)
    valid = torch.zeros(len(motion), dtype=torch.bool)
    for begin, stop in path.stretches:
        valid[begin:stop] = True
    return Initialization(moved, valid, torch.zeros(len(motion)), moved.t_world_root.diff(dim=0))


def sole_height(patches: FootPatches) -> float:
    """Mean height (m) of the patches' vertices above the floor in the rest pose: skin is rounder than a sole."""
    standing = patches.middles(patches.soles.rest_vertices[None])[..., 2].mean().item()
    return standing + patches.body.skeleton.root_height
