"""Clap detection in the acceleration of the wrists and in a camera's sound track (thesis §4.3.4).

The thesis only states that claps are "detected in both modalities"; the detectors are ours.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
import scipy.ndimage
import scipy.signal
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.recording.recording import CameraStream, ImuStream
from wearcap.sensors.imu import GRAVITY


@dataclass(frozen=True)
class ClapSettings:
    """Thresholds for a spike of the wrists' acceleration to count as a clap."""

    min_acc: float = 15.0
    """m/s² above its surroundings; palms stop with 20 to 60, of which a sensor's filter takes some."""
    max_width_s: float = 0.05
    """Largest width at half height: a swinging arm takes longer."""
    together_s: float = 0.05
    """Largest delay between the spikes of the two wrists."""
    min_contrast: float = 6.0
    """Smallest ratio to the median of the surrounding second: no claps are detected during shaking."""
    max_alike: float = 0.5
    """Largest cosine between the wrists' accelerations: clapping hands stop each other, a landing pushes both up."""


CLAPS = ClapSettings()


def detect_claps(*wrists: ImuStream, settings: ClapSettings = CLAPS) -> Float64[Tensor, "clap"]:
    """Times (s, sensor clock, sub-sample precision) of claps in one or, more reliably, both wrists' acceleration.

    Streams come raw or in world axes, at 60 Hz or more; a suit's own pose gives them by `synthesize_imu(suit,
    joint, n=1)`. Raises WearcapError when there is no clap, and for streams without acceleration.
    """
    if len(wrists) not in (1, 2):
        raise WearcapError(f"{len(wrists)} inertial streams", expected="one wrist's or both wrists'")
    jerks = [_fast_part(wrist) for wrist in wrists]
    spikes = [_spikes(wrist.timestamps.numpy(), jerk, settings) for wrist, jerk in zip(wrists, jerks)]
    times = spikes[0]
    if len(wrists) == 2:
        first, second = _nearest_pairs(spikes[0], spikes[1], settings.together_s)
        times = (first + second) / 2
        if jerks[0].shape[1] == jerks[1].shape[1] == 3:
            clocks = [wrist.timestamps.numpy() for wrist in wrists]
            times = times[_alike(times, clocks, jerks) <= settings.max_alike]
    if not len(times):
        where = " and ".join(wrist.joint for wrist in wrists)
        span = f"{wrists[0].timestamps[0]:.1f} s to {wrists[0].timestamps[-1]:.1f} s"
        raise WearcapError(
            f"no clap found between {span}",
            where=f"acceleration of {where}",
            expected=f"a spike of 20 to 60 m/s² within {settings.max_width_s * 1000:.0f} ms"
            + (" in both wrists" if len(wrists) == 2 else ""),
            fix="Give the times of the claps by hand, or lower min_acc.",
        )
    return torch.from_numpy(times)


def _fast_part(wrist: ImuStream) -> np.ndarray:
    """Acceleration (time, 3) in world axes or, without orientation, its amount (time, 1), less its running median."""
    if len(wrist.timestamps) < 10:
        raise WearcapError(f"{len(wrist.timestamps)} samples", where=wrist.joint, expected="a second or more")
    if wrist.acc_world is not None:
        acc = wrist.acc_world.double()
    elif wrist.acc_imu is not None and wrist.R_world_imu is not None:
        acc = (wrist.R_world_imu @ wrist.acc_imu[..., None])[..., 0].double()
    elif wrist.acc_imu is not None:
        acc = wrist.acc_imu.double().norm(dim=-1, keepdim=True) - GRAVITY
    else:
        raise WearcapError("a stream without acceleration", where=wrist.joint, expected="acc_world or acc_imu")
    acc = acc.numpy()
    # A spike of 50 ms fills a third of the window and leaves its median alone.
    window = max(2 * round(0.075 / _step(wrist.timestamps.numpy())) + 1, 5)
    return acc - scipy.ndimage.median_filter(acc, size=(window, 1), mode="nearest")


def _step(timestamps: np.ndarray) -> float:
    return float(np.median(np.diff(timestamps)))


def _spikes(timestamps: np.ndarray, jerk: np.ndarray, settings: ClapSettings) -> np.ndarray:
    """Times of single short peaks; the top lies where a Gaussian through three samples has it."""
    step, amount = _step(timestamps), np.linalg.norm(jerk, axis=1)
    peaks, _ = scipy.signal.find_peaks(amount, height=0.6 * settings.min_acc, distance=max(round(0.1 / step), 1))
    peaks = peaks[(peaks > 0) & (peaks < len(amount) - 1)]
    width = scipy.signal.peak_widths(amount, peaks, rel_height=0.5)[0] * step
    window = 2 * round(0.5 / step) + 1
    around = scipy.ndimage.median_filter(amount, size=window, mode="nearest")[peaks]
    before, top, after = (np.log(np.maximum(amount[peaks + k], 0.3)) for k in (-1, 0, 1))
    curve = np.minimum(before - 2 * top + after, -1e-9)
    shift = np.clip(0.5 * (before - after) / curve, -0.5, 0.5)
    height = np.exp(top - 0.25 * (before - after) * shift)
    good = height >= np.maximum(settings.min_acc, settings.min_contrast * around)
    good &= width <= max(settings.max_width_s, 2.5 * step)
    peaks, shift = peaks[good], shift[good]
    return np.interp(peaks + shift, np.arange(len(timestamps)), timestamps)


def _nearest_pairs(a: np.ndarray, b: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Times of two lists that are each other's nearest and within reach."""
    if not len(a) or not len(b):
        return a[:0], b[:0]
    gap = np.abs(a[:, None] - b)
    to_b, to_a = gap.argmin(1), gap.argmin(0)
    mutual = (to_a[to_b] == np.arange(len(a))) & (gap.min(1) <= reach)
    return a[mutual], b[to_b[mutual]]


def _alike(times: np.ndarray, clocks: list[np.ndarray], jerks: list[np.ndarray]) -> np.ndarray:
    """Cosine between the two wrists' fast accelerations over 50 ms around each time."""
    at = times[:, None] + np.linspace(-0.025, 0.025, 13)
    left, right = (
        np.stack([np.interp(at, clock, jerk[:, axis]) for axis in range(3)], -1) for clock, jerk in zip(clocks, jerks)
    )
    size = np.sqrt((left**2).sum((1, 2)) * (right**2).sum((1, 2)))
    return (left * right).sum((1, 2)) / np.maximum(size, 1e-12)


SOUND_BANDS_HZ = ((1000.0, 2000.0), (2000.0, 4000.0), (4000.0, 7500.0))
"""A clap is loud in all bands at once; a knock has lower frequencies, a whistle is in one band."""


def detect_claps_audio(
    waveform: Float[Tensor, "sample"], rate: float, min_rise_db: float = 15.0, max_length_s: float = 0.1
) -> Float64[Tensor, "clap"]:
    """Times (s from the first sample) of short, broadband onsets of a sound track.

    In three bands from 1 to 7.5 kHz at once the sound must rise by `min_rise_db` above the loudest of the 60 ms
    before (a millisecond's energy each), stand out from the two seconds around, and be 10 dB below its peak again
    after `max_length_s`. Raises WearcapError when there is none.
    """
    if rate < 16_000:
        raise WearcapError(f"a sound track of {rate:.0f} samples per second", expected="16000 or more")
    sound = waveform.double().numpy()
    hop = round(rate / 1000)
    if len(sound) < 100 * hop:
        raise WearcapError(f"a sound track of {len(sound)} samples", expected="a second or more")
    level = np.stack([_level_db(sound, rate, band, hop) for band in SOUND_BANDS_HZ])
    before = scipy.ndimage.maximum_filter1d(level, 60, axis=1, origin=29, mode="nearest")
    # A start may lie between two milliseconds: the last three before do not count.
    before = np.concatenate([before[:, :1].repeat(4, 1), before[:, :-4]], 1)
    around = scipy.ndimage.median_filter(level[:, ::20], size=(1, 101), mode="nearest").repeat(20, 1)
    rise = (level - np.maximum(before, around[:, : level.shape[1]])).min(0)
    onsets, _ = scipy.signal.find_peaks(rise, height=min_rise_db, distance=80)
    total = 10 * np.log10((10 ** (level / 10)).sum(0))
    peak = scipy.ndimage.maximum_filter1d(total, 20, origin=-10)[onsets]
    later = scipy.ndimage.median_filter(total, 21, mode="nearest")
    onsets = onsets[later[(onsets + round(1000 * max_length_s)).clip(max=len(total) - 1)] <= peak - 10]
    if not len(onsets):
        raise WearcapError(
            f"no clap found in {len(sound) / rate:.1f} s",
            where="sound track",
            expected="a short sound with a sudden start, 1 to 7.5 kHz",
            fix="Give the times of the claps by hand.",
        )
    return torch.from_numpy(np.array([_start(sound, rate, i * hop, hop) for i in onsets.tolist()]))


def _level_db(sound: np.ndarray, rate: float, band: tuple[float, float], hop: int) -> np.ndarray:
    """Energy (dB) of each millisecond in a band, from a causal filter so that onsets are not smeared backwards."""
    design = scipy.signal.butter(2, band, "bandpass", fs=rate, output="sos")
    filtered = np.asarray(scipy.signal.sosfilt(design, sound))
    count = len(sound) // hop
    energy = (filtered[: count * hop] ** 2).reshape(count, hop).mean(1)
    return 10 * np.log10(energy + 1e-10)


def _start(sound: np.ndarray, rate: float, sample: int, hop: int) -> float:
    """Time (s) at which the sound near `sample` first reaches a quarter of its peak."""
    first = max(sample - 5 * hop, 0)
    piece = np.abs(np.diff(sound[first : sample + 4 * hop]))
    return (first + int((piece > 0.25 * piece.max()).argmax())) / rate


def read_audio(video: str | Path) -> tuple[Float[Tensor, "sample"], float, float]:
    """Sound of a video: mono waveform, samples per second, and the time (s) of its first sample after the first
    picture. Raises WearcapError when the file cannot be read or has no sound."""
    try:
        with av.open(str(video)) as container:
            if not container.streams.audio:
                raise WearcapError("this video has no sound", where=video, fix="Give the times of the claps by hand.")
            sound = container.streams.audio[0]
            starts = [_start_s(stream) for stream in (sound, *container.streams.video[:1])]
            mono = av.AudioResampler(format="flt", layout="mono")
            pieces = [
                piece.to_ndarray()[0] for frame in [*container.decode(sound), None] for piece in mono.resample(frame)
            ]
            rate = float(sound.rate)
    except (av.FFmpegError, OSError) as error:
        raise WearcapError(f"cannot be read as a video ({error})", where=video) from error
    if not pieces:
        raise WearcapError("the sound track of this video is empty", where=video)
    return torch.from_numpy(np.concatenate(pieces)), rate, starts[0] - starts[-1]


def _start_s(stream) -> float:
    return float((stream.start_time or 0) * stream.time_base)


def camera_claps(
    camera: CameraStream, folder: str | Path, given_s: Sequence[float] | None = None
) -> Float64[Tensor, "clap"]:
    """Times of claps on a camera's clock: from its video's sound, or as given by the user.

    `given_s` counts seconds from the video's first picture, for silent videos; `folder` is the data set's.
    """
    start = camera.timestamps[0]
    if given_s is not None:
        return torch.tensor(sorted(given_s), dtype=torch.float64) + start
    if camera.video is None:
        raise WearcapError("a camera without a video", expected="a video with sound, or the times of the claps")
    waveform, rate, delay = read_audio(Path(folder) / camera.video)
    return detect_claps_audio(waveform, rate) + delay + start
