"""The interactive page: a recording and motions captured from it, in the browser.

Python runs the clock and sends poses; the browser skins, draws and moves the camera.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import torch
import viser
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.apps.viewer.page_layers import (
    BodyLayer,
    BodyPointsLayer,
    CertaintyLayer,
    FeetLayer,
    HeadLayer,
    LabelLayer,
    Layer,
    MotionLayers,
    ObjectsLayer,
    add_points,
    read_scene,
)
from wearcap.apps.viewer.shown import poses_at, surface_or_sticks, with_objects
from wearcap.apps.web.page_server import ServedPage
from wearcap.apps.web.page_text import block, escaped
from wearcap.errors import WearcapError, require_choice
from wearcap.geometry.trajectory import Trajectory, nearest_frames
from wearcap.recording import Motion, Recording
from wearcap.scene.objects import Environment, SceneObject

UPDATES_PER_S = 30.0
OVER, BESIDE = "over", "beside"
TRUTH = "truth"
TRUTH_COLOR = (150, 155, 160)
CAPTURE_COLOR = (70, 160, 150)
COLORS = (CAPTURE_COLOR, (215, 140, 75), (155, 110, 170), (120, 165, 85), (80, 125, 200), (205, 95, 110))
"""Colours of captures, in order."""
ASIDE_M = 1.2
"""Least distance (m) from one motion to the next, side by side."""
FLESH_M, NEAR_M = 0.2, 1.0
"""Extent (m) of a body beyond its joints, and distance (m) from the root beyond which objects are not part of a motion."""
STILL_M, STILL_RAD = 0.02, 0.05
"""Changes of pose (m, rad) below which an object is static."""
SPEEDS = ("0.1×", "0.25×", "0.5×", "1×", "2×", "4×")


@dataclass
class _Timeline:
    """A time that runs between start and stop (s) when playing, at `speed` times real time."""

    start: float
    stop: float
    time: float
    playing: bool = False
    speed: float = 1.0

    @classmethod
    def of(cls, recording: Recording, motions: dict[str, Motion]) -> "_Timeline":
        """A timeline over all moving layers. Raises WearcapError if there is nothing to show."""
        head = recording.head
        streams = [motion.timestamps for motion in motions.values()]
        if head is not None and len(head.timestamps):
            streams.append(head.timestamps)
        if not streams and recording.points is None and not recording.scene:
            what = f"recording {recording.name!r} has nothing to show"
            raise WearcapError(what, expected="a motion, a head path, points or a scene")
        start = min((times[0].item() for times in streams), default=0.0)
        return cls(start, max((times[-1].item() for times in streams), default=0.0), start)

    def advance(self, elapsed_s: float) -> bool:
        """Advance by wall time; returns whether the shown time changed. It loops at the end."""
        if not self.playing or self.stop <= self.start:
            return False
        self.time += elapsed_s * self.speed
        if self.time > self.stop:
            self.time = self.start
        return True

    def seek(self, time: float) -> None:
        self.time = min(max(time, self.start), self.stop)


def _layers(
    server: viser.ViserServer,
    name: str,
    motion: Motion,
    recording: Recording,
    items: Sequence[SceneObject],
    color: tuple[int, int, int],
    several: bool,
) -> MotionLayers:
    """A motion with its own moving objects; one of `several` is labelled, and its objects are tinted like its body."""
    body, points, objects = surface_or_sticks(motion.skeleton, recording.shape), None, None
    if motion.body_contact_prob is not None:
        points = BodyPointsLayer(server, f"{name}_points", motion, body)
    if items and motion.object_motion:
        tint = color if several else None
        objects = ObjectsLayer(server, f"{name}_objects", items, motion.object_motion, tint)
    surface = BodyLayer(server, name, motion, body, color)
    feet = FeetLayer.of(server, f"{name}_feet", motion, recording.contacts if name == TRUTH else None)
    label = LabelLayer(server, name, motion) if several else None
    sure = None if motion.joint_std is None else CertaintyLayer(server, f"{name}_certainty", motion)
    return MotionLayers(surface, feet, label, points, objects, sure)


class Page(ServedPage):
    """One recording's page. `run` plays until interrupted; `stop` closes the server."""

    step_s = 1 / UPDATES_PER_S

    def __init__(
        self,
        recording: Recording,
        captures: dict[str, Motion] | None = None,
        *,
        folder: Path | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        environment: Environment | None = None,
    ):
        """`captures` are the captured motions by display name; several are shown side by side at first.

        `folder` is the data set's folder, which `recording.scene` is relative to. Moving objects of an `environment` are
        shown with each motion, the others at their true poses, else their initial ones.
        """
        truth = with_objects(recording, environment)
        shown = ({} if truth is None else {TRUTH: truth}) | (captures or {})
        motions = {name: motion for name, motion in shown.items() if len(motion)}
        self.timeline = _Timeline.of(recording, motions)
        scene = read_scene(folder / recording.scene) if recording.scene and folder is not None else None
        super().__init__("wearcap", host, port, "medium")
        moving, tracks = [], [motion.object_motion or {} for motion in motions.values()]
        if environment is not None:
            moving = [item for item in environment.objects if any(_moves(of.get(item.name), item) for of in tracks)]
        self.bodies: dict[str, MotionLayers] = {}
        for name, motion in motions.items():
            number = len(self.bodies) - (TRUTH in self.bodies)
            color = TRUTH_COLOR if name == TRUTH else COLORS[number % len(COLORS)]
            self.bodies[name] = _layers(self.server, name, motion, recording, moving, color, len(motions) > 1)
        self.layers: list[Layer] = list(self.bodies.values())
        self.aside_m = _spacing_m(list(motions.values()), moving) if len(motions) > 1 else 0.0
        if recording.head is not None and len(recording.head.timestamps):
            self.layers.append(HeadLayer(self.server, recording.head))
        self._surroundings = self.server.scene.add_frame("/surroundings", show_axes=False)
        if recording.points is not None:
            add_points(self.server, recording.points)
        if scene is not None:
            self.server.scene.add_mesh_trimesh("/surroundings/scene", scene)
        if environment is not None:
            still = [item for item in environment.objects if item not in moving]
            self.layers.append(ObjectsLayer(self.server, "surroundings/objects", still, recording.object_motion))
        self._updated_s, self._shown = math.inf, 0
        self.layout = BESIDE if len(self.bodies) - (TRUTH in self.bodies) > 1 else OVER
        floor_z = _floor_height(recording)
        self.server.scene.add_grid("/floor", infinite_grid=True, position=(0.0, 0.0, floor_z), fade_distance=25.0)
        self._add_controls(recording)
        self._followed = np.zeros(3)
        self.arrange(self.layout)
        # The camera is at the front left, or in front of the middle one of several bodies side by side.
        self._followed = self._focus()
        direction = np.array([2.2, 2.0, 0.9])
        if self.layout == BESIDE:
            direction = np.array([1.0, 0.15, 0.3]) * max(3.0, 1.0 + 0.35 * self.aside_m * len(self.bodies))
        self.server.initial_camera.look_at = tuple(self._followed)
        self.server.initial_camera.position = tuple(self._followed + direction)

    def _add_controls(self, recording: Recording) -> None:
        gui, clock = self.server.gui, self.timeline
        about = escaped(recording.activity or recording.source)
        gui.add_html(block(f"<b>{escaped(recording.name)}</b><br>{about}"))
        self._play = gui.add_button("Play")
        longest = max(clock.stop - clock.start, 1e-3)
        self._slider = gui.add_slider("Time (s)", min=0.0, max=longest, step=0.01, initial_value=0.0)
        self._device_time = None
        if clock.start != 0.0:
            self._device_time = gui.add_text("Device's clock (s)", f"{clock.start:.2f}", disabled=True)
        self._speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1×")
        self._follow = gui.add_checkbox("Follow with the camera", initial_value=False)
        # The surroundings of one motion would overlap the others where these are shown side by side.
        self._surroundings.visible = self.layout != BESIDE
        around = gui.add_checkbox("Surroundings", initial_value=self._surroundings.visible)
        around.on_update(lambda _: setattr(self._surroundings, "visible", around.value))
        if any(placed.certainty for placed in self.bodies.values()):
            gui.add_html(block("Balls: two in three errors of a joint are no larger, along each axis."))
        self._play.on_click(lambda _: self.toggle())
        self._slider.on_update(self.scrubbed)
        self._speed.on_update(lambda _: setattr(clock, "speed", float(self._speed.value[:-1])))
        if len(self.bodies) > 1:
            layout = gui.add_dropdown("Truth and captures", self._layouts(), initial_value=self.layout)
            layout.on_update(lambda _: self.arrange(layout.value))
        keys = (
            ("Play or pause", "space", self.toggle),
            ("Back one second", "J", lambda: self.jump(-1.0)),
            ("On one second", "L", lambda: self.jump(1.0)),
            ("To the start", "home", lambda: self.jump(-np.inf)),
        )
        for label, key, action in keys:
            gui.add_command(label, hotkey=key).on_trigger(lambda _, action=action: action())

    def toggle(self) -> None:
        """Play or pause."""
        self.timeline.playing = not self.timeline.playing
        self._play.label = "Pause" if self.timeline.playing else "Play"

    def jump(self, seconds: float) -> None:
        self.timeline.seek(self.timeline.time + seconds)
        self._show_time()
        self.show()

    def _show_time(self) -> None:
        """Move the slider, which counts from the start, and name the device's own time."""
        self._slider.value = self.timeline.time - self.timeline.start
        if self._device_time is not None:
            self._device_time.value = f"{self.timeline.time:.2f}"

    def _layouts(self) -> tuple[str, ...]:
        return (OVER, BESIDE, *self.bodies)

    def arrange(self, layout: str) -> None:
        """Show ground truth and captures "over" one another, "beside" (the first capture in its place), or one alone."""
        require_choice(layout, self._layouts(), f"no layout {layout!r}")
        self.layout = layout
        for column, (name, placed) in enumerate(self.bodies.items()):
            aside = self.aside_m * ((TRUTH in self.bodies) - column) if layout == BESIDE else 0.0
            visible = layout in (OVER, BESIDE, name)
            placed.place(np.array([0.0, aside, 0.0]), visible, named=visible and layout != OVER)
        self.show()

    def scrubbed(self, event: viser.GuiEvent) -> None:
        """Seek to the slider's time, if a person moved it and not the page while playing."""
        if event.client is not None:
            self.timeline.seek(self.timeline.start + self._slider.value)
            self._show_time()
            self.show()

    def show(self) -> None:
        """Send the poses of the current time."""
        with self.server.atomic():
            for layer in self.layers:
                layer.show(self.timeline.time)
            focus = self._focus()
            moved, self._followed = focus - self._followed, focus
            if self._follow.value and moved.any():
                for client in self.server.get_clients().values():
                    # Moving the camera carries its look-at point along.
                    client.camera.position = client.camera.position + moved
        self.server.flush()

    def _focus(self) -> np.ndarray:
        """Point that the camera looks at: the middle of the shown bodies, or the head."""
        shown = [placed.body.handle.position for placed in self.bodies.values() if placed.visible]
        if shown:
            return np.mean(shown, axis=0)
        for layer in self.layers:
            if isinstance(layer, HeadLayer):
                return np.array(layer.frustum.position)
        return np.zeros(3)

    def update(self, now_s: float) -> None:
        """Run the clock."""
        elapsed_s, self._updated_s = now_s - min(self._updated_s, now_s), now_s
        if self.timeline.advance(elapsed_s):
            self.show()
            self._shown += 1
            if self._shown % 6 == 0:  # the slider need not be as smooth as the body
                self._show_time()


def _floor_height(recording: Recording) -> float:
    """Height (m) of the lowest recorded floor; without bodies, a height below nearly all points; else zero."""
    if recording.floor is not None and len(recording.floor.height):
        return float(recording.floor.height.min())
    if recording.motion is None and recording.points is not None and len(recording.points.points_world):
        return float(np.quantile(recording.points.points_world[:, 2].numpy(), 0.01))
    return 0.0


def _moves(track: Trajectory | None, item: SceneObject) -> bool:
    if track is None or not len(track):
        return False
    R, t = track.R_world_body, track.t_world_body
    turned = (R - item.R_world_object.to(R)).flatten(1).norm(dim=1).max()
    shifted = (t - item.t_world_object.to(t)).norm(dim=1).max()
    # A small angle is the matrices' distance divided by √2.
    return float(shifted) > STILL_M or float(turned) > 2**0.5 * STILL_RAD


def _spacing_m(motions: Sequence[Motion], items: Sequence[SceneObject] = ()) -> float:
    """Distance (m, along y) of neighbours at which none covers the next one at any time.

    The first has the greatest y. A motion occupies its body and the objects near it.
    """
    start = min(motion.timestamps[0].item() for motion in motions)
    stop = max(motion.timestamps[-1].item() for motion in motions)
    times = torch.linspace(start, stop, 400, dtype=torch.float64)
    spans = [_span(motion, items, times) for motion in motions]
    overlaps = [float((behind[1] - ahead[0]).max()) for ahead, behind in pairwise(spans)]
    return max(ASIDE_M, *overlaps)


def _span(
    motion: Motion, items: Sequence[SceneObject], times: Float64[Tensor, "time"]
) -> tuple[Float[Tensor, "time"], Float[Tensor, "time"]]:
    """Least and greatest y (m) of a motion and its near objects, at some times."""
    joints = motion.T_world_joint.t[nearest_frames(motion.timestamps, times)].double()
    low, high = joints[..., 1].amin(1) - FLESH_M, joints[..., 1].amax(1) + FLESH_M
    for item in items if motion.object_motion else ():
        T = poses_at((motion.object_motion or {}).get(item.name), item, times)
        box = zip(item.mesh.vertices.min(0), item.mesh.vertices.max(0), strict=True)
        corners = torch.from_numpy(np.array(list(product(*box)))).to(T.t)  # of its bounding box, in its own axes
        placed = (corners @ T.R.mT + T.t[:, None]).double()
        y, middle = placed[..., 1], placed.mean(1)
        radius = (corners - corners.mean(0)).norm(dim=1).max()
        near = (middle - joints[:, 0])[:, :2].norm(dim=1) < radius + NEAR_M
        low = torch.where(near, torch.minimum(low, y.amin(1)), low)
        high = torch.where(near, torch.maximum(high, y.amax(1)), high)
    return low, high
