"""Fingers of each device's files: planted hands in its layout come back as joints that the fit understands."""

import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import planted_hands as planted
from headset_tables import TIME, all_seven, csv, matrices, names_of, seven, texts, write
from mvnx_files import SEGMENTS, mvnx, numbers, sample
from wearcap.body.hands import FINGER_NAMES, HAND_JOINTS, OPENXR
from wearcap.body.skeleton import SIDES
from wearcap.errors import WearcapError
from wearcap.io.conventions import Conventions
from wearcap.io.devices.aria_hands import read_fingers
from wearcap.io.devices.aria_mps import read_mps
from wearcap.io.devices.headset_axes import CONVENTIONS
from wearcap.io.devices.headset_log import read_headset_log
from wearcap.io.formats.mvnx import read_mvnx
from wearcap.recording.recording import Recording
from wearcap.recording.store import RecordingFile, save_recording
from wearcap.recording.timing import first_seconds
from wearcap.tracking.fingers import fit_hand, with_fingers

ANGLES = {side: planted.moving(len(TIME), seed) for seed, side in enumerate(SIDES)}
HANDS = {side: planted.carried(planted.joints(each, side), 4) for side, each in ANGLES.items()}


def compare(hands, angles=ANGLES, within_deg=1.0, fingers=slice(None)) -> None:
    assert set(hands) == set(angles)
    for side, hand in hands.items():
        fitted = fit_hand(hand, side)
        assert fitted.measured.all()
        off = np.degrees(np.abs(fitted.angles.numpy() - angles[side]))[:, fingers]
        assert off.max() < within_deg


# --- headsets ------------------------------------------------------------------------------------------------------


def foreign(side: str, axes: str, names) -> np.ndarray:
    """Places of joints in a convention's axes, those that hands lack at the wrist's."""
    places = planted.at(HANDS[side], names) @ CONVENTIONS[axes].double().numpy()
    return np.where(np.isfinite(places), places, places[:, names.index("wrist")][:, None])


def unity(folder):
    """XR Hands' XRHandJointID."""
    joints = [name for name in HAND_JOINTS if "metacarpal" not in name or "thumb" in name]
    words = ["".join(map(str.title, name.replace("pinky", "little").split("_"))) for name in joints]
    header = [f"{side.title()}_{word}_Pos{axis}" for side in SIDES for word in words for axis in "XYZ"]
    places = [foreign(side, "unity", joints).reshape(len(TIME), -1) for side in SIDES]
    return csv(folder / "a.csv", ",".join(["time", names_of("{d}_{q}_{a}"), *header]), TIME, all_seven(), *places)


def webxr(folder):
    """XRHand's joints by name in a list of input sources."""
    joints = [name for name in HAND_JOINTS if "metacarpal" not in name or "thumb" in name]
    bones = {"proximal": "phalanx-proximal", "intermediate": "phalanx-intermediate", "distal": "phalanx-distal"}
    places = {side: foreign(side, "openxr", joints) for side in SIDES}

    def word(name: str) -> str:
        finger, _, bone = name.partition("_")
        return name if name == "wrist" else f"{finger}{'-finger' * (finger != 'thumb')}-{bones.get(bone, bone)}"

    M = (CONVENTIONS["openxr"].mT @ CONVENTIONS["unity"]).double().numpy()  # of the table's poses

    def pose(device: str, k: int) -> dict:
        at, turn = seven(device)[k, :3], Rotation.from_quat(seven(device)[k, 3:]).as_matrix()
        xyzw = Rotation.from_matrix(M @ turn @ M.T).as_quat()
        return {"position": dict(zip("xyz", M @ at)), "orientation": dict(zip("xyzw", xyzw))}

    frames = [
        {
            "time": moment * 1e3,
            "viewer": {"transform": pose("head", k)},
            "inputSources": [
                {
                    "handedness": side,
                    "gripSpace": pose(side, k),
                    "hand": {word(name): dict(zip("xyz", places[side][k, n])) for n, name in enumerate(joints)},
                }
                for side in SIDES
            ],
        }
        for k, moment in enumerate(TIME.tolist())
    ]
    return write(folder / "a.json", json.dumps({"frames": frames}))


def hololens(folder):
    """HoloLens2ForCV's 26 matrices a hand, without a header."""
    ticks = [str(116444736000000000 + round((1.7e9 + moment) * 1e7)) for moment in TIME]
    parts = [matrices("head").reshape(len(TIME), 16)]
    for side in SIDES:
        joints = np.tile(np.eye(4), (len(TIME), 26, 1, 1))
        joints[..., :3, 3] = foreign(side, "unity", OPENXR)
        joints[:, 1] = matrices(side)
        joints[:, 1, :3, 3] = foreign(side, "unity", OPENXR)[:, 1]
        parts += [np.ones((len(TIME), 1)), joints.reshape(len(TIME), -1)]
    rows = texts(ticks, *parts, np.zeros((len(TIME), 10)))
    return write(folder / "head_hand_eye.csv", "\n".join(map(",".join, rows)))


@pytest.mark.parametrize("layout", [unity, webxr, hololens], ids=lambda layout: layout.__name__)
def test_headset_logs(tmp_path, layout):
    axes = "openxr" if layout is webxr else "unity"
    log = read_headset_log(layout(tmp_path), Conventions(axes=axes, unit="m", quaternion="xyzw", hands="grip"))
    compare(log.fingers)


def test_a_hand_that_is_lost_or_frozen_is_not_valid(tmp_path):
    lines = unity(tmp_path).read_text().splitlines()
    first = lines[0].split(",").index("Left_Wrist_PosX")
    rows = [line.split(",") for line in lines[1:]]
    for row in rows[10:20]:
        row[first:] = ["0.0"] * (len(row) - first)
    for row in rows[40:]:
        row[first:] = rows[40][first:]
    path = write(tmp_path / "b.csv", "\n".join([lines[0], *map(",".join, rows)]))
    valid = read_headset_log(path, Conventions(axes="unity", unit="m", hands="grip")).fingers["left"].valid
    assert not valid[10:20].any()
    assert not valid[41:].any()
    assert valid[:10].all()
    assert valid[20:41].all()


# --- Aria ----------------------------------------------------------------------------------------------------------


def mps_file(folder, **changes):
    times = np.round((10 + TIME) * 1e6).astype(int)
    table = {"tracking_timestamp_us": times}
    for side in SIDES:
        table[f"{side}_tracking_confidence"] = np.where(np.arange(len(TIME)) % 50 == 7, -1.0, 0.97)
        places = planted.at(HANDS[side], (*planted.MPS, "palm"))
        for k in range(21):
            table |= {f"t{axis}_{side}_landmark_{k}_device": places[:, k, n] for n, axis in enumerate("xyz")}
    table |= changes
    rows = [",".join(table), *(",".join(str(column[k]) for column in table.values()) for k in range(len(TIME)))]
    return write(folder / "hand_tracking_results.csv", "\n".join(rows))


def test_mps_landmarks(tmp_path):
    hands = read_fingers([mps_file(tmp_path)])
    for side, hand in hands.items():
        fitted = fit_hand(hand, side)
        tracked = np.arange(len(TIME)) % 50 != 7
        assert torch.equal(fitted.measured, torch.from_numpy(tracked))
        # The thumb's first joint is no landmark of MPS: it is placed by the palm's size, which is the default's here.
        off = np.degrees(np.abs(fitted.angles.numpy() - ANGLES[side]))[tracked]
        assert off.max() < 1.0
    assert read_fingers([]) == {}
    broken = np.full(len(TIME), np.nan)
    with pytest.raises(WearcapError, match="left landmarks"):
        read_fingers([mps_file(tmp_path, tx_left_landmark_9_device=broken)])


@pytest.mark.real
def test_a_real_mps_sample(real_data):
    folder = real_data / "aria_mps"
    assert read_mps(folder).fingers == {}  # of another time than the trajectory
    hands = read_fingers([folder / "hand_tracking/hand_tracking_results_v2.csv"])
    assert set(hands) == set(SIDES)
    for side, hand in hands.items():
        fitted = fit_hand(hand, side)
        assert torch.equal(fitted.measured, hand.valid)
        assert hand.valid.sum() == 3
        assert fitted.shape.bones[2].tolist() == pytest.approx([0.0429, 0.0275, 0.025], abs=5e-4)


# --- gloves --------------------------------------------------------------------------------------------------------

NUMBERS = ("First", "Second", "Third", "Fourth", "Fifth")
FULL = {
    "metacarpal": "Metacarpal",
    "proximal": "ProximalPhalange",
    "intermediate": "MiddlePhalange",
    "distal": "DistalPhalange",
}
SHORT = {"metacarpal": "MC", "proximal": "PP", "intermediate": "MP", "distal": "DP"}


def with_gloves(text: str, frames: int, words: dict[str, str]) -> str:
    """An MVNX file with both hands' segments behind the body's, and their poses in each frame."""
    joints = ["wrist", *(name for name in HAND_JOINTS[1:] if not name.endswith("_tip"))]
    listed, fields = "", [""] * frames
    for side in SIDES:
        labels = ["Carpus"] + [
            NUMBERS[FINGER_NAMES.index(n.split("_")[0])] + words[n.split("_")[1]] for n in joints[1:]
        ]
        segments = "".join(f'<segment label="{side.title()}{label}" id="{k}"/>' for k, label in enumerate(labels, 1))
        name = f"fingerTrackingSegments{side.title()}"
        listed += f"<{name}>{segments}</{name}>"
        places, turns = planted.joints(ANGLES[side][:frames], side), np.tile(np.eye(3), (frames, 20, 1, 1))
        for finger in FINGER_NAMES:  # a last bone's y axis points to the tip, or on right hands away from it
            tip, last = (places[:, HAND_JOINTS.index(f"{finger}_{bone}")] for bone in ("tip", "distal"))
            y = (tip - last) / np.linalg.norm(tip - last, axis=1, keepdims=True) * (1 if side == "left" else -1)
            x = np.cross(y, [0.3, 0.2, 0.9])
            x /= np.linalg.norm(x, axis=1, keepdims=True)
            turns[:, joints.index(f"{finger}_distal")] = np.stack([x, y, np.cross(x, y)], 2)
        shown = np.nan_to_num(planted.at(places, joints))
        wxyz = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_quat()[:, [3, 0, 1, 2]].reshape(frames, -1)
        for k in range(frames):
            fields[k] += f"<positionFingers{side.title()}>{numbers(shown[k])}</positionFingers{side.title()}>"
            fields[k] += f"<orientationFingers{side.title()}>{numbers(wxyz[k])}</orientationFingers{side.title()}>"
    head, *parts = text.replace("</segments>", f"</segments>{listed}").split('type="normal"')
    return head + "".join(
        'type="normal"' + part.replace("</frame>", f"{field}</frame>", 1) for field, part in zip(fields, parts)
    )


@pytest.mark.parametrize("words", [FULL, SHORT], ids=["SDK", "Manus"])
def test_mvnx_gloves(tmp_path, words):
    motion = sample()
    path = tmp_path / "t.mvnx"
    path.write_text(with_gloves(mvnx(motion), len(motion), words))
    recording = read_mvnx(path)
    torch.testing.assert_close(recording.motion.T_world_joint.t, motion.T_world_joint.t, atol=1e-5, rtol=0)
    compare(recording.fingers, {side: each[: len(motion)] for side, each in ANGLES.items()}, 2.0)
    assert len(SEGMENTS) == 23
    path.write_text(
        with_gloves(mvnx(motion), len(motion), words).replace("<positionFingersLeft>", "<positionFingersLeft>1 ", 1)
    )
    with pytest.raises(WearcapError, match="positionFingersLeft with 61 values where 60 belong"):
        read_mvnx(path)


# --- in recordings -------------------------------------------------------------------------------------------------


def test_recordings_keep_and_cut_fingers(tmp_path):
    motion, hands = sample(), {side: planted.stream(HANDS[side]) for side in SIDES}
    save_recording(Recording("r", motion=motion, suit=motion, fingers=hands), tmp_path / "r.safetensors")
    back = RecordingFile(tmp_path / "r.safetensors").load()
    for side in SIDES:
        torch.testing.assert_close(back.fingers[side].points, hands[side].points, equal_nan=True)
        assert back.fingers[side].rotations is None
    assert len(first_seconds(back, 0.5).fingers["left"].timestamps) == 30
    assert with_fingers(back.suit, back.fingers).fingers_measured.eq(1).all()
