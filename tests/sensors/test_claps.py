"""Claps: found where they were planted, to a fraction of a sample; nothing else counts as one."""

from dataclasses import replace

import av
import numpy as np
import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.recording import CameraStream, ImuStream
from wearcap.sensors.claps import camera_claps, detect_claps, detect_claps_audio

ACROSS = np.array([0.0, 1.0, 0.2])


def pulse(time, at, height, width):
    """A Gaussian bump `width` seconds wide at half its height."""
    return height * np.exp(-4 * np.log(2) * ((time - at) / width) ** 2)


def arms(seconds, rate, claps, *, seed=0, height=(20.0, 60.0), width=0.025, swing=4.0, cadence=0.9):
    """Both wrists of a walker: swinging arms, footfalls in both, noise, and claps that push the hands apart."""
    rng = np.random.default_rng(seed)
    time = np.arange(int(seconds * rate)) / rate + rng.uniform(0, 1 / rate)
    both = np.zeros((2, len(time), 3))
    for side, sign in enumerate((1, -1)):
        both[side, :, 0] = sign * swing * np.sin(2 * np.pi * cadence * time)
        both[side] += 0.3 * rng.standard_normal((len(time), 3))
    for fall in np.arange(0.3, seconds, 1 / (2 * cadence)):
        both[..., 2] += pulse(time, fall, 2.0 * swing, 0.04)
    for clap in claps:
        push = pulse(time, clap, rng.uniform(*height), width)[:, None] * ACROSS / np.linalg.norm(ACROSS)
        both += np.stack([push, -push])
    return [stream(time, acc, joint) for acc, joint in zip(both, ("left_wrist", "right_wrist"))]


def stream(time, acc, joint="left_wrist"):
    return ImuStream(torch.from_numpy(time), joint, acc_world=torch.from_numpy(acc).float())


@pytest.mark.parametrize(("rate", "rms_s"), [(60.0, 0.0025), (100.0, 0.001), (240.0, 0.0005)])
def test_claps_are_found_below_a_sample(rate, rms_s):
    claps = np.random.default_rng(1).uniform(0.6, 0.9, 60).cumsum()
    found = detect_claps(*arms(60.0, rate, claps))
    inside = claps[claps < 59.5]
    assert len(found) == len(inside)
    assert np.sqrt(np.mean((found.numpy() - inside) ** 2)) < rms_s


@pytest.mark.parametrize(("swing", "cadence"), [(4.0, 0.9), (30.0, 1.4), (60.0, 2.5)])
def test_walking_running_and_shaking_arms_are_no_claps(swing, cadence):
    with pytest.raises(WearcapError, match="no clap found.*left_wrist and right_wrist|left_wrist.*no clap found"):
        detect_claps(*arms(60.0, 120.0, [], swing=swing, cadence=cadence))


def test_claps_while_running():
    claps = [10.0, 10.41, 10.8]
    found = detect_claps(*arms(20.0, 120.0, claps, swing=20.0, cadence=1.4, height=(40, 60)))
    np.testing.assert_allclose(found.numpy(), claps, atol=0.004)


def test_a_knock_of_one_hand_counts_with_one_wrist_only():
    left, right = arms(20.0, 120.0, [])
    time = left.timestamps.numpy()
    knock = stream(time, left.acc_world.numpy() + pulse(time, 7.0, 50.0, 0.02)[:, None] * ACROSS)
    np.testing.assert_allclose(detect_claps(knock).numpy(), [7.0], atol=0.002)
    with pytest.raises(WearcapError, match="no clap found"):
        detect_claps(knock, right)
    late = stream(time, right.acc_world.numpy() + pulse(time, 7.1, 50.0, 0.02)[:, None] * ACROSS, "right_wrist")
    with pytest.raises(WearcapError, match="no clap found"):
        detect_claps(knock, late)


def test_a_landing_pushes_both_hands_alike_and_is_no_clap():
    pair = arms(20.0, 120.0, [])
    time = pair[0].timestamps.numpy()
    landed = [
        replace(
            w,
            acc_world=w.acc_world
            + torch.from_numpy(pulse(time, 9.0, 45.0, 0.03))[:, None].float() * torch.tensor([0.1, 0.0, 1.0]),
        )
        for w in pair
    ]
    with pytest.raises(WearcapError, match="no clap found"):
        detect_claps(*landed)


def test_raw_sensors_with_and_without_orientation():
    claps = [3.0, 3.5, 12.0]
    plain = arms(20.0, 100.0, claps)
    turn = rotation.exp(torch.tensor([0.4, 1.0, -0.3])).expand(len(plain[0].timestamps), 3, 3)
    up = torch.tensor([0.0, 0.0, 9.81])
    raw = [
        ImuStream(w.timestamps, w.joint, R_world_imu=turn, acc_imu=(turn.mT @ (w.acc_world + up)[..., None])[..., 0])
        for w in plain
    ]
    np.testing.assert_allclose(detect_claps(*raw).numpy(), detect_claps(*plain).numpy(), atol=1e-3)
    bare = [replace(w, R_world_imu=None) for w in raw]
    np.testing.assert_allclose(detect_claps(*bare).numpy(), claps, atol=0.006)
    with pytest.raises(WearcapError, match="without acceleration"):
        detect_claps(replace(bare[0], acc_imu=None))


def sound(claps, rate=48_000, seconds=20.0, seed=0):
    """A room: hum, speech-like tones that swell, dull thuds, and claps of noise that die away in 15 ms."""
    rng = np.random.default_rng(seed)
    time = np.arange(int(seconds * rate)) / rate
    wave = 0.003 * rng.standard_normal(len(time)) + 0.02 * np.sin(2 * np.pi * 100 * time)
    since = np.arange(int(0.4 * rate)) / rate
    voice = sum(np.sin(2 * np.pi * f * since) / n for n, f in enumerate((220, 440, 1500, 3100), 1))
    voice = 0.1 * np.clip(since / 0.05, 0, 1) * voice
    thud = 0.5 * np.sin(2 * np.pi * 70 * since) * np.exp(-since / 0.05)
    for start in np.arange(0.8, seconds - 1.5, 1.7):
        add(wave, round(start * rate), voice)
        add(wave, round((start + 0.9) * rate), thud)
    for clap in claps:
        add(wave, int(np.ceil(clap * rate)), 0.4 * rng.standard_normal(len(since)) * np.exp(-since / 0.015))
    return torch.from_numpy(wave).float()


def add(wave, first, piece):
    wave[first : first + len(piece)] += piece[: len(wave) - first]


@pytest.mark.parametrize("rate", [22_050, 44_100, 48_000])
def test_claps_are_heard_to_a_millisecond(rate):
    claps = [2.0, 2.4503, 9.7777, 15.1234]
    np.testing.assert_allclose(detect_claps_audio(sound(claps, rate), rate).numpy(), claps, atol=0.001)


def test_hum_speech_and_thuds_are_no_claps():
    with pytest.raises(WearcapError, match="no clap found in 20.0 s"):
        detect_claps_audio(sound([]), 48_000.0)
    with pytest.raises(WearcapError, match="16000 or more"):
        detect_claps_audio(sound([2.0], 8_000), 8_000.0)


def test_a_sound_that_stays_is_no_clap():
    rng = np.random.default_rng(0)
    wave = np.where(np.arange(5 * 48_000) > 3 * 48_000, 0.2, 0.001) * rng.standard_normal(5 * 48_000)
    with pytest.raises(WearcapError, match="no clap found"):
        detect_claps_audio(torch.from_numpy(wave), 48_000.0)


def write_clip(path, waveform=None, rate=48_000):
    """A grey video of 3 s at 30 fps, with sound or without."""
    with av.open(str(path), "w") as container:
        video = container.add_stream("mpeg4", rate=30)
        video.width = video.height = 64
        video.pix_fmt = "yuv420p"
        audio = container.add_stream("pcm_s16le", rate=rate, layout="mono") if waveform is not None else None
        for _ in range(90):
            picture = av.VideoFrame.from_ndarray(np.full((64, 64, 3), 128, np.uint8), format="rgb24")
            container.mux(video.encode(picture))
        container.mux(video.encode(None))
        if audio is not None:
            samples = (waveform.numpy().clip(-1, 1) * 32767).astype(np.int16)[None]
            for first in range(0, samples.shape[1], 1024):
                frame = av.AudioFrame.from_ndarray(samples[:, first : first + 1024].copy(), "s16", "mono")
                frame.rate, frame.pts = rate, first
                container.mux(audio.encode(frame))
            container.mux(audio.encode(None))


def worn_camera(video):
    time = torch.arange(90, dtype=torch.float64) / 30 + 100.0
    return CameraStream(time, Camera.pinhole(64, 64, 60), torch.eye(3), torch.zeros(3), video=video)


def test_claps_of_a_video(tmp_path):
    write_clip(tmp_path / "head.mkv", sound([1.5, 2.1], seconds=3.0))
    found = camera_claps(worn_camera("head.mkv"), tmp_path)
    np.testing.assert_allclose(found.numpy(), [101.5, 102.1], atol=0.003)


def test_a_silent_video_takes_times_by_hand(tmp_path):
    write_clip(tmp_path / "head.mkv")
    with pytest.raises(WearcapError, match=r"head.mkv: this video has no sound.*by hand"):
        camera_claps(worn_camera("head.mkv"), tmp_path)
    assert camera_claps(worn_camera("head.mkv"), tmp_path, [2.0, 1.0]).tolist() == [101.0, 102.0]
    (tmp_path / "bad.mkv").write_bytes(b"nothing")
    with pytest.raises(WearcapError, match=r"bad.mkv: not a readable video"):
        camera_claps(worn_camera("bad.mkv"), tmp_path)
    with pytest.raises(WearcapError, match="no such video"):
        camera_claps(worn_camera("none.mkv"), tmp_path)
    with pytest.raises(WearcapError, match="without a video"):
        camera_claps(worn_camera(None), tmp_path)
