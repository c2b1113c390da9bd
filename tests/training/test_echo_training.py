"""Training ECHO: the truth costs nothing, objects count where there are some, every experiment runs, resumed as straight."""

import csv
import json
from functools import partial
from pathlib import Path

import pytest
import torch

from benchmarks.rivals import SEARCH
from benchmarks.tables import echo
from benchmarks.tables import echo_rows as rows
from carried_box import WINDOW, boxes, carried_dataset, carrying, small_features, small_net
from wearcap.body.skeleton import xsens23
from wearcap.cli import capture, evaluate, train
from wearcap.data.windows import Source, Windows
from wearcap.diffusion.levels import LevelMix
from wearcap.diffusion.schedule import CosineSchedule
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.motion_npz import read_motion
from wearcap.models.checkpoint import load_trained
from wearcap.models.layers import TransformerSize
from wearcap.recording import RecordingStore
from wearcap.systems.echo.features import HANDS, OBJECT_SIZE, EchoFeatures
from wearcap.systems.echo.model import EchoDenoiser
from wearcap.systems.echo.observations import ObjectReader
from wearcap.systems.echo.scores import score_echo
from wearcap.systems.echo.training import SLOPE, STANDING, EchoDiffusion
from wearcap.systems.echo.training_windows import EchoContent, EchoWindow
from wearcap.training import losses
from wearcap.training.base import Optimization
from wearcap_testing import experiments, small_dataset

pytestmark = pytest.mark.usefixtures("few_statistics")

RUNS = {name: (f"experiment={name}",) for name in experiments("echo")} | echo.TRAININGS
WEIGHTS = {
    "human": 1.0,
    "object": 1.0,
    "contact": 1.0,
    "object_vertices": 1.0,
    "joints": 2.0,
    "velocity": 0.1,
    "skate": 0.2,
    "held": 0.1,
    "foot_contact": 0.1,
}


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> str:
    return carried_dataset(tmp_path_factory.mktemp("carried"))


@pytest.fixture(scope="module")
def people(tmp_path_factory) -> str:
    return str(small_dataset(tmp_path_factory.mktemp("people"), (200,) * 6).root)


def dataset(features, *roots: str) -> Windows:
    sources = [Source(root) for root in roots]
    content = EchoContent(features, None)
    return Windows(sources, "train", content=content, window=WINDOW, stride=4, fps=features.fps, every=None)


def batch(features, *roots: str, count: int = 8) -> EchoWindow:
    windows = dataset(features, *roots)
    return windows.batch(torch.arange(count) * 5 % len(windows), torch.arange(count))


def learner(net=None, frame: str = "own", features: EchoFeatures | None = None, **changes) -> EchoDiffusion:
    features = features or small_features(frame)
    make = net or partial(EchoDenoiser, window=WINDOW, transformer=TransformerSize(32, 1, 2, 32, 0.0))
    given = {
        "loss_weights": WEIGHTS,
        "levels": LevelMix(0.25, 0.6, 0.15, ramp=(4, 16)),
        "optimization": Optimization(torch.optim.AdamW),
    }
    return EchoDiffusion(make, features, CosineSchedule(), xsens23(), **given | changes)


class Oracle(EchoDenoiser):
    """A network with a fixed output."""

    def forward(self, x_t, level, encoded, valid):
        return self.outputs


def oracle(frame: str = "own", **changes) -> EchoDiffusion:
    net = partial(Oracle, window=WINDOW, transformer=TransformerSize(32, 1, 2, 32, 0.0))
    return learner(net, features=small_features(frame, **changes))


def explicit_vertices(batch: EchoWindow, cloud: torch.Tensor, R, t) -> torch.Tensor:
    """Root of the mean square over all points of an object, point by point."""
    found = (R[:, :, None] @ cloud[None, None, :, :, None])[..., 0] + t[:, :, None]
    true = batch.T_world_object[:, :, None] @ cloud
    return ((found - true).square().sum(-1).mean(-1) + 1e-6).sqrt()


@pytest.mark.parametrize("frame", ["own", "window", "world"])
def test_the_truth_costs_nothing(data, people, frame):
    system = oracle(frame)
    windows = batch(system.features, data, people)
    at = system.features.canonical(windows.points)
    system.net.outputs = system.truth(windows, at)
    for name, term in system.terms(windows).items():
        if name not in ("skate", "foot_contact"):
            assert term < 0.005, name
        assert name != "foot_contact" or term < 0.03, "what is left at targets of ±1"
    wrong = system.net.outputs.clone()
    wrong[..., 2] += 0.1
    system.net.outputs = wrong
    terms = system.terms(windows)
    assert terms["joints"] == pytest.approx(0.1, abs=0.01)
    assert terms["object_vertices"] < 0.005
    assert terms["velocity"] < 1e-3


@pytest.mark.parametrize("frame", ["own", "window"])
def test_the_vertex_term_is_the_mean_over_the_points(data, frame):
    system = oracle(frame)
    windows = batch(system.features, data)
    cloud = ObjectReader(system.features, None)(boxes().objects[0]).cloud
    at = system.features.canonical(windows.points)
    outputs = system.truth(windows, at)
    turn = rotation.exp(0.7 * torch.randn(*windows.valid.shape, 3))
    R, t = turn @ windows.R_world_object, windows.t_world_object + 0.2 * torch.randn_like(windows.t_world_object)
    first = system.net.sizes[0]
    outputs[..., first : first + OBJECT_SIZE] = system.features.encode_object(type(at)(R, t), at)
    first = system.net.sizes[0]
    T = system.features.decode_object(outputs[..., first : first + OBJECT_SIZE], at)
    value = system.object_vertices(T, windows)
    torch.testing.assert_close(value, explicit_vertices(windows, cloud, R, t).mean(), atol=1e-4, rtol=1e-4)


def test_objects_that_are_not_there_count_for_nothing(data, people):
    torch.manual_seed(0)
    system = learner(partial(small_net_like))
    mixed = batch(system.features, data, people, count=12)
    none = ~mixed.has_object
    assert none.any()
    assert mixed.has_object.any()
    other = mixed._replace(
        R_world_object=torch.where(none[..., None, None], rotation.exp(torch.ones(3)), mixed.R_world_object),
        t_world_object=torch.where(none[..., None], 9.0, mixed.t_world_object),
        R_world_canonical=torch.where(none[..., None, None], rotation.exp(torch.ones(3)), mixed.R_world_canonical),
        t_world_canonical=torch.where(none[..., None], 9.0, mixed.t_world_canonical),
        object_code=torch.where(none[..., None], 5.0, mixed.object_code),
    )
    for name, term in system.terms(mixed).items():
        torch.testing.assert_close(system.terms(other)[name], term, msg=name)


def small_net_like(**_):
    return small_net(small_features())


def test_windows_draw_noise_for_every_channel(data):
    features = small_features()
    assert batch(features, data, count=1).noise.shape[-1] == sum(learner(features=features).net.sizes)


def test_absent_objects_are_noise_alone(data, people):
    system = learner()
    windows = batch(system.features, data, people, count=12)
    levels = system.levels(windows)
    assert (levels[..., 1][~windows.has_object] == 1).all()
    assert (levels[..., 1][windows.has_object] < 1).any()
    without = learner(contacts=False)
    assert (without.levels(windows)[..., 2] == 1).all()
    assert "contact" not in without.terms(windows)


def test_padding_counts_for_nothing(data):
    torch.manual_seed(0)
    system = learner(partial(small_net_like))
    windows = batch(system.features, data)
    short = windows.valid.clone()
    short[:, 10:] = False
    windows = windows._replace(valid=short)
    other = windows._replace(
        t_world_root=torch.where(short[..., None], windows.t_world_root, 7.0),
        t_world_object=torch.where(short[..., None], windows.t_world_object, -7.0),
        t_world_canonical=torch.where(short[..., None], windows.t_world_canonical, -7.0),
        contact=torch.where(short[..., None], windows.contact, 1.0),
    )
    for name, term in system.terms(windows).items():
        torch.testing.assert_close(system.terms(other)[name], term, msg=name)


def test_an_object_that_slips_in_the_hand_costs_what_moves_with_it_does_not(data):
    system = learner()
    windows = batch(system.features, data)
    time = torch.arange(windows.valid.shape[1])[:, None] / system.features.fps
    true, speed = windows.T_world_object, 0.3
    held = (windows.contact[..., HANDS["left_wrist"]] > 0).any(-1)
    assert 0.3 < held.float().mean() <= 1
    shifted = Rigid(true.R, true.t + speed * time * torch.tensor([0.0, 0.0, 1.0]))
    share = (held[:, 1:] & held[:, :-1]).float().mean()
    # The closed form of points that all move as one: the shift's velocity in the hand's own axes.
    assert system.held(true, windows) < 1e-5
    assert system.held(shifted, windows).item() > 0.5 * speed**2 * share.item()
    wrist = Rigid(windows.R_world_point[:, :, 1], windows.t_world_point[:, :, 1])
    rigid = wrist @ (wrist.inverse() @ true)[:, :1]
    assert system.held(rigid, windows) < 1e-4, "the box is carried: constant in the hand"
    none = windows._replace(contact=torch.zeros_like(windows.contact))
    assert system.held(shifted, none) == 0


def test_both_classes_of_foot_contact_count_alike():
    """Where the share is the data's, saying always one costs as much as saying always the other."""
    contact = (torch.arange(1000) < 1000 * STANDING).float()[None, :, None]
    valid = torch.ones(1, 1000)
    costs = [
        losses.balanced_cross_entropy(torch.full_like(contact, SLOPE * value), contact, STANDING, valid)
        for value in (-1.0, 1.0)
    ]
    assert costs[0].item() == pytest.approx(costs[1].item(), rel=0.01)
    right = losses.balanced_cross_entropy(SLOPE * (2 * contact - 1), contact, STANDING, valid)
    assert right < 0.05 * costs[0]
    assert losses.balanced_cross_entropy(SLOPE * (2 * contact - 1), contact, STANDING, 1 - valid) == 0


def test_alike_orientations_are_asked_for_where_no_clean_frame_shows_the_true_one(data):
    windows = batch(small_features(), data)
    half = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    windows = windows._replace(R_world_canonical=windows.R_world_object @ half)
    levels = torch.full((*windows.valid.shape, 3), 0.5)
    asked = EchoDiffusion.knowable(windows, levels)
    assert torch.equal(asked.R_world_object, windows.R_world_canonical)
    levels[::2, 3, 1] = 0.0
    asked = EchoDiffusion.knowable(windows, levels)
    assert torch.equal(asked.R_world_object[::2], windows.R_world_object[::2])
    assert torch.equal(asked.R_world_object[1::2], windows.R_world_canonical[1::2])
    levels[..., 1] = torch.where(windows.has_object, 0.5, 0.0)
    without = windows._replace(has_object=torch.zeros_like(windows.has_object))
    asked = EchoDiffusion.knowable(without, torch.zeros_like(levels))
    assert torch.equal(asked.R_world_object, windows.R_world_canonical), "what is not there shows nothing"


@pytest.mark.parametrize("frame", ["own", "window", "world"])
def test_every_term_is_finite_and_every_weight_is_learned(data, people, frame):
    torch.manual_seed(0)
    system = learner(features=small_features(frame))
    system.set_statistics(dataset(system.features, data, people), limit=100)
    terms = system.terms(batch(system.features, data, people))
    assert set(terms) == set(WEIGHTS)
    assert all(term.isfinite() for term in terms.values())
    sum(WEIGHTS[name] * term for name, term in terms.items()).backward()
    for name, parameter in system.net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name


def test_where_windows_move_vectors_share_one_scale(data):
    system = learner(frame="window")
    system.set_statistics(dataset(system.features, data), limit=100)
    mean, scale = system.net.motion_normalizer.mean, system.net.motion_normalizer.scale
    first = system.net.sizes[0]
    for part in (slice(0, 3), slice(3, 9), slice(first, first + 3), slice(first + 3, first + 9)):
        assert (mean[part] == 0).all()
        assert (scale[part] == scale[part][0]).all()
    assert (scale[first + OBJECT_SIZE :] == 1).all()


def test_windows_and_model_must_be_of_the_same_features(data):
    with pytest.raises(WearcapError, match="windows of other features"):
        learner(frame="world").set_statistics(dataset(small_features("own"), data), limit=100)


def test_one_batch_is_learned(data, people):
    torch.manual_seed(0)
    system = learner()
    system.set_statistics(dataset(system.features, data, people), limit=100)
    windows = batch(system.features, data, people, count=4)
    optimizer, losses = torch.optim.AdamW(system.parameters(), 5e-3), []
    for _ in range(50):
        loss = system.measure(windows)["loss"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.35 * losses[0]


def arguments(experiment: str, data: str, people: str, run: Path, *more: str) -> list[str]:
    return [
        f"experiment={experiment}",
        f"data.sources.objects.root={data}",
        f"data.val_sources.objects.root={data}",
        f"data.sources.cmu.root={people}",
        "data.sources.objects.weight=0.6",
        "data.sources.cmu.weight=0.3",
        "people@data.sources=none",
        "debug=fast",
        SEARCH,
        f"hydra.run.dir={run}",
        f"paths.outputs={run.parent}",
        f"data.dataset.window={WINDOW}",
        "data.dataset.content.encoder=null",
        "model.encoder=null",
        "features.shape_size=0",
        "model.net.transformer.width=32",
        "model.net.transformer.layers=1",
        "model.net.transformer.heads=4",
        "model.net.transformer.feedforward=32",
        "trainer.accelerator=cpu",
        "trainer.precision=32-true",
        "trainer.log_every_n_steps=1",
        "trainer.enable_progress_bar=false",
        "callbacks.progress=null",
        "logger.csv.flush_logs_every_n_steps=1",
        *more,
    ]


def losses_of(run: Path) -> dict[int, str]:
    with open(run / "metrics.csv") as file:
        return {int(row["step"]): row["train/loss"] for row in csv.DictReader(file) if row.get("train/loss")}


@pytest.mark.slow
@pytest.mark.parametrize("changes", RUNS.values(), ids=RUNS)
def test_every_experiment_and_ablation_runs(changes, data, people, tmp_path):
    given = arguments("echo", data, people, tmp_path / "run")[1:]
    train.main([*given, *changes, "trainer.max_steps=2"])
    system, _ = load_trained(tmp_path / "run" / "checkpoints" / "last.ckpt")
    assert isinstance(system, EchoDiffusion)
    assert not torch.equal(system.net.motion_normalizer.scale, torch.ones(sum(system.net.sizes)))
    with open(tmp_path / "run/metrics.csv") as file:
        captured = [row for row in csv.DictReader(file) if row.get("capture/v2v_cm")]
    baseline = "baseline/" in " ".join(changes)  # they leave that out
    assert bool(captured) != baseline, "ECHO captures validation recordings, with their objects, in training"
    assert bool(list((tmp_path / "run").glob("pictures/*.png"))) != baseline
    assert all(0 < float(row["capture/mpjpe_mm"]) < 5000 for row in captured)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bodiffusion_object", "bodiffusion", "egoallo_human", "agrol_human"])
def test_a_baseline_learns_in_a_few_steps_and_captures(name, data, people, tmp_path):
    run, captured = tmp_path / "run", name if name.startswith("bodiffusion") else "bodiffusion"
    small = ("trainer.max_steps=30", "data.loading.steps_per_epoch=30", "data.loading.batch_size=8")
    small += ("optimizer.scheduler.warmup=2", "optimizer.optimizer.lr=0.01")
    train.main(arguments(f"baseline/{name}", data, people, run, *small))
    losses = [float(loss) for loss in losses_of(run).values()]
    assert sum(losses[-5:]) < 0.9 * sum(losses[:5])
    method = rows.Method(
        name,
        f"{run}/checkpoints/last.ckpt",
        (f"pipeline=baseline/{captured}", f"pipeline.sampling.rewindow={WINDOW // 2}"),
    )
    (one,) = rows.captured(method, RecordingStore.open(data), ["c2"], [0], items=1)
    assert one.motion.R_parent_joint.isfinite().all()
    assert set(one.motion.object_motion or {}) == ({"box_1"} if name == "bodiffusion_object" else set())
    assert score_echo(one.motion, one.truth, "c2", 0).scores["mpjpe_mm"] < 1000


@pytest.mark.slow
def test_stopped_and_resumed_equals_straight_through(data, people, tmp_path):
    """Batches, noise, levels and dropout are functions of seed and step."""
    more = (
        "data.loading.steps_per_epoch=2",
        "model.net.transformer.dropout=0.3",
        "optimizer.scheduler.total=6",
        "optimizer.scheduler.warmup=1",
    )
    runs = {name: tmp_path / name / "run" for name in ("straight", "half", "resumed")}
    train.main(arguments("echo", data, people, runs["straight"], "trainer.max_steps=6", *more))
    train.main(arguments("echo", data, people, runs["half"], "trainer.max_steps=2", *more))
    resume = f"resume={runs['half']}/checkpoints/last.ckpt"
    train.main(arguments("echo", data, people, runs["resumed"], "trainer.max_steps=6", resume, *more))
    straight, after = losses_of(runs["straight"]), losses_of(runs["resumed"])
    assert min(after) == 2
    assert after == {step: loss for step, loss in straight.items() if step >= 2}


def test_with_the_encoder_it_trains_is_evaluated_and_captures(data, people, tmp_path):
    """The whole pipeline with the objects' shapes, as the configs have it."""
    run = tmp_path / "run"
    given = [
        row for row in arguments("echo", data, people, run) if "encoder=null" not in row and "shape_size" not in row
    ]
    train.main(given)
    checkpoint = run / "checkpoints" / "last.ckpt"
    assert load_trained(checkpoint)[0].features.shape_size == 256
    common = [f"checkpoint={checkpoint}", "pipeline=echo_online", "pipeline.sampling.context=12"]
    evaluate.main(
        [
            *common,
            f"dataset={data}",
            "baselines=false",
            "seeds=[0]",
            f"output={tmp_path}/table.json",
            f"hydra.run.dir={tmp_path}/e",
        ]
    )
    scores = json.loads((tmp_path / "table.json").read_text())["methods"]["wearcap"]
    assert {"mpjpe_mm", "v2v_cm", "center_cm", "rotation_deg", "touch_f1"} <= set(scores)
    capture.main(
        [
            *common,
            "pipeline.runtime=eager",
            f"recording={data}/c2",
            "video=false",
            "body=false",
            f"output={tmp_path}/c",
            f"hydra.run.dir={tmp_path}/c",
        ]
    )
    motion = read_motion(tmp_path / "c" / "motion.npz")
    assert len(motion) == len(carrying(2.0).motion)
    assert set(motion.object_motion) == {"box_1"}
