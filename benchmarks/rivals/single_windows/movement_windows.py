"""Training windows of the motion autoencoder: joints of the true motion."""

from benchmarks.rivals.single_windows.bodies import OtherPerson
from benchmarks.rivals.single_windows.transforms import Cut, Draws, Window, joint_twins
from benchmarks.rivals.single_windows.windows import Content, Windows
from wearcap.data.motion_features import MotionFeatures, Movement
from wearcap.recording.store import RecordingFile, RecordingStore


class MovementContent(Content):
    """Complete windows of true motion, of which every `features.every`-th frame is used.

    A recording's joints are computed at its first use and kept: 17 MB per hour at 20 frames a second.
    """

    draws = ("shift", "mirror")

    def __init__(self, features: MotionFeatures):
        self.features, self._twins = features, {"t_world_joint": joint_twins(features.skeleton)}

    def cut(self, track: Movement, start: int, frames: int, every: int, windows: Windows) -> Cut:
        every, length = self.features.every, len(track.floor_height)
        stride = windows.stride // every
        return Cut(start // every, windows.window // every, length, stride, stretch=windows.stretch)

    def open(self, store: RecordingStore, name: str, every: int, person: OtherPerson | None = None) -> Movement:
        return self.features.movement(RecordingFile(store.path_of(name)).part("motion"))

    def read(self, track: Movement, cut: Cut, random: Draws) -> Window:
        values = dict(zip(("t_world_joint", "R_world_root", "floor_height"), track))
        return Window({name: cut.take(name, part) for name, part in values.items()}, self._twins)

    def item(self, track: Movement, cut: Cut, window: Window, random: Draws) -> Movement:
        return Movement(*window.values.values())
