"""The house's rules on the source: imports only point down, files and functions stay short."""

import ast
import re
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "wearcap"
ROOT = SOURCE.parents[1]
FLOORS = (
    ("errors", "version", "files", "locks", "extras", "fetch", "parallel", "workers", "boundary"),
    ("geometry",),
    ("body", "scene"),
    ("recording",),
    ("models", "diffusion", "sensors", "localization", "io"),
    ("optimize", "tracking", "data", "training", "metrics", "runtime"),
    ("systems", "wearsim"),
    ("evaluation", "export", "checks", "prepare", "reading"),
    ("apps",),
    ("cli", "data_prep"),
)
MAY_SIMULATE = ("wearsim", "data_prep", "cli")
"""Folders that may use the simulator; it stands beside the product and no part of a capture knows it."""
MAY_PREPARE = ("data_prep", "cli")
"""Folders that may use preparation, which `wearcap prepare` runs."""
LEVEL = {folder: level for level, floor in enumerate(FLOORS) for folder in floor}
LIGHTNING = {"lightning", "pytorch_lightning", "torchmetrics"}
HYDRA = {"hydra", "omegaconf"}
TRAINING = {"training", "calibration", "validation"} | {
    f"{name}_training" for name in ("egoview", "manifold", "object", "voxel_autoencoder")
}
"""Modules of a system that are LightningModules and callbacks."""
PRIVATE_WORDS = {
    "told",
    "said",
    "unsaid",
    "lane",
    "lanes",
    "hung",
    "beneath",
    "thing",
    "things",
    "belt",
    "robbed",
    "amend",
    "amended",
    "asked",
}
"""Of identifiers: condition, output, batch item, anchored, below, object, rolling schedule, dropped, correction instead."""
SIMULATOR = SOURCE.with_name("wearsim")
DATA_PREP = ROOT / "data_prep"
MODULES = sorted(path for house in (SOURCE, SIMULATOR, DATA_PREP) for path in house.rglob("*.py"))
MAX_FUNCTION, MAX_MODULE, MAX_ENTRY = 60, 600, 40


def folder_of(path: Path) -> str:
    for house in (SIMULATOR, DATA_PREP):
        if path.is_relative_to(house):
            return house.name
    relative = path.relative_to(SOURCE)
    return relative.parts[0] if len(relative.parts) > 1 else relative.stem


def imports(tree: ast.AST) -> list[tuple[str, int]]:
    """Dotted names of everything imported, with lines; relative imports are not used in this project."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: a relative import"
            found += [(f"{node.module}.{alias.name}", node.lineno) for alias in node.names]
    return found


def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def upward(folder: str, tree: ast.AST) -> list[str]:
    """Imports of this project that do not point down (a floor's folders may use each other)."""
    wrong = []
    for name, line in imports(tree):
        parts = name.split(".")
        if (parts[0] == "wearsim" and folder not in MAY_SIMULATE) or (
            parts[0] == "data_prep" and folder not in MAY_PREPARE
        ):
            wrong.append(f"line {line}: {name}")
        if parts == ["wearcap"]:
            wrong.append(f"line {line}: the package's face, which reaches up to cli")
        elif parts[0] == "wearcap":
            assert parts[1] in LEVEL, f"line {line}: {name} stands on no floor"
            if LEVEL[parts[1]] > LEVEL[folder]:
                wrong.append(f"line {line}: {name}")
    return wrong


def test_systems_do_not_use_each_other():
    """But for iReplica, which begins with HPS."""
    for path in (SOURCE / "systems").glob("*/**/*.py"):
        system = path.relative_to(SOURCE / "systems").parts[0]
        allowed = {system, "hps"} if system == "ireplica" else {system}
        for name, line in imports(parsed(path)):
            parts = name.split(".")
            assert parts[:2] != ["wearcap", "systems"] or parts[2] in allowed, f"{path}, line {line}: {name}"


def test_commands_know_no_system():
    """The verbs ask `runtime.system.System`; they import no system and name no system's class."""
    classes = {
        node.name
        for path in (SOURCE / "systems").rglob("pipeline.py")
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.ClassDef)
    }
    assert {"HPS", "HMD2", "Echo"} <= classes
    for path in (SOURCE / "cli").glob("*.py"):
        tree = parsed(path)
        assert not [name for name, _ in imports(tree) if name.startswith("wearcap.systems")], path
        named = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
        named |= {
            node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)
        }
        assert not named & classes, path


def trains(path: Path) -> bool:
    """Whether a module may know Lightning: `training/`, a DataModule, and what trains in a system's folder."""
    return folder_of(path) in ("training", "data", "cli") or (folder_of(path) == "systems" and path.stem in TRAINING)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_a_module_keeps_the_rules(path):
    tree, folder = parsed(path), folder_of(path)
    if folder != "__init__":
        assert folder in LEVEL, f"{folder} stands on no floor"
        assert not upward(folder, tree)
    for name, line in imports(tree):
        package = name.split(".")[0]
        assert package not in LIGHTNING or trains(path), f"line {line}: {name}"
        assert package not in HYDRA or folder == "cli", f"line {line}: {name}"
        assert name != "__future__.annotations", f"line {line}: it hides shapes from the checks"
    lines = len(path.read_text(encoding="utf-8").splitlines())
    assert lines <= MAX_MODULE, f"{lines} lines"
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = (node.end_lineno or 0) - node.lineno + 1
            assert length <= MAX_FUNCTION, f"{node.name} has {length} lines"


def test_folders_of_one_floor_do_not_use_each_other_in_a_circle():
    uses: dict[str, set[str]] = {}
    for path in MODULES:
        names = [name.split(".") for name, _ in imports(parsed(path))]
        used = {parts[1] for parts in names if parts[0] == "wearcap" and len(parts) > 1}
        used |= {parts[0] for parts in names if parts[0] in ("wearsim", "data_prep")} - {folder_of(path)}
        uses.setdefault(folder_of(path), set()).update(used & set(LEVEL) - {folder_of(path)})
    for folder in uses:
        reached, border = set(), {folder}
        while border:
            border = set().union(*(uses.get(name, set()) for name in border)) - reached
            reached |= border
        assert folder not in reached, f"{folder} uses itself through {sorted(reached)}"


def test_identifiers_are_the_fields_own():
    """Words that docs/conventions.md gives another word for are no names (SIMD lanes of the kernels are lanes)."""
    for path in MODULES:
        tree = parsed(path)
        names = [node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)]
        names += [node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)]
        names += [node.id for node in ast.walk(tree) if isinstance(node, ast.Name)]
        names += [node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
        words = {
            word for name in names for word in re.findall("[a-z]+", re.sub("([a-z])([A-Z])", r"\1_\2", name).lower())
        }
        wrong = words & PRIVATE_WORDS
        assert not wrong - ({"lane", "lanes"} if "kinematics" in path.stem else set()), f"{path}: {wrong}"


def test_a_lightning_module_stays_small():
    for path in (path for path in MODULES if trains(path)):
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.ClassDef) and any("LightningModule" in ast.unparse(b) for b in node.bases):
                assert (node.end_lineno or 0) - node.lineno < 200, f"{path.name}: {node.name}"


@pytest.mark.parametrize("name", ["train.py", "evaluate.py", "capture.py", "export.py"])
def test_entry_scripts_are_short_and_show_their_application(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    assert len(text.splitlines()) <= MAX_ENTRY
    assert f'@hydra.main(version_base="1.3", config_path="conf", config_name="{name[:-3]}")' in text


def test_nothing_unsafe_is_read():
    """No pickle, eval or unrestricted torch.load outside the one restricted unpickler."""
    for path in MODULES:
        if path.name == "pickles.py":
            continue
        tree = parsed(path)
        names = {name for name, _ in imports(tree)}
        assert not names & {"dill", "shelve", "marshal", "cloudpickle"}, path
        assert not {name for name in names if name.startswith("pickle.")} - {"pickle.UnpicklingError"}, path
        used = {ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        assert not used & {"pickle.load", "pickle.loads", "pickle.Unpickler", "pickle.dump", "pickle.dumps"}, path
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            function = ast.unparse(call.func)
            assert function not in ("eval", "exec", "yaml.load", "np.load", "numpy.load") or any(
                keyword.arg == "allow_pickle" and ast.unparse(keyword.value) == "False" for keyword in call.keywords
            ), f"{path}: {ast.unparse(call)}"
            if function == "torch.load":
                assert any(k.arg == "weights_only" and ast.unparse(k.value) == "True" for k in call.keywords), path


@pytest.mark.parametrize(
    ("folder", "line", "wrong"),
    [
        ("geometry", "from wearcap.body.skeleton import Skeleton", True),
        ("geometry", "import wearcap.cli.conf", True),
        ("training", "import wearcap", True),
        ("cli", "from wearcap.training.run import fit", False),
        ("data_prep", "from wearsim.places.world import World", False),
        ("cli", "from data_prep.shared.engine import prepare", False),
        ("evaluation", "from data_prep.shared.engine import prepare", True),
        ("data", "from wearsim.places.world import World", True),
        ("recording", "from wearcap.errors import WearcapError", False),
    ],
)
def test_the_scan_sees_upward_imports(folder, line, wrong):
    assert bool(upward(folder, ast.parse(line))) == wrong
