"""MediaPipe's hands: which is whose, and the message when the package or its model is missing."""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from data_prep.keypoint_detectors import MODEL_VARIABLE, Detector, MediaPipeHands, _Hand, wearers_hands
from wearcap.body.hands import FINGER_NAMES, HAND_JOINTS
from wearcap.errors import WearcapError


def mark(x: float, y: float) -> SimpleNamespace:
    return SimpleNamespace(x=x, y=y)


def side(name: str, score: float) -> list[SimpleNamespace]:
    return [SimpleNamespace(category_name=name, score=score)]


@pytest.fixture
def package(monkeypatch, tmp_path):
    """A package with the parts of MediaPipe's interface that are used; `answer` is its next one."""
    fake = ModuleType("mediapipe")
    fake.answer = SimpleNamespace(hand_landmarks=[], handedness=[], hand_world_landmarks=[])
    fake.shown = []

    class Landmarker:
        @classmethod
        def create_from_options(cls, options):
            if not options["base_options"]["model_asset_path"].endswith(".task"):
                raise RuntimeError("Unable to open zip archive")
            fake.options = options
            return cls()

        def detect_for_video(self, image, time_ms):
            fake.shown.append((image["data"].shape, time_ms))
            return fake.answer

    vision = SimpleNamespace(
        HandLandmarkerOptions=dict, RunningMode=SimpleNamespace(VIDEO="video"), HandLandmarker=Landmarker
    )
    fake.tasks = SimpleNamespace(vision=vision, BaseOptions=dict)
    fake.Image, fake.ImageFormat = dict, SimpleNamespace(SRGB="srgb")
    monkeypatch.setitem(sys.modules, "mediapipe", fake)
    (tmp_path / "hand_landmarker.task").write_bytes(b"model")
    monkeypatch.setenv(MODEL_VARIABLE, str(tmp_path / "hand_landmarker.task"))
    return fake


def test_wrists_are_pixels_of_the_wearers_hands(package):
    detector = MediaPipeHands()
    assert isinstance(detector, Detector)
    assert package.options["num_hands"] == 2
    picture = np.zeros((100, 200, 3), np.uint8)
    assert detector(picture, 0.0) == {}
    package.answer = SimpleNamespace(
        hand_landmarks=[[mark(0.75, 0.5), mark(0, 0)], [mark(0.25, 0.8), mark(0, 0)]],
        handedness=[side("Right", 0.97), side("Left", 0.9)],
        hand_world_landmarks=[[SimpleNamespace(x=k / 100, y=sign, z=0.0) for k in range(21)] for sign in (1.0, -1.0)],
    )
    found = detector(picture, 0.0333)
    assert found["right_wrist"][:2] == pytest.approx((149.5, 49.5))
    assert found["left_wrist"][:2] == pytest.approx((49.5, 79.5))
    assert all(0.9 < keypoint.confidence <= 1 for keypoint in found.values())
    assert package.shown == [((100, 200, 3), 0), ((100, 200, 3), 33)]
    hands = detector.fingers()
    assert {name: hand.points[1, 0, 1].item() for name, hand in hands.items()} == {"left": -1.0, "right": 1.0}
    assert hands["left"].valid.tolist() == [False, True]
    tips = [hands["left"].points[1, HAND_JOINTS.index(f"{finger}_tip"), 0].item() for finger in FINGER_NAMES]
    assert tips == pytest.approx([0.04, 0.08, 0.12, 0.16, 0.20])  # MediaPipe's landmarks 4, 8, 12, 16, 20


def test_two_hands_are_never_of_one_side():
    sure, unsure = _Hand(0.5, 0.5, 0.95), _Hand(0.6, 0.5, 0.7)
    found = wearers_hands([unsure, sure])
    assert found["left_wrist"][0] == sure
    assert found["right_wrist"][0] == unsure
    assert found["left_wrist"][1] < 0.9


def test_one_hand_is_what_it_looks_like_unless_that_is_unsure():
    assert list(wearers_hands([_Hand(0.9, 0.5, 0.99)])) == ["left_wrist"]
    assert list(wearers_hands([_Hand(0.9, 0.5, 0.55)])) == ["right_wrist"]
    assert wearers_hands([]) == {}


def test_what_is_missing_is_named(package, monkeypatch, tmp_path):
    with pytest.raises(WearcapError, match="no model of MediaPipe's hands"):
        MediaPipeHands(tmp_path / "none.task")
    (tmp_path / "model.bin").write_bytes(b"")
    with pytest.raises(WearcapError, match="not a model that MediaPipe can run .Unable to open zip archive"):
        MediaPipeHands(tmp_path / "model.bin")
    monkeypatch.delenv(MODEL_VARIABLE)
    with pytest.raises(WearcapError, match="WEARCAP_HANDS_MODEL.*Download it"):
        MediaPipeHands()
    monkeypatch.setitem(sys.modules, "mediapipe", None)
    with pytest.raises(WearcapError, match=r"needs the package 'mediapipe'.*wearcap\[hands\]"):
        MediaPipeHands()
