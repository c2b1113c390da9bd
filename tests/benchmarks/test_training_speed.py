"""What trainings are compared with: windows drawn one by one, other papers' loaders, generated data sets; and their clocks."""

import json
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.rivals.single_windows import windows as frozen
from benchmarks.rivals.single_windows.compose import compose_old, data_before, training_config
from benchmarks.rivals.single_windows.datamodule import WindowsModule
from benchmarks.rivals.window_loaders import Archive, ClipsInMemory, FilePerItem, encoded_clips, loader, raw_clips
from benchmarks.speed import training_losses
from benchmarks.speed.training_paths import EXPERIMENTS, Clock, Trained, config_of, samples, small_sets
from benchmarks.speed.training_sets import generated, sources_of, varied, write_set
from benchmarks.speed.training_whole_vs_before import BEFORE, _reached, as_before
from wearcap.geometry.rotation import matrix_from_quat_wxyz, matrix_from_rot6d
from wearcap.recording import RecordingStore
from wearcap.systems.hmd2.features import HeadFeatures

WINDOW = 60


@pytest.fixture(scope="module")
def datasets(tmp_path_factory):
    """A folder with a small generated data set, and the overrides of its training."""
    folder = tmp_path_factory.mktemp("sets")
    return folder, small_sets(folder)


def targets(part) -> list[str]:
    if isinstance(part, dict):
        return [part.get("_target_", ""), *(name for each in part.values() for name in targets(each))]
    return [name for each in part for name in targets(each)] if isinstance(part, list) else []


@pytest.mark.parametrize("experiment", [*EXPERIMENTS, "motion_autoencoder"])
def test_nothing_of_the_drawing_before_is_todays(experiment, monkeypatch):
    made = []
    monkeypatch.setattr("benchmarks.rivals.single_windows.compose.instantiate", lambda config, **_: made.append(config))
    monkeypatch.setattr("benchmarks.rivals.single_windows.compose._name_embeddings", lambda config: None)
    data_before(training_config(experiment, ["paths.run=run"]))
    theirs = {name for name in targets(made[0]) if name.startswith("wearcap.")}
    drawing = ("wearcap.data.", "training_windows")
    assert not {n for n in theirs if any(part in n for part in drawing) and "MotionFeatures" not in n}, theirs
    assert any(name.startswith("benchmarks.rivals.single_windows.") for name in targets(made[0]))


def test_a_window_before_is_a_part_of_its_recording(datasets):
    folder, given = datasets
    data, module = compose_old("motion_diffusion_head", [f"paths.datasets={folder}", "paths.run=run", *given])
    assert isinstance(data, WindowsModule)
    data.setup("fit")
    store = RecordingStore.open(folder / "simulated")
    train: Any = data.train
    windows: Any = data.val
    assert isinstance(windows, frozen.Windows)
    number, start, _ = windows.starts[-1].tolist()
    motion = store.load(windows.recordings[number][1]).motion
    assert motion is not None
    item: Any = windows[len(windows) - 1, 3]
    count = int(item.valid.sum())
    assert count > 100
    assert torch.equal(item.R_parent_joint[:count], motion.R_parent_joint[start : start + count])
    index, seed = samples(train, 5)
    batch = train.batch(index, seed)
    assert torch.equal(batch.noise[2], train[int(index[2]), int(seed[2])].noise)
    assert module.measure(batch)["loss"].isfinite()


def test_settings_before_keep_the_rest_of_a_config(datasets):
    config = config_of("echo", datasets[0])
    old = as_before("echo", config)
    assert old.trainer.precision == "bf16-mixed"
    assert (
        as_before("mocap_every", config_of("mocap_every", datasets[0])).trainer.precision == BEFORE["trainer.precision"]
    )
    head = config_of("motion_diffusion_head", datasets[0], "model.compile=true")
    assert as_before("motion_diffusion_head", head).model.compile is False
    assert head.model.compile is True
    assert old.optimizer.optimizer.lr == config.optimizer.optimizer.lr


def test_loaders_cut_what_was_recorded(tmp_path):
    write_set(tmp_path / "set", generated(sources_of(None), 30 / 3600, 5.0, 60.0))
    store, features = RecordingStore.open(tmp_path / "set"), HeadFeatures()
    clips, raw = encoded_clips([store], features, WINDOW), raw_clips([store], WINDOW)
    names = store.names("train")
    memory, files = ClipsInMemory(clips, WINDOW), FilePerItem(clips, tmp_path, WINDOW)
    archive = Archive(raw, tmp_path / "all.npz", WINDOW)
    for number, name in enumerate(names):
        motion = store.load(name).motion
        assert motion is not None
        local = motion.R_parent_joint[:, 1:].unfold(0, WINDOW, 1).movedim(-1, 1)  # joints in their parents' axes
        encoded = memory[number].motion * (memory.std + 1e-8) + memory.mean
        found = {
            "memory": matrix_from_rot6d(encoded[:, 6:].unflatten(-1, (-1, 6))),
            "file": matrix_from_rot6d(files[number].motion[:, 6:].unflatten(-1, (-1, 6))),
            "archive": matrix_from_quat_wxyz(archive[number]["body_quats"]),
        }
        for which, R in found.items():
            assert (local - R).abs().amax((1, 2, 3, 4)).min() < 1e-4, which
    batch = next(iter(loader(archive, 2, 0)))
    assert batch["T_world_cpf"].shape == (2, WINDOW, 7)
    step = batch["T_cpf_tm1_cpf_t"][0, 1:]
    R = matrix_from_quat_wxyz(batch["T_world_cpf"][0, :, :4])
    assert torch.allclose(R[:-1] @ matrix_from_quat_wxyz(step[:, :4]), R[1:], atol=1e-5)


def test_generated_recordings_have_their_size_and_differ():
    (source, *_) = sources_of(None)
    one, other = (varied(source, "r", 25.0, 30.0, seed) for seed in (4, 5))
    again = varied(source, "r", 25.0, 30.0, 4)
    motion, second = one.motion, other.motion
    assert motion is not None
    assert second is not None
    assert again.motion is not None
    assert len(motion) == 750
    assert motion.fps == pytest.approx(30.0)
    assert torch.equal(motion.R_parent_joint, again.motion.R_parent_joint)
    assert not torch.allclose(motion.R_parent_joint, second.R_parent_joint, atol=0.1)
    # Back and forth: no frame jumps, although the source is shorter than the recording.
    assert motion.joint("left_wrist").t.diff(dim=0).norm(dim=-1).max() < 0.5
    assert one.head is not None
    assert torch.allclose(one.head.T_world_head.t, motion.joint("head").t, atol=1e-5)


def test_clocks_find_equal_validation_and_waiting():
    clock = Clock()
    clock.ends, clock.validations = [1.0, 2.0, 4.0, 6.0], [(2, 3.0), (4, 1.0)]
    training = Trained(clock, [9.0, 0.5, 0.5, 0.25, 7.0])
    assert _reached(training, 2.0) == 4.0  # halfway between the validations at 2 s and at 6 s
    assert _reached(training, 5.0) == 2.0
    assert _reached(training, 0.5) is None
    assert training.waiting == pytest.approx(1.25 / 5.0)
    assert training.each_s == 2.0


def test_losses_of_equal_trainings_are_equal_and_others_stand_apart(datasets, capsys):
    random = np.random.default_rng(0)
    same = (random.normal(0, 1, (2, 8, 200)) + 5).tolist()
    apart = torch.tensor(training_losses._apart(*same))
    assert 0.85 < (apart.abs() < 2.4).float().mean() < 0.99
    shifted = (np.array(same[0]) + 3).tolist()
    assert min(training_losses._apart(shifted, same[1])) > 2
    folder, given = datasets
    settings = ["--experiments", "motion_diffusion_head", "--steps", "2", "--seeds", "1", "--datasets"]
    training_losses.main([*settings, str(folder), "--overrides", *given[:2]])
    row = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert row["experiment"] == "motion_diffusion_head"
    assert len(row["now"]["mean"]) == len(row["before"]["spread"]) == 1
    assert row["now"]["mean"] == pytest.approx(row["before"]["mean"], rel=0.3)
