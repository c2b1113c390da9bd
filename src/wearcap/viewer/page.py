"""The interactive page: a recording and motions captured from it, in the browser.

Python runs the clock and sends poses; the browser skins, draws and moves the camera.
"""

import time as wall
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import viser

from wearcap.errors import WearcapError
from wearcap.recording import Motion, Recording
from wearcap.scene.environment import Environment
from wearcap.viewer.guard import Guard
from wearcap.viewer.objects import ObjectsLayer
from wearcap.viewer.page_layers import HeadLayer, Layer, Placed, add_points, read_scene
from wearcap.viewer.page_motions import TRUTH, motions_shown, moving_objects, placed_motions, spacing_m
from wearcap.viewer.page_server import start_server

UPDATES_PER_S = 30.0
OVER, BESIDE = "over", "beside"
SPEEDS = ("0.1×", "0.25×", "0.5×", "1×", "2×", "4×")


@dataclass
class Timeline:
    """A time that runs between start and stop (s) when playing, at `speed` times real time."""

    start: float
    stop: float
    time: float
    playing: bool = False
    speed: float = 1.0

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

    def step(self, seconds: float) -> None:
        self.seek(self.time + seconds)


class Page:
    """One recording's page. `run` plays until interrupted; `stop` closes the server."""

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
        motions = motions_shown(recording, captures or {}, environment)
        self.timeline = _timeline(recording, motions)
        self._stopped = False
        scene = read_scene(folder / recording.scene) if recording.scene and folder is not None else None
        self.guard = Guard(host)
        self.server = start_server(self.guard, port, "wearcap")
        self.server.scene.set_up_direction("+z")
        self.server.gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        moving = moving_objects(list(motions.values()), environment)
        self.bodies: dict[str, Placed] = placed_motions(self.server, recording, motions, moving)
        self.layers: list[Layer] = list(self.bodies.values())
        self.aside_m = spacing_m(list(motions.values()), moving) if len(motions) > 1 else 0.0
        if recording.head is not None and len(recording.head.timestamps):
            self.layers.append(HeadLayer(self.server, recording.head))
        self._surroundings = self.server.scene.add_frame("/surroundings", show_axes=False)
        if recording.points is not None:
            add_points(self.server, recording.points)
        if scene is not None:
            self.server.scene.add_mesh_trimesh("/surroundings/scene", scene)
        if environment is not None:
            still = [item for item in environment.objects if item not in moving]
            self.layers.append(ObjectsLayer(self.server, "surroundings", still, recording.object_motion))
        self.layout = BESIDE if len(self.bodies) - (TRUTH in self.bodies) > 1 else OVER
        self._followed = np.zeros(3)
        floor_z = _floor_height(recording)
        self.server.scene.add_grid("/floor", infinite_grid=True, position=(0.0, 0.0, floor_z), fade_distance=25.0)
        self._add_controls(recording)
        self.arrange(self.layout)
        self._point_camera()

    @property
    def url(self) -> str:
        """Address to open; it contains the token without which the page does not answer."""
        return self.guard.url(self.server.get_port())

    def _add_controls(self, recording: Recording) -> None:
        gui, clock = self.server.gui, self.timeline
        gui.add_markdown(f"**{recording.name}**  \n{recording.activity or recording.source}")
        self._play = gui.add_button("Play")
        self._slider = gui.add_slider(
            "Time (s)", min=clock.start, max=max(clock.stop, clock.start + 1e-3), step=0.01, initial_value=clock.start
        )
        self._speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1×")
        self._follow = gui.add_checkbox("Follow with the camera", initial_value=False)
        # The surroundings of one motion would overlap the others where these are shown side by side.
        self._surroundings.visible = self.layout != BESIDE
        around = gui.add_checkbox("Surroundings", initial_value=self._surroundings.visible)
        around.on_update(lambda _: setattr(self._surroundings, "visible", around.value))
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
        self.timeline.step(seconds)
        self._slider.value = self.timeline.time
        self.show()

    def _layouts(self) -> tuple[str, ...]:
        return (OVER, BESIDE, *self.bodies)

    def arrange(self, layout: str) -> None:
        """Show ground truth and captures "over" one another, "beside" (the first capture in its place), or one alone."""
        if layout not in self._layouts():
            raise WearcapError(f"no layout {layout!r}", expected=f"one of {', '.join(self._layouts())}")
        self.layout = layout
        for column, (name, placed) in enumerate(self.bodies.items()):
            aside = self.aside_m * ((TRUTH in self.bodies) - column) if layout == BESIDE else 0.0
            visible = layout in (OVER, BESIDE, name)
            placed.place(np.array([0.0, aside, 0.0]), visible, named=visible and layout != OVER)
        self.show()

    def scrubbed(self, event: viser.GuiEvent) -> None:
        """Seek to the slider's time, if a person moved it and not the page while playing."""
        if event.client is not None:
            self.timeline.seek(self._slider.value)
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
        shown = [placed.body.handle.position for placed in self.bodies.values() if placed.body.handle.visible]
        if shown:
            return np.mean(shown, axis=0)
        for layer in self.layers:
            if isinstance(layer, HeadLayer):
                return np.array(layer.frustum.position)
        return np.zeros(3)

    def _point_camera(self) -> None:
        """Place the camera at the front left, or in front of the middle one of several bodies side by side."""
        self._followed = self._focus()
        direction = np.array([2.2, 2.0, 0.9])
        if self.layout == BESIDE:
            direction = np.array([1.0, 0.15, 0.3]) * max(3.0, 1.0 + 0.35 * self.aside_m * len(self.bodies))
        camera = self.server.initial_camera
        camera.look_at = tuple(self._followed)
        camera.position = tuple(self._followed + direction)

    def run(self, seconds: float = np.inf) -> None:
        """Run the clock until interrupted, or for the given seconds."""
        begin = last = wall.monotonic()
        shown = 0
        while not self._stopped and (now := wall.monotonic()) - begin < seconds:
            if self.timeline.advance(now - last):
                self.show()
                shown += 1
                if shown % 6 == 0:  # the slider need not be as smooth as the body
                    self._slider.value = self.timeline.time
            last = now
            wall.sleep(max(0.0, 1 / UPDATES_PER_S - (wall.monotonic() - now)))

    def stop(self) -> None:
        self._stopped = True
        self.server.stop()


def _timeline(recording: Recording, motions: dict[str, Motion]) -> Timeline:
    """First and last time (s) of all moving layers."""
    head = recording.head
    streams = [motion.timestamps for motion in motions.values()]
    if head is not None and len(head.timestamps):
        streams.append(head.timestamps)
    if not streams and recording.points is None and not recording.scene:
        raise WearcapError(
            f"recording {recording.name!r} has nothing to show", expected="a motion, a head path, points or a scene"
        )
    start = min((times[0].item() for times in streams), default=0.0)
    return Timeline(start, max((times[-1].item() for times in streams), default=0.0), start)


def _floor_height(recording: Recording) -> float:
    """Height (m) of the lowest recorded floor; without bodies, a height below nearly all points; else zero."""
    if recording.floor is not None and len(recording.floor.height):
        return float(recording.floor.height.min())
    if recording.motion is None and recording.points is not None and len(recording.points.points_world):
        return float(np.quantile(recording.points.points_world[:, 2].numpy(), 0.01))
    return 0.0
