"""Motion on characters: bones point as the motion's do, feet stand on the floor, and the file stays what it was."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch

import foreign_bvh
import rig_files
import wearcap
from walking_person import walk
from wearcap.body.kinematics import local_rotations
from wearcap.body.retarget import reach
from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.geometry.rotation import about_axis
from wearcap.io.formats.bvh import read_bvh_content
from wearcap.prepare.rigs import read_rig, write_on_rig
from wearcap.recording import Motion

PARTS = {"hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand"}
BONES = [("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist")]
EACH = [(side, *bone) for side in ("left", "right") for bone in BONES]


def stepping(frames: int = 120) -> tuple[Motion, torch.Tensor]:
    """Somebody who shifts the weight, bends the knees, turns and waves, with both feet planted; and where ankles are."""
    skeleton, time = xsens23(), torch.arange(frames, dtype=torch.float64) / 60
    R = torch.eye(3, dtype=torch.float64).repeat(frames, len(skeleton), 1, 1)
    sway = torch.stack([0.03 * (2 * time).sin(), 0.04 * (3 * time).sin(), 0.05 * (2.5 * time).sin() - 0.12], -1)
    root = sway + torch.tensor([2.0, -1.0, skeleton.root_height])
    R[:, 0] = about_axis("z", 0.1 * time.sin()) @ about_axis("y", 0.1 * (1.3 * time).sin())
    R[:, skeleton.index("left_shoulder")] = about_axis("x", time.sin()) @ about_axis("z", 0.5 * time)
    R[:, skeleton.index("left_elbow")] = about_axis("z", -1.1 - 0.3 * (1 - (2 * time).cos()))
    R[:, skeleton.index("right_shoulder")] = about_axis("x", 1.2 + 0.2 * time.sin())
    R[:, skeleton.index("right_elbow")] = about_axis("z", 1.2 + 0.2 * time)
    R[:, skeleton.index("head")] = about_axis("z", 0.5 * time.sin())
    motion = Motion(time, skeleton, R, root)
    world, feet = motion.T_world_joint.R.clone(), []
    for side, y in (("left", 0.1), ("right", -0.1)):
        joints = [skeleton.index(f"{side}_{name}") for name in ("hip", "knee", "ankle")]
        hip, knee, ankle = (motion.T_world_joint.t[:, joint] for joint in joints)
        feet.append(torch.tensor([2.0, y - 1.0, 0.08], dtype=torch.float64))
        ahead = torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64).expand_as(hip)
        upper, lower = reach(hip, knee, ankle, feet[-1].expand_as(hip), ahead)
        world[:, joints[0]], world[:, joints[1]] = upper @ world[:, joints[0]], lower @ world[:, joints[1]]
        for name in ("ankle", "toe"):
            world[:, skeleton.index(f"{side}_{name}")] = torch.eye(3, dtype=torch.float64)
    local = local_rotations(skeleton, world)
    return Motion(time, skeleton, local.float(), root.float(), torch.ones(frames, 4)), torch.stack(feet)


def directions(motion: Motion, bone: tuple[str, str, str]) -> np.ndarray:
    side, first, second = bone
    step = motion.joint(f"{side}_{second}").t - motion.joint(f"{side}_{first}").t
    return torch.nn.functional.normalize(step, dim=-1).double().numpy()


def angles_deg(steps: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    steps = steps / np.linalg.norm(steps, axis=-1, keepdims=True)
    return np.degrees(np.arccos(np.clip((steps * wanted).sum(-1), -1, 1)))


@pytest.mark.parametrize("vrm", [False, True], ids=["mixamo t-pose", "vrm a-pose"])
@pytest.mark.parametrize("size", [0.7, 1.0])
def test_a_character_of_a_glb_moves_as_the_motion(tmp_path, vrm, size):
    """The file is played by the specification; its axes: x left, y up, z ahead, for VRM 0 x right and z back."""
    rig, out = tmp_path / f"own.{'vrm' if vrm else 'glb'}", tmp_path / f"moved.{'vrm' if vrm else 'glb'}"
    before = rig_files.write(rig, vrm, size)
    motion, _ = stepping()
    wearcap.save(motion, out, rig=rig)
    played = rig_files.Played(out)
    to_ours = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]) @ np.diag([-1, 1, -1] if vrm else [1, 1, 1])
    names = [name for name, _, _ in rig_files.joints()]
    T = {name: played.matrices(k) for k, name in enumerate(names)}
    t = {name: pose[:, :3, 3] @ to_ours.T for name, pose in T.items()}
    np.testing.assert_allclose(played.times, motion.timestamps.numpy() - motion.timestamps[0].item(), atol=1e-6)
    for bone in EACH:
        first, second = (bone[0].title() + PARTS[part] for part in bone[1:])
        assert angles_deg(t[second] - t[first], directions(motion, bone)).max() < 1.0, bone
    for name, parent, offset in rig_files.joints():
        if parent:
            lengths = np.linalg.norm(t[name] - t[parent], axis=-1)
            np.testing.assert_allclose(lengths, size * np.linalg.norm(offset), atol=1e-5)
    # Toes and head point ahead as the motion's do; soles of the mesh are at the floor, and feet do not slide.
    for side in ("Left", "Right"):
        foot, toe = t[f"{side}Foot"], t[f"{side}ToeBase"]
        assert angles_deg((toe - foot)[:, :2], np.array([1.0, 0.0])).max() < 1.0
        sole = t[f"{side}Toe_End"][:, 2] - rig_files.SOLE * size
        assert np.abs(sole).max() < 0.01
        assert np.ptp(foot, axis=0).max() < 0.012 * size
    head = np.einsum("tij,jk->tik", T["Head"][:, :3, :3], np.linalg.inv(T["Head"][0, :3, :3]))
    turned = motion.joint("head").R.double().numpy()
    np.testing.assert_allclose(to_ours @ head @ to_ours.T, turned @ turned[:1].swapaxes(1, 2), atol=1e-4)
    kept_as_it_was(before, rig, played)


def kept_as_it_was(before: dict, rig, played: rig_files.Played) -> None:
    """All of the document but what an animation adds, and all bytes of its buffer."""
    after = played.json
    for key in ("asset", "scenes", "nodes", "meshes", "materials", "skins", "extensions", "extensionsUsed"):
        assert after.get(key) == before.get(key), key
    for key in ("accessors", "bufferViews"):
        assert after[key][: len(before[key])] == before[key]
    assert [each["name"] for each in after["animations"]] == ["wearcap", "idle"]
    assert after["buffers"][0]["name"] == "all"
    size = before["buffers"][0]["byteLength"]
    assert played.binary[:size] == rig.read_bytes()[-size:]


def test_hands_are_kept_where_they_are(tmp_path):
    """A character with other arms: palms that meet in the motion meet on it."""
    rig_files.write(tmp_path / "own.glb", vrm=False)
    motion, _ = stepping()
    rig = read_rig(tmp_path / "own.glb")
    goals = {side: motion.joint(f"{side}_wrist").t - motion.joint("pelvis").t for side in ("left", "right")}
    apart = {}
    for keep in (False, True):
        write_on_rig(motion, rig, tmp_path / "moved.glb", keep)
        played = rig_files.Played(tmp_path / "moved.glb")
        hands = [played.matrices(played.named[f"mixamorig:{side}Hand"])[:, :3, 3] for side in ("Left", "Right")]
        wanted = torch.linalg.norm(goals["left"] - goals["right"], dim=-1).double().numpy()
        apart[keep] = np.std(np.linalg.norm(hands[0] - hands[1], axis=-1) / wanted)
    assert apart[True] < 1e-3 < apart[False]


@pytest.mark.parametrize("convention", ["cmu", "mixamo", "motionbuilder", "humanik", "biped", "unreal", "nameless"])
def test_the_hierarchy_of_a_bvh_is_kept(tmp_path, convention):
    """CMU's names, T- and A-poses, and rests in which nobody stands; played by the tests' own reader of bvh places."""
    R, p = foreign_bvh.walk(60)
    written = foreign_bvh.CONVENTIONS[convention]
    foreign_bvh.write(tmp_path / "own.bvh", written, R, p)
    motion, _ = stepping()
    rig = read_rig(tmp_path / "own.bvh")
    write_on_rig(motion, rig, tmp_path / "moved.bvh")
    before, after = (tmp_path / name for name in ("own.bvh", "moved.bvh"))
    assert before.read_text().partition("MOTION")[0].split() == after.read_text().partition("MOTION")[0].split()
    places = bvh_places(after)
    for bone in EACH:
        first, second = (written.name(f"{bone[0]}_{part}") for part in bone[1:])
        step = (places[second] - places[first]) @ written.axes
        assert angles_deg(step, directions(motion, bone)).max() < 1.0, bone
    ends = np.stack([places[f"{written.name(f'{side}_toe')} end"] @ written.axes for side in ("left", "right")])
    loose = 0.03 if written.rest in ("own x", "zero") else 0.01  # these show their soles in the straightest frame alone
    assert np.abs(ends[..., 2] * written.unit_m).max() < loose
    assert np.ptp(ends, axis=1).max() * written.unit_m < 0.015


def bvh_places(path) -> dict[str, np.ndarray]:
    """World places of joints and ends by name, from the text alone."""
    top, bottom = path.read_text().split("MOTION")
    table = np.array([list(map(float, line.split())) for line in bottom.strip().splitlines()[2:]])
    column, stack, places, name = 0, [(np.eye(3), np.zeros(3))], {}, ""
    lines = iter(top.splitlines())
    for words in (line.split() for line in lines):
        if words[:1] in (["ROOT"], ["JOINT"], ["End"]):
            name = f"{name} end" if words[0] == "End" else " ".join(words[1:])
            next(lines)
            offset = np.array(list(map(float, next(lines).split()[1:])))
            channels = [] if words[0] == "End" else next(lines).split()[2:]
            R, t = np.tile(np.eye(3), (len(table), 1, 1)), np.tile(offset, (len(table), 1))
            for channel in channels:
                values, axis = table[:, column], channel[0].lower()
                column += 1
                if channel.endswith("position"):
                    t[:, "xyz".index(axis)] = values
                else:
                    R = R @ foreign_bvh.turn(axis, np.radians(values))
            R_above, t_above = stack[-1]
            places[name] = t_above + np.einsum("...ij,tj->ti" if R_above.ndim == 2 else "tij,tj->ti", R_above, t)
            stack.append((R_above @ R, places[name]))
        elif words == ["}"]:
            stack.pop()
    return places


def test_feet_slide_no_more_than_the_motions(tmp_path):
    rig_files.write(tmp_path / "own.glb", vrm=False)
    motion, contact = walk(torch.arange(120, dtype=torch.float64) / 60)
    motion = replace(motion, contact_prob=contact.float())
    write_on_rig(motion, read_rig(tmp_path / "own.glb"), tmp_path / "moved.glb")
    played = rig_files.Played(tmp_path / "moved.glb")
    for k, side in enumerate(("Left", "Right")):
        ours = played.matrices(played.named[f"mixamorig:{side}Foot"])[:, :3, 3]
        theirs = motion.joint(f"{side.lower()}_ankle").t.numpy()
        stands = (contact[1:, 2 * k] & contact[:-1, 2 * k]).numpy()
        slide, of_motion = (np.linalg.norm(np.diff(t, axis=0), axis=-1)[stands].sum() for t in (ours, theirs))
        assert slide < of_motion + 0.01


def split(path) -> tuple[dict, bytes]:
    """The JSON of a .glb file, and what follows it."""
    data = path.read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + size]), data[20 + size :]


def join(path, document: dict, rest: bytes) -> None:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest)) + struct.pack("<I4s", len(text), b"JSON")
    path.write_bytes(head + text + rest)


def test_what_is_missing_is_named(tmp_path):
    rig_files.write(tmp_path / "own.glb", vrm=False)
    document, binary = split(tmp_path / "own.glb")
    hips = document["nodes"][0]
    for removed, words in (([11], "left leg of skeleton .* is not recognised"), ([4], "different trees")):
        changed = {**document, "nodes": [dict(node) for node in document["nodes"]]}
        if removed == [11]:
            changed["nodes"][0] = {**hips, "children": [child for child in hips["children"] if child not in removed]}
            for node in changed["nodes"]:
                node["name"] = node["name"].replace("LeftLeg", "Cape")
        else:
            changed["nodes"][3] = {
                **changed["nodes"][3],
                "children": [c for c in changed["nodes"][3]["children"] if c != 4],
            }
            changed["scenes"] = [{"nodes": [*document["scenes"][0]["nodes"], 4]}]
        join(tmp_path / "broken.glb", changed, binary)
        with pytest.raises(WearcapError, match=words):
            read_rig(tmp_path / "broken.glb")
    for path, words in ((tmp_path / "x.fbx", ".vrm"), (tmp_path / "no.glb", "no such")):
        with pytest.raises(WearcapError, match=words):
            read_rig(path)
    with pytest.raises(WearcapError, match=r"ends with \.glb"):
        wearcap.save(stepping(8)[0], tmp_path / "moved.vrm", rig=tmp_path / "own.glb")


def test_a_tree_without_arms_is_refused_by_name(tmp_path):
    R, p = foreign_bvh.walk(10)
    legs = {k: v for k, v in foreign_bvh.CONVENTIONS["mixamo"].names.items() if k not in ("shoulder", "elbow", "wrist")}
    foreign_bvh.write(tmp_path / "own.bvh", foreign_bvh.Convention(legs), R, p)
    with pytest.raises(
        WearcapError, match="arm of skeleton .* is not recognised.*Expected head, two arms and two legs"
    ):
        read_rig(tmp_path / "own.bvh")


@pytest.mark.parametrize("at", range(40))
def test_damaged_characters_are_refused_or_read(tmp_path, at):
    """A byte of the header, of the JSON or of the buffer is another: one clear error, or a character."""
    rig_files.write(tmp_path / "own.glb", vrm=True)
    data = bytearray((tmp_path / "own.glb").read_bytes())
    data[(at * 211) % len(data)] ^= 1 + at % 255
    (tmp_path / "own.glb").write_bytes(data)
    said = "own.glb"
    try:
        write_on_rig(stepping(4)[0], read_rig(tmp_path / "own.glb"), tmp_path / "moved.glb")
    except WearcapError as error:
        said = str(error)
    assert "own.glb" in said or "moved.glb" in said


def test_a_bvh_without_the_channels_is_refused(tmp_path):
    R, p = foreign_bvh.walk(10)
    foreign_bvh.write(tmp_path / "own.bvh", foreign_bvh.CONVENTIONS["mixamo"], R, p)
    content = read_bvh_content(tmp_path / "own.bvh")
    assert content.hierarchy[-1] == "MOTION"
    text = (tmp_path / "own.bvh").read_text()
    head, _, rows = text.partition("MOTION")
    joint = head.index("LeftUpLeg")
    head = head[:joint] + head[joint:].replace("CHANNELS 3 Zrotation Xrotation Yrotation", "CHANNELS 1 Xrotation", 1)
    first = sum(int(line.split()[1]) for line in head[:joint].splitlines() if "CHANNELS" in line)
    lines = rows.strip().splitlines()
    table = [" ".join(v for k, v in enumerate(line.split()) if k not in (first, first + 2)) for line in lines[2:]]
    (tmp_path / "own.bvh").write_text(head + "MOTION\n" + "\n".join([*lines[:2], *table]) + "\n")
    with pytest.raises(WearcapError, match="LeftUpLeg.* turns about more axes"):
        write_on_rig(stepping(8)[0], read_rig(tmp_path / "own.bvh"), tmp_path / "moved.bvh")
