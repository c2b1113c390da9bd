"""Streaming captures: samples go in as devices send them, final poses come out, and a session is saved as a file.

A saved session holds plain values and tensors of a closed table of classes, no code, and a checksum of its content.
Attributes that a class names in `transient` are not written; its method `restored` makes them anew. What a capture
shares with its system is written as a reference.
"""

import dataclasses
import json
import math
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import save
from torch import Tensor

from wearcap.boundary.tensors import read_tensors
from wearcap.boundary.texts import parse_json
from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion
from wearcap.runtime.stages import digest
from wearcap.runtime.system import CaptureInput
from wearcap.runtime.wearer import Wearer
from wearcap.sensors.packets import Admitted, HeadInput, WristInput
from wearcap.sensors.samples import ActiveObject, ObjectSample
from wearcap.tracking.head_path import Chunk, HeadTrack

_KEY, _SETTINGS, _DIGEST = "wearcap_state", "settings", "sha256"
_DAMAGE = (KeyError, IndexError, TypeError, ValueError, AttributeError, RuntimeError, OverflowError, RecursionError)
"""Exceptions that restoring a damaged state may raise."""


class Session(ABC):
    """A streaming capture of one or several wearers with one system; every wearer has their own clock.

    Implausible samples (`sensors.packets`) are refused and counted, and never affect other wearers. A session can be
    saved at any time and goes on as if nothing had happened.
    """

    classes: ClassVar[Mapping[str, type]]
    """Classes of a saved session's state."""
    stream_class: ClassVar[type]
    """Class of the streams of single wearers."""
    devices: ClassVar[tuple[str, ...]] = ("head",)
    """Devices of a wearer without which there is no motion: "head", joints of wrists, "suit", "camera"."""
    tracks_wrists: ClassVar[bool] = False
    """Whether wrists come as tracked poses; otherwise as orientation and acceleration of watches."""
    given_floor: ClassVar[bool] = False
    """Whether a capture of a whole recording takes the floor that it has, as a stream then takes its wearer's `floor_m`."""
    takes_objects: ClassVar[bool] = False
    """Whether samples of objects, and of which one is active, are taken."""

    def __init__(self, system: Any, streams: Sequence[Any]):
        """`streams`: one for each wearer, with the properties `dropped` and `refused`, `take(sample)` for one sample, and
        `poses(ended)` for the frames that became final since the last call, or None. Raises WearcapError without any.
        """
        if not streams:
            raise WearcapError("a session without wearers", expected="one wearer or more")
        self.system, self.streams = system, list(streams)

    @classmethod
    def of_wearers(
        cls, system: Any, wearers: Sequence[Wearer], seed: int = 0, source: CaptureInput | None = None
    ) -> "Session":
        """The session of some wearers, each with a seed from `seed` on; `source`: recording, scan and objects that belong
        to the place, for systems that use them. Raises WearcapError as the system's own constructor does."""
        return cls(system, wearers)

    @classmethod
    def of_objects(cls, system: Any, source: CaptureInput) -> list[ActiveObject | ObjectSample]:
        """The samples of objects, in order of time, that a capture of a whole recording corresponds to.

        Raises WearcapError as that capture does.
        """
        return []

    @property
    def fps(self) -> float:
        """Frame rate of the poses (Hz)."""
        return self.system.fps

    @property
    def dropped(self) -> list[int]:
        """Number of each wearer's head poses that were late, duplicated or refused."""
        return [stream.dropped for stream in self.streams]

    @property
    def refused(self) -> list[dict[str, int]]:
        """Number of each wearer's refused samples, or parts of samples, by reason ("head: not a rotation")."""
        return [stream.refused for stream in self.streams]

    def push(self, samples: Sequence[Sequence[Any]]) -> None:
        """Take in each wearer's new samples (`sensors.samples`), any number of them.

        Raises WearcapError for samples of another number of wearers.
        """
        if len(samples) != len(self.streams):
            expected = f"of {len(self.streams)}, as the session has"
            raise WearcapError(f"samples of {len(samples)} wearers", expected=expected)
        for stream, part in zip(self.streams, samples):
            for sample in part:
                stream.take(sample)

    def poses(self, ended: bool = False) -> list[Motion | None]:
        """Each wearer's frames that became final since the last call; `ended`: no more samples will come.

        After a wearer's clock was set back, the frames before that come first, and the next call returns those after
        it.
        """
        return [stream.poses(ended) for stream in self.streams]

    @classmethod
    @abstractmethod
    def settings(cls, system: Any) -> dict[str, Any]:
        """The settings of a system that a session's state depends on."""

    @classmethod
    def shared(cls, system: Any) -> dict[str, Any]:
        """Parts of the system that a session's state refers to, by name."""
        return {"system": system}

    def state(self) -> dict[str, Any]:
        """Everything that future poses depend on, except the system."""
        return {"streams": self.streams}

    def save(self, path: str | Path) -> None:
        """Write the session (.safetensors)."""
        write_state(path, self.state(), self.settings(self.system), self.classes, **self.shared(self.system))

    @classmethod
    def load(cls, path: str | Path, system: Any) -> "Session":
        """Restore a saved session with the system that it ran with.

        Raises WearcapError for a file that is no session or is damaged, and for a system with other settings.
        """
        getattr(system, "prepare", lambda: None)()
        state = read_state(path, cls.settings(system), cls.classes, **cls.shared(system))
        session = object.__new__(cls)
        session.system = system
        streams = state.get("streams") if isinstance(state, dict) else None
        if not (isinstance(streams, list) and streams and all(isinstance(part, cls.stream_class) for part in streams)):
            raise WearcapError("not a saved session", where=path, expected=f"one of {cls.__name__}.save")
        for name, part in state.items():
            setattr(session, name, part)
        return session


class HeadAndWristsStream(ABC):
    """The streaming capture of one wearer with a head device and sensors on both wrists, on one clock.

    Invalid packets (`sensors.packets`) are counted as `refused`. If the head device's clock is set back for good, the
    capture restarts like a new session.
    """

    def __init__(self, pipeline: Any, fps: float, stride: int):
        """`fps`: frame rate of the poses (Hz); `stride`: frames of a chunk of the head's path."""
        pipeline.prepare()
        self.pipeline = pipeline
        self.silent = 0
        """Number of frames without samples of a wrist, counted per wrist."""
        self._head_input, self._track = HeadInput(), HeadTrack(fps, stride)
        self._wrists = WristInput(self._head_input)
        self._finished: list[Motion] = []
        """Final motions with times of a previous clock, not returned yet."""

    @property
    def dropped(self) -> int:
        """Number of head poses that were late, duplicated or refused."""
        return self._track.dropped + self._head_input.dropped

    @property
    def refused(self) -> dict[str, int]:
        """Number of refused samples, or parts of samples, by reason ("head: not a rotation")."""
        return dict(self._head_input.refused)

    @abstractmethod
    def take(self, sample: Any) -> None:
        """Take in one sample (`sensors.samples`)."""

    def head(
        self, timestamp: float, T_world_device: Rigid | None, points_world: Float[Tensor, "point 3"] | None = None
    ) -> None:
        """Take in one time step (s) of the head device: its pose (None while tracking is lost) and new points (m)."""
        if self._head_input.timely(timestamp):
            packet = self._head_input.pose(T_world_device), self._head_input.points(points_world)
            self._take(self._head_input.admit(float(timestamp), packet))

    def _take(self, admitted: Admitted) -> None:
        if admitted.begins:
            if admitted.again and (motion := self._final(ended=True)) is not None:
                self._finished.append(motion)
            self._restart(admitted.again)
            self._wrists.rejoin(None if admitted.again else admitted.packets[0][0])
        for time, (pose, _) in admitted.packets:
            self._track.take(time, pose)

    def _restart(self, again: bool = False) -> None:
        """Restart the capture, with `again` on another clock; wrist samples and counters are kept."""
        dropped = self._track.dropped
        self._track = HeadTrack(self._track.fps, self._track.stride)
        self._track.dropped = dropped
        self._chunks: list[Chunk] = []

    def poses(self, ended: bool = False) -> Motion | None:
        """Frames that became final since the last call, or None; `ended`: no more samples will come.

        After the head device's clock was set back, the frames before come first; call again for the new clock's.
        """
        if ended:
            for time, (pose, _) in self._head_input.end():
                self._track.take(time, pose)
        return self._finished.pop(0) if self._finished else self._final(ended)

    @abstractmethod
    def _final(self, ended: bool) -> Motion | None:
        """Frames on the present clock that became final, or None."""


def classes_of(*modules: ModuleType) -> dict[str, type]:
    """The classes that modules define, by their names with module."""
    found = [part for module in modules for part in vars(module).values() if isinstance(part, type)]
    names = {module.__name__ for module in modules}
    return {_name(part): part for part in found if part.__module__ in names}


def write_state(path: str | Path, state: Any, settings: Mapping[str, Any], classes: Mapping[str, type], **shared: Any):
    """Write a state (.safetensors): None, numbers, text, tensors, containers, and objects of `classes`.

    `settings`: those of the system that the state depends on. `shared`: objects of the system by name, written as
    references. Raises TypeError for a value of another kind.
    """
    writer = _Writer(classes, {id(part): name for name, part in shared.items()})
    tree = {"state": writer.encoded(state), "objects": writer.objects}
    tensors = {name: value.detach().cpu().contiguous().clone() for name, value in writer.tensors.items()}
    text = json.dumps(tree)
    about = {_KEY: text, _SETTINGS: json.dumps(dict(settings)), _DIGEST: digest(text, tensors)}
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(tensors, about))


def read_state(path: str | Path, settings: Mapping[str, Any], classes: Mapping[str, type], **shared: Any) -> Any:
    """The state of a file that `write_state` wrote.

    Raises WearcapError for a file that is no state or is damaged, and for one of a system with other settings.
    """
    try:
        about, tensors = read_tensors(path, "saved session")
        theirs = parse_json(about[_SETTINGS], path)
        if digest(about[_KEY], tensors) != about[_DIGEST]:
            raise ValueError("another checksum")
        ours = json.loads(json.dumps(dict(settings)))
        if (wrong := next((name for name in {**theirs, **ours} if theirs.get(name) != ours.get(name)), None)) is None:
            tree = parse_json(about[_KEY], path)
            return _Reader(classes, shared, tree["objects"], tensors).decoded(tree["state"])
    except (WearcapError, *_DAMAGE) as error:
        expected = "a whole .safetensors file of Session.save"
        raise WearcapError("not a saved session", where=path, expected=expected) from error
    what = f"a session with {wrong} {theirs.get(wrong)}, not {ours.get(wrong)}"
    raise WearcapError(what, where=path, fix="Load it with the pipeline it ran with.")


def _name(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


class _Writer:
    """Turns values into JSON: [kind, content], with tensors and objects by number."""

    def __init__(self, classes: Mapping[str, type], shared: Mapping[int, str]):
        self.classes, self.shared = classes, shared
        self.tensors: dict[str, Tensor] = {}
        self.objects: list[Any] = []
        self._number: dict[int, int] = {}
        self._alive: list[Any] = []

    def encoded(self, value: Any) -> Any:
        """One value. Raises TypeError for one of another kind."""
        if value is None or isinstance(value, bool | int | str):
            return value
        if isinstance(value, float):
            return value if math.isfinite(value) else ["float", str(value)]
        if id(value) in self.shared:
            return ["shared", self.shared[id(value)]]
        if isinstance(value, Tensor):
            return self._tensor("tensor", value)
        if isinstance(value, np.ndarray):
            return self._tensor("array", torch.from_numpy(np.ascontiguousarray(value)))
        if isinstance(value, torch.Generator):
            return self._tensor("generator", value.get_state())
        kind = type(value)
        if kind in (list, tuple):
            return [kind.__name__, [self.encoded(part) for part in value]]
        if kind is deque:
            return ["deque", [value.maxlen, [self.encoded(part) for part in value]]]
        if kind in (dict, Counter):
            return [kind.__name__, [[self.encoded(key), self.encoded(part)] for key, part in value.items()]]
        if _name(kind) not in self.classes:
            raise TypeError(f"a {_name(kind)} cannot be saved")
        if isinstance(value, tuple):
            return ["named", [_name(kind), [self.encoded(part) for part in value]]]
        if id(value) not in self._number:
            self._number[id(value)] = len(self.objects)
            self._alive.append(value)
            self.objects.append(None)
            # Cached properties of data classes and `transient` attributes are no part of the state.
            if dataclasses.is_dataclass(value):
                names = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
            else:
                names = vars(value)
            left_out = getattr(kind, "transient", ())
            parts = {name: self.encoded(part) for name, part in names.items() if name not in left_out}
            self.objects[self._number[id(value)]] = [_name(kind), parts]
        return ["object", self._number[id(value)]]

    def _tensor(self, kind: str, value: Tensor) -> list[str]:
        name = str(len(self.tensors))
        self.tensors[name] = value
        return [kind, name]


class _Reader:
    """The inverse of `_Writer`; raises one of `_DAMAGE` for what it did not write."""

    def __init__(self, classes: Mapping[str, type], shared: Mapping[str, Any], objects: Sequence, tensors: Mapping):
        self.classes, self.shared, self.objects, self.tensors = classes, shared, objects, tensors
        self._made: dict[int, Any] = {}

    def decoded(self, tree: Any) -> Any:
        """One value."""
        if not isinstance(tree, list):
            return tree
        kind, content = tree
        match kind:
            case "float":
                return float(content)
            case "shared":
                return self.shared[content]
            case "tensor":
                return self.tensors[content]
            case "array":
                return self.tensors[content].numpy()
            case "deque":
                return deque((self.decoded(part) for part in content[1]), content[0])
            case "generator":
                generator = torch.Generator()
                generator.set_state(self.tensors[content])
                return generator
            case "list":
                return [self.decoded(part) for part in content]
            case "tuple":
                return tuple(self.decoded(part) for part in content)
            case "dict" | "Counter":
                pairs = {self.decoded(key): self.decoded(part) for key, part in content}
                return pairs if kind == "dict" else Counter(pairs)
            case "named":
                return self.classes[content[0]](*(self.decoded(part) for part in content[1]))
            case "object":
                return self._object(content)
        raise ValueError(f"a value of kind {kind!r}")

    def _object(self, number: int) -> Any:
        if number not in self._made:
            name, parts = self.objects[number]
            made = self._made[number] = object.__new__(self.classes[name])
            for attribute, part in parts.items():
                if not attribute.isidentifier() or attribute.startswith("__"):
                    raise ValueError(f"an attribute {attribute!r}")
                object.__setattr__(made, attribute, self.decoded(part))
            if hasattr(made, "restored"):
                made.restored()
        return self._made[number]
