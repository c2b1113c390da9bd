"""ECHO (Petrov et al.): human, object and contacts from head and wrists, with one diffusion model, at any length."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from scipy.spatial import KDTree

from wearcap.body.anny_body import anny_body
from wearcap.body.contact_points import BODY_POINTS, contact_points
from wearcap.body.skeleton import Skeleton
from wearcap.diffusion.conveyor import Correct, Denoise, RollingSchedule
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.environment import read_environment
from wearcap.metrics.table import Row
from wearcap.recording import Motion, Recording
from wearcap.recording.active_objects import ActiveSpan, true_spans
from wearcap.runtime.graphs import chosen
from wearcap.runtime.needs import HEAD, HEIGHT, TRACKED_WRISTS
from wearcap.runtime.system import CaptureInput, LearnedSystem
from wearcap.runtime.windows import batched
from wearcap.scene.objects import Environment
from wearcap.systems.echo.contacts import ContactUse, GuidedScene, with_static_objects
from wearcap.systems.echo.model import EchoRunner
from wearcap.systems.echo.observations import BatchItem, ObjectReader, ObjectShape, Scenario, batch_item_of
from wearcap.systems.echo.queue import Conditioning, EchoModel, EchoQueue, Guided, Outputs
from wearcap.systems.echo.scores import Truth, score_echo, truth_of
from wearcap.systems.echo.windows import AveragedWindows, Rewindow
from wearcap.systems.echo.wrists import Reaching, reaches
from wearcap.tracking.anchor import anchored_to_head
from wearcap.tracking.head_path import head_path
from wearcap.tracking.refinement import Measured, Refinement, refined_over


@dataclass(frozen=True)
class Sampling:
    """How frames are denoised; see `diffusion.conveyor.RollingSchedule`."""

    context: int = 4
    """Clean frames kept before the ramp: a pose is final once window - context - 1 more frames have arrived."""
    per_frame: int = 2
    """Denoising steps per new frame; with a window of 60 and a context of 4 a frame takes 112 in all (ECHO: 100)."""
    spacing: float = 2.0
    eta: float = 0.0
    step: str = "posterior"
    lead: float = 0.0
    """Share by which the contacts' ramp of levels is shorter: they are denoised before body and object (ours)."""
    observed_length_scale: float | None = 8.0
    """Length scale (frames) of the Gaussian process by which an observed frame's residual of x̂0 reaches its neighbours (ours); None: not at all."""
    wrists: float | None = 0.3
    """Share of its distance from the tracked wrists by which x̂0 approaches them in every step (ours); None: not at all
    (ECHO)."""
    rewindow: int | None = None
    """Frames by which overlapping windows advance that are each denoised from scratch; None: a conveyor (ECHO)."""
    rewindow_steps: int | None = None
    """Denoising steps of such a window: 1 leads to the mean of the plausible motions; None: as many as a frame takes on
    the conveyor."""
    average: bool = False
    """Whether what these windows predict for a frame is averaged (ours; they then advance by no more than half of the window
    less the context, so that two at least predict each frame), or their overlap is inpainted (ECHO Fig. 3)."""
    mirror_average: bool = False
    """Mirror test-time augmentation of averaged windows: the prediction for the mirrored window is averaged in (ours)."""


MAX_ENVIRONMENTS = 16
"""Most environments that a pipeline keeps in memory."""


@dataclass
class Echo(LearnedSystem):
    """Captures recordings in averaged windows (ours), or with a rolling schedule over frames (the conveyor, ECHO §3.3);
    batching does not change results."""

    model: EchoModel
    sampling: Sampling = Sampling()
    contacts: ContactUse = field(default_factory=ContactUse)
    anchor: bool = True
    """Whether the body is anchored to the measured head (ours) or keeps its sampled position (ECHO)."""
    refinement: Refinement | None = None
    """How sampled motion is refined (ours); None: it stays as sampled."""
    active_objects: str | Sequence[Mapping[str, Any]] | Callable[[Motion, Environment], tuple[ActiveSpan, ...]] = (
        "truth"
    )
    """Which object is active when: "truth", the recording's interactions; "none": the human alone; a list of
    {object, start_s, stop_s}; or a search."""
    environment: str | None = None
    """File of the objects; None: the recording's own."""
    placed: bool = False
    """Whether the objects' initial poses in the environment count as observed (ours; ECHO has no initial poses)."""
    freedoms: bool = True
    """Whether objects keep to the freedom that the environment gives them: hinges, axes, the floor (ours); ECHO knows none."""
    runtime: str = "eager"
    """Backend of the denoising steps (`runtime.graphs.RUNTIMES`)."""
    precision: str = "float32"
    """Number format of the steps' matrix products (`runtime.graphs.PRECISIONS`)."""
    device: str = "cpu"

    name = "echo"
    pipeline = "echo"
    sampled = "ablation/echo_conveyor"
    experiment = "experiment=echo"
    shared = ("echo",)
    required = (HEAD, TRACKED_WRISTS, HEIGHT)
    baselines = ()

    def __post_init__(self):
        if isinstance(self.active_objects, str) and self.active_objects not in ("truth", "none"):
            expected = "truth, none, or a list of {object, start_s, stop_s}"
            raise WearcapError(f"unknown active_objects {self.active_objects!r}", expected=expected)
        ramp, _ = self.rolling.ramp, self._listed_spans()
        rewindow = self.sampling.rewindow
        if rewindow is not None and not (rewindow > 0 and (self.sampling.average or rewindow <= ramp)):
            what = f"windows that advance by {rewindow} frames"
            raise WearcapError(what, expected=f"1 to {ramp}, the window less the context")
        if self.sampling.rewindow_steps is not None and (rewindow is None or self.sampling.rewindow_steps < 1):
            what = f"rewindow_steps={self.sampling.rewindow_steps} with rewindow={rewindow}"
            fix = "On a conveyor, say rewindow_steps=null, too."
            raise WearcapError(what, expected="at least one step, of windows (rewindow=FRAMES)", fix=fix)
        for name, value, usual in (("step", self.sampling.step, "posterior"), ("lead", self.sampling.lead, 0.0)):
            if rewindow is not None and value != usual:
                what = f"{name}={value} with windows that are denoised from scratch"
                expected = f"{name}={usual}, or a conveyor: rewindow=null, rewindow_steps=null"
                raise WearcapError(what, expected=expected)
        chosen(self.runtime, self.precision, self.device)
        self._runner: EchoRunner | None = None
        self._environments: dict[Path, Environment] = {}
        self._reader: ObjectReader | None = None

    @property
    def rolling(self) -> RollingSchedule:
        """The conveyor's rolling schedule."""
        how = self.sampling
        lead = (0.0, 0.0, how.lead) if how.lead else ()
        return RollingSchedule(self.model.net.window, how.context, how.per_frame, how.spacing, how.eta, how.step, lead)

    @property
    def stride(self) -> int | None:
        """Frames by which windows advance; None on a conveyor."""
        if self.sampling.rewindow is None or not self.sampling.average:
            return self.sampling.rewindow
        return min(self.sampling.rewindow, max(1, self.rolling.ramp // 2))

    @property
    def fps(self) -> float:
        """Frame rate of captures (Hz)."""
        return self.model.features.fps

    @property
    def latency_s(self) -> float:
        """Time between a frame and its final pose (s)."""
        return (self.rolling.ramp - 1 + (0 if self.refinement is None else self.refinement.lookahead)) / self.fps

    @property
    def contact_use(self) -> ContactUse:
        """`contacts`, or none of it for a network without contacts."""
        return self.contacts if self.model.contacts else ContactUse(None, None)

    def prepare(self) -> None:
        """Move the network to its device and set up its runtime; exporting or compiling happens once."""
        net = self.model.net.to(self.device).eval()
        if self._runner is None or self.runtime == "eager":
            self._runner = EchoRunner(net, self.runtime, self.precision)

    def reader(self) -> ObjectReader:
        """A reader that turns objects into embedded conditions for the network, each once."""
        self.prepare()
        model = self.model
        embed = lambda codes: model.net.object(codes.to(self.device)).cpu()  # noqa: E731
        return ObjectReader(model.features, model.encoder, embed, self.freedoms)

    def motions(self, sources: Sequence[CaptureInput], seeds: Sequence[int]) -> list[Motion]:
        """One motion per recording and seed, with the objects of the recordings' environments.

        Raises WearcapError as `objects` and `capture_scenarios` do.
        """
        once = {id(source): self.scenario(source.recording, self.objects(source)) for source in sources}
        return self.capture_scenarios([once[id(source)] for source in sources], seeds)

    def objects(self, source: CaptureInput) -> Environment | None:
        """The objects of a recording; the last few files are kept. Raises WearcapError for a file that cannot be read."""
        path = source.environment_file(self.environment)
        if path is not None and path not in self._environments:
            if len(self._environments) >= MAX_ENVIRONMENTS:
                # The reader knows shapes by their meshes, which go with the environments.
                self._environments, self._reader = {}, None
            self._environments[path] = read_environment(path)
        return None if path is None else self._environments[path]

    def truth(self, motion: Motion, source: CaptureInput) -> Truth:
        """The ground truth at a capture's frames, whichever active objects the capture was conditioned on."""
        environment, recording = self.objects(source), source.recording
        self._reader = self._reader or self.reader()
        has_objects = environment is not None and bool(recording.object_motion)
        spans = tuple(true_spans(recording)) if has_objects else ()
        return truth_of(Scenario(recording, environment, spans), motion.timestamps, self._reader)

    def score(self, motion: Motion, source: CaptureInput, seed: int) -> Row:
        """ECHO's metrics of one capture (ECHO §4.1)."""
        return score_echo(motion, self.truth(motion, source), source.recording.name, seed)

    def _listed_spans(self) -> tuple[ActiveSpan, ...]:
        if isinstance(self.active_objects, str) or callable(self.active_objects):
            return ()
        try:
            return tuple(sorted((ActiveSpan(**row) for row in self.active_objects), key=lambda span: span.start_s))
        except TypeError as error:
            raise WearcapError(
                f"active_objects {self.active_objects!r}", expected="a list of {object, start_s, stop_s}"
            ) from error

    def scenario(self, recording: Recording, environment: Environment | None) -> Scenario:
        """A recording with its active objects, according to `active_objects`.

        Without an environment, or without interactions and object poses, the human alone is captured, unless `active_objects`
        is a list.
        """
        if self.active_objects == "truth":
            tracked = bool(recording.object_motion) or recording.interactions is not None
            has_objects = environment is not None and tracked
            spans = tuple(true_spans(recording)) if has_objects else ()
            return Scenario(recording, environment, spans, placed=self.placed)
        if callable(self.active_objects) and environment is not None:
            alone = self.capture_scenarios([Scenario(recording)], [0])[0]
            return Scenario(recording, environment, self.active_objects(alone, environment), placed=self.placed)
        return Scenario(recording, environment, self._listed_spans(), placed=self.placed)

    @torch.no_grad()
    def capture_scenarios(self, scenarios: Sequence[Scenario], seeds: Sequence[int]) -> list[Motion]:
        """One motion per (scenario, seed), with `object_motion` and `body_contact_prob` where objects are active.

        Raises WearcapError as `head_path` and `batch_item_of` do.
        """
        self.prepare()
        # 1. Conditioning: three tracked points at the model's rate and codes of the active objects, once for all seeds.
        reader, once = self.reader(), {id(scenario): scenario for scenario in scenarios}
        item_by = {
            key: batch_item_of(scenario, head_path(scenario.recording, self.model.skeleton, self.fps), reader)
            for key, scenario in once.items()
        }
        items = [item_by[id(scenario)] for scenario in scenarios]
        # 2. Denoising: overlapping windows, whose predictions are averaged, or the rolling schedule, on which frames enter
        # as noise one by one and leave clean. All stretches are denoised side by side.
        parts = [(k, *stretch) for k, item in enumerate(items) for stretch in item.path.stretches]
        queue = self.queue(
            [items[k].path.skeleton for k, *_ in parts],
            [stretch_seed(seeds[k], start) for k, start, _ in parts],
            [scenarios[k].recording.shape for k, *_ in parts],
            [items[k].objects for k, *_ in parts],
        )
        lengths = torch.tensor([stop - start for _, start, stop in parts])
        stretches = [items[k].conditioning.frames(slice(start, stop)) for k, start, stop in parts]
        whole = batched(stretches, int(lengths.max()))
        # The last frame repeated as not valid pads a stretch.
        inside = torch.arange(whole.valid.shape[1]) < lengths[:, None]
        whole = whole._replace(valid=whole.valid & inside, is_observed=whole.is_observed & inside[..., None])
        together = queue.run(whole)
        found: list[list[Outputs]] = [[] for _ in items]
        for row, (k, start, stop) in enumerate(parts):
            found[k].append(Outputs(*(field[row : row + 1, : stop - start] for field in together)))
        # Gaps between stretches repeat the frame before them.
        outputs = [
            Outputs(*(torch.cat(fields, 1)[:, item.path.held_frames] for fields in zip(*stretches)))
            for stretches, item in zip(found, items)
        ]
        # 3. Untouched objects are made static, and the body is anchored to the measured head.
        if (threshold := self.contact_use.static_threshold) is not None:
            outputs = [with_static_objects(item.conditioning, part, threshold) for item, part in zip(items, outputs)]
        settings, contacts = self.settings(), self.model.contacts
        motions = [motion_of(item, part, self.anchor, settings, contacts) for item, part in zip(items, outputs)]
        # 4. It is smoothed, its feet are held, and its arms reach the tracked wrists.
        return [
            refined_over(self.refinement, motion, measured_of(item), item.path, self.fps, self.anchor)
            for motion, item in zip(motions, items)
        ]

    def queue(
        self,
        skeletons: Sequence[Skeleton],
        seeds: Sequence[int],
        shapes: Sequence[dict[str, float]],
        objects: Sequence[Sequence[ObjectShape]],
    ) -> EchoQueue:
        """An empty queue for a batch, with the bodies and objects that guidance needs, if any."""
        kind = AveragedWindows if self.sampling.average else Rewindow
        queue = (EchoQueue if self.stride is None else kind)(self, skeletons, seeds)
        if self.contact_use.guidance is not None:
            queue.guide(pulled_by(skeletons, shapes, objects))
        return queue

    def denoiser(self, queue: EchoQueue, conditioning: Conditioning, frame: Rigid) -> tuple[Denoise, list[Correct]]:
        """x̂0 of a window's frames as a function of x_t and levels, and what corrects it: tracked wrists, guidance.

        The condition is encoded once per call; the level-dependent part is cached between calls.
        """
        condition = self.model.features.condition(conditioning.points, conditioning.floor_height, queue.size, frame)
        if self._runner is None:
            self.prepare()
        assert self._runner is not None
        denoise = self._runner.begin(condition, conditioning.object_code, conditioning.has_object, conditioning.valid)
        guidance, model = self.contact_use.guidance, self.model
        corrections: list[Correct] = []
        if (share := self.sampling.wrists) is not None and reaches(model.features):
            reaching = Reaching(model.net, model.features, model.skeleton, queue.t_parent_joint, conditioning, frame)
            corrections.append(lambda x0_hat: reaching.corrected(x0_hat, share))
        if guidance is not None and queue.guided is not None:
            surfaces, objects = queue.guided
            scene = GuidedScene(model.net, model.features, conditioning, frame, surfaces, objects)
            corrections.append(lambda x0_hat: guidance.corrected(x0_hat, scene))
        return denoise, corrections

    def settings(self) -> dict[str, str]:
        """Settings that a capture depends on, for its provenance."""
        spans, use = "search" if callable(self.active_objects) else self.active_objects, self.contact_use
        own = {
            "rewindow": self.stride,
            "anchor": self.anchor,
            "refinement": self.refinement,
            "static_threshold": use.static_threshold,
            "placed": self.placed,
            "freedoms": self.freedoms,
        }
        settings = {**vars(self.sampling), **own, "guidance": use.guidance, "active_objects": spans}
        return {"pipeline": "echo"} | {name: str(value) for name, value in settings.items()}


def motion_of(
    item: BatchItem, outputs: Outputs, anchor: bool, provenance: dict[str, str], contacts: bool = True
) -> Motion:
    """Outputs of one batch item as a motion, if `anchor` anchored to the measured head except in observed frames; without
    touch of the object where `contacts` were not predicted."""
    path, contact = item.path, outputs.contact_prob[0]
    motion = Motion(
        path.timestamps,
        path.skeleton,
        outputs.R_parent_joint[0],
        outputs.t_world_root[0],
        contact[:, BODY_POINTS:],
        body_contact_prob=contact[:, :BODY_POINTS] * item.conditioning.has_object[0, :, None] if contacts else None,
        object_motion=object_tracks(item, outputs) or None,
        provenance=provenance,
    )
    if not anchor:
        return motion
    anchored = anchored_to_head(motion, path.T_world_head)
    is_observed = item.conditioning.is_observed[0, :, 0]
    R = torch.where(is_observed[:, None, None, None], motion.R_parent_joint, anchored.R_parent_joint)
    t = torch.where(is_observed[:, None], motion.t_world_root, anchored.t_world_root)
    return replace(motion, R_parent_joint=R, t_world_root=t)


def measured_of(item: BatchItem) -> Measured:
    """What one batch item's refinement knows: head, floor, tracked wrists, and frames whose body is observed."""
    conditioning = item.conditioning
    wrists = Rigid(conditioning.R_world_point[0, :, 1:], conditioning.t_world_point[0, :, 1:])
    seen = conditioning.seen[0, :, 1:]
    measured = Measured.of(item.path.T_world_head, conditioning.floor_height[0], wrists, seen)
    return measured._replace(given=conditioning.is_observed[0, :, 0])


def pulled_by(
    skeletons: Sequence[Skeleton], shapes: Sequence[dict[str, float]], objects: Sequence[Sequence[ObjectShape]]
) -> Guided:
    """Inputs of guidance per batch item: contact points of the body, and KD-trees over the points of its objects."""
    surfaces = [contact_points(anny_body(skeleton, shape or None)) for skeleton, shape in zip(skeletons, shapes)]
    return surfaces, [[KDTree(shape.cloud.numpy()) for shape in mine] for mine in objects]


def object_tracks(item: BatchItem, outputs: Outputs) -> dict[str, Trajectory]:
    """Poses of each object: as predicted while it is active, else constant since its last active frame (before the
    first: as in the first)."""
    active = torch.where(item.conditioning.has_object[0], item.conditioning.object_number[0], -1.0)
    T = Rigid(outputs.R_world_object[0], outputs.t_world_object[0])
    tracks = {}
    for number, shape in enumerate(item.objects):
        rows = (active == number).nonzero()[:, 0]
        if not len(rows):
            continue
        last = torch.searchsorted(rows, torch.arange(len(active)), right=True).sub(1).clamp_min(0)
        pose, found = shape.reachable(T), item.conditioning.is_observed[0, :, 1]
        pose = Rigid(torch.where(found[:, None, None], T.R, pose.R), torch.where(found[:, None], T.t, pose.t))
        pose = shape.of_mesh(pose[rows[last]])
        tracks[shape.name] = Trajectory(item.path.timestamps, pose.R, pose.t)
    return tracks


def stretch_seed(seed: int, start: int) -> int:
    """Seed of the stretch that begins at frame `start`: every stretch of a recording has its own noise."""
    return seed + 1_000_003 * start
