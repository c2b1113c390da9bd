"""Baselines of ECHO: nearest-neighbour retrieval of training windows, and objects rigidly attached to a wrist."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from einops import rearrange
from jaxtyping import Float, Int64
from torch import Tensor

from wearcap.body.contact_points import BODY_POINTS
from wearcap.data.batch import Batch
from wearcap.data.draws import Draws
from wearcap.data.features import body_size
from wearcap.data.windows import MIN_SCALE, Windows
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.models.point_encoder import PointNeXt
from wearcap.recording import Motion
from wearcap.systems.echo.features import OBJECT_SIZE, EchoFeatures, ThreePoints
from wearcap.systems.echo.observations import BatchItem, ObjectReader, Scenario, batch_item_of
from wearcap.systems.echo.pipeline import motion_of, object_tracks
from wearcap.systems.echo.queue import Outputs
from wearcap.systems.echo.training_windows import EchoContent, EchoWindow
from wearcap.tracking.head_path import head_path

NO_CLASS = "none"
"""Class label of windows without an active object."""


def _own(features: EchoFeatures) -> EchoFeatures:
    return replace(features, frame="own", body=True)


def _channels(
    features: EchoFeatures, points: ThreePoints, floor_height: Tensor, size: Tensor
) -> Float[Tensor, "time channel"]:
    """Descriptor of each frame's three points in head-centred coordinates: the condition without the head's path and
    heading since the window's start, and without limb lengths."""
    condition = features.condition(ThreePoints(*(part[None] for part in points)), floor_height[None], size[None])[0]
    return torch.cat([condition[:, :36], condition[:, 39:54], condition[:, 56:57]], 1)


def whole_recording(dataset: Windows, number: int) -> EchoWindow:
    """A whole recording of a data set as one window, with the wearer's own body and nothing changed."""
    count, one = int(dataset.packed.length[number]), torch.tensor([number])
    parts = dataset.content.parts if dataset.bodies is not None else ()
    read = Batch(dataset.packed, Draws(one), one, 0 * one, count, dataset.fps).read()
    return dataset.content.batch(read.changed(**{name: read.values[name].sum(-2) for name in parts}))


def _category(features: EchoFeatures, track: EchoWindow, frame: int) -> str:
    """Class of the active object at a frame."""
    if not track.has_object[0, frame]:
        return NO_CLASS
    return features.classes[int(track.object_code[0, frame, : len(features.classes)].argmax())]


@dataclass(frozen=True, eq=False)
class NearestEcho:
    """Retrieves the training window with the most similar motion of head and wrists among those with the same object
    class, and copies its body, object and contacts in head-centred coordinates. Windows overlap by half and are
    cross-faded."""

    features: EchoFeatures
    encoder: PointNeXt | None
    window: int
    """Frames per window."""
    sample: int
    """Stride (frames) of the frames that describe a window."""
    mean: Float[Tensor, "channel"]
    scale: Float[Tensor, "channel"]
    descriptor: dict[str, Float[Tensor, "window feature"]]
    """Descriptors of the windows by class; `NO_CLASS` without an object."""
    frames: dict[str, Int64[Tensor, "window"]]
    """Index in `outputs` of each window's first frame, by class."""
    outputs: Float[Tensor, "frame value"]
    """Ground truth of all training frames."""

    @classmethod
    def fit(cls, dataset: Windows, window: int = 30, stride: int = 3, sample: int = 3) -> "NearestEcho":
        """Compute descriptors of a training split's windows."""
        assert isinstance(dataset.content, EchoContent)
        features, encoder = _own(dataset.content.features), dataset.content.encoder
        channels, outputs, starts, labels, first = [], [], [], [], 0
        for number in range(len(dataset.recordings)):
            track = whole_recording(dataset, number)
            count = track.floor_height.shape[1]
            points = ThreePoints(*(part[0] for part in track.points))
            channels.append(_channels(features, points, track.floor_height[0], track.size[0]))
            # Ground truth in each frame's head-centred coordinates.
            frame = features.canonical(track.points)
            T = features.encode_object(track.T_world_object, frame)
            outputs.append(torch.cat([features.encode_body(track.body, frame), T, track.contact], -1)[0])
            for start in range(0, count - window + 1, stride):
                starts.append(first + start)
                labels.append(_category(features, track, start + window // 2))
            first += count
        whole = torch.cat(channels)
        mean, scale = whole.mean(0), whole.std(0).clamp_min(MIN_SCALE)
        whole = (whole - mean) / scale
        offsets = torch.arange(0, window, sample)
        descriptor, frames = {}, {}
        for name in sorted(set(labels)):
            mine = torch.tensor([start for start, label in zip(starts, labels) if label == name])
            samples = whole[mine[:, None] + offsets]
            descriptor[name] = rearrange(samples, "window frame channel -> window (frame channel)")
            frames[name] = mine
        return cls(features, encoder, window, sample, mean, scale, descriptor, frames, torch.cat(outputs))

    def capture_scenarios(self, scenarios: Sequence[Scenario], seeds: Sequence[int]) -> list[Motion]:
        """One motion per scenario; deterministic, seeds are ignored."""
        reader, fps = ObjectReader(self.features, self.encoder), self.features.fps
        paths = [head_path(scenario.recording, scenario.recording.skeleton, fps) for scenario in scenarios]
        offsets, motions = torch.arange(self.window), []
        triangle = torch.minimum(offsets + 1, self.window - offsets).float()[:, None] / self.window
        for item in (batch_item_of(scenario, path, reader) for scenario, path in zip(scenarios, paths)):
            conditioning, count = item.conditioning, len(item.path.timestamps)
            points = ThreePoints(*(part[0] for part in conditioning.points))
            size = body_size(item.path.skeleton)
            channels = (_channels(self.features, points, conditioning.floor_height[0], size) - self.mean) / self.scale
            total, weight = torch.zeros(count, self.outputs.shape[1]), torch.zeros(count, 1)
            for start in [*range(0, max(count - self.window, 0), self.window // 2), max(count - self.window, 0)]:
                take = (start + offsets).clamp_max(count - 1)
                active = int(conditioning.object_number[0, take[self.window // 2]])
                name = item.objects[active].category if active >= 0 else NO_CLASS
                name = name if name in self.descriptor else NO_CLASS
                query = rearrange(channels[take[:: self.sample]], "frame channel -> (frame channel)")
                best = (self.descriptor[name] - query).square().sum(1).argmin()
                retrieved = self.outputs[self.frames[name][best] + offsets]
                total.index_add_(0, take, retrieved * triangle)
                weight.index_add_(0, take, triangle)
            outputs = _decoded(self.features, total / weight, item)
            motions.append(motion_of(item, outputs, True, {"pipeline": "nearest_echo"}))
        return motions


def _decoded(features: EchoFeatures, outputs: Float[Tensor, "time feature"], item: BatchItem) -> Outputs:
    frame = features.canonical(item.conditioning.points)
    sizes = features.human_size, OBJECT_SIZE, outputs.shape[1] - features.human_size - OBJECT_SIZE
    human, scene_object, contact = outputs[None].split(sizes, -1)
    body, T = features.decode_body(human, frame), features.decode_object(scene_object, frame)
    return Outputs(*body, T.R, T.t, contact)


@dataclass(frozen=True, eq=False)
class RigidWrist:
    """Another method's body with the object rigidly attached to a wrist, at its class's mean offset from that wrist
    in training frames with contact. The wrist is the one that is closer, on average over the object's active frames,
    to the class's mean position relative to the head."""

    features: EchoFeatures
    encoder: PointNeXt | None
    place: dict[str, Float[Tensor, "3"]]
    """Mean position of each class in head-centred, yaw-aligned coordinates (m)."""
    offset: dict[str, Float[Tensor, "wrist 3"]]
    """Mean displacement between each wrist and the object, in yaw-aligned head axes (m)."""
    turn: dict[str, Float[Tensor, "3 3"]]
    """Mean orientation of each class in yaw-aligned head axes."""

    @classmethod
    def fit(cls, dataset: Windows) -> "RigidWrist":
        """Compute the means over a training split."""
        assert isinstance(dataset.content, EchoContent)
        features, encoder = _own(dataset.content.features), dataset.content.encoder
        rows: dict[str, list[tuple[Tensor, Tensor, Tensor]]] = {}
        for number in range(len(dataset.recordings)):
            track = whole_recording(dataset, number)
            frame = features.canonical(track.points)
            heading, handled = frame.R[0], track.has_object[0] & (track.contact[0, :, :BODY_POINTS].amax(1) > 0)
            kinds = track.object_code[0, :, : len(features.classes)].argmax(1)
            for kind in kinds[handled].unique().tolist():
                touched = handled & (kinds == kind)
                T, wrists = track.T_world_object[0, touched], track.t_world_point[0, touched, 1:]
                back = heading[touched].mT
                place = (back @ (T.t - frame.t[0][touched])[..., None])[..., 0]
                offset = (back[:, None] @ (T.t[:, None] - wrists)[..., None])[..., 0]
                rows.setdefault(features.classes[kind], []).append((place, offset, back @ T.R))
        place, offset, turn = {}, {}, {}
        for name, parts in rows.items():
            places, offsets, R = (torch.cat(each) for each in zip(*parts))
            if len(places):
                place[name], offset[name] = places.mean(0), offsets.mean(0)
                turn[name] = rotation.mean_rotation(R)
        if not place:
            what = "these training recordings have no contact with objects"
            raise WearcapError(what, expected="recordings with objects in hands")
        return cls(features, encoder, place, offset, turn)

    def attached(self, motion: Motion, item: BatchItem) -> Motion:
        """The motion with its objects attached to wrists."""
        points = item.conditioning.points
        frame = self.features.canonical(points)
        heading, head = frame.R[0], frame.t[0]
        count = len(head)
        R, t = heading.clone(), head.clone()
        for number, shape in enumerate(item.objects):
            rows = (item.conditioning.object_number[0] == number) & item.conditioning.has_object[0]
            name = shape.category if shape.category in self.place else next(iter(self.place))
            wrists = points.t_world_point[0, rows, 1:]
            expected = head[rows] + (heading[rows] @ self.place[name])
            wrist = int((wrists - expected[:, None]).norm(dim=-1).mean(0).argmin()) if rows.any() else 0
            t[rows] = wrists[:, wrist] + heading[rows] @ self.offset[name][wrist]
            R[rows] = heading[rows] @ self.turn[name]
        body = torch.zeros(1, count, 1, 3, 3), torch.zeros(1, count, 3)
        outputs = Outputs(*body, R[None], t[None], torch.zeros(1, count, 1))
        return replace(motion, object_motion=object_tracks(item, outputs), provenance={"pipeline": "rigid_wrist"})
