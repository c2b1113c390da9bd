"""The page for a browser, without a browser: what its folder holds, that its modules compute what the pipeline does, and what
they say to files of strangers."""

import base64
import hashlib
import io
import json
import re
import shutil
import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import short_walk
import wearcap
from wearcap.cli.conf import compose
from wearcap.cli.export import with_page_pipeline
from wearcap.errors import WearcapError
from wearcap.export import web
from wearcap.export.files import open_exported
from wearcap.export.web import LIBRARIES, PAGE, fetched_libraries, page_exports, require_libraries, write_page
from wearcap.io.devices.aria_mps import read_mps
from wearcap.reading import read
from wearcap.runtime.system import CaptureInput
from web_page import ROOT, answer, in_node, node_modules, poses_of, simulated, small_system, write


@pytest.fixture(scope="module")
def recording():
    return simulated()


@pytest.fixture(scope="module")
def system():
    return small_system()


@pytest.fixture(scope="module")
def page(system, recording, tmp_path_factory) -> Path:
    return write(system, tmp_path_factory.mktemp("web") / "page", recording)


def test_the_folder_holds_all_that_the_page_loads(page, recording):
    files = json.loads((page / "files.json").read_text())["files"]
    here = {path.relative_to(page).as_posix() for path in page.rglob("*") if path.is_file()}
    assert set(files) == here - {"files.json"}
    assert {"index.html", "network.onnx", "network.json", "sample.json", "sample.glb", "body.glb", "sw.js"} <= here
    for source in page.glob("*.js"):
        for name in re.findall(r"""(?:from|import) ["'](\.[^"']+)["']""", source.read_text()):
            assert (page / name).is_file(), f"{source.name} imports {name}"
    sample = json.loads((page / "sample.json").read_text())
    assert sample["truth"]
    assert set(sample["wrists"]) == {"left_wrist", "right_wrist"}
    assert len(sample["head"]["times"]) == len(recording.head.timestamps)


def test_the_page_names_no_other_host_and_allows_none(page):
    html = (page / "index.html").read_text()
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', html).group(1)
    allowed = {rule.split()[0]: rule.split()[1:] for rule in policy.split(";")}
    assert allowed["default-src"] == ["'none'"]
    assert set(allowed["connect-src"]) == {"'self'", "blob:", "data:"}
    inline = re.search(r'<script type="importmap">(.*?)</script>', html, re.DOTALL).group(1)
    digest = base64.b64encode(hashlib.sha256(inline.encode()).digest()).decode()
    assert f"'sha256-{digest}'" in allowed["script-src"]
    for source in [*page.glob("*.js"), *page.glob("*.html"), *page.glob("*.css")]:
        assert not re.search(r"https?://", source.read_text()), source.name
        assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(", source.read_text())


def test_the_page_s_own_code_stays_small():
    lines = sum(len(path.read_text().splitlines()) for path in PAGE.glob("*.js"))
    assert lines <= 1800


def test_a_window_s_graph_is_the_pipeline_s_window(system, recording, page):
    run = open_exported(page / "network.onnx")
    graph = page_exports(system).graphs["window"]
    inputs = dict(graph.inputs)
    R = recording.head.T_world_head.R[: system.window]
    inputs |= {"head_rotation": R[None].float(), "is_final": torch.arange(system.window)[None] < 5}
    with torch.inference_mode():
        eager = graph.module(**inputs)
    assert (run(**inputs) - eager).abs().max() < 1e-4
    unseen = inputs | {"seen": torch.zeros_like(inputs["seen"])}
    assert (run(**unseen) - run(**inputs)).abs().max() > 1e-3  # hands matter


@pytest.mark.parametrize("hands", [True, False])
def test_the_modules_capture_what_the_pipeline_captures(system, recording, page, hands):
    assert torch.equal(recording.motion.timestamps, recording.head.timestamps)
    captured = recording if hands else replace(recording, tracked={})
    motion = system.motions([CaptureInput(captured)], [0])[0]
    frames = answer(page, "capture", str(hands).lower())
    assert len(frames) == len(motion)
    times = torch.tensor([frame["time"] for frame in frames], dtype=torch.float64)
    assert (times - motion.timestamps).abs().max() < 1e-4
    joints = torch.tensor([frame["joints"] for frame in frames])
    assert (joints - motion.T_world_joint.t).norm(dim=-1).max() < 1e-3
    assert motion.contact_prob.std() > 0.05  # feet are held now and then


def test_noise_is_pytorch_s(page):
    random = torch.Generator().manual_seed(12)
    drawn = [torch.randn(10, 140, generator=random).flatten() for _ in range(2)]
    for ours, theirs in zip(answer(page, "noise", 12, 1400), drawn, strict=True):
        assert torch.allclose(torch.tensor(ours), theirs, atol=1e-5)


def headset(path: Path, convention: str, kind: str) -> Path:
    time, R, t = short_walk.walk()
    word = {"wrist": "wrist", "grip": "grip", "aim": "aim"}[kind]
    names = {"time": "time", "head": "HMD.{quantity}.{axis}"}
    names |= {side: f"{side}_{word}_{{quantity}}_{{axis}}" for side in ("left", "right")}
    poses = short_walk.headset_poses(time, R, t, convention, kind)
    return short_walk.headset_csv(path, time, poses, names)


def file_of(kind: str, folder: Path) -> Path:
    """A file of a walk by the name of its kind."""
    time, R, t = short_walk.walk()
    camera = R @ short_walk.CAMERA_IN_HEAD
    writers = {"tum": short_walk.tum, "euroc": short_walk.euroc}
    if kind in writers:
        return writers[kind](folder / f"walk_{kind}.csv", time, camera, t)
    if kind == "example":
        return ROOT / "examples/headset_walk.csv"
    return headset(folder / "log.csv", *kind.split("_"))


@pytest.mark.parametrize("kind", ["tum", "euroc", "example", "openxr_wrist", "openxr_aim", "unity_grip", "unity_wrist"])
def test_a_file_is_read_as_python_reads_it(kind, page, tmp_path):
    file = file_of(kind, tmp_path)
    found, expected = answer(page, "read", file), read(file)
    head = poses_of(found["head"])
    assert (head.t - expected.head.t_world_device).abs().max() < 1e-4
    assert (head.R - expected.head.R_world_device).abs().max() < 1e-4
    assert set(found["wrists"]) == set(expected.tracked)
    for joint, track in expected.tracked.items():
        wrist = poses_of(found["wrists"][joint])
        assert (wrist.t - track.t_world_body).abs().max() < 1e-4
        assert (wrist.R - track.R_world_body).abs().max() < 1e-4
    assert (found.get("floor") == 0) == (expected.floor is not None)


@pytest.mark.parametrize("gravity", ["0,0,-9.81", "0,-9.81,0"])
def test_aria_s_closed_loop_is_read_as_python_reads_it(gravity, page, tmp_path):
    time, R, t = short_walk.walk()
    file = short_walk.mps(tmp_path / "closed_loop_trajectory.csv", time, R @ short_walk.CAMERA_IN_HEAD, t)
    more = [f"{part}_velocity_{axis}_device" for part in ("device_linear", "angular") for axis in "xyz"]
    more += [*(f"gravity_{axis}_world" for axis in "xyz"), "quality_score"]
    head, *rows = file.read_text().splitlines()
    file.write_text("\n".join([",".join([head, *more]), *(f"{row},0,0,0,0,0,0,{gravity},1" for row in rows)]))
    found, expected = answer(page, "read", file), read_mps(tmp_path, fps=None).head
    head = poses_of(found["head"])
    assert (head.t - expected.t_world_device).abs().max() < 1e-4
    assert (head.R - expected.R_world_device).abs().max() < 1e-4


BAD = {
    "empty": b"",
    "bytes": bytes(range(256)) * 40,
    "words": b"once upon a time\nthere was\na head\nthat walked\n",
    "no times": b"head_pos_x,head_pos_y\n1,2\n3,4\n5,6\n",
    "no rotation": b"time,head_pos_x,head_pos_y,head_pos_z\n0,1,2,3\n1,1,2,3\n2,1,2,3\n",
    "half a json": b'{"head": {"times": [0, 1], "poses"',
    "json of another": b'{"a": [1, 2, 3]}',
    "json with texts": b'{"head": {"times": ["<img src=x onerror=alert(1)>", 1], "poses": [[1,2,3,0,0,0,1],[1,2,3,0,0,0,1]]}}',
    "times that fall": b"3 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n",
    "no quaternions": b"0 0 0 0 5 5 5 5\n0.1 0 0 0 5 5 5 5\n0.2 0 0 0 5 5 5 5\n0.3 0 0 0 5 5 5 5\n",
    "lying": "\n".join(f"{k / 30} {k / 90} 0 0 {np.sin(k)} 0 0 {np.cos(k)}" for k in range(90)).encode(),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_refused_in_a_line(name, page, tmp_path):
    file = tmp_path / "bad.csv"
    file.write_bytes(BAD[name])
    found = in_node(page, "read", file)
    assert found.returncode == 1, found.stdout[:200]
    lines = found.stderr.strip().splitlines()
    assert len(lines) == 1
    assert "undefined" not in lines[0]
    assert re.match(r"[A-Z].{10,160}$", lines[0]), lines[0]


def test_other_systems_have_no_page():
    with pytest.raises(WearcapError, match="no page for mocap_every"):
        page_exports(wearcap.load("mocap_every_online"))


def test_several_steps_have_no_page():
    with pytest.raises(WearcapError, match="5 steps"):
        page_exports(small_system(steps=5))


def test_a_folder_with_other_files_stays(system, recording, tmp_path):
    (tmp_path / "thesis.tex").write_text("all of it")
    with pytest.raises(WearcapError, match="other files"):
        write_page(page_exports(system), tmp_path, recording, node_modules())
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_page_is_replaced_as_a_whole(system, recording, page, tmp_path):
    folder = tmp_path / "again"
    shutil.copytree(page, folder)
    (folder / "old.js").write_text("")
    write(system, folder, recording)
    assert not (folder / "old.js").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["again"]


def test_libraries_of_another_version_are_refused(tmp_path):
    with pytest.raises(WearcapError, match=r"no three/package\.json"):
        require_libraries(tmp_path)
    shutil.copytree(
        node_modules() / "three", tmp_path / "three", ignore=shutil.ignore_patterns("src", "fonts", "textures")
    )
    about = json.loads((tmp_path / "three/package.json").read_text())
    (tmp_path / "three/package.json").write_text(json.dumps(about | {"version": "0.1.0"}))
    with pytest.raises(WearcapError, match=r"three 0\.1\.0"):
        require_libraries(tmp_path)


def test_libraries_are_unpacked_from_verified_packages(tmp_path, monkeypatch):
    """From a folder of a machine without a network; nothing but the named files is taken."""
    entries, weights = {}, tmp_path / "weights"
    weights.mkdir()
    for package, names in LIBRARIES.items():
        archive = weights / f"{package}-1.2.3.tgz"
        with tarfile.open(archive, "w:gz") as tar:
            for name in ("package.json", *names, "../outside.js", "unneeded.js"):
                content = json.dumps({"version": "1.2.3", "of": name}).encode()
                about = tarfile.TarInfo(f"package/{name}")
                about.size = len(content)
                tar.addfile(about, io.BytesIO(content))
        digest = base64.b64encode(hashlib.sha512(archive.read_bytes()).digest()).decode()
        entries[package] = {
            "version": "1.2.3",
            "integrity": f"sha512-{digest}",
            "resolved": f"https://none.invalid/{package}",
        }
    monkeypatch.setattr(web, "locked", lambda: entries)
    monkeypatch.setenv("WEARCAP_WEIGHTS", str(weights))
    monkeypatch.setenv("WEARCAP_CACHE", str(tmp_path / "cache"))
    folder = fetched_libraries()
    require_libraries(folder)
    assert not list(tmp_path.rglob("outside.js"))
    assert not list(tmp_path.rglob("unneeded.js"))
    shutil.rmtree(folder)
    (weights / "three-1.2.3.tgz").write_bytes(b"another")
    with pytest.raises(WearcapError, match="another file"):
        fetched_libraries()


def test_the_command_takes_the_streaming_pipeline():
    assert with_page_pipeline(["checkpoint=hmd2", "format=web"])[0] == "pipeline=hmd2_online"
    assert with_page_pipeline(["checkpoint=hmd2"])[0] == "pipeline=hmd2"
    chosen = ["checkpoint=hmd2", "format=web", "pipeline=hmd2"]
    assert with_page_pipeline(chosen) == chosen
    assert compose("export", ["checkpoint=hmd2", "format=web"]).libraries is None
