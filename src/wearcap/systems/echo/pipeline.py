"""ECHO (Petrov et al.): human, object and contacts from head and wrists, by one diffusion model, endlessly."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from scipy.spatial import KDTree

from wearcap.body.anny_body import anny_body
from wearcap.body.contact_points import BODY_POINTS, contact_points
from wearcap.body.skeleton import Skeleton
from wearcap.diffusion.conveyor import Belt, Denoise
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
from wearcap.systems.echo.observations import Lane, Scenario, lane_of
from wearcap.systems.echo.queue import Amend, EchoQueue, Said, Told
from wearcap.systems.echo.rewindow import Rewindow
from wearcap.systems.echo.static_objects import rested
from wearcap.systems.echo.step_runner import EchoRunner, require_runtime
from wearcap.tracking.anchor import hang_from_head
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
    """See `diffusion.conveyor.Belt`."""
    rewindow: int | None = None
    """Frames by which windows advance that are denoised from scratch, as is usual; None: a conveyor."""
    hang: bool = True
    """Whether the body hangs from the measured head (ours) or stands where it was drawn (the document)."""
    rest: float | None = 0.7
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
        ramp, _ = self.belt.ramp, self._given_acts()
        if self.rewindow is not None and not 0 < self.rewindow <= ramp:
            raise WearcapError(f"windows that advance by {self.rewindow} frames", expected=f"1 to {ramp}, the window less the context")  # fmt: skip
        if self.rewindow is not None and self.step == "redraw":
            raise WearcapError("step=redraw with windows that are denoised from scratch", expected="step=posterior, or rewindow=null")  # fmt: skip
        require_runtime(self.runtime, self.device)

    @property
    def belt(self) -> Belt:
        """How the conveyor runs."""
        return Belt(self.net.window, self.context, self.per_frame, self.spacing, self.eta, self.step)

    @property
    def fps(self) -> float:
        return self.features.fps

    @property
    def latency_s(self) -> float:
        """Between a frame and its final pose."""
        return (self.belt.ramp - 1) / self.fps

    @property
    def rests_below(self) -> float | None:
        """`rest`, where the network knows contacts."""
        return self.rest if self.contacts else None

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
            told = bool(recording.object_motion) or recording.interactions is not None
            there = environment is not None and told
            acts = tuple(true_acts(recording)) if there else ()
            return Scenario(recording, environment, acts, placed=self.placed)
        if callable(self.acts) and environment is not None:
            alone = self.capture_scenarios([Scenario(recording)], [0])[0]
            return Scenario(recording, environment, self.acts(alone, environment), placed=self.placed)
        return Scenario(recording, environment, self._given_acts(), placed=self.placed)

    @torch.no_grad()
    def capture_scenarios(self, scenarios: Sequence[Scenario], seeds: Sequence[int]) -> list[Motion]:
        """One motion per (scenario, seed), with `object_motion` and `body_contact_prob` where objects are active.

        Raises WearcapError as `head_path` and `lane_of` do.
        """
        self.prepare()
        # 1. the three tracked points on the model's clock, and the active objects' codes; once for all seeds
        reader, once = self.reader(), {id(scenario): scenario for scenario in scenarios}
        lane_by = {key: self._lane(scenario, reader) for key, scenario in once.items()}
        lanes = [lane_by[id(scenario)] for scenario in scenarios]
        # 2. frame after frame enters as noise and leaves clean
        said = self._conveyed(lanes, [scenario.recording for scenario in scenarios], seeds)
        # 3. the body hangs from the measured head; objects rest while nothing touches them
        if (threshold := self.rests_below) is not None:
            said = [rested(lane.told, part, threshold) for lane, part in zip(lanes, said)]
        return [motion_of(lane, part, self.hang, self.settings()) for lane, part in zip(lanes, said)]

    def _lane(self, scenario: Scenario, reader: ObjectReader) -> Lane:
        return lane_of(scenario, head_path(scenario.recording, self.skeleton, self.fps), reader)

    def _conveyed(
        self, lanes: Sequence[Lane], recordings: Sequence[Recording], seeds: Sequence[int]
    ) -> list[Said]:
        """All frames of every lane: its stretches side by side, what lies between them as it was before."""
        parts = [(k, *stretch) for k, lane in enumerate(lanes) for stretch in lane.path.stretches]
        longest = max(stop - start for _, start, stop in parts)
        queue = self.queue(
            [lanes[k].path.skeleton for k, *_ in parts],
            [stretch_seed(seeds[k], start) for k, start, _ in parts],
            [recordings[k].shape for k, *_ in parts],
            [lanes[k].objects for k, *_ in parts],
        )
        told = [_padded(lanes[k].told, start, stop, longest) for k, start, stop in parts]
        whole = Told(*(torch.cat(fields) for fields in zip(*told)))
        together = queue.run(whole)
        found: list[list[Said]] = [[] for _ in lanes]
        for row, (k, start, stop) in enumerate(parts):
            found[k].append(Said(*(field[row : row + 1, : stop - start] for field in together)))
        return [_bridged(said, lane.path) for said, lane in zip(found, lanes)]

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

    def denoiser(self, queue: EchoQueue, told: Told, frame: Rigid) -> tuple[Denoise, Amend | None]:
        """x̂0 of the frames on a conveyor as a function of x_t and levels, and what guidance makes of it.

        What the frames are told is encoded once, what their levels do is kept for when the same ones come again.
        """
        condition = self.features.condition(told.points, told.floor_height, queue.size, frame)
        if self._runner is None:
            self.prepare()
        assert self._runner is not None
        denoise = self._runner.begin(condition, told.object_code, told.has_object, told.valid)
        guidance = self.guided_by
        if guidance is None or queue.guided is None:
            return denoise, None
        surfaces, objects = queue.guided
        scene = GuidedScene(self.net, self.features, told, frame, surfaces, objects)
        return denoise, lambda x0_hat: guidance.amended(x0_hat, scene)

    def settings(self) -> dict[str, str]:
        """What the motion depends on, beside the network."""
        return {
            "pipeline": "echo", "context": str(self.context), "per_frame": str(self.per_frame), "spacing": str(self.spacing),
            "eta": str(self.eta), "step": self.step, "rewindow": str(self.rewindow), "hang": str(self.hang),
            "rest": str(self.rests_below), "placed": str(self.placed), "guidance": str(self.guided_by), "acts": "search" if callable(self.acts) else str(self.acts),
        }  # fmt: skip


def motion_of(lane: Lane, said: Said, hung: bool, provenance: dict[str, str]) -> Motion:
    """What was said of a lane as a motion, hung from the measured head or not; a body that is observed stays as it is."""
    path, contact = lane.path, said.contact_prob[0]
    motion = Motion(
        path.timestamps, path.skeleton, said.R_parent_joint[0], said.t_world_root[0], contact[:, BODY_POINTS:],
        body_contact_prob=contact[:, :BODY_POINTS] * lane.told.has_object[0, :, None],
        object_motion=object_tracks(lane, said) or None, provenance=provenance,
    )  # fmt: skip
    if not hung:
        return motion
    hanging, seen = hang_from_head(motion, path.T_world_head), lane.told.is_known[0, :, 0]
    R = torch.where(seen[:, None, None, None], motion.R_parent_joint, hanging.R_parent_joint)
    t = torch.where(seen[:, None], motion.t_world_root, hanging.t_world_root)
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


def object_tracks(lane: Lane, said: Said) -> dict[str, Trajectory]:
    """Each object's poses: as said while it is active, as it was last (before the first time: as it will be first) else."""
    active = torch.where(lane.told.has_object[0], lane.told.object_number[0], -1.0)
    T = Rigid(said.R_world_object[0], said.t_world_object[0])
    tracks = {}
    for number, shape in enumerate(lane.objects):
        rows = (active == number).nonzero()[:, 0]
        if not len(rows):
            continue
        last = torch.searchsorted(rows, torch.arange(len(active)), right=True).sub(1).clamp_min(0)
        pose = shape.of_mesh(T[rows[last]])
        tracks[shape.name] = Trajectory(lane.path.timestamps, pose.R, pose.t)
    return tracks


def stretch_seed(seed: int, start: int) -> int:
    """Of a stretch that begins at a frame: stretches of one recording have noise of their own."""
    return seed + 1_000_003 * start


def _padded(told: Told, start: int, stop: int, length: int) -> Told:
    """Frames start…stop-1, up to a length: the last one again, not valid."""
    take = (start + torch.arange(length)).clamp_max(stop - 1)
    there = torch.arange(length) < stop - start
    padded = told.frames(take)
    return padded._replace(valid=padded.valid & there, is_known=padded.is_known & there[:, None])


def _bridged(said: list[Said], path: HeadPath) -> Said:
    """Stretches as one; frames in the gaps between them are as the one before."""
    whole, held = Said(*(torch.cat(fields, 1) for fields in zip(*said))), path.held_frames
    return Said(*(field[:, held] for field in whole))
