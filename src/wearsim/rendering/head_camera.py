"""The camera on a simulated wearer's head: its mount, its clock, the texture it sees, and its video with sound."""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.geometry import raster, rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.io.formats.video import video_encoder
from wearcap.recording.motion import Motion
from wearcap.recording.recording import CameraStream
from wearcap.sensors.simulated import smooth_noise
from wearsim.places.world import World
from wearsim.rendering.views import NEAR_M, Development, Scenery, render_view
from wearsim.sensors.slam import R_DEVICE_CAM

HEAD_CAMERA = Camera(
    "opencv", 1920, 1080, 871.80, 885.58, 961.54, 550.69, (-0.2546, 0.0804, 1.458e-4, -1.397e-5)
).scaled(960, 540)
"""The HPS data set's head camera at half its size."""
HEAD_CAMERA_TRUTH = "head_camera"
"""Entry of `Recording.object_motion` with the camera's true poses, on the camera's own clock."""
GLANCE_PX, GLANCE = (27, 48), (22.0, 22.0, 23.5, 13.0)
"""Height and width of the small image in which texture is measured; its focal lengths and middle (px)."""
SOUND_HZ = 48_000
WORD_EVERY_S, KNOCK_EVERY_S = 8.0, 120.0
"""Mean time between words and between knocks in the sound track."""
BLUR_STEP_PX, MOST_STEPS = 3.0, 5
"""Largest motion between the sub-frames that are averaged into a frame, and most sub-frames."""
GLARE = 0.03
"""Contrast during glare, when the image shows next to nothing."""


@dataclass(frozen=True)
class HeadCameraConfig:
    """Mount of the camera, and its clock."""

    camera_fps: float = 30.0
    clock_offset_s: float = 4.0
    """Largest offset of the camera's clock from the suit's, in either direction."""
    clock_drift_ms_per_h: tuple[float, float] = (87.0, 12.0)
    """Mean and deviation over recordings of the drift of the camera's clock."""
    mount_deg: float = 4.0
    mount_m: float = 0.008
    """Deviations of the camera's mount on the head from the nominal one."""

    def __post_init__(self):
        if self.camera_fps <= 0:
            raise WearcapError(f"{self.camera_fps} Hz of the camera", expected="more than 0")


def head_camera(
    motion: Motion, t_head_device: Float[Tensor, "3"], config: HeadCameraConfig, rng: np.random.Generator
) -> tuple[CameraStream, Trajectory, tuple[float, float]]:
    """The stream with its nominal mount, the true poses on its clock, and that clock's offset (s) and drift (ms/h)."""
    offset = float(rng.uniform(-1, 1)) * config.clock_offset_s
    drift = float(rng.normal(*config.clock_drift_ms_per_h))
    rate = 1 + drift / 3.6e6
    turn = np.deg2rad(config.mount_deg) * rng.standard_normal(3) / np.sqrt(3)
    R_mount = rotation.exp(torch.from_numpy(turn).float()) @ R_DEVICE_CAM
    t_mount = t_head_device + torch.from_numpy(config.mount_m * rng.standard_normal(3)).float()
    T_world_head = motion.joint("head")
    T_world_cam = T_world_head @ Rigid(R_mount, t_mount)[None]
    true = Trajectory(motion.timestamps, T_world_cam.R, T_world_cam.t)
    start, stop = motion.timestamps[0].item(), motion.timestamps[-1].item()
    first = start * rate + offset + float(rng.uniform(0.0, 1 / config.camera_fps))
    count = int((stop * rate + offset - first) * config.camera_fps)
    times = first + torch.arange(count, dtype=torch.float64) / config.camera_fps
    at = resample(true, ((times - offset) / rate).clamp(start, stop))
    stream = CameraStream(times, HEAD_CAMERA, R_DEVICE_CAM, torch.tensor([0.09, 0.0, 0.09]))
    return stream, Trajectory(times, at.R_world_body, at.t_world_body), (offset, drift)


def view_texture(world: World, path: Trajectory, every: int = 15) -> Float[Tensor, "time"]:
    """Texture in a camera's frames: the mean texture grade (features per m²) in view.

    Every n-th frame is looked at, those between are interpolated.
    """
    frames = np.arange(0, len(path.timestamps), every)
    grade = np.append(np.minimum(world.face_texture, 60.0), 3.0)  # the sky shows roofs and trees now and then
    seen = np.empty(len(frames))
    R, t = path.R_world_body.double().numpy(), path.t_world_body.double().numpy()
    for row, frame in enumerate(frames):
        nearness, index = raster.empty_buffers(*GLANCE_PX)
        vertices = (world.mesh.vertices - t[frame]) @ R[frame]
        raster.draw_pinhole(vertices, world.mesh.faces, *GLANCE, NEAR_M, nearness, index)
        seen[row] = grade[index].mean()
    return torch.from_numpy(np.interp(np.arange(len(path.timestamps)), frames, seen)).float()


@dataclass(frozen=True)
class Filming:
    """Settings of the head camera's video."""

    shutter_s: float = 1 / 120
    """Exposure time; 0: no motion blur."""
    noise: float = 3.0
    """Deviation in grey levels."""
    exposure: float = 0.12
    """Deviation of the automatic exposure, as a share, over some seconds."""
    vignetting: float = 0.3
    crf: int = 17
    """H.264's constant quality: lower is better."""
    glare_s: tuple[tuple[float, float], ...] = ()
    """Intervals (start, stop) on the camera's clock in which the image shows next to nothing."""


def film(
    scenery: Scenery, camera: Camera, path: Trajectory, times: torch.Tensor, filming: Filming, rng: np.random.Generator
):
    """Yields the frame (uint8 height width 3) of every time (s, on the clock of `path`, the camera's true poses)."""
    first, last = path.timestamps[0], path.timestamps[-1]
    fps = 1.0 / times.diff().median().item() if len(times) > 1 else 30.0
    exposure = 1 + filming.exposure * smooth_noise(rng, len(times), 1, 6.0, fps)[:, 0].clamp(-2, 2)
    for number, time in enumerate(times.tolist()):
        ends = resample(path, torch.tensor([time, time + filming.shutter_s]).double().clamp(first, last))
        turned = rotation.geodesic(ends.R_world_body[0], ends.R_world_body[1]).item()
        steps = min(MOST_STEPS, 1 + int(turned * camera.fx / BLUR_STEP_PX)) if filming.shutter_s else 1
        moments = torch.linspace(time, time + (filming.shutter_s if steps > 1 else 0.0), steps).double()
        poses = resample(path, moments.clamp(first, last))
        glared = any(start <= time < stop for start, stop in filming.glare_s)
        how = Development(exposure[number].item(), GLARE if glared else 1.0, filming.noise, filming.vignetting)
        yield render_view(scenery, camera, Rigid(poses.R_world_body, poses.t_world_body), how, rng)


def write_head_video(
    file: str | Path,
    scenery: Scenery,
    camera: Camera,
    path: Trajectory,
    times: torch.Tensor,
    filming: Filming,
    rng: np.random.Generator,
    claps_s: Sequence[float] = (),
) -> None:
    """Write an MP4 with one frame per time (evenly spaced), and the claps' sound (`claps_s` on the same clock).

    Raises WearcapError for odd picture sizes and fewer than two times.
    """
    if camera.width % 2 or camera.height % 2 or len(times) < 2:
        what = f"a video of {len(times)} frames of {camera.width}x{camera.height}"
        raise WearcapError(what, expected="even sizes, two frames or more")
    fps = 1.0 / times.diff().median().item()
    with atomic_path(file) as temporary, av.open(str(temporary), "w", format="mp4") as container:
        codec, options = video_encoder(filming.crf)
        stream = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1001), options=options)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, "yuv420p"
        sound = container.add_stream("aac", rate=SOUND_HZ, layout="mono")
        first, last = times[0].item(), times[-1].item()
        wave = sound_track(last - first + 0.1, [clap - first for clap in claps_s], rng)
        for start in range(0, len(wave), 1024):
            piece = av.AudioFrame.from_ndarray(wave[None, start : start + 1024].copy(), "fltp", "mono")
            piece.rate, piece.pts = SOUND_HZ, start
            container.mux(sound.encode(piece))
        container.mux(sound.encode(None))
        for picture in film(scenery, camera, path, times, filming, rng):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))


def sound_track(
    seconds: float, claps_s: Sequence[float], rng: np.random.Generator, steps_s: Sequence[float] = ()
) -> Float[np.ndarray, "sample"]:
    """What the head camera's microphone hears (48 kHz, -1…1), `claps_s` and footfalls `steps_s` from its first sample.

    A room with hum and noise, footfalls with a dull and a sharp part, rustling clothes, a voice now and then, knocks of
    other people's doing, and claps of some 10 ms with the room's reverberation.
    """
    count = int(seconds * SOUND_HZ)
    time = np.arange(count, dtype=np.float32) / SOUND_HZ
    wave = 0.002 * rng.standard_normal(count, np.float32) + 0.004 * np.sin(2 * np.pi * 100 * time)
    since = np.arange(int(0.4 * SOUND_HZ), dtype=np.float32) / SOUND_HZ

    def noise() -> np.ndarray:
        return rng.standard_normal(len(since), np.float32)

    for step in steps_s:
        heel = 0.05 * np.sin(2 * np.pi * 70 * since) * np.exp(-since / 0.04)
        _add(wave, step, float(rng.uniform(0.5, 1.5)) * (heel + 0.006 * np.exp(-since / 0.005) * noise()))
        _add(wave, step + 0.2, 0.004 * np.sin(np.pi * since / since[-1]) ** 2 * noise())
    for word in rng.uniform(0.0, seconds, rng.poisson(seconds / WORD_EVERY_S)):
        pitch = rng.uniform(100, 240)
        voiced = sum(np.sin(2 * np.pi * pitch * n * since) / n for n in (1, 2, 5, 8, 13))
        _add(wave, word, 0.06 * np.clip(since / 0.04, 0, 1) * np.clip((0.35 - since) / 0.1, 0, 1) * voiced)
        _add(wave, word + 0.3, 0.02 * np.sin(np.pi * np.clip(since / 0.2, 0, 1)) * noise())
    for knock in rng.uniform(0.0, seconds, rng.poisson(seconds / KNOCK_EVERY_S)):
        ringing = np.sin(2 * np.pi * 350 * since) + 0.4 * np.exp(-since / 0.003) * noise()
        _add(wave, knock, 0.1 * ringing * np.exp(-since / 0.02))
    for clap in claps_s:
        burst = np.exp(-since / 0.006) + 0.03 * np.exp(-since / 0.12) * (since > 0.01)
        _add(wave, clap, float(rng.uniform(0.2, 0.5)) * burst * noise())
    return wave.clip(-1, 1).astype(np.float32)


def _add(wave: np.ndarray, at_s: float, piece: np.ndarray) -> None:
    """Add a piece of sound to a track, from a time on and as far as the track reaches."""
    start = round(at_s * SOUND_HZ)
    if 0 <= start < len(wave):
        wave[start : start + len(piece)] += piece[: len(wave) - start]
