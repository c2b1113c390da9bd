"""Training MocapEvery's estimator and its manifold: losses vanish for the truth, every experiment learns and runs."""

import json
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from torch import nn

from benchmarks.rivals import SEARCH
from benchmarks.rivals.last_pose import LastPoseEstimator
from benchmarks.tables import mocap_every
from wearcap.body.skeleton import xsens23
from wearcap.cli import capture, evaluate, train
from wearcap.cli.conf import compose
from wearcap.data.windows import Source, Windows
from wearcap.errors import WearcapError
from wearcap.io.formats.amass import read_amass
from wearcap.io.formats.motion_npz import read_motion
from wearcap.models.checkpoint import load_trained
from wearcap.models.layers import TransformerSize
from wearcap.systems.mocap_every.features import ENDS, WatchFeatures
from wearcap.systems.mocap_every.manifold import MotionManifold
from wearcap.systems.mocap_every.manifold_training import ManifoldTraining
from wearcap.systems.mocap_every.model import Estimate, MLPEstimator, TwoStageEstimator
from wearcap.systems.mocap_every.training import WatchRegression
from wearcap.systems.mocap_every.training_windows import WatchContent
from wearcap.systems.mocap_every.visual_cues import load_visual_cues
from wearcap.training.base import Optimization
from wearcap_testing import small_dataset

pytestmark = pytest.mark.usefixtures("few_statistics")

TRAININGS = mocap_every.TRAININGS
SIZE = TransformerSize(32, 1, 2, 32, 0.0)
SMALL = ["width=32", "layers=1", "heads=4", "feedforward=32"]
TWO_STAGE = [f"model.net.transformer.{row}" for row in SMALL]
OTHERS = {"agrol": SMALL[:2], "mlp": SMALL[:2], "avatarposer": SMALL}
"""Sizes of the networks that are no two-stage estimators, by the ends of their experiments' names."""
WEIGHTS = {
    "skate": 0.5,
    "root": 1.0,
    "rotation": 1.0,
    "position": 10.0,
    "mid": 5.0,
    "consistency": 2.0,
    "contact": 0.5,
    "foot_velocity": 0.2,
    "velocity": 1.0,
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return small_dataset(tmp_path_factory.mktemp("data")).root


def arguments(experiment: str, data: Path, run: Path, *more: str) -> list[str]:
    return [
        f"experiment={experiment}",
        f"data.sources.cmu.root={data}",
        "data.sources.simulated=null",
        "people@data.sources=none",
        f"data.val_sources.cmu.root={data}",
        "debug=fast",
        SEARCH,
        f"hydra.run.dir={run}",
        f"paths.outputs={run.parent}",
        "trainer.accelerator=cpu",
        "trainer.precision=32-true",
        "trainer.log_every_n_steps=1",
        "trainer.enable_progress_bar=false",
        "callbacks.progress=null",
        *more,
    ]


def batch(data: Path):
    windows = Windows([Source(str(data))], "train", content=WatchContent(), window=40, stride=10, fps=30.0, every=2)
    return windows.batch(torch.arange(16) % len(windows), torch.arange(16))


def system(net=None, **features) -> WatchRegression:
    estimated = WatchFeatures(**{"frame": "heading"} | features)
    make = net or (
        lambda **sizes: TwoStageEstimator(**sizes, window=40, transformer=SIZE, hidden=32, frames_per_token=2)
    )
    return WatchRegression(make, estimated, xsens23(), 30.0, WEIGHTS, Optimization(torch.optim.AdamW), end_weight=2.0)


class Oracle(nn.Module):
    """Returns what it was given."""

    window = 40

    def __init__(self, **sizes):
        super().__init__()
        self.output: Estimate | None = None

    def forward(self, features):
        return self.output


@pytest.mark.parametrize("features", [{}, {"frame": "own"}, {"frame": "head", "root": "window"}, {"frame": "world"}])
def test_the_truth_costs_nothing(data, features):
    windows, oracle = batch(data), system(Oracle, **features)
    _, true, canonical = oracle._inputs(windows)
    joints = oracle._joints(true, windows, canonical)[:, :, xsens23().indices(*ENDS)]
    ends = oracle.ends_from_world(joints, windows, canonical)
    sure = 40 * (2 * windows.foot_contact - 1)
    oracle.net.output = Estimate(true, sure, ends.flatten(-2))
    for name, term in oracle.terms(windows).items():
        assert term < 0.005, name  # the smoothing of norms at zero
    wrong = true.clone()
    wrong[..., 0] += 0.1
    oracle.net.output = Estimate(wrong, sure, ends.flatten(-2))
    terms = oracle.terms(windows)
    assert terms["root"] == pytest.approx(0.1, abs=0.01)
    assert terms["position"] == pytest.approx(0.1, abs=0.01)
    assert terms["consistency"] == pytest.approx(0.1, abs=0.01)
    assert terms["velocity"] < 0.1  # what is off by a constant in a head that turns


def test_both_stages_and_contacts_are_learned(data):
    torch.manual_seed(0)
    windows, learner = batch(data), system()
    learner.set_statistics(
        Windows([Source(str(data))], "train", content=WatchContent(), window=40, stride=10, fps=30.0, every=2), limit=20
    )
    terms = learner.terms(windows)
    sum(WEIGHTS[name] * term for name, term in terms.items()).backward()
    assert set(terms) == set(WEIGHTS)
    for name, parameter in learner.net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name


def test_contacts_come_before_the_body():
    """The paper's order: the predicted contacts change the predicted body."""
    torch.manual_seed(0)
    net = TwoStageEstimator(31, 141, 40, SIZE, 16).eval()
    features = torch.randn(2, 40, 31)
    before = net(features)
    with torch.no_grad():
        net.contact[-1].bias += 3.0
    after = net(features)
    assert not torch.allclose(before.motion, after.motion)
    torch.testing.assert_close(before.ends, after.ends)


def test_one_stage_predicts_no_ends():
    net = TwoStageEstimator(31, 141, 40, SIZE, 16, multi_stage=False)
    assert net(torch.randn(1, 40, 31)).ends is None


def test_the_last_pose_alone():
    output = LastPoseEstimator(27, 141, 40, 32, 1, 4, 32, 0.0)(torch.randn(3, 40, 27))
    assert output.motion.shape == (3, 1, 141)
    assert output.contact_logit.shape == (3, 1, 2)


def test_an_mlp_sees_the_whole_window_and_predicts_all_frames():
    net, features = MLPEstimator(27, 141, 40, 32, 2).eval(), torch.randn(3, 40, 27)
    output = net(features)
    assert output.motion.shape == (3, 40, 141)
    assert output.contact_logit.shape == (3, 40, 2)
    features[:, 39] += 1.0
    assert (net(features).motion - output.motion)[:, 0].abs().max() > 1e-5


def test_an_mlps_output_is_blended_over_time():
    """What shakes from frame to frame shakes less."""
    torch.manual_seed(0)
    net, plain = MLPEstimator(27, 141, 40, 32, 2, blend=7).eval(), MLPEstimator(27, 141, 40, 32, 2).eval()
    assert net.blend is not None
    plain.load_state_dict({name: value for name, value in net.state_dict().items() if not name.startswith("blend.")})
    features = torch.randn(3, 40, 27)
    shaking = [each(features).motion.diff(dim=1).norm() for each in (net, plain)]
    assert shaking[0] < 0.7 * shaking[1]


def test_the_papers_size():
    config = compose("train", ["experiment=full/mocap_every", "paths.run=none"])
    net = instantiate(config.model, _convert_="all").net
    assert net.embed.out_features == 640
    assert net.embed_ends.out_features == 640
    assert len(net.encoder.layers) == 4
    assert net.encoder.layers[0].self_attn.num_heads == 10
    assert net.body[0].out_features == 256


@pytest.mark.parametrize("changes", TRAININGS.values(), ids=TRAININGS)
def test_every_experiment_and_ablation_runs(changes, data, tmp_path):
    run = tmp_path / "run"
    other = OTHERS.get(changes[0].rpartition("_")[2])
    small = TWO_STAGE if other is None else [f"model.net.{row}" for row in other]
    train.main([*arguments("mocap_every", data, run, *small)[1:], *changes])
    trained, config = load_trained(run / "checkpoints" / "last.ckpt")
    assert isinstance(trained, WatchRegression)
    assert config["model"]["features"]["_target_"].endswith("WatchFeatures")


def test_prodigy_may_stand_in_a_checkpoint(data, tmp_path):
    run = tmp_path / "run"
    train.main(arguments("mocap_every", data, run, *TWO_STAGE, "optimizer=prodigy", "optimizer.optimizer.lr=1.0"))
    assert isinstance(load_trained(run / "checkpoints" / "last.ckpt")[0], WatchRegression)


def test_a_trained_estimator_is_evaluated_and_edits_by_cues(data, tmp_path):
    run, manifold = tmp_path / "run", tmp_path / "manifold"
    train.main(arguments("mocap_every", data, run, *TWO_STAGE))
    train.main(arguments("motion_manifold", data, manifold, "model.net.channels=8", "model.net.width=5"))
    found = tmp_path / "table.json"
    evaluate.main(
        [
            f"checkpoint={run}/checkpoints/last.ckpt",
            "pipeline=mocap_every",
            f"dataset={data}",
            "baselines=false",
            "seeds=[0]",
            f"output={found}",
            f"hydra.run.dir={tmp_path / 'evaluate'}",
        ]
    )
    scores = json.loads(found.read_text())["methods"]["wearcap"]
    assert {"r_mpjpe_cm", "mpjpe_cm", "mpjve_cm_s", "root_cm", "jitter_ratio", "right_hand_pe_cm"} <= set(scores)
    capture.main(
        [
            f"checkpoint={run}/checkpoints/last.ckpt",
            "pipeline=mocap_every",
            f"recording={data}/r4",
            "smpl=true",
            "video=false",
            "body=false",
            f"output={tmp_path / 'capture'}",
            f"hydra.run.dir={tmp_path / 'capture'}",
        ]
    )
    motion = read_motion(tmp_path / "capture" / "motion.npz")
    smpl = read_amass(tmp_path / "capture" / "motion_smplh.npz").motion
    assert motion.fps == pytest.approx(30.0)
    assert smpl is not None
    wrists = [m.joint("left_wrist").t - m.joint("left_elbow").t for m in (motion, smpl)]
    straight = [w / w.norm(dim=-1, keepdim=True) for w in wrists]
    assert (straight[0] * straight[1]).sum(-1).min() > 0.95
    assert (tmp_path / "capture" / "motion.bvh").is_file()
    assert load_visual_cues(str(manifold / "checkpoints" / "last.ckpt")).window == 80
    with pytest.raises(
        WearcapError, match="a checkpoint of WatchRegression|no MotionManifold|motion_manifold|MotionManifold"
    ):
        load_visual_cues(str(run / "checkpoints" / "last.ckpt"))


def manifold_system() -> ManifoldTraining:
    weights = {"contact": 0.2, "root": 1.0, "rotation": 2.0, "position": 10.0, "velocity": 0.5}
    return ManifoldTraining(
        lambda size: MotionManifold(size, 16, 5, 3), xsens23(), 30.0, weights, Optimization(torch.optim.AdamW)
    )


def test_the_manifold_keeps_time_and_learns(data):
    torch.manual_seed(0)
    windows, learner = batch(data), manifold_system()
    learner.set_statistics(
        Windows([Source(str(data))], "train", content=WatchContent(), window=40, stride=10, fps=30.0, every=2), limit=20
    )
    assert learner.net.size == 5 + 6 * 23
    optimizer, losses = torch.optim.AdamW(learner.parameters(), 3e-3), []
    for _ in range(30):
        terms = learner.terms(windows)
        loss = sum(weight * terms[name] for name, weight in learner.loss_weights.items())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.6 * losses[0]
    for frames in (8, 40, 80):
        motion = torch.randn(2, frames, learner.net.size)
        assert learner.net.encode(motion).shape == (2, 16, frames // 8)
        assert learner.net(motion).shape == motion.shape
