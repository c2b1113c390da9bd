"""The interactive page: a recording and what was captured from it, in the browser.

Python keeps the clock and sends poses; the browser skins, draws and moves the camera.
"""

import time as wall
from pathlib import Path

import numpy as np
import viser

from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.recording import Motion, Recording
from wearcap.scene.environment import Environment
from wearcap.viewer.objects import ObjectsLayer
from wearcap.viewer.page_layers import (
    BodyLayer,
    FeetLayer,
    HeadLayer,
    Layer,
    Placed,
    add_points,
    read_scene,
    surface_or_sticks,
)
from wearcap.viewer.page_timeline import SPEEDS, Timeline

UPDATES_PER_S = 30.0
ASIDE_M = 1.2
TRUTH_COLOR, CAPTURE_COLOR = (150, 155, 160), (70, 160, 150)
_LAYOUTS = ("over", "beside", "truth", "capture")


class Page:
    """One recording's page. `run` plays until interrupted; `stop` closes the server."""

    def __init__(
        self, recording: Recording, motion: Motion | None = None, *, folder: Path | None = None,
        host: str = "127.0.0.1", port: int = 8080, environment: Environment | None = None,
    ):  # fmt: skip
        """`motion`: what was captured; `folder`: the data set's, where `recording.scene` lies.

        Objects of an `environment` stand where the capture has them, else where they truly were.
        """
        self.timeline = _timeline(recording, motion)
        self._stopped = False
        scene = read_scene(folder / recording.scene) if recording.scene and folder is not None else None
        self.server = viser.ViserServer(host=host, port=port, label="wearcap", verbose=False)
        self.server.scene.set_up_direction("+z")
        self.server.gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        self.bodies: dict[str, Placed] = {}
        self.layers: list[Layer] = []
        self._add_bodies(recording, motion)
        if recording.head is not None and len(recording.head.timestamps):
            self.layers.append(HeadLayer(self.server, recording.head))
        if recording.points is not None:
            add_points(self.server, recording.points)
        if scene is not None:
            self.server.scene.add_mesh_trimesh("/scene", scene)
        if environment is not None:
            tracks = (
                motion.object_motion
                if motion is not None and motion.object_motion
                else recording.object_motion
            )
            self.layers.append(ObjectsLayer(self.server, environment, tracks))
        self._add_floor(recording)
        self._add_controls(recording)
        self._followed = self._focus()
        self._point_camera()
        self.show()

    @property
    def url(self) -> str:
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def _add_bodies(self, recording: Recording, motion: Motion | None) -> None:
        for name, shown, color in (
            ("truth", recording.motion, TRUTH_COLOR),
            ("capture", motion, CAPTURE_COLOR),
        ):
            if shown is None or not len(shown):
                continue
            body = surface_or_sticks(shown.skeleton, recording.shape)
            layer = BodyLayer(self.server, name, shown, body, color)
            placed = Placed(layer, _feet(self.server, name, shown, recording))
            self.bodies[name] = placed
            self.layers.append(placed)

    def _add_floor(self, recording: Recording) -> None:
        self.server.scene.add_grid(
            "/floor", infinite_grid=True, position=(0.0, 0.0, _floor_height(recording)), fade_distance=25.0
        )

    def _add_controls(self, recording: Recording) -> None:
        gui, clock = self.server.gui, self.timeline
        gui.add_markdown(f"**{recording.name}**  \n{recording.activity or recording.source}")
        self._play = gui.add_button("Play")
        self._slider = gui.add_slider(
            "Time (s)",
            min=clock.start,
            max=max(clock.stop, clock.start + 1e-3),
            step=0.01,
            initial_value=clock.start,
        )
        self._speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1×")
        self._follow = gui.add_checkbox("Follow with the camera", initial_value=False)
        self._play.on_click(lambda _: self.toggle())
        self._slider.on_update(self._scrubbed)
        self._speed.on_update(lambda _: setattr(clock, "speed", float(self._speed.value[:-1])))
        if len(self.bodies) == 2:
            self._layout = gui.add_dropdown("Truth and capture", _LAYOUTS, initial_value="over")
            self._layout.on_update(lambda _: self.arrange(self._layout.value))
        keys = (
            ("Play or pause", "space", self.toggle), ("Back one second", "J", lambda: self.jump(-1.0)),
            ("On one second", "L", lambda: self.jump(1.0)), ("To the start", "home", lambda: self.jump(-np.inf)),
        )  # fmt: skip
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

    def arrange(self, layout: str) -> None:
        """Truth and capture "over" one another, "beside", or one alone."""
        if layout not in _LAYOUTS:
            raise WearcapError(f"no layout {layout!r}", expected=f"one of {', '.join(_LAYOUTS)}")
        for name, placed in self.bodies.items():
            aside = ASIDE_M if layout == "beside" and name == "truth" else 0.0
            placed.place(np.array([0.0, aside, 0.0]), layout in ("over", "beside", name))
        self.show()

    def _scrubbed(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # not our own update of the slider while playing
            self.timeline.seek(self._slider.value)
            self.show()

    def show(self) -> None:
        """Send the poses of the current time."""
        with self.server.atomic():
            for layer in self.layers:
                layer.show(self.timeline.time)
            self._follow_camera()
        self.server.flush()

    def _focus(self) -> np.ndarray:
        """What the camera looks at: the body, or the head."""
        for placed in reversed(self.bodies.values()):
            return np.array(placed.body.handle.position)
        for layer in self.layers:
            if isinstance(layer, HeadLayer):
                return np.array(layer.frustum.position)
        return np.zeros(3)

    def _point_camera(self) -> None:
        for layer in self.layers:
            layer.show(self.timeline.time)
        self._followed = self._focus()
        camera = self.server.initial_camera
        camera.look_at = tuple(self._followed)
        camera.position = tuple(self._followed + np.array([2.2, 2.0, 0.9]))

    def _follow_camera(self) -> None:
        focus = self._focus()
        moved, self._followed = focus - self._followed, focus
        if not self._follow.value or not moved.any():
            return
        for client in self.server.get_clients().values():
            # Moving the camera carries its look-at point along.
            client.camera.position = client.camera.position + moved

    def run(self, seconds: float = np.inf) -> None:
        """Keep the clock until interrupted, or for so many seconds."""
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


def _timeline(recording: Recording, motion: Motion | None) -> Timeline:
    """From the first to the last moment of whatever moves."""
    streams = [
        s.timestamps
        for s in (recording.motion, motion, recording.head)
        if s is not None and len(s.timestamps)
    ]
    if not streams and recording.points is None and not recording.scene:
        raise WearcapError(f"recording {recording.name!r} has nothing to show",
                           expected="a motion, a head path, points or a scene")  # fmt: skip
    start = min((s[0].item() for s in streams), default=0.0)
    return Timeline(start, max((s[-1].item() for s in streams), default=0.0), start)


def _floor_height(recording: Recording) -> float:
    """The lowest floor as recorded; else below nearly all points where no body stands; else zero."""
    if recording.floor is not None and len(recording.floor.height):
        return float(recording.floor.height.min())
    if recording.motion is None and recording.points is not None and len(recording.points.points_world):
        return float(np.quantile(recording.points.points_world[:, 2].numpy(), 0.01))
    return 0.0


def _feet(server: viser.ViserServer, name: str, motion: Motion, recording: Recording) -> FeetLayer | None:
    """Contacts: the motion's own, or for the truth the recording's."""
    if not set(FOOT_PATCHES) <= set(motion.skeleton.sites):
        return None
    if motion.contact_prob is not None:
        return FeetLayer(server, f"{name}_feet", motion, motion.contact_prob > 0.5, motion.timestamps)
    track = recording.contacts if name == "truth" else None
    if track is None or not set(FOOT_PATCHES) <= set(track.parts):
        return None
    columns = [track.parts.index(patch) for patch in FOOT_PATCHES]
    return FeetLayer(server, f"{name}_feet", motion, track.contact[:, columns], track.timestamps)
