"""Every verb: a screen of help at once, and settings as `key=value` and as `--key value`."""

import subprocess
import sys

import pytest

from wearcap.cli import main as cli
from wearcap.cli import prepare
from wearcap.cli.conf import compose, readable, require_writable
from wearcap.cli.verbs import VERBS, Arguments, conf_dir, help_of, overrides, sources
from wearcap.errors import WearcapError

CONFIGS = [verb for verb in VERBS if (conf_dir() / f"{verb}.yaml").is_file()]
OWN = [verb for verb in VERBS if verb not in CONFIGS]


@pytest.mark.parametrize("arguments", [[verb] for verb in CONFIGS] + [["prepare", name] for name in sources()])
def test_a_config_verbs_help_is_one_screen(arguments):
    lines = help_of(arguments[0], arguments[1:]).splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 80
    assert "hydra" not in "".join(lines).lower()


@pytest.mark.parametrize(
    "arguments",
    [[], ["capture"], ["prepare", "cmu"], ["view"], ["render"], ["annotate"], ["doctor"], ["scene", "edit"]],
)
def test_help_imports_nothing_heavy(arguments):
    code = "import sys; from wearcap.cli.main import main\ntry: main(sys.argv[1:])\nfinally: "
    code += "assert not {'torch', 'hydra', 'numpy', 'rich'} & set(sys.modules)"
    ended = subprocess.run([sys.executable, "-c", code, *arguments, "--help"], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert max(map(len, ended.stdout.splitlines())) <= 80


@pytest.mark.parametrize("verb", CONFIGS)
def test_both_styles_are_the_same_overrides(verb):
    plain = ["seed=3", "test=true", "a.b=[1,2]", "x_y=-3", "device=cpu"]
    assert overrides(verb, plain) == plain
    assert overrides(verb, ["--seed", "3", "--test", "--a.b=[1,2]", "--x-y", "-3", "--device", "cpu"]) == plain
    assert overrides(verb, ["--cfg", "job", "-m", "seed=1,2"]) == ["--cfg", "job", "-m", "seed=1,2"]


@pytest.mark.parametrize(("verb", "key"), [("capture", "recording"), ("track", "source"), ("evaluate", "checkpoint")])
def test_the_first_word_needs_no_key(verb, key):
    assert overrides(verb, ["a walk (2).bvh", "--video", "false"]) == [f"{key}=a walk (2).bvh", "video=false"]


@pytest.mark.parametrize("path", ["a walk (2).bvh", "it's", "C:\\x\\(1).bvh", "vmc://:39540?wearer=a"])
def test_a_path_needs_no_quotes(path):
    assert compose("capture", [f"recording={path}"]).recording == path
    assert readable("seeds=[0,1") == "seeds=[0,1", "a list that does not end is an error"


@pytest.mark.parametrize("given", [["recording=d/r", "motion=[a,b]", "port=81", "no_sound=true"], ["d/r", "--motion", "a", "b", "--port", "81", "--no-sound"]])  # fmt: skip
def test_own_parsers_take_both_styles(given):
    parser = Arguments(prog="wearcap view")
    parser.add_argument("recording")
    parser.add_argument("--motion", nargs="+", action="extend", default=[])
    parser.add_argument("--port", type=int)
    parser.add_argument("--no-sound", action="store_true")
    options = parser.parse_args(given)
    assert (options.recording, options.motion, options.port, options.no_sound) == ("d/r", ["a", "b"], 81, True)
    for wrong, message in (
        ("prt=3", "Did you mean 'port'"),
        ("no_sound=yes", "no_sound=true"),
        ("--x", "unrecognized"),
    ):
        with pytest.raises(WearcapError, match=message):
            parser.parse_args(["d/r", wrong])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["capture", "recording=nope", "pipeline=recorded", "device=cuda:77"], "device=cuda:77"),
        (["capture", "recording=nope", "pipeline=recorded", "output=file/x"], "in the way"),
        (["capture", "nope"], "nope"),
        (["train", "trainer.accelerator=gpu"], "no GPU"),
        (["evaluate", "checkpoint=hmd2"], "dataset=DIR"),
        (["live", "recording=nope"], "nothing leaves"),
        (["prepare", "simulated", "preset=demo"], "preset=quick or preset=standard"),
        (["view", "recording=nope"], "nope"),
        (["annotate", "--recording", "nope"], "recording"),
    ],
)
def test_a_refused_command_is_one_line_and_leaves_nothing(arguments, message, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    if "gpu" in arguments[-1]:
        monkeypatch.setattr("torch.accelerator.is_available", lambda: False)
    (tmp_path / "file").touch()
    assert cli.run_verb(arguments[0], arguments[1:]) == cli.USER_ERROR
    lines = capfd.readouterr().err.strip().splitlines()
    assert message in lines[-1]
    assert len(lines) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_what_cannot_be_written_is_said_before(tmp_path):
    (tmp_path / "file").touch()
    require_writable(tmp_path / "new/deep/x.json", "output")
    for path in ("file", "file/x"):
        with pytest.raises(WearcapError, match=r"output=.* in the way"):
            require_writable(tmp_path / path, "output")
    with pytest.raises(WearcapError, match="in the way"):
        prepare.main(["simulated", "preset=quick", f"output={tmp_path / 'file'}"])
