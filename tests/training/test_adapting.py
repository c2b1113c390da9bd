"""A checkpoint adapted to one wearer: what is held out, what is refused, and that nothing worse is ever written."""

from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest
import torch

from mvnx_files import mvnx
from wearcap.body.skeletons import xsens23
from wearcap.cli import adapt, evaluate, train
from wearcap.cli.conf import compose
from wearcap.errors import WearcapError
from wearcap.io.conventions import DETECTED
from wearcap.recording import HeadStream, Motion, RecordingStore
from wearcap_testing import recording_of, small_dataset, swaying_motion

pytestmark = pytest.mark.usefixtures("few_statistics")
SMALL = [f"model.net.transformer.{name}" for name in ("width=32", "layers=1", "heads=4", "feedforward=32")]
QUIET = ["trainer.enable_progress_bar=false", "trainer.enable_model_summary=false", "callbacks.progress=null"]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> Path:
    """A run of two steps, on data that are not here any more."""
    root = tmp_path_factory.mktemp("runs")
    data = small_dataset(root / "data").root
    sizes = ["data.dataset.window=60", "trainer.max_steps=2", "optimizer.scheduler.total=8", "trainer.accelerator=cpu"]
    given = ["experiment=motion_diffusion_head", f"data.sources.simulated.root={data}", "debug=fast", *sizes]
    train.main([*given, *SMALL, *QUIET, "callbacks.capture=null", f"hydra.run.dir={root / 'run'}"])
    data.rename(root / "elsewhere")
    return root / "run" / "checkpoints" / "last.ckpt"


@pytest.fixture(scope="module")
def wearer(tmp_path_factory) -> Path:
    """Eight seconds of somebody in two recordings."""
    store = RecordingStore(tmp_path_factory.mktemp("wearer"))
    for name in ("a", "b"):
        store.add(recording_of(swaying_motion(240, 3), name), split="train", config_hash="")
    return store.root


def arguments(checkpoint: Path, wearer: Path, output: Path, *more: str) -> list[str]:
    quiet = [f"+train.{each}" for each in [*QUIET, "trainer.accelerator=cpu"]]
    small = ["least_s=5", "distances=[0.5,1.0]", "train.data.loading.steps_per_epoch=10", *quiet]
    return [f"checkpoint={checkpoint}", f"recordings={wearer}", f"output={output}", *small, *more]


def test_it_is_better_on_what_was_held_out_and_goes_on_where_it_was_killed(checkpoint, wearer, tmp_path, capsys):
    output = tmp_path / "me.safetensors"
    faster = ["steps=20", "train.optimizer.optimizer.lr=0.01", "train.optimizer.scheduler.warmup=1"]
    adapt.main(arguments(checkpoint, wearer, output, *faster))
    assert output.is_file()
    run = tmp_path / "me.safetensors.run"
    errors = {}
    for path in (checkpoint, output):
        given = [
            f"checkpoint={path}",
            f"dataset={run / 'wearer'}",
            "split=val",
            "seeds=[0]",
            "baselines=false",
            "jobs=1",
        ]
        scores = evaluate.run(compose("evaluate", [*given, f"output={tmp_path / 't.json'}", f"paths.run={tmp_path}"]))
        errors[path] = scores["wearcap"]["mpjpe_cm"].mean
    assert errors[output] < 0.9 * errors[checkpoint]
    before = output.read_bytes()
    capsys.readouterr()
    adapt.main(arguments(checkpoint, wearer, output, *faster))
    assert "going on from" in capsys.readouterr().out
    assert output.read_bytes() == before
    with pytest.raises(WearcapError, match="another config: .*lr"):
        adapt.main(arguments(checkpoint, wearer, output, "steps=20"))


def test_nothing_worse_is_written(checkpoint, wearer, tmp_path):
    output = tmp_path / "me.safetensors"
    with pytest.raises(WearcapError, match=r"nothing was gained on the held-out part .*nothing is written"):
        adapt.main(arguments(checkpoint, wearer, output, "steps=2", "train.optimizer.optimizer.lr=0.0"))
    assert not output.exists()


def test_the_last_part_is_held_out():
    recordings = [recording_of(swaying_motion(600), "a"), recording_of(swaying_motion(1200), "b")]
    learnt, held_out = adapt.parted(recordings, 0.4)
    assert [each.name for each in learnt] == ["a", "b"]
    first, last, whole = (cast(Motion, each.motion) for each in (learnt[1], held_out[0], recordings[1]))
    assert torch.equal(torch.cat([first.t_world_root, last.t_world_root]), whole.t_world_root)
    assert cast(HeadStream, held_out[0].head).timestamps[0] == last.timestamps[0] == pytest.approx(8.0, abs=0.1)
    learnt, held_out = adapt.parted([recording_of(swaying_motion(200, k), f"{k}") for k in range(4)], 0.25)
    assert (len(learnt), [each.name for each in held_out]) == (3, ["3"]), "short ones stay whole"


def test_a_suits_take_is_true_motion(tmp_path):
    path = tmp_path / "take.mvnx"
    path.write_text(mvnx(replace(swaying_motion(90), contact_prob=torch.ones(90, 4))))
    [found] = adapt.true_recordings(path, DETECTED)
    assert found.head is not None
    assert found.motion is not None
    assert found.motion.skeleton.joint_names == xsens23().joint_names
    assert (found.head.t_world_device - found.motion.joint("head").t).norm(dim=-1).max() < 0.2


def test_what_cannot_be_learnt_from_is_named(tmp_path):
    store = RecordingStore(tmp_path / "set")
    store.add(replace(recording_of(swaying_motion(60), "seen"), motion=None), split="train", config_hash="")
    with pytest.raises(WearcapError, match="'seen' has no true motion"):
        adapt.true_recordings(store.root, DETECTED)
    a, bones = recording_of(swaying_motion(60), "a"), xsens23()
    with pytest.raises(WearcapError, match="1 s of motion are too little"):
        adapt.require_one_wearer([a], 30, 0.05)
    taller = replace(bones, t_parent_joint=1.1 * bones.t_parent_joint)
    b = recording_of(swaying_motion(60, skeleton=taller), "b")
    with pytest.raises(WearcapError, match="several people's skeletons: .* in a; .* in b"):
        adapt.require_one_wearer([a, b], 1, 0.05)


@pytest.mark.parametrize(("name", "message"), [("contact_sequence", "is not adapted to wearers"), ("nobody", "no such checkpoint")])  # fmt: skip
def test_other_checkpoints_are_refused(name, message, wearer, tmp_path):
    with pytest.raises(WearcapError, match=message):
        adapt.main(arguments(Path(name), wearer, tmp_path / "me.safetensors"))


def test_weights_lie_between_those_of_the_start_and_of_the_end():
    before = {"weight": torch.full((2, 2), 1.0), "count": torch.tensor([7])}
    after = {"weight": torch.full((2, 2), 3.0), "count": torch.tensor([9]), "new": torch.ones(3)}
    found = adapt.between(before, after, 0.25)
    assert found.keys() == {"weight"}, "counts, and what the start has not, stay those of the end"
    assert torch.equal(found["weight"], torch.full((2, 2), 1.5))
