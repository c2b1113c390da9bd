"""ECHO (Petrov et al.): human, object and contacts from head and wrists, by one diffusion model, endlessly."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from scipy.spatial import KDTree

from wearcap.body.anny_body import anny_body
from wearcap.body.contact_points import BODY_POINTS, contact_points
from wearcap.body.skeleton import Skeleton
from wearcap.diffusion.conveyor import Denoise, RollingSchedule
from wearcap.diffusion.schedule import Schedule
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.models.point_encoder import PointNeXt
from wearcap.recording import Motion, Recording
from wearcap.recording.acts import Act, true_acts
from wearcap.scene.environment import Environment
from wearcap.systems.echo.features import EchoFeatures
from wearcap.systems.echo.guidance import Guidance, GuidedScene
from wearcap.systems.echo.model import EchoDenoiser
from wearcap.systems.echo.objects import ObjectReader, ObjectShape
from wearcap.systems.echo.observations import BatchItem, Scenario, batch_item_of
from wearcap.systems.echo.queue import Conditioning, Correction, EchoQueue, Outputs
from wearcap.systems.echo.rewindow import Rewindow
from wearcap.systems.echo.static_objects import with_static_objects
from wearcap.systems.echo.step_runner import EchoRunner, require_runtime
from wearcap.tracking.anchor import anchored_to_head
from wearcap.tracking.head_path import HeadPath, head_path


@dataclass
class Echo:
    """Captures whole recordings on a conveyor of frames; recordings share batches, which changes nothing but the time."""

    net: EchoDenoiser
    features: EchoFeatures
    schedule: Schedule
    skeleton: Skeleton
    """For recordings that do not say whose body it is."""
    encoder: PointNeXt | None = None
    contacts: bool = True
    """Whether the network was trained on contacts."""
    context: int = 4
    """Clean frames that are kept before the ramp: a pose is final when window - context - 1 frames have followed it."""
    per_frame: int = 2
    """Steps for every frame that enters; with a window of 60 and a context of 4 it takes 112 for each (the document: 100)."""
    spacing: float = 2.0
    eta: float = 0.0
    step: str = "posterior"
    """See `diffusion.conveyor.RollingSchedule`."""
    rewindow: int | None = None
    """Frames by which windows advance that are denoised from scratch, as is usual; None: a conveyor."""
    anchor: bool = True
    """Whether the body hangs from the measured head (ours) or stands where it was drawn (the document)."""
    static_threshold: float | None = 0.7
    """Objects stay where they are in frames in which nothing touches them with this probability (ours); None: they are as
    drawn (the document), and so they are where the network knows no contacts."""
    guidance: Guidance | None = None
    """None: the prediction is left as it is, and so it is where the network knows no contacts."""
    acts: str | Sequence[Mapping[str, Any]] | Callable[[Motion, Environment], tuple[Act, ...]] = "truth"
    """Which object is active when: "truth", as the recording's interactions say; "none": the human alone; a list of
    {object, start_s, stop_s}; or a search."""
    environment: str | None = None
    """File of the objects; None: what the recording names."""
    placed: bool = False
    """Whether objects are known to begin where the environment has them (ours; the document knows no places)."""
    runtime: str = "eager"
    """See `systems.echo.step_runner`."""
    device: str = "cpu"
    _runner: EchoRunner | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self):
        if isinstance(self.acts, str) and self.acts not in ("truth", "none"):
            raise WearcapError(f"no acts {self.acts!r}", expected="truth, none, or a list of {object, start_s, stop_s}")  # fmt: skip
        ramp, _ = self.rolling.ramp, self._given_acts()
        if self.rewindow is not None and not 0 < self.rewindow <= ramp:
            raise WearcapError(f"windows that advance by {self.rewindow} frames", expected=f"1 to {ramp}, the window less the context")  # fmt: skip
        if self.rewindow is not None and self.step == "redraw":
            raise WearcapError("step=redraw with windows that are denoised from scratch", expected="step=posterior, or rewindow=null")  # fmt: skip
        require_runtime(self.runtime, self.device)

    @property
    def rolling(self) -> RollingSchedule:
        """How the conveyor runs."""
        return RollingSchedule(
            self.net.window, self.context, self.per_frame, self.spacing, self.eta, self.step
        )

    @property
    def fps(self) -> float:
        return self.features.fps

    @property
    def latency_s(self) -> float:
        """Between a frame and its final pose."""
        return (self.rolling.ramp - 1) / self.fps

    @property
    def static_below(self) -> float | None:
        """`static_threshold`, where the network knows contacts."""
        return self.static_threshold if self.contacts else None

    @property
    def guided_by(self) -> Guidance | None:
        """`guidance`, where the network knows contacts."""
        return self.guidance if self.contacts else None

    def prepare(self) -> None:
        """Bring the network to its device and into the form it runs in; what is exported or compiled is made once."""
        self.net.to(self.device).eval()
        if self._runner is None or self.runtime == "eager":
            self._runner = EchoRunner(self.net, self.runtime)

    def reader(self) -> ObjectReader:
        """What turns objects into what the network is told, which embeds each once."""
        self.prepare()
        return ObjectReader(
            self.features, self.encoder, lambda codes: self.net.object(codes.to(self.device)).cpu()
        )

    def capture(self, recordings: Sequence[Recording], seeds: Sequence[int]) -> list[Motion]:
        """One motion of the human alone per (recording, seed); with objects: `capture_scenarios`."""
        return self.capture_scenarios([Scenario(recording) for recording in recordings], seeds)

    def _given_acts(self) -> tuple[Act, ...]:
        if isinstance(self.acts, str) or callable(self.acts):
            return ()
        try:
            return tuple(sorted((Act(**row) for row in self.acts), key=lambda act: act.start_s))
        except TypeError as error:
            raise WearcapError(f"acts {self.acts!r}", expected="a list of {object, start_s, stop_s}") from error  # fmt: skip

    def scenario(self, recording: Recording, environment: Environment | None) -> Scenario:
        """A recording with the objects that are active in it, as `acts` says.

        A recording without an environment, or without interactions and objects' poses, is of a human alone, unless acts
        were given.
        """
        if self.acts == "truth":
            tracked = bool(recording.object_motion) or recording.interactions is not None
            there = environment is not None and tracked
            acts = tuple(true_acts(recording)) if there else ()
            return Scenario(recording, environment, acts, placed=self.placed)
        if callable(self.acts) and environment is not None:
            alone = self.capture_scenarios([Scenario(recording)], [0])[0]
            return Scenario(recording, environment, self.acts(alone, environment), placed=self.placed)
        return Scenario(recording, environment, self._given_acts(), placed=self.placed)

    @torch.no_grad()
    def capture_scenarios(self, scenarios: Sequence[Scenario], seeds: Sequence[int]) -> list[Motion]:
        """One motion per (scenario, seed), with `object_motion` and `body_contact_prob` where objects are active.

        Raises WearcapError as `head_path` and `batch_item_of` do.
        """
        self.prepare()
        # 1. the three tracked points on the model's clock, and the active objects' codes; once for all seeds
        reader, once = self.reader(), {id(scenario): scenario for scenario in scenarios}
        item_by = {key: self._item(scenario, reader) for key, scenario in once.items()}
        items = [item_by[id(scenario)] for scenario in scenarios]
        # 2. frame after frame enters as noise and leaves clean
        outputs = self._conveyed(items, [scenario.recording for scenario in scenarios], seeds)
        # 3. the body hangs from the measured head; objects rest while nothing touches them
        if (threshold := self.static_below) is not None:
            outputs = [
                with_static_objects(item.conditioning, part, threshold) for item, part in zip(items, outputs)
            ]
        return [motion_of(item, part, self.anchor, self.settings()) for item, part in zip(items, outputs)]

    def _item(self, scenario: Scenario, reader: ObjectReader) -> BatchItem:
        return batch_item_of(scenario, head_path(scenario.recording, self.skeleton, self.fps), reader)

    def _conveyed(
        self, items: Sequence[BatchItem], recordings: Sequence[Recording], seeds: Sequence[int]
    ) -> list[Outputs]:
        """All frames of every lane: its stretches side by side, what lies between them as it was before."""
        parts = [(k, *stretch) for k, item in enumerate(items) for stretch in item.path.stretches]
        longest = max(stop - start for _, start, stop in parts)
        queue = self.queue(
            [items[k].path.skeleton for k, *_ in parts],
            [stretch_seed(seeds[k], start) for k, start, _ in parts],
            [recordings[k].shape for k, *_ in parts],
            [items[k].objects for k, *_ in parts],
        )
        conditioning = [_padded(items[k].conditioning, start, stop, longest) for k, start, stop in parts]
        whole = Conditioning(*(torch.cat(fields) for fields in zip(*conditioning)))
        together = queue.run(whole)
        found: list[list[Outputs]] = [[] for _ in items]
        for row, (k, start, stop) in enumerate(parts):
            found[k].append(Outputs(*(field[row : row + 1, : stop - start] for field in together)))
        return [_bridged(outputs, item.path) for outputs, item in zip(found, items)]

    def queue(
        self,
        skeletons: Sequence[Skeleton],
        seeds: Sequence[int],
        shapes: Sequence[dict[str, float]],
        objects: Sequence[Sequence[ObjectShape]],
    ) -> EchoQueue:
        """An empty queue of as many lanes, with what guidance pulls at where there is guidance."""
        queue = EchoQueue(self, skeletons, seeds)
        if self.rewindow is not None:
            queue = Rewindow(self, skeletons, seeds, self.rewindow)
        if self.guided_by is not None:
            queue.guided = pulled_by(skeletons, shapes, objects)
        return queue

    def denoiser(
        self, queue: EchoQueue, conditioning: Conditioning, frame: Rigid
    ) -> tuple[Denoise, Correction | None]:
        """x̂0 of the frames on a conveyor as a function of x_t and levels, and what guidance makes of it.

        What the frames are told is encoded once, what their levels do is kept for when the same ones come again.
        """
        condition = self.features.condition(conditioning.points, conditioning.floor_height, queue.size, frame)
        if self._runner is None:
            self.prepare()
        assert self._runner is not None
        denoise = self._runner.begin(
            condition, conditioning.object_code, conditioning.has_object, conditioning.valid
        )
        guidance = self.guided_by
        if guidance is None or queue.guided is None:
            return denoise, None
        surfaces, objects = queue.guided
        scene = GuidedScene(self.net, self.features, conditioning, frame, surfaces, objects)
        return denoise, lambda x0_hat: guidance.corrected(x0_hat, scene)

    def settings(self) -> dict[str, str]:
        """What the motion depends on, beside the network."""
        return {
            "pipeline": "echo", "context": str(self.context), "per_frame": str(self.per_frame), "spacing": str(self.spacing),
            "eta": str(self.eta), "step": self.step, "rewindow": str(self.rewindow), "anchor": str(self.anchor),
            "static_threshold": str(self.static_below), "placed": str(self.placed), "guidance": str(self.guided_by), "acts": "search" if callable(self.acts) else str(self.acts),
        }  # fmt: skip


def motion_of(item: BatchItem, outputs: Outputs, anchored: bool, provenance: dict[str, str]) -> Motion:
    """What was said of a lane as a motion, hung from the measured head or not; a body that is observed stays as it is."""
    path, contact = item.path, outputs.contact_prob[0]
    motion = Motion(
        path.timestamps, path.skeleton, outputs.R_parent_joint[0], outputs.t_world_root[0], contact[:, BODY_POINTS:],
        body_contact_prob=contact[:, :BODY_POINTS] * item.conditioning.has_object[0, :, None],
        object_motion=object_tracks(item, outputs) or None, provenance=provenance,
    )  # fmt: skip
    if not anchored:
        return motion
    anchored_motion = anchored_to_head(motion, path.T_world_head)
    seen = item.conditioning.is_observed[0, :, 0]
    R = torch.where(seen[:, None, None, None], motion.R_parent_joint, anchored_motion.R_parent_joint)
    t = torch.where(seen[:, None], motion.t_world_root, anchored_motion.t_world_root)
    return replace(motion, R_parent_joint=R, t_world_root=t)


def pulled_by(
    skeletons: Sequence[Skeleton],
    shapes: Sequence[dict[str, float]],
    objects: Sequence[Sequence[ObjectShape]],
) -> tuple[list, list]:
    """Contact points of every lane's body, and trees over its objects' points: what guidance pulls at."""
    surfaces = [
        contact_points(anny_body(skeleton, shape or None)) for skeleton, shape in zip(skeletons, shapes)
    ]
    return surfaces, [[KDTree(shape.cloud.numpy()) for shape in mine] for mine in objects]


def object_tracks(item: BatchItem, outputs: Outputs) -> dict[str, Trajectory]:
    """Each object's poses: as said while it is active, as it was last (before the first time: as it will be first) else."""
    active = torch.where(item.conditioning.has_object[0], item.conditioning.object_number[0], -1.0)
    T = Rigid(outputs.R_world_object[0], outputs.t_world_object[0])
    tracks = {}
    for number, shape in enumerate(item.objects):
        rows = (active == number).nonzero()[:, 0]
        if not len(rows):
            continue
        last = torch.searchsorted(rows, torch.arange(len(active)), right=True).sub(1).clamp_min(0)
        pose = shape.of_mesh(T[rows[last]])
        tracks[shape.name] = Trajectory(item.path.timestamps, pose.R, pose.t)
    return tracks


def stretch_seed(seed: int, start: int) -> int:
    """Of a stretch that begins at a frame: stretches of one recording have noise of their own."""
    return seed + 1_000_003 * start


def _padded(conditioning: Conditioning, start: int, stop: int, length: int) -> Conditioning:
    """Frames start…stop-1, up to a length: the last one again, not valid."""
    take = (start + torch.arange(length)).clamp_max(stop - 1)
    there = torch.arange(length) < stop - start
    padded = conditioning.frames(take)
    return padded._replace(valid=padded.valid & there, is_observed=padded.is_observed & there[:, None])


def _bridged(outputs: list[Outputs], path: HeadPath) -> Outputs:
    """Stretches as one; frames in the gaps between them are as the one before."""
    whole, frames = Outputs(*(torch.cat(fields, 1) for fields in zip(*outputs))), path.held_frames
    return Outputs(*(field[:, frames] for field in whole))
