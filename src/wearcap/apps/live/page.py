"""The live page: persons as they move, their devices, floor and surroundings, the numbers, and buttons.

It is a sink like any other: `take` only stores, a thread of the page's own draws at `UPDATES_PER_S`.
"""

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
import viser
from torch import Tensor

from wearcap.apps.live.pacing import Playout
from wearcap.apps.live.packets import HEAD
from wearcap.apps.live.page_devices import Devices
from wearcap.apps.live.page_panel import Panel
from wearcap.apps.live.sink import Sink
from wearcap.apps.live.status import MAX_POINTS, LiveControls, LiveStatus, WearerStatus
from wearcap.apps.viewer.page import COLORS, UPDATES_PER_S
from wearcap.apps.viewer.page_layers import BodyLayer, FeetLayer, LabelLayer, MotionLayers, ObjectsLayer, add_points
from wearcap.apps.viewer.shown import surface_or_sticks
from wearcap.apps.web.page_server import ServedPage
from wearcap.apps.web.page_text import fitting
from wearcap.body.skeleton import Skeleton
from wearcap.recording import Motion, PointCloud
from wearcap.scene.objects import SceneObject

MAX_WEARERS = 16
"""Most wearers that are drawn."""
STATUS_S, PANEL_S, POINTS_S = 0.1, 0.3, 1.0
"""Times (s) between questions for the state, updates of the panel, and of the points."""
UNSEEN_S = 0.5
"""Time (s) between frames that no browser sees."""
SOON_S = 0.3
"""Time (s) that the camera takes to follow."""
LOOK_AT_M, CAMERA_M = (0.0, -0.3, 0.9), (2.2, 1.5, 1.35)
"""Where the camera looks and stands at first, from the floor below the person; the panel covers the right side."""
LABEL_M = 0.09
"""Height (m) of persons' names."""
_NOTHING = LiveStatus()


@dataclass
class _Person:
    """One wearer on the page."""

    number: int
    """Names the wearer's nodes: names from the network do not."""
    known: Mapping[str, SceneObject]
    """Objects of the place, by name."""
    playout: Playout = field(default_factory=Playout)
    wanted: Skeleton | None = None
    """Of the motion that comes; None once the wearer has left."""
    layers: MotionLayers | None = None
    objects: dict[str, ObjectsLayer] = field(default_factory=dict)
    """By name, those that had a pose; without a new one they stay where they were."""
    shown: bool = True

    def __post_init__(self):
        self.devices = Devices(f"/world/devices_{self.number}")

    @property
    def color(self) -> tuple[int, int, int]:
        return COLORS[self.number % len(COLORS)]

    @property
    def visible(self) -> bool:
        return self.layers is not None and self.layers.visible

    def draw(self, server: viser.ViserServer, name: str, now_s: float, several: bool) -> None:
        """Show the body, and the objects that it moves, at its play-out's time."""
        found = None if self.wanted is None else self.playout.step(now_s)
        if found is not None:
            self._follow(server, name, found[0])
        elif self.wanted is not None:
            return
        visible = self.shown and found is not None
        if self.layers is not None:
            self.layers.place(np.zeros(3), visible, named=visible and several)
        for layer in self.objects.values():
            layer.place(np.zeros(3), visible)
        if visible and found is not None and self.layers is not None:
            for layer in (self.layers, *self.objects.values()):
                layer.show(found[1])

    def _follow(self, server: viser.ViserServer, name: str, motion: Motion) -> None:
        """Nodes for a skeleton, in place of those of another one, and for objects that the motion moves for the first time."""
        node = f"world/person_{self.number}"
        before = None if self.layers is None else self.layers.body.motion.skeleton
        if before is not motion.skeleton and before != motion.skeleton:
            if self.layers is not None:
                self.layers.remove()
            body = BodyLayer(server, node, motion, surface_or_sticks(motion.skeleton, {}), self.color)
            label = LabelLayer(server, node, motion)
            label.handle.text = fitting(name) or "wearer"
            label.handle.font_size_mode, label.handle.font_scene_height = "scene", LABEL_M
            self.layers = MotionLayers(body, FeetLayer.of(server, f"{node}_feet", motion, None), label)
        if self.layers is not None:
            self.layers.follow(motion)
        for item_name, track in (motion.object_motion or {}).items():
            if item_name not in self.objects and item_name in self.known:
                self.objects[item_name] = ObjectsLayer(server, f"{node}_objects", [self.known[item_name]], {})
            if item_name in self.objects and len(track):
                self.objects[item_name].tracks[item_name] = track


class LivePage(ServedPage, Sink):
    """The page of a running capture. `take` stores and returns; `open` starts the thread that draws."""

    name = "page"
    convention = "metres, z up, as the capture"

    def __init__(
        self, controls: LiveControls, host: str = "127.0.0.1", port: int = 8080, objects: Sequence[SceneObject] = ()
    ):
        """`objects`: of the place; each is shown once a motion moves it."""
        super().__init__("wearcap live", host, port, "medium")
        self.controls = controls
        self.objects = {item.name: item for item in objects}
        self.errors = 0
        """Number of frames that could not be drawn."""
        self.last_error = ""
        self.frames = 0
        """Number of frames drawn so far."""
        self._persons: dict[str, _Person] = {}
        self._lock = threading.Lock()
        self._status, self._status_s, self._panel_s, self._points_s = _NOTHING, -math.inf, -math.inf, -math.inf
        self._points: list[Tensor] = []
        # The capture's world moves below a camera that stays: cameras report where they are too late to be moved along.
        self._worlds = [self.server.scene.add_frame(node, show_axes=False) for node in ("/world", "/surroundings")]
        self._floor = self.server.scene.add_grid(
            "/world/floor", infinite_grid=True, fade_distance=25.0, section_color=(170, 170, 170)
        )
        self._panel = Panel(self.server, controls)
        self._focus: np.ndarray | None = None
        """Place on the floor (m, the capture's world) that the camera follows."""
        self.server.initial_camera.look_at, self.server.initial_camera.position = LOOK_AT_M, CAMERA_M
        self._drawn_s = 0.0
        self._thread = threading.Thread(target=self.run, name="page", daemon=True)

    # --- as a sink -------------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Start to draw."""
        if not self._thread.is_alive():
            self._thread.start()

    def begin(self, wearer: str, skeleton: Skeleton, fps: float) -> None:
        """A wearer's motion begins; beyond `MAX_WEARERS` they are left out."""
        if (person := self._person(wearer)) is not None:
            person.playout.clear()
            person.wanted = skeleton

    def take(self, wearer: str, motion: Motion) -> None:
        """Store the next frames."""
        if (person := self._person(wearer)) is not None:
            person.wanted = motion.skeleton
            person.playout.put(motion)
            self.sent += len(motion)

    def end(self, wearer: str) -> None:
        """A wearer has left: the body is hidden until it comes back."""
        if (person := self._persons.get(wearer)) is not None:
            person.wanted = None
            person.playout.clear()

    def close(self) -> None:
        """Close the page."""
        self.stop()

    def stop(self) -> None:
        """Stop to draw, and close the server."""
        if self._stopped:
            return
        self._stopped = True
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join(5.0)
        super().stop()

    def _person(self, name: str) -> _Person | None:
        with self._lock:
            if name not in self._persons and len(self._persons) < MAX_WEARERS:
                self._persons[name] = _Person(len(self._persons), self.objects)
            return self._persons.get(name)

    # --- drawing ---------------------------------------------------------------------------------------------------

    def update(self, now_s: float) -> None:
        """Draw; what cannot be drawn is counted."""
        try:
            self.draw(now_s)
        except Exception as error:  # a frame that cannot be drawn must not end the page
            self.errors += 1
            self.last_error = f"{type(error).__name__}: {error}"[:200]
        self.step_s = 1 / UPDATES_PER_S if self.server.get_clients() else UNSEEN_S

    def draw(self, now_s: float) -> None:
        """Send one frame."""
        with self._lock:
            persons = dict(self._persons)
        self.frames += 1
        fresh = now_s - self._status_s >= STATUS_S
        if fresh:
            self._status_s = now_s
            self._status = self.controls.status()
        of = {wearer.name: wearer for wearer in self._status.wearers}
        with self.server.atomic():
            for name, person in persons.items():
                folder = self._panel.wearers.get(name)
                person.shown = folder is None or bool(folder.shown.value)
                person.draw(self.server, name, now_s, len(persons) > 1)
                if fresh:
                    person.devices.see(self.server, of[name].devices if name in of else (), now_s)
                # The body is late by the capture's latency and by its play-out.
                latency_ms = of[name].latency.median if name in of and person.visible else 0.0
                delay_s = latency_ms / 1000 + person.playout.behind_s
                visible = person.shown and bool(self._panel.devices.value)
                person.devices.show(now_s, delay_s, visible, None if person.layers is None else person.layers.body)
            self._follow(persons, now_s)
            if now_s - self._panel_s >= PANEL_S:
                self._panel_s = now_s
                self._show_status()
        if now_s - self._points_s >= POINTS_S:
            self._points_s = now_s
            self._show_points()
        self.server.flush()
        self._drawn_s = now_s

    def _show_status(self) -> None:
        """Panel and floor."""
        known = [wearer for wearer in self._status.wearers if self._person(wearer.name) is not None]
        behind = {name: person.playout.behind_s for name, person in self._persons.items()}
        shown = LiveStatus(tuple(known), self._status.sinks, self._status.recording, self._status.seconds)
        self._panel.update(shown, lambda name: self._persons[name].color, behind)
        floors = [wearer.floor_m for wearer in known if wearer.floor_m is not None and self._persons[wearer.name].shown]
        if floors and math.isfinite(floors[0]):
            self._floor.position = (0.0, 0.0, floors[0])

    def _show_points(self) -> None:
        """The newest points of all wearers that are shown; they are sent again when new ones have come."""
        shown = (
            [wearer for wearer in self._status.wearers if self._has_points(wearer)] if self._panel.points.value else []
        )
        points = [wearer.points_world for wearer in shown if wearer.points_world is not None]
        if len(points) == len(self._points) and all(a is b for a, b in zip(points, self._points)):
            return
        self._points = points
        every = torch.cat([each[-MAX_POINTS:].cpu() for each in points])[-MAX_POINTS:] if points else torch.zeros(0, 3)
        every = every[every.isfinite().all(-1)]
        add_points(self.server, PointCloud(every))

    def _has_points(self, wearer: WearerStatus) -> bool:
        person = self._persons.get(wearer.name)
        return wearer.points_world is not None and len(wearer.points_world) > 0 and (person is None or person.shown)

    def _follow(self, persons: dict[str, _Person], now_s: float) -> None:
        """Keep the middle of the persons that are shown, or of their heads, where the camera looks; the first one at once."""
        bodies = [one.layers.body.handle for one in persons.values() if one.layers is not None and one.visible]
        heads = [one.devices.known[HEAD].frame for one in persons.values() if HEAD in one.devices.known and one.shown]
        roots = [np.asarray(handle.position) for handle in bodies or heads]
        if not roots or (self._focus is not None and not self._panel.follow.value):
            return
        middle = np.mean(roots, axis=0)
        middle[2] = self._floor.position[2]
        share = 1.0 if self._focus is None else 1 - math.exp(-max(now_s - self._drawn_s, 0.0) / SOON_S)
        focus = middle if self._focus is None else self._focus + share * (middle - self._focus)
        if self._focus is None or np.linalg.norm(focus - self._focus) > 1e-4:
            self._focus = focus
            for frame in self._worlds:
                frame.position = -focus
