"""Calibration: planted intrinsics come back, bad views go, and what cannot be calibrated is reported."""

import json
from dataclasses import replace

import av
import cv2
import numpy as np
import pytest
from board_pictures import BOARD, CAMERA, picture, pictures, pose, rays_of

from wearcap.cli import calibrate as verb
from wearcap.cli import main as cli
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.io.formats.camera_json import read_camera, write_camera
from wearcap.localization.checkerboard import Board, _View, calibrate_from_pictures, varied


@pytest.fixture(scope="module")
def shown() -> list[tuple[str, np.ndarray]]:
    return pictures(24)


def near(camera: Camera, share: float) -> None:
    assert (camera.fx, camera.fy) == pytest.approx((CAMERA.fx, CAMERA.fy), rel=share)
    assert (camera.cx, camera.cy) == pytest.approx((CAMERA.cx, CAMERA.cy), abs=share * CAMERA.fx)
    assert camera.distortion[:2] == pytest.approx(CAMERA.distortion[:2], abs=0.02)
    assert camera.distortion[2:] == pytest.approx(CAMERA.distortion[2:], abs=2e-3)


def test_planted_intrinsics_are_recovered(shown):
    found = calibrate_from_pictures(shown, BOARD)
    near(found.camera, 0.005)
    assert found.rms_px < 0.2
    corners = np.concatenate([view.corners for view in found.views])
    size = (CAMERA.width, CAMERA.height)
    seen, _, _ = np.histogram2d(*corners.T, bins=(8, 6), range=[(0, side) for side in size])
    assert found.coverage == pytest.approx((seen > 0).mean())
    assert found.coverage > 0.6
    assert found.examined == 24
    assert found.seen >= len(found.views) >= 15
    assert abs(found.camera.fx - CAMERA.fx) < 4 * found.focal_std_px


def test_a_wrong_view_is_rejected(shown):
    """A board that bends: its corners lie on no plane."""
    bent = shown[3][1]
    x, y = np.meshgrid(np.arange(bent.shape[1], dtype=np.float32), np.arange(bent.shape[0], dtype=np.float32))
    bent = cv2.remap(
        bent, x + 6 * np.sin(x / 40), y + 5 * np.sin(x / 55), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    found = calibrate_from_pictures([*shown, ("bent.png", bent)], BOARD)
    assert "bent.png" in [view.name for view in found.rejected]
    near(found.camera, 0.005)


def test_corners_lie_where_the_camera_projects_them():
    random = np.random.default_rng(5)
    R, t = pose(random, BOARD, tilt_deg=25)
    gray = cv2.cvtColor(picture(rays_of(CAMERA), BOARD, R, t), cv2.COLOR_RGB2GRAY)
    view = BOARD.find(gray)
    assert view is not None
    expected = cv2.projectPoints(
        BOARD.points,
        cv2.Rodrigues(R)[0],
        t,
        np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]]),
        np.array(CAMERA.distortion),
    )[0].reshape(-1, 2)
    error = min(np.abs(view.corners - way).max() for way in (expected, expected[::-1]))
    assert error < 0.35


def test_blurred_pictures_stand_back_for_sharp_ones(shown):
    blurred = [(f"b{name}", cv2.GaussianBlur(image, None, 2.5)) for name, image in shown[:6]]
    found = calibrate_from_pictures([*blurred, *shown], BOARD)
    assert not any(view.name.startswith("b") for view in found.views)
    assert min(BOARD.find(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)).blur_px for _, image in blurred[3:4]) > 4


def test_varied_views_are_chosen():
    random = np.random.default_rng(0)
    near_one = [
        _View(f"same{k}", BOARD.points[:, :2] * 800 + 100 + random.normal(0, 0.1, 2).astype(np.float32), 1.0)
        for k in range(30)
    ]
    far = [_View("left", BOARD.points[:, :2] * 800, 2.0), _View("small", BOARD.points[:, :2] * 300 + 100, 2.0)]
    assert {"left", "small"} <= {view.name for view in varied([*near_one, *far], (640, 480), 4)}


@pytest.mark.parametrize("tilt_deg", [0.0, 3.0])
def test_frontal_views_leave_the_focal_length_open(tilt_deg):
    with pytest.raises(WearcapError, match=r"focal length open .*Tilt the board"):
        calibrate_from_pictures(pictures(12, tilt_deg=tilt_deg, seed=3), BOARD)


@pytest.mark.parametrize(
    ("board", "message"),
    [
        (Board(9, 6, 0.03), "no board of 9x6 inner corners in 3 pictures of 480x360 .* 8x5 inner corners was found"),
        (Board(12, 9, 0.03), "no board of 12x9 .*Count inner corners"),
    ],
)
def test_no_board(shown, board, message):
    with pytest.raises(WearcapError, match=message):
        calibrate_from_pictures(shown[1:4], board)


def test_too_few_views_and_mixed_sizes(shown):
    with pytest.raises(WearcapError, match="good views of the 8x5 board.*at least 8"):
        calibrate_from_pictures(shown[1:6], BOARD)
    with pytest.raises(WearcapError, match="100x100 pixels"):
        calibrate_from_pictures([shown[0], ("odd.png", np.zeros((100, 100, 3), np.uint8))], BOARD)
    with pytest.raises(WearcapError, match="no pictures"):
        calibrate_from_pictures([], BOARD)


@pytest.mark.parametrize("wrong", [(2, 6, 0.03), (9, 6, 0.0), (9, 6, -1.0)])
def test_no_such_board(wrong):
    with pytest.raises(WearcapError, match="at least 3x3"):
        Board(*wrong)


# The verb ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(shown, tmp_path_factory):
    root = tmp_path_factory.mktemp("pictures")
    for name, image in shown:
        cv2.imwrite(str(root / name), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return root


def command(source, out, *more) -> list[str]:
    return [
        f"source={source}",
        "columns=8",
        "rows=5",
        "square_m=0.03",
        f"hydra.run.dir={out}",
        f"output={out}/camera.json",
        *more,
    ]


def test_the_verb_on_a_folder(folder, tmp_path, capsys):
    verb.main(command(folder, tmp_path))
    near(read_camera(tmp_path / "camera.json"), 0.005)
    about = json.loads((tmp_path / "camera.json").read_text())["calibration"]
    assert about["pictures_examined"] == 24
    assert sum(view["used"] for view in about["views"]) >= 15
    assert "reprojection RMS" in capsys.readouterr().out


def test_the_verb_on_a_video(shown, tmp_path):
    with av.open(str(tmp_path / "board.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=10, options={"qscale": "2"})
        stream.width, stream.height, stream.pix_fmt = CAMERA.width, CAMERA.height, "yuv420p"
        stream.bit_rate = 20_000_000
        for _, image in shown:
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):
                container.mux(packet)
        container.mux(stream.encode())
    verb.main(command(tmp_path / "board.mp4", tmp_path, "max_pictures=24"))
    camera = read_camera(tmp_path / "camera.json")
    assert camera.fx == pytest.approx(CAMERA.fx, rel=0.01)


@pytest.mark.parametrize(
    ("source", "message"),
    [("none.mp4", "no such file or folder"), (".", "no pictures in this folder"), ("bad.mp4", "not a readable video")],
)
def test_the_verb_reports_what_is_wrong(source, message, tmp_path, capfd):
    (tmp_path / "bad.mp4").write_bytes(b"nothing of a video")
    with pytest.raises(SystemExit) as caught:
        cli.main(["calibrate", *command(tmp_path / source, tmp_path / "out")])
    assert caught.value.code == 2
    assert message in capfd.readouterr().err
    assert not (tmp_path / "out/camera.json").exists()


# The file ----------------------------------------------------------------------------------------------------------


def test_a_camera_file_round_trip(tmp_path):
    write_camera(CAMERA, tmp_path / "camera.json", {"rms_px": 0.1})
    assert read_camera(tmp_path / "camera.json") == CAMERA


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{}", "no intrinsics .lacks 'cx'"),
        ("[1]", "no intrinsics"),
        ("{", "not readable JSON"),
        ('{"camera": {"model": "opencv"}}', "intrinsics"),
        (
            '{"camera": {"model": "opencv", "width": 4, "height": 4, "fx": 1, "fy": 1, "cx": NaN, "cy": 1, "distortion": [0,0,0,0]}}',
            "not finite",
        ),
        (
            '{"camera": {"model": "lens", "width": 4, "height": 4, "fx": 1, "fy": 1, "cx": 1, "cy": 1, "distortion": []}}',
            "no camera model",
        ),
    ],
)
def test_missing_intrinsics(content, message, tmp_path):
    (tmp_path / "camera.json").write_text(content)
    with pytest.raises(WearcapError, match=message):
        read_camera(tmp_path / "camera.json")


def test_another_resolution_is_another_camera():
    assert replace(CAMERA, width=960) != CAMERA
