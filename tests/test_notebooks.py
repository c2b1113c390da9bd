"""The notebooks of examples/ run from first to last cell, and lie in the repository without outputs."""

import json
import re
import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))


@pytest.fixture
def executed(tmp_path, monkeypatch):
    """A function that runs a notebook in a copy of examples/; returns the outputs of its cells, by their type, and its folder
    for outputs."""
    for module in ("ipykernel", "matplotlib"):
        pytest.importorskip(module, reason="notebooks need: pip install -e '.[notebooks]'")
    nbclient = pytest.importorskip("nbclient", reason="notebooks need: pip install -e '.[notebooks]'")
    import nbformat

    monkeypatch.setenv("PYTHONPATH", f"{ROOT / 'src'}:{ROOT}")
    monkeypatch.setenv("MPLCONFIGDIR", str(tmp_path / "matplotlib"))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    folder = tmp_path / "examples" / "notebooks"
    folder.mkdir(parents=True)
    shutil.copy(ROOT / "examples" / "headset_walk.csv", folder.parent)

    def run(name: str, **changed: int) -> tuple[dict[str, list[str]], Path]:
        notebook = nbformat.read(ROOT / "examples" / "notebooks" / f"{name}.ipynb", as_version=4)
        for variable, value in changed.items():
            cell = next(cell for cell in notebook.cells if re.search(rf"^{variable} = ", cell.source, re.MULTILINE))
            cell.source = re.sub(rf"^{variable} = \d+", f"{variable} = {value}", cell.source, flags=re.MULTILINE)
        nbclient.NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(folder)}}).execute()
        found: dict[str, list[str]] = {}
        for output in (output for cell in notebook.cells for output in cell.get("outputs", [])):
            for kind, content in output.get("data", {output.get("name"): output.get("text")}).items():
                found.setdefault(kind, []).append(content)
        return found, tmp_path / "outputs" / "notebooks"

    return run


@pytest.mark.slow
def test_a_recording_becomes_motion(executed):
    outputs, folder = executed("capture")
    text = "".join(outputs["stdout"])
    assert "15.0 s of a head, left_wrist and right_wrist" in text
    assert re.search(r"45\d frames at 30 Hz, 23 joints", text)
    assert "error" not in text
    assert len(outputs["image/png"]) == 2
    assert sum("<video " in html for html in outputs["text/html"]) == 1
    assert {path.suffix for path in folder.iterdir()} == {".npz", ".bvh", ".glb"}


@pytest.mark.slow
def test_a_network_is_trained_and_captures(executed):
    outputs, folder = executed("train", STEPS=10)
    text = "".join(outputs["stdout"])
    assert "6 written, 0 current, 0 failed" in text
    assert float(re.search(r"validation loss (\S+)", text)[1]) > 0
    (table,) = outputs["text/markdown"]
    assert re.findall(r"^\| (\w[\w ]*?) \|", table, re.MULTILINE) == [
        "method",
        "wearcap",
        "mean pose",
        "nearest window",
    ]
    errors = {label: float(cm) for label, cm in re.findall(r"(\w+): joints (\S+) cm off", text)}
    assert errors["shared"] < errors["trained"], "ten steps teach less than hours"
    assert sum("<video " in html for html in outputs["text/html"]) == 1
    assert (folder / "train" / "run" / "checkpoints" / "last.ckpt").is_file()


def test_the_recording_is_read_as_in_the_readme():
    readme = re.findall(r"headset_walk\.csv\", height=([\d.]+)", (ROOT / "README.md").read_text(encoding="utf-8"))
    notebook = json.loads((ROOT / "examples" / "notebooks" / "capture.ipynb").read_text(encoding="utf-8"))
    sources = "".join("".join(cell["source"]) for cell in notebook["cells"])
    assert re.findall(r"headset_walk\.csv\", height=([\d.]+)", sources) == readme
    assert readme


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_outputs_are_not_kept(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    assert len(cells) <= 16
    for cell in (cell for cell in cells if cell["cell_type"] == "code"):
        assert cell["outputs"] == []
        assert cell["execution_count"] is None
