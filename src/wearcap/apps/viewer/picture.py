"""Pictures and videos without a screen: ground truth and captures side by side, shaded, with contacts; a head's path."""

import math
import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import cycle
from pathlib import Path
from time import monotonic

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.progress import track
from torch import Tensor

from wearcap.apps.viewer.camera_path import KEY_S, azimuths, smoothed
from wearcap.apps.viewer.ground import Ground
from wearcap.apps.viewer.shown import by_height, lit_points, posed_meshes, stick_body, vertex_colors
from wearcap.body.contact_points import contact_points
from wearcap.body.kinematics import site_positions
from wearcap.body.model import BodyModel
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.geometry.camera import Camera
from wearcap.geometry.mesh import Mesh, capsules
from wearcap.geometry.render import Light, Splats, render
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.video import write_frames
from wearcap.recording.motion import HANDS, Motion
from wearcap.recording.recording import Recording
from wearcap.scene.objects import Environment

PALETTE = np.array([[0.45, 0.55, 0.66], [0.86, 0.55, 0.30], [0.44, 0.62, 0.42], [0.62, 0.45, 0.62]])
"""Colours of the motions, in order."""

CONTACT_COLOR = np.array([0.80, 0.18, 0.12])
HOLD_COLOR = np.array([0.20, 0.62, 0.25])
TILES = np.array([[0.85, 0.85, 0.84], [0.73, 0.74, 0.75]])
SKY = (0.965, 0.97, 0.975)
RIM = np.array(SKY) / 1.081
"""Colour at the rim of the ground, which the light makes that of the sky."""
VIEW_RAD, TILT, DISTANCE_M = math.atan2(0.78, -0.62), -0.30, 4.2
"""Azimuth of the direction in which the camera looks, from the front left at someone facing +x, its vertical part beside a
horizontal part of 1, and the camera's distance from the person."""
PATH_COLOR, LOOK_COLOR = (0.85, 0.35, 0.12), (0.15, 0.35, 0.70)
CUT_AWAY_M = 0.75
"""Objects that stand between the camera and the person, nearer to it by more than this (m), are not drawn."""
LOOKS = 12
"""Number of viewing directions drawn along the path."""
LINE_S = 10.0
"""Time (s) between lines about a video's progress, without a terminal."""
HEIGHT_COLORS = ((0.35, 0.45, 0.55), (0.80, 0.68, 0.45))
"""Colours (RGB) of points at the lowest and the highest height."""


@dataclass(frozen=True)
class _Actor:
    """A motion with the body surface that shows it."""

    label: str
    motion: Motion
    body: BodyModel
    color: Float[np.ndarray, "3"]
    ground: Ground
    environment: Environment | None = None
    """Objects that are drawn at the poses of the motion's `object_motion`."""

    def meshes(self, frame: int) -> list[Mesh]:
        """Body, marks of feet in contact, contact points (without them: marks of hands in contact)."""
        T = self.motion.T_world_joint[frame]
        vertices = self.body.vertices(T).detach().numpy().astype(np.float32)
        color = vertex_colors(self.body, self.motion, frame, self.color).astype(np.float32)
        body = Mesh(vertices, self.body.faces.numpy().astype(np.int32), color, smooth=True)
        palms = tuple(f"{side}_palm" for side in HANDS)
        feet = self._marks(T, FOOT_PATCHES, self.motion.contact_prob, frame, 0.028, CONTACT_COLOR)
        if self.motion.body_contact_prob is None:
            touching = self._marks(T, palms, self.motion.hand_contact_prob, frame, 0.055, HOLD_COLOR)
        else:
            lit = lit_points(self._points, self.motion, frame)
            touching = [] if lit is None else [lit]
        return [body, *feet, *touching]

    def objects(self, frame: int) -> list[Mesh]:
        """Objects of the environment where the motion has them."""
        if self.environment is None:
            return []
        return posed_meshes(self.environment, self.motion.object_motion or {}, self.motion.timestamps[frame].item())

    def azimuths(self, frames: Sequence[int], distance: float) -> Float[np.ndarray, "frame"]:
        """Azimuths (rad) from which objects hide as little of the body as may be, over a sequence of frames."""
        if self.environment is None:
            return np.full(len(frames), VIEW_RAD)
        bodies = [self.motion.T_world_joint.t[frame].double().numpy() for frame in frames]
        return azimuths(bodies, [self.objects(frame) for frame in frames], VIEW_RAD, TILT, distance)

    @cached_property
    def _points(self) -> BodyModel:
        return contact_points(self.body)

    def _marks(
        self,
        T_world_joint: Rigid,
        sites: tuple[str, ...],
        prob: Tensor | None,
        frame: int,
        radius: float,
        color: Float[np.ndarray, "3"],
    ) -> list[Mesh]:
        """Balls at the sites that are in contact."""
        skeleton = self.motion.skeleton
        if prob is None or not set(sites) <= set(skeleton.sites):
            return []
        places = site_positions(skeleton, T_world_joint, sites).double().numpy()[(prob[frame] > 0.5).numpy()]
        if not len(places):
            return []
        size = np.full(len(places), radius)
        return [capsules(places, places, size, size, np.tile(color, (len(places), 1)), 8)]


def _actors(
    motions: dict[str, Motion], body: BodyModel | None = None, environment: Environment | None = None
) -> list[_Actor]:
    """One actor per motion, on the ground of the first, in sticks unless a body is given. Raises WearcapError for none."""
    if not motions:
        raise WearcapError("no motion to draw", expected="at least one")
    ground = Ground.of(next(iter(motions.values())))
    shown = []
    for (label, motion), color in zip(motions.items(), cycle(PALETTE)):
        suits = body and body.skeleton.joint_names == motion.skeleton.joint_names
        surface = body if body and suits else stick_body(motion.skeleton)
        shown.append(_Actor(label, motion, surface, color, ground, environment))
    return shown


def _looking(
    direction: Sequence[float], target: Float[np.ndarray, "3"], distance: float, size: tuple[int, int], focal: float
) -> tuple[Camera, Rigid]:
    """A camera of `size` (width, height) that looks in a direction of the world at a point from a distance (m)."""
    width, height = size
    forward = np.array(direction) / np.linalg.norm(direction)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward], 1)
    camera = Camera("pinhole", width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    return camera, Rigid(torch.from_numpy(R).float(), torch.from_numpy(target - distance * forward).float())


def _panel(
    actor: _Actor,
    frame: int,
    target: Float[np.ndarray, "3"],
    size: tuple[int, int],
    *,
    supersample: int = 2,
    distance: float = DISTANCE_M,
    azimuth: float = VIEW_RAD,
) -> UInt8[np.ndarray, "height width 3"]:
    """One actor at one frame, on a chequered floor, seen in the direction of an azimuth (rad)."""
    direction, focal = (math.cos(azimuth), math.sin(azimuth), TILT), 1.75 * min(size[1], size[0] * 1.3)
    camera, T_world_cam = _looking(direction, target, distance, size, focal)
    time = actor.motion.timestamps[frame].item()
    stage = actor.ground.mesh(target, time, TILES, RIM)
    below = (float(target[0]), float(target[1]), float(actor.ground.heights(target[None, :2], time)[0]))
    light = Light(to_light=(0.55, -0.35, 1.0), shadow_center=below, shadow_radius=1.6)
    objects = [_visible(mesh, camera, T_world_cam, distance - CUT_AWAY_M) for mesh in actor.objects(frame)]
    meshes = [*actor.meshes(frame), *(mesh for mesh in objects if mesh is not None), stage]
    return render(camera, T_world_cam, meshes, light=light, background=SKY, supersample=supersample).color


def _visible(mesh: Mesh, camera: Camera, T_world_cam: Rigid, nearest_m: float) -> Mesh | None:
    """The faces of a mesh that reach farther from the camera than a distance (m); None for a mesh outside the picture."""
    R, t = T_world_cam.R.double().numpy(), T_world_cam.t.double().numpy()
    in_cam = (mesh.vertices - t) @ R
    low, high = in_cam.min(0), in_cam.max(0)
    (x, y, depth), radius = (low + high) / 2, 0.5 * float(np.linalg.norm(high - low))
    wide, tall = camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)
    outside = max(abs(x) - wide * depth, abs(y) - tall * depth) > radius * (1 + max(wide, tall))
    faces = mesh.faces[in_cam[mesh.faces, 2].max(1) > nearest_m]
    if outside or not len(faces):
        return None
    if mesh.color.ndim == 2 and len(mesh.color) == len(mesh.faces):  # coloured by face
        return mesh if len(faces) == len(mesh.faces) else None
    return mesh if len(faces) == len(mesh.faces) else replace(mesh, faces=faces)


def contact_sheet(
    motions: dict[str, Motion],
    frames: Sequence[int] | None = None,
    *,
    columns: int = 6,
    size: tuple[int, int] = (200, 240),
    body: BodyModel | None = None,
    environment: Environment | None = None,
    distance: float = DISTANCE_M,
) -> UInt8[np.ndarray, "height width 3"]:
    """Frames of motions on a shared clock, one row per motion, with the camera following the first motion's root.

    `size` is a panel's (width, height). `frames` are the first motion's, the others' are the nearest in time; without
    them `shared_frames` chooses `columns`. With more frames than columns, the rows repeat below. Objects of an
    `environment` are drawn where each motion has them. Raises WearcapError for missing frames, and for
    motions that share no time.
    """
    shown = _actors(motions, body, environment)
    length = len(shown[0].motion)
    frames = shared_frames(motions, columns) if frames is None else list(frames)
    if not frames or max(frames) >= length or min(frames) < 0:
        raise WearcapError(f"frames {frames}", expected=f"some from 0 to {length - 1}")
    clocks = [actor.motion.timestamps.numpy() for actor in shown]
    bands = [frames[start : start + columns] for start in range(0, len(frames), columns)]
    width, height = size
    sheet = Image.new("RGB", (width * min(columns, len(frames)), height * len(shown) * len(bands)), "white")
    for band, chosen in enumerate(bands):
        for column, frame in enumerate(chosen):
            target, (azimuth,) = _focus(shown[0].motion, frame), shown[0].azimuths([frame], distance)
            for row, (actor, clock) in enumerate(zip(shown, clocks)):
                nearest = frame if row == 0 else int(np.abs(clock - clocks[0][frame]).argmin())
                image = _panel(actor, nearest, target, size, distance=distance, azimuth=azimuth)
                seconds = clock[nearest] - clocks[0][0]
                text = f"{actor.label}  {seconds:.2f} s" if column == 0 else f"{seconds:.2f} s"
                sheet.paste(captioned(image, text), (column * width, (band * len(shown) + row) * height))
    return np.asarray(sheet)


def _shared_time(motions: Iterable[Motion]) -> tuple[float, float]:
    """First and last time (s) that all motions share. Raises WearcapError if there is none."""
    clocks = [motion.timestamps for motion in motions]
    start, stop = max(clock[0].item() for clock in clocks), min(clock[-1].item() for clock in clocks)
    if stop < start:
        raise WearcapError("the motions share no time", expected="recordings of the same moments")
    return start, stop


def shared_frames(motions: dict[str, Motion], count: int) -> list[int]:
    """`count` frames of the first motion (or all, if it has fewer), spread over the time that all motions share."""
    start, stop = _shared_time(motions.values())
    clock = next(iter(motions.values())).timestamps.numpy()
    first = int(np.searchsorted(clock, start))
    last = max(int(np.searchsorted(clock, stop, side="right")) - 1, first)
    return np.linspace(first, last, min(count, last - first + 1)).round().astype(int).tolist()


def _focus(motion: Motion, frame: int) -> Float[np.ndarray, "3"]:
    """Target of the camera: a point slightly below the root (m)."""
    return motion.t_world_root[frame].double().numpy() - np.array([0.0, 0.0, 0.08])


def draw_head_path(recording: Recording, size: tuple[int, int] = (640, 520)) -> UInt8[np.ndarray, "height width 3"]:
    """Two panels of `size` (width, height). Raises WearcapError if there is no head path either."""
    if recording.head is None:
        raise WearcapError("nothing to draw", where=recording.name, expected="a motion, or a head's path")
    path = recording.head.t_world_device.double().numpy()
    points = np.zeros((0, 3)) if recording.points is None else recording.points.points_world.double().numpy()
    cloud = np.concatenate([path, points])
    low, high = np.quantile(cloud, 0.02, 0), np.quantile(cloud, 0.98, 0)
    centre, radius = (low + high) / 2, max(0.5 * float(np.linalg.norm(high - low)), 1.0)
    shades = by_height(points, low[2], high[2], HEIGHT_COLORS).astype(np.float32)
    splats = Splats(points.astype(np.float32), shades, 0.8)
    # The path is a tube, with short rods along the viewing directions.
    steps = path[:: max(1, len(path) // 300)]
    at = np.linspace(0, len(path) - 1, LOOKS).astype(int)
    ahead = recording.head.R_world_device[torch.from_numpy(at)][:, :, 0].double().numpy()
    start = np.concatenate([steps[:-1], path[at]])
    end = np.concatenate([steps[1:], path[at] + 0.12 * radius * ahead])
    thick = np.full(len(start), 0.006 * radius)
    colors = np.concatenate([np.tile(PATH_COLOR, (len(steps) - 1, 1)), np.tile(LOOK_COLOR, (LOOKS, 1))])
    tube = capsules(start, end, thick, thick, colors, 8)
    panels = []
    for caption, direction in (("from above", (0.02, 0.05, -1.0)), ("aside", (-0.6, 0.75, -0.35))):
        camera, T_world_cam = _looking(direction, centre, 2.4 * radius, size, 1.0 * size[1])
        frame = render(camera, T_world_cam, [tube], [splats], background=SKY)
        panels.append(np.asarray(captioned(frame.color, f"{recording.name}, {caption}")))
    return np.asarray(Image.fromarray(np.concatenate(panels, 1)))


def captioned(image: UInt8[np.ndarray, "height width 3"], text: str) -> Image.Image:
    """The picture with a line of text in its upper left corner."""
    picture = Image.fromarray(image)
    ImageDraw.Draw(picture).text((6, 4), text, fill=(50, 50, 55), font=ImageFont.load_default(size=13))
    return picture


def save_png(path: str | Path, image: UInt8[np.ndarray, "height width 3"]) -> None:
    """Write a PNG atomically."""
    with atomic_path(path) as temporary:
        Image.fromarray(image).save(temporary, format="PNG")


def save_sheet(path: str | Path, motions: dict[str, Motion]) -> None:
    """Write a contact sheet of motions, by their labels, as PNG."""
    save_png(path, contact_sheet(motions))


def write_video(
    path: str | Path,
    motions: dict[str, Motion],
    *,
    fps: float = 30.0,
    size: tuple[int, int] = (480, 400),
    body: BodyModel | None = None,
    environment: Environment | None = None,
    max_seconds: float = math.inf,
) -> None:
    """Write panels of `size` (width, height) side by side, one per motion, on their shared clock.

    The camera follows the first motion. Raises WearcapError when the motions share no time, or for odd sizes.
    """
    if fps <= 0:
        raise WearcapError(f"a video at {fps} fps", expected="a positive rate")
    shown = _actors(motions, body, environment)
    start, stop = _shared_time(motions.values())
    times = start + np.arange(int((min(stop, start + max_seconds) - start) * fps) + 1) / fps
    clocks = [actor.motion.timestamps.numpy() for actor in shown]
    keys = times[:: max(round(KEY_S * fps), 1)]
    turned = shown[0].azimuths([int(np.abs(clocks[0] - time).argmin()) for time in keys], DISTANCE_M)
    looks = dict(zip(times.tolist(), smoothed(turned, keys, times)))

    def drawn(time: float) -> UInt8[np.ndarray, "height width 3"]:
        frames = [int(np.abs(clock - time).argmin()) for clock in clocks]
        target = _focus(shown[0].motion, frames[0])
        look = {"supersample": 1, "azimuth": looks[time]}
        images = [_panel(actor, frame, target, size, **look) for actor, frame in zip(shown, frames)]
        return np.concatenate([np.asarray(captioned(image, actor.label)) for image, actor in zip(images, shown)], 1)

    pictures = _in_parallel(drawn, times.tolist())
    write_frames(path, _with_progress(pictures, len(times), f"video {Path(path).name}"), fps, crf=23)


def _with_progress(pictures: Iterator[np.ndarray], total: int, about: str) -> Iterator[np.ndarray]:
    """The pictures, with a bar on stderr or, where that is no terminal, a line every `LINE_S` seconds."""
    console, shown_at = Console(stderr=True), monotonic()
    bar = track(pictures, about, total, console=console, transient=True, disable=not console.is_terminal)
    for number, picture in enumerate(bar, 1):
        yield picture
        if not console.is_terminal and monotonic() - shown_at > LINE_S:
            print(f"{about}: {number} of {total} pictures", file=sys.stderr, flush=True)
            shown_at = monotonic()


def _in_parallel(draw: Callable[[float], np.ndarray], times: Iterable[float]) -> Iterator[np.ndarray]:
    """Pictures of all times in order, drawn by a thread per core (the renderer releases the GIL), few ahead of their use."""
    workers = os.cpu_count() or 1
    with ThreadPoolExecutor(workers) as pool:
        ahead: deque[Future[np.ndarray]] = deque()
        for time in times:
            ahead.append(pool.submit(draw, time))
            if len(ahead) > 2 * workers:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
