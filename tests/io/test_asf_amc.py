"""ASF/AMC: forward kinematics against a plain reading of the documented formula, hostile files, fuzz."""

import gzip
import lzma

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hostile import fuzz, mutated
from wearcap.errors import WearcapError
from wearcap.io.formats.asf_amc import read_amc, read_asf
from wearcap.recording import Motion

ASF = """# comment
:version 1.10
:name TEST
:units
  mass 1.0
  length 0.45
  angle deg
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 0 0
   orientation 0 0 0
:bonedata
  begin
     id 1
     name lhipjoint
     direction 0.6 -0.8 0
     length 2.5
     axis 0 0 0 XYZ
  end
  begin
     id 2
     name lfemur
     direction 0.34202 -0.939693 0
     length 7.1
     axis 0 0 20 XYZ
     dof rx ry rz
     limits (-160.0 20.0)
            (-70.0 70.0)
            (-60.0 70.0)
  end
  begin
     id 3
     name ltibia
     direction 0.34202 -0.939693 0
     length 7.4
     axis 10 -5 20 XYZ
     dof rx
  end
  begin
     id 4
     name lfoot
     direction 0 0 1
     length 2.4
     axis -90 0 20 ZYX
     dof rz rx
  end
  begin
     id 5
     name lowerback
     direction 0 1 0
     length 2
     axis 0 30 0 XYZ
     dof rx ry rz
  end
:hierarchy
  begin
    root lhipjoint lowerback
    lhipjoint lfemur
    lfemur ltibia
    ltibia lfoot
  end
"""
DOF = {"root": 6, "lowerback": 3, "lfemur": 3, "ltibia": 1, "lfoot": 2}
UNIT_M = 0.0254 / 0.45


def amc_text(frames: int, seed: int = 0) -> str:
    values = np.random.default_rng(seed).normal(0, 30, (frames, sum(DOF.values())))
    lines = ["#!OML:ASF", ":FULLY-SPECIFIED", ":DEGREES"]
    for number, row in enumerate(values, 1):
        lines.append(str(number))
        for name, count in DOF.items():
            lines.append(" ".join([name, *(f"{v:.6g}" for v in row[:count])]))
            row = row[count:]
    return "\n".join(lines) + "\n"


def rotation(degrees, order: str) -> np.ndarray:
    """Plain numpy: the first letter of `order` acts first."""
    x, y, z = np.radians(degrees)
    axes = {
        "x": [[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]],
        "y": [[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]],
        "z": [[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]],
    }
    first, second, third = (np.array(axes[letter]) for letter in order.lower())
    return third @ second @ first


def plain_fk(asf_text: str, amc: str) -> tuple[list[dict], dict]:
    """Per frame: START position of every node in our axes (m), straight from the formula, frame by frame."""
    bones, parents, name = {}, {}, ""
    body, hierarchy = asf_text.split(":bonedata")[1].split(":hierarchy")
    for line in body.splitlines():
        words = line.split()
        if words[:1] == ["name"]:
            name = words[1]
            bones[name] = {"dof": []}
        elif words[:1] in (["direction"], ["length"]):
            bones[name][words[0]] = np.array(words[1:4], dtype=float)
        elif words[:1] == ["axis"]:
            bones[name] |= {"axis": np.array(words[1:4], dtype=float), "order": words[4]}
        elif words[:1] == ["dof"]:
            bones[name]["dof"] = words[1:]
    for line in hierarchy.splitlines():
        for child in line.split()[1:]:
            parents[child] = line.split()[0]
    frames = []
    for line in amc.splitlines():
        words = line.split()
        if line.startswith(("#", ":")):
            continue
        if len(words) == 1:
            frames.append({})
        else:
            frames[-1][words[0]] = [float(word) for word in words[1:]]
    starts = []
    for frame in frames:
        G = {"root": rotation(frame["root"][3:], "xyz")}
        end = {"root": np.array(frame["root"][:3])}
        start = {"root": end["root"]}
        todo = list(parents)
        while todo:
            name = todo.pop(0)
            if parents[name] not in G:
                todo.append(name)
                continue
            bone, degrees = bones[name], [0.0, 0.0, 0.0]
            for channel, value in zip(bone["dof"], frame.get(name, [])):
                degrees["xyz".index(channel[1])] = value
            C = rotation(bone["axis"], bone["order"])
            G[name] = G[parents[name]] @ C @ rotation(degrees, bone["order"]) @ C.T
            start[name] = end[parents[name]]
            end[name] = start[name] + G[name] @ bone["direction"] * bone["length"]
        x, y, z = 0, 1, 2
        turn = [z, x, y]
        starts.append(
            {name: UNIT_M * p[turn] for name, p in start.items()} | {"lfoot END": UNIT_M * end["lfoot"][turn]}
        )
    return starts, parents


def write(tmp_path, asf: str = ASF, amc: str | None = None):
    (tmp_path / "t.asf").write_text(asf)
    (tmp_path / "t.amc").write_text(amc_text(3) if amc is None else amc)
    return tmp_path / "t.asf", tmp_path / "t.amc"


def read(tmp_path, asf: str = ASF, amc: str | None = None) -> Motion:
    asf_path, amc_path = write(tmp_path, asf, amc)
    return read_amc(read_asf(asf_path), amc_path)


def test_forward_kinematics_equal_the_documented_formula(tmp_path):
    text = amc_text(7)
    motion = read(tmp_path, amc=text)
    starts, _ = plain_fk(ASF, text)
    for name in motion.skeleton.joint_names:
        expected = np.array([frame[name] for frame in starts])
        np.testing.assert_allclose(motion.joint(name).t.numpy(), expected, atol=2e-5)
    site = motion.skeleton.sites["lfoot_end"]
    end = (motion.joint("lfoot").R @ torch.tensor(site.t_joint_site)) + motion.joint("lfoot").t
    np.testing.assert_allclose(end.numpy(), np.array([frame["lfoot END"] for frame in starts]), atol=2e-5)
    assert motion.fps == pytest.approx(120)


@pytest.mark.parametrize(("suffix", "pack"), [(".xz", lzma.compress), (".gz", gzip.compress)])
def test_compressed_files_read_alike(tmp_path, suffix, pack):
    asf, amc = write(tmp_path)
    packed = amc.with_name(amc.name + suffix)
    packed.write_bytes(pack(amc.read_bytes()))
    a, b = read_amc(read_asf(asf), amc, fps=60), read_amc(read_asf(asf), packed, fps=60)
    assert torch.equal(a.R_parent_joint, b.R_parent_joint)
    assert b.fps == pytest.approx(60)
    packed.write_bytes(packed.read_bytes()[:-20])
    with pytest.raises(WearcapError, match="not a complete"):
        read_amc(read_asf(asf), packed)


def test_dropped_frames_show_in_the_timestamps(tmp_path):
    motion = read(tmp_path, amc=amc_text(3).replace("\n3\n", "\n5\n"))
    torch.testing.assert_close(motion.timestamps, torch.tensor([0, 1, 4], dtype=torch.float64) / 120)


AMC_FAULTS = {
    "empty": (lambda t: "", "empty"),
    "no frames": (lambda t: "#!OML:ASF\n:DEGREES\n", "lacks"),
    "radians": (lambda t: t.replace(":DEGREES", ":RADIANS"), "another unit"),
    "truncated": (lambda t: t[: int(len(t) * 0.8)], "line|cut short"),
    "nan": (lambda t: t.replace("ltibia ", "ltibia nan #", 1), "line 8"),
    "nan later": (lambda t: t[:400] + t[400:].replace("ltibia ", "ltibia nan", 1), "line"),
    "missing channel": (lambda t: t.replace("lowerback ", "lowerback 1 ", 1), "line 6.*lowerback"),
    "missing bone": (lambda t: "\n".join(line for line in t.splitlines() if not line.startswith("lfoot")), "lfoot"),
    "unknown bone": (lambda t: t.replace("lfoot", "tail"), "tail"),
    "bone twice": (lambda t: t.replace("lfoot", "lfemur"), "twice"),
    "later frame differs": (lambda t: t[::-1].replace("toofl", "liat", 1)[::-1], "line 21"),
    "frames backwards": (lambda t: t.replace("\n3\n", "\n1\n"), "line 16.*frame number"),
    "huge number": (lambda t: t.replace("\n3\n", "\n" + "9" * 5000 + "\n"), "line 16.*frame number"),
}


@pytest.mark.parametrize("fault", AMC_FAULTS)
def test_hostile_amc_is_named(tmp_path, fault):
    damage, message = AMC_FAULTS[fault]
    with pytest.raises(WearcapError, match=message) as caught:
        read(tmp_path, amc=damage(amc_text(3)))
    assert "t.amc" in str(caught.value)


ASF_FAULTS = {
    "truncated": (ASF[: len(ASF) // 2], "cut short"),
    "no hierarchy": (ASF.split(":hierarchy")[0], "cut short"),
    "nan length": (ASF.replace("length 2.5", "length nan"), "line 18"),
    "zero unit": (ASF.replace("length 0.45", "length 0"), "line 6"),
    "bad order": (ASF.replace("20 ZYX", "20 ZYZ"), "permutation"),
    "unknown channel": (ASF.replace("dof rz rx", "dof rz l"), "channels"),
    "loop": (ASF.replace("ltibia lfoot", "ltibia lfoot lfemur"), "two parents"),
    "orphan": (ASF.replace("    ltibia lfoot\n", ""), "do not hang"),
    "unknown child": (ASF.replace("ltibia lfoot", "ltibia fin"), "fin"),
    "bone twice": (ASF.replace("name lfoot", "name ltibia"), "name of its own"),
    "two numbers": (ASF.replace("direction 0 0 1", "direction 0 0"), "three numbers"),
}


@pytest.mark.parametrize("fault", ASF_FAULTS)
def test_hostile_asf_is_named(tmp_path, fault):
    text, message = ASF_FAULTS[fault]
    with pytest.raises(WearcapError, match=message) as caught:
        read(tmp_path, asf=text)
    assert "t.asf" in str(caught.value)


def test_binary_missing_and_folder_are_refused(tmp_path):
    (tmp_path / "b.asf").write_bytes(bytes(range(256)) * 9)
    for path in (tmp_path / "b.asf", tmp_path / "none.asf", tmp_path):
        with pytest.raises(WearcapError):
            read_asf(path)


@fuzz
@given(asf=mutated(ASF), amc=mutated(amc_text(3)), which=st.booleans())
def test_fuzz_gives_a_motion_or_one_clear_error(tmp_path, asf, amc, which):
    for file, text in (("t.asf", asf if which else ASF), ("t.amc", amc_text(3) if which else amc)):
        (tmp_path / file).write_bytes(text.encode("utf-8", "replace"))
    try:
        motion = read_amc(read_asf(tmp_path / "t.asf"), tmp_path / "t.amc")
    except WearcapError:
        return
    assert motion.R_parent_joint.isfinite().all()


@pytest.mark.real
def test_cmu_positions_equal_the_documented_formula(real_data):
    folder = real_data / "cmu_mocap" / "trials" / "001"
    asf = read_asf(folder / "01.asf")
    assert asf.skeleton.name == "cmu31"
    assert len(asf.skeleton) == 31
    motion = read_amc(asf, folder / "01_01.amc.xz")
    text = lzma.decompress((folder / "01_01.amc.xz").read_bytes()).decode()
    starts, _ = plain_fk((folder / "01.asf").read_text(), text)
    assert len(starts) == len(motion) == 2751
    for name in asf.skeleton.joint_names:
        expected = np.array([frame[name] for frame in starts])
        np.testing.assert_allclose(motion.joint(name).t.numpy(), expected, atol=3e-5)


@pytest.mark.real
def test_every_cmu_trial_is_read_as_a_person(real_data):
    folder = real_data / "cmu_mocap"
    trials = sorted(folder.glob("trials/*/*.amc.xz"))
    indices = [path.read_text(encoding="utf-8") for path in folder.glob("index*.csv")]
    assert len(trials) == sum(text.count(".amc.xz,") for text in indices) >= 235
    frames = 0
    for trial in trials:
        motion = read_amc(read_asf(next(trial.parent.glob("*.asf"))), trial)
        frames += len(motion)
        assert motion.timestamps.diff().max() < 1.001 / 120, trial
        height = motion.skeleton.rest_sites["crown"][2] + motion.skeleton.root_height
        assert 1.3 < height < 2.0, trial
        assert motion.t_world_root[:, 2].median() > 0.25, trial
    assert frames > 200_000
