"""Clap detection in the acceleration of the wrists and in a camera's sound track (thesis §4.3.4).

The thesis only states that claps are "detected in both modalities"; the detectors are ours.
"""

import itertools
from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np
import scipy
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.boundary.limits import Budget
from wearcap.errors import WearcapError
from wearcap.io.formats.video import decoded, open_container
from wearcap.recording.recording import CameraStream, ImuStream
from wearcap.sensors.clock import mutual_pairs
from wearcap.sensors.imu import GRAVITY

_MIN_ACC = 15.0
"""Smallest acceleration (m/s²) of a clap above its surroundings; palms stop with 20 to 60, of which a sensor's filter
takes some."""
_MAX_WIDTH_S = 0.05
"""Largest width at half height: a swinging arm takes longer."""
_TOGETHER_S = 0.05
"""Largest delay between the spikes of the two wrists."""
_MIN_CONTRAST = 6.0
"""Smallest ratio to the median of the surrounding second: no claps are detected during shaking."""
_MAX_ALIKE = 0.5
"""Largest cosine between the wrists' accelerations: clapping hands stop each other, a landing pushes both up."""
SOUND_BANDS_HZ = ((1000.0, 2000.0), (2000.0, 4000.0), (4000.0, 7500.0))
"""A clap is loud in all bands at once; a knock has lower frequencies, a whistle is in one band."""
_MIN_RISE_DB, _MAX_LENGTH_S = 15.0, 0.1
"""Least rise of a clap's sound above what is before it, and time after which it has decayed."""


def detect_claps(*wrists: ImuStream) -> Float64[Tensor, "clap"]:
    """Times (s, sensor clock, sub-sample precision) of claps in one or, more reliably, both wrists' acceleration.

    Streams come raw or in world axes, at 60 Hz or more; a suit's own pose gives them by `synthesize_imu(suit,
    joint, n=1)`. Raises WearcapError when there is no clap, and for streams without acceleration.
    """
    if len(wrists) not in (1, 2):
        raise WearcapError(f"{len(wrists)} inertial streams", expected="one wrist's or both wrists'")
    jerks = [_fast_part(wrist) for wrist in wrists]
    spikes = []
    for wrist, jerk in zip(wrists, jerks):
        # Times of single short peaks; the top lies where a Gaussian through three samples has it
        timestamps = wrist.timestamps.numpy()
        step, amount = _step(timestamps), np.linalg.norm(jerk, axis=1)
        peaks, _ = scipy.signal.find_peaks(amount, height=0.6 * _MIN_ACC, distance=max(round(0.1 / step), 1))
        peaks = peaks[(peaks > 0) & (peaks < len(amount) - 1)]
        width = scipy.signal.peak_widths(amount, peaks, rel_height=0.5)[0] * step
        window = 2 * round(0.5 / step) + 1
        around = scipy.ndimage.median_filter(amount, size=window, mode="nearest")[peaks]
        before, top, after = (np.log(np.maximum(amount[peaks + k], 0.3)) for k in (-1, 0, 1))
        curve = np.minimum(before - 2 * top + after, -1e-9)
        shift = np.clip(0.5 * (before - after) / curve, -0.5, 0.5)
        height = np.exp(top - 0.25 * (before - after) * shift)
        good = height >= np.maximum(_MIN_ACC, _MIN_CONTRAST * around)
        good &= width <= max(_MAX_WIDTH_S, 2.5 * step)
        peaks, shift = peaks[good], shift[good]
        spikes.append(np.interp(peaks + shift, np.arange(len(timestamps)), timestamps))
    times = spikes[0]
    if len(wrists) == 2:
        first, second = mutual_pairs(*spikes, _TOGETHER_S)
        times = (spikes[0][first] + spikes[1][second]) / 2
        if jerks[0].shape[1] == jerks[1].shape[1] == 3:
            clocks = [wrist.timestamps.numpy() for wrist in wrists]
            times = times[_alike(times, clocks, jerks) <= _MAX_ALIKE]
    if not len(times):
        where = " and ".join(wrist.joint for wrist in wrists)
        span = f"{wrists[0].timestamps[0]:.1f} s to {wrists[0].timestamps[-1]:.1f} s"
        raise WearcapError(
            f"no clap found between {span}",
            where=f"acceleration of {where}",
            expected=f"a spike of 20 to 60 m/s² within {_MAX_WIDTH_S * 1000:.0f} ms"
            + (" in both wrists" if len(wrists) == 2 else ""),
            fix="Give the times of the claps by hand.",
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


def _alike(times: np.ndarray, clocks: list[np.ndarray], jerks: list[np.ndarray]) -> np.ndarray:
    """Cosine between the two wrists' fast accelerations over 50 ms around each time."""
    at = times[:, None] + np.linspace(-0.025, 0.025, 13)
    left, right = (
        np.stack([np.interp(at, clock, jerk[:, axis]) for axis in range(3)], -1) for clock, jerk in zip(clocks, jerks)
    )
    size = np.sqrt((left**2).sum((1, 2)) * (right**2).sum((1, 2)))
    return (left * right).sum((1, 2)) / np.maximum(size, 1e-12)


def detect_claps_audio(waveform: Float[Tensor, "sample"], rate: float) -> Float64[Tensor, "clap"]:
    """Times (s from the first sample) of short, broadband onsets of a sound track.

    In three bands from 1 to 7.5 kHz at once the sound must rise by `_MIN_RISE_DB` above the loudest of the 60 ms
    before (a millisecond's energy each), stand out from the two seconds around, and be 10 dB below its peak again
    after `_MAX_LENGTH_S`. Raises WearcapError when there is none.
    """
    if rate < 16_000:
        raise WearcapError(f"a sound track of {rate:.0f} samples per second", expected="16000 or more")
    sound = waveform.double().numpy()
    hop = round(rate / 1000)
    if len(sound) < 100 * hop:
        raise WearcapError(f"a sound track of {len(sound)} samples", expected="a second or more")
    levels = []
    for band in SOUND_BANDS_HZ:
        # The filter is causal, so that onsets are not smeared backwards.
        design = scipy.signal.butter(2, band, "bandpass", fs=rate, output="sos")
        filtered = np.asarray(scipy.signal.sosfilt(design, sound))[: len(sound) // hop * hop]
        levels.append(10 * np.log10((filtered**2).reshape(-1, hop).mean(1) + 1e-10))
    level = np.stack(levels)
    before = scipy.ndimage.maximum_filter1d(level, 60, axis=1, origin=29, mode="nearest")
    # A start may lie between two milliseconds: the last three before do not count.
    before = np.concatenate([before[:, :1].repeat(4, 1), before[:, :-4]], 1)
    around = scipy.ndimage.median_filter(level[:, ::20], size=(1, 101), mode="nearest").repeat(20, 1)
    rise = (level - np.maximum(before, around[:, : level.shape[1]])).min(0)
    onsets, _ = scipy.signal.find_peaks(rise, height=_MIN_RISE_DB, distance=80)
    total = 10 * np.log10((10 ** (level / 10)).sum(0))
    peak = scipy.ndimage.maximum_filter1d(total, 20, origin=-10)[onsets]
    later = scipy.ndimage.median_filter(total, 21, mode="nearest")
    onsets = onsets[later[(onsets + round(1000 * _MAX_LENGTH_S)).clip(max=len(total) - 1)] <= peak - 10]
    if not len(onsets):
        what = f"no clap found in {len(sound) / rate:.1f} s"
        expected = "a short sound with a sudden start, 1 to 7.5 kHz"
        raise WearcapError(what, where="sound track", expected=expected, fix="Give the times of the claps by hand.")
    return torch.from_numpy(np.array([_start(sound, rate, i * hop, hop) for i in onsets.tolist()]))


def _start(sound: np.ndarray, rate: float, sample: int, hop: int) -> float:
    """Time (s) at which the sound near `sample` first reaches a quarter of its peak."""
    first = max(sample - 5 * hop, 0)
    piece = np.abs(np.diff(sound[first : sample + 4 * hop]))
    return (first + int((piece > 0.25 * piece.max()).argmax())) / rate


def camera_claps(
    camera: CameraStream, folder: str | Path, given_s: Sequence[float] | None = None
) -> Float64[Tensor, "clap"]:
    """Times of claps on a camera's clock: from its video's sound, or as given by the user.

    `given_s` counts seconds from the video's first picture, for silent videos; `folder` is the data set's. Raises
    WearcapError when the camera has no video, and when that cannot be read, has no sound, or none with a clap.
    """
    start = camera.timestamps[0]
    if given_s is not None:
        return torch.tensor(sorted(given_s), dtype=torch.float64) + start
    if camera.video is None:
        raise WearcapError("a camera without a video", expected="a video with sound, or the times of the claps")
    video = Path(folder) / camera.video
    budget, pieces = Budget(video, "sound"), []
    with open_container(video) as container:
        if not container.streams.audio:
            raise WearcapError("this video has no sound", where=video, fix="Give the times of the claps by hand.")
        sound = container.streams.audio[0]
        both = (sound, *container.streams.video[:1])
        starts = [float((stream.start_time or 0) * (stream.time_base or 0)) for stream in both]
        mono = av.AudioResampler(format="flt", layout="mono")
        for frame in itertools.chain(decoded(container, sound, video), (None,)):
            for piece in mono.resample(frame):
                budget.spend(piece.samples * 4)
                pieces.append(piece.to_ndarray()[0])
        rate = float(sound.rate)
    if not pieces:
        raise WearcapError("the sound track of this video is empty", where=video)
    delay_s = starts[0] - starts[-1]  # of the first sample after the first picture
    return detect_claps_audio(torch.from_numpy(np.concatenate(pieces)), rate) + delay_s + start
