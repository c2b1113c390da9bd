"""Our image encoder: targets are where limbs are seen, mirrored alike, learned from pictures, resumed as if never stopped."""

import csv
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import torch

from wearcap.cli import train
from wearcap.data.windows import Source
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.models.checkpoint import read_checkpoint
from wearcap.models.image_encoder import EgoViewEncoder
from wearcap.recording import Motion, Recording, RecordingStore
from wearcap.recording.recording import CameraStream
from wearcap.systems.hmd2.egoview_frames import HANDS, POINTS, EgoFrames, half_mirrored, limb_points, relit, turned
from wearcap.systems.hmd2.egoview_training import view_scores
from wearcap_testing import recording_of, swaying_motion, window_of
from wearsim.sensors.slam import R_DEVICE_CAM

CAMERA = Camera.pinhole(96, 72, 85)
COLOURS = {"left": (230, 60, 40), "right": (40, 80, 230)}


def arms_before_the_body(frames: int, seed: int) -> Motion:
    """Both arms swing in front of the chest, now within sight of the head and now not."""
    motion = swaying_motion(frames, seed)
    R, time = torch.eye(3).repeat(frames, len(motion.skeleton), 1, 1), motion.timestamps.float()
    for side, sign in (("left", 1.0), ("right", -1.0)):
        phase = 3 * seed + sign
        turn = torch.stack(
            [0.9 * torch.sin(1.3 * time + phase), 0 * time, -sign * (0.6 + 1.0 * torch.sin(1.9 * time + phase))], -1
        )
        R[:, motion.skeleton.index(f"{side}_shoulder")] = rotation.exp(turn)
    return replace(motion, R_parent_joint=R)


def filmed(root: Path, name: str, seed: int, frames: int = 180) -> Recording:
    """A recording whose film shows a coloured square where each palm is, before a grey wall."""
    motion = arms_before_the_body(frames, seed)
    tilt = rotation.about_axis("y", torch.tensor(0.5))
    camera = CameraStream(
        motion.timestamps[::2], CAMERA, tilt @ R_DEVICE_CAM, torch.tensor([0.09, 0.0, 0.05]), video=f"videos/{name}.mp4"
    )
    points, visible = limb_points(motion, camera)
    pixels = CAMERA.project(points)[0].round().long()
    path = root / f"videos/{name}.mp4"
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "12", "preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = 96, 72, "yuv420p"
        for frame in range(len(points)):
            picture = np.full((72, 96, 3), 100 + 10 * seed, np.uint8)
            for name_, colour in zip(HANDS, COLOURS.values()):
                point = POINTS.index(name_)
                if visible[frame, point]:
                    x, y = pixels[frame, point].tolist()
                    picture[max(0, y - 6) : y + 7, max(0, x - 6) : x + 7] = colour
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
    return replace(recording_of(motion, name), camera=camera)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    store = RecordingStore(tmp_path_factory.mktemp("filmed"))
    for index, split in enumerate(["train", "train", "train", "train", "val"]):
        store.add(filmed(store.root, f"r{index}", index), split=split, config_hash="test")
    return store.root


def arguments(data: Path, run: Path, *more: str) -> list[str]:
    return [
        "experiment=egoview",
        f"data.sources.simulated.root={data}",
        "data.sources.cmu=null",
        f"hydra.run.dir={run}",
        f"paths.outputs={run.parent}",
        "data.dataset.every=2",
        "trainer.accelerator=cpu",
        "trainer.log_every_n_steps=1",
        "trainer.enable_progress_bar=false",
        "callbacks.progress=null",
        "logger.csv.flush_logs_every_n_steps=1",
        *more,
    ]


def logged(run: Path, name: str) -> dict[int, str]:
    with open(run / "metrics.csv") as file:
        return {int(row["step"]): row[name] for row in csv.DictReader(file) if row.get(name)}


def test_a_hand_is_where_the_picture_shows_it(data):
    frames = EgoFrames([Source(str(data))], "val", every=3)
    assert len(frames) == 30
    shown = 0
    for index in range(len(frames)):
        frame = window_of(frames, index)
        for name, colour in zip(HANDS, COLOURS.values()):
            point = POINTS.index(name)
            near = (frame.picture.float() - torch.tensor(colour)).norm(dim=-1) < 90
            if not frame.visible[point]:
                assert near.sum() < 20
                continue
            x, y = CAMERA.project(frame.point_cam[point])[0].tolist()
            if 8 < x < 87 and 8 < y < 63 and near.sum() > 100:
                rows, columns = near.nonzero().float().mean(0).tolist()
                assert abs(columns - x) < 2.5
                assert abs(rows - y) < 2.5
                shown += 1
    assert shown > 10


def test_frames_are_decoded_once(data):
    first = EgoFrames([Source(str(data))], "val", every=3).pictures[5]
    kept = sorted((data / "cache/ego_frames").glob("*.npy"))
    times = [path.stat().st_mtime_ns for path in kept]
    assert torch.equal(EgoFrames([Source(str(data))], "val", every=3).pictures[5], first)
    assert times == [path.stat().st_mtime_ns for path in kept]


def test_frames_with_hands_are_drawn_more_often(data):
    frames = EgoFrames([Source(str(data))], "train", every=3, hand_share=0.8)
    shown = frames.visible[:, [POINTS.index(name) for name in HANDS]].any(-1)
    assert 0.05 < shown.double().mean() < 0.75
    assert frames.weights[shown].sum() / frames.weights.sum() == pytest.approx(0.8)


def test_a_data_set_without_pictures_is_named(tmp_path):
    store = RecordingStore(tmp_path)
    store.add(recording_of(swaying_motion(60), "plain"), split="train", config_hash="test")
    with pytest.raises(WearcapError, match="camera=true"):
        EgoFrames([Source(str(tmp_path))], "train", every=1)


def test_mirror_images_swap_the_sides(data):
    frames = EgoFrames([Source(str(data))], "val", every=3)
    batch = frames.batch(torch.arange(30), torch.arange(30))
    pictures = batch.picture.movedim(-1, 1).float()
    torch.manual_seed(0)
    flipped_pictures, points, visible = half_mirrored(pictures, batch.point_cam, batch.visible)
    flipped = (points != batch.point_cam).flatten(1).any(1)
    assert 4 < flipped.sum() < 26
    assert torch.equal(flipped_pictures[flipped], pictures[flipped].flip(-1))
    left, right = (POINTS.index(name) for name in HANDS)
    before, after = CAMERA.project(batch.point_cam)[0], CAMERA.project(points)[0]
    torch.testing.assert_close(after[flipped, left, 0], 95 - before[flipped, right, 0], atol=1e-3, rtol=0)
    torch.testing.assert_close(after[flipped, left, 1], before[flipped, right, 1])
    assert torch.equal(visible[flipped, right], batch.visible[flipped, left])
    assert torch.equal(flipped_pictures[~flipped], pictures[~flipped])


def test_a_turned_camera_sees_points_where_its_picture_shows_them():
    lens = Camera("pinhole", 96, 72, 40.0, 38.0, 46.0, 36.5)
    pixels = torch.tensor([30.0, 40.0]) + torch.rand(64, 2, generator=torch.Generator().manual_seed(1)) * 30
    point = 0.7 * lens.unproject(pixels)[:, None]
    y, x = torch.meshgrid(torch.arange(72.0), torch.arange(96.0), indexing="ij")
    blob = torch.exp(-((torch.stack([x, y], -1) - pixels[:, None, None]) ** 2).sum(-1) / 8)
    torch.manual_seed(0)
    intrinsics = torch.tensor([lens.fx, lens.fy, lens.cx, lens.cy]).expand(64, 4)
    seen = torch.ones(64, 1, dtype=torch.bool)
    shown, moved, visible = turned(blob[:, None].repeat(1, 3, 1, 1), intrinsics, point, seen, 8.0)
    place, inside = lens.project(moved[:, 0])
    assert torch.equal(visible[:, 0], inside)
    torch.testing.assert_close(moved.norm(dim=-1), point.norm(dim=-1))
    assert (place - pixels).norm(dim=-1).mean() > 4
    well = ((place > 8) & (place < torch.tensor([87.0, 63.0]))).all(-1)
    weight = shown[well, 0] / shown[well, 0].sum((1, 2), keepdim=True)
    found = torch.stack([(weight * x).sum((1, 2)), (weight * y).sum((1, 2))], -1)
    assert well.sum() > 30
    torch.testing.assert_close(found, place[well], atol=0.6, rtol=0)


def test_other_light_keeps_the_picture_recognisable(data):
    frames = EgoFrames([Source(str(data))], "val", every=3)
    pictures = frames.pictures[:30].movedim(-1, 1) / 64 - 1.8
    torch.manual_seed(0)
    changed = relit(pictures)
    assert changed.isfinite().all()
    assert (changed - pictures).abs().mean() > 0.1
    both = torch.stack([pictures.mean(1).flatten(1), changed.mean(1).flatten(1)])
    centred = both - both.mean(-1, keepdim=True)
    alike = torch.cosine_similarity(centred[0], centred[1], dim=-1)
    assert alike[pictures.flatten(1).std(1) > 0.2].median() > 0.6


def test_scores_of_a_known_guess():
    visible = torch.zeros(4, len(POINTS), dtype=torch.bool)
    visible[:2, 0] = visible[:1, 1] = True
    truth = torch.zeros(4, len(POINTS), 3)
    guess, mean = truth + torch.tensor([0.03, 0.04, 0.0]), truth + torch.tensor([0.0, 0.0, 0.2])
    scores = view_scores(visible.float(), guess, mean, truth, visible)
    assert scores["hand_average_precision"] == pytest.approx(1.0)
    assert scores["hand_share"] == pytest.approx(3 / 8)
    assert scores["hand_error_cm"] == pytest.approx(5.0)
    assert scores["hand_error_cm_of_mean"] == pytest.approx(20.0)


@pytest.fixture(scope="module")
def learned(data, tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "run"
    train.main(
        arguments(
            data,
            run,
            "trainer.max_steps=40",
            "data.loading.steps_per_epoch=40",
            "data.loading.batch_size=32",
            "model.net.channels=[16,24,32]",
            "callbacks.average.decay=0.8",
            "optimizer.scheduler.warmup=5",
            "optimizer.optimizer.lr=0.005",
        )
    )
    return run


def test_hands_are_learned_from_pictures(learned):
    value = {
        name: float(next(iter(logged(learned, f"val/{name}").values())))
        for name in ("hand_average_precision", "hand_share", "hand_error_cm", "hand_error_cm_of_mean")
    }
    assert value["hand_average_precision"] > max(0.8, value["hand_share"] + 0.1)
    assert value["hand_error_cm"] < 0.8 * value["hand_error_cm_of_mean"]


def test_the_encoder_comes_out_of_the_checkpoint(learned, data):
    path = learned / "checkpoints/last.ckpt"
    encoder = EgoViewEncoder.load(path)
    state = read_checkpoint(path)[1]
    assert torch.equal(encoder.bottleneck.weight, state["net.bottleneck.weight"])
    frames = EgoFrames([Source(str(data))], "val", every=3)
    embedding = encoder.embed(frames.pictures[:30])
    assert embedding.std(0).mean() > 0.1  # it tells frames apart


def test_resumed_equals_straight_through(data, tmp_path):
    more = [
        "data.loading.steps_per_epoch=2",
        "data.loading.batch_size=4",
        "data.loading.val_windows=8",
        "optimizer.scheduler.total=6",
        "model.net.channels=[8,8,8]",
    ]
    straight, first, second = (tmp_path / name for name in ("straight", "first", "second"))
    train.main(arguments(data, straight, *more, "trainer.max_steps=6"))
    train.main(arguments(data, first, *more, "trainer.max_steps=4"))
    train.main(arguments(data, second, *more, "trainer.max_steps=6", f"resume={first}/checkpoints/last.ckpt"))
    for name in ("train/loss", "val/loss"):
        whole, rest = logged(straight, name), logged(second, name)
        assert rest
        assert rest == {step: value for step, value in whole.items() if step >= 4}
