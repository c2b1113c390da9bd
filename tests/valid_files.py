"""Every reader of wearcap.io with a small valid file for it."""

import gzip
import json
import lzma
import pickle
import sys
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch

TESTS = Path(__file__).resolve().parent
sys.path[:0] = [path for path in (str(TESTS), str(TESTS / "io")) if path not in sys.path]

import hoi_files  # noqa: E402
import hps_files  # noqa: E402
import mocap_every_files  # noqa: E402
import ocam_files  # noqa: E402
import one_object_files  # noqa: E402
import test_adt  # noqa: E402
import test_aria_mps  # noqa: E402
import test_asf_amc  # noqa: E402
import test_colmap  # noqa: E402
import test_egohoi  # noqa: E402
import test_glb  # noqa: E402
import test_hand_detections  # noqa: E402
import test_hcontact  # noqa: E402
import test_headset_layouts  # noqa: E402
import test_mvnx  # noqa: E402
import test_watch_log  # noqa: E402
import totalcapture_files  # noqa: E402
from PIL import Image  # noqa: E402

import c3d_files  # noqa: E402
import foreign_bvh  # noqa: E402
import keypoint_files  # noqa: E402
import marker_person  # noqa: E402
import rig_files  # noqa: E402
import short_walk  # noqa: E402
from data_prep import (  # noqa: E402
    adt,
    behave,
    egohoi,
    hcontact,
    hps,
    keypoint_detectors,
    mocap_every_folder,
    nymeria,
    omomo,
    totalcapture,
    ui_prmd,
)
from wearcap.body.skeletons import smplh52  # noqa: E402
from wearcap.boundary import arrays, pickles, texts  # noqa: E402
from wearcap.geometry.camera import Camera  # noqa: E402
from wearcap.geometry.rigid import Rigid  # noqa: E402
from wearcap.geometry.trajectory import Trajectory  # noqa: E402
from wearcap.io.devices import aria_hands, aria_mps, headset_log, headset_tables, watch_log  # noqa: E402
from wearcap.io.formats import (  # noqa: E402
    amass,
    asf_amc,
    bsor,
    bvh,
    c3d_markers,
    camera_frames,
    camera_json,
    colmap,
    contact_labels,
    csv_table,
    environment,
    glb,
    glb_rig,
    hand_detections,
    motion_npz,
    mvnx,
    navvis,
    ocamcalib,
    pcd,
    ply,
    scene_folder,
    smpl,
    trajectory,
    trc,
    video,
    wavefront,
)
from wearcap.prepare import foreign  # noqa: E402
from wearcap.recording import Cue  # noqa: E402
from wearcap.scene.scan import Photo  # noqa: E402
from wearcap.sensors import watch_calibration  # noqa: E402
from wearcap_testing import swaying_motion  # noqa: E402


@dataclass(frozen=True)
class Reader:
    """What writes a reader's files into an empty folder, and what reads them."""

    write: Callable[[Path], Any]
    read: Callable[[Path], Any]


LENS = Camera("pinhole", 16, 12, 12.0, 12.0, 7.5, 5.5)
POSE = Rigid(torch.eye(3), torch.tensor([1.0, 2.0, 3.0]))
FRAMES = 12
"""Of data sets whose files are long: short ones show the same faults sooner."""
TUM = "".join(f"{0.1 * k:.1f} {k} 2 3 0 0 0 1\n" for k in range(12))
EUROC = "#timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z\n" + "".join(f"{10**9 * k},{k},0,0,1,0,0,0\n" for k in range(1, 9))
NERF = json.dumps({"frames": [{"file_path": f"{k}.png", "transform_matrix": np.eye(4).tolist()} for k in range(6)]})
_WATCH = '{"R_world_ref_wxyz": [1, 0, 0, 0], "R_joint_imu_wxyz": [1, 0, 0, 0], "board_still_deg": 0.1, "board_tilt_deg": 0.2, "pose_still_deg": 1}'
_CLOCK = '{"camera_s": [1, 2], "watch_s": [3, 4], "swings": 9, "drift_s_per_hour": 0, "residual_s": 0, "std_s": 0.001}'
WORN = f"""{{"watches": {{"left_wrist": {_WATCH}, "right_wrist": {_WATCH}}}, "clocks": {{"left_wrist": {_CLOCK}}},
 "camera": {{"scale": 2, "R_world_slam_wxyz": [1, 0, 0, 0], "t_world_slam": [0, 0, 1], "residual_m": 0.01}},
 "head": {{"R_head_cam_wxyz": [1, 0, 0, 0], "t_head_cam": [0, 0, 0], "still_deg": 1}}}}"""
POINTS = "uid,graph_uid,px_world,py_world,pz_world,inv_dist_std,dist_std\n1,g,1,2,0,0.001,0.001\n2,g,1,2,9,0.1,1\n"
ASCII_PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 2
property list uchar int vertex_indices
end_header
0 0 0 1 2 3
1 0 0 1 2 3
1 1 0 1 2 3
0 1 0 1 2 3
4 0 1 2 3
3 0 2 3
"""
PCD = "VERSION .7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 4\nHEIGHT 1\nPOINTS 4\nDATA "
CONTACTS = {"contacts": {"left_hand": [[0.5, 1.0]], "right_hand": [[0.5, 1.0], [1.5, 0.0]]}}
ENVIRONMENT_OBJECT = "door"
NODES = [{"children": [1, 2], "translation": [1, 2, 3]}, {"mesh": 0, "scale": [2, 2, 2]}, {"mesh": 0}]


def one(name: str, content: str | bytes, read: Callable[[Path], Any]) -> Reader:
    """A reader of one file that is known by its content."""
    data = content.encode() if isinstance(content, str) else content
    return Reader(lambda folder: (folder / name).write_bytes(data), lambda folder: read(folder / name))


def made(name: str, write: Callable[[Path], Any], read: Callable[[Path], Any]) -> Reader:
    """A reader of one file that another function writes."""
    return Reader(lambda folder: write(folder / name), lambda folder: read(folder / name))


def _headset_poses() -> tuple:
    time, R, t = short_walk.walk(seconds=1.0)
    return time, short_walk.headset_poses(time, R, t, "unity", "grip")


def _headset_csv(path: Path) -> None:
    names = {name: name + "_{quantity}_{axis}" for name in ("head", "left", "right")}
    short_walk.headset_csv(path, *_headset_poses(), {"time": "time"} | names)


def _headset_json(path: Path, dumps: Callable[[list[dict]], str]) -> None:
    path.write_text(dumps(short_walk.headset_frames(*_headset_poses())))


def _x_imu(folder: Path) -> None:
    """Inertial.csv and Quaternion.csv of a sensor at rest."""
    names = [
        f"{kind} {axis} ({unit})" for kind, unit in (("Gyroscope", "deg/s"), ("Accelerometer", "g")) for axis in "XYZ"
    ]
    rows = "".join(f"{20000 * k},0.1,0.2,0.3,0,0,1\n" for k in range(30))
    (folder / "Inertial.csv").write_text(",".join(["Timestamp (us)", *names]) + "\n" + rows)
    rows = "".join(f"{20000 * k},1,0,0,0\n" for k in range(30))
    (folder / "Quaternion.csv").write_text("Timestamp (us),W,X,Y,Z\n" + rows)


def _points(count: int = 8) -> np.ndarray:
    return np.random.default_rng(0).normal(0, 1, (count, 3)).astype(np.float32)


def _compressed_pcd() -> bytes:
    rows = _points(4).T.tobytes() + bytes(16)
    literal = b"".join(bytes([len(rows[k : k + 32]) - 1]) + rows[k : k + 32] for k in range(0, len(rows), 32))
    sizes = np.array([len(literal), len(rows)], "<u4").tobytes()
    return (PCD + "binary_compressed\n").encode() + sizes + literal


def _uneven_ply(order: str) -> bytes:
    header = ASCII_PLY.split("end_header")[0].replace("ascii", f"binary_{order}_endian") + "end_header\n"
    sign = "<" if order == "little" else ">"
    vertices = np.zeros(4, [("p", sign + "f4", 3), ("c", "u1", 3)]).tobytes()
    faces = b"".join(bytes([len(f)]) + np.array(f, sign + "i4").tobytes() for f in ([0, 1, 2, 3], [0, 2, 3]))
    return header.encode() + vertices + faces


def _mps(folder: Path) -> None:
    slam = folder / "slam"
    slam.mkdir()
    test_aria_mps.write(slam / "closed_loop_trajectory.csv", test_aria_mps.rows(20))
    (slam / "semidense_points.csv.gz").write_bytes(gzip.compress(POINTS.encode(), mtime=0))


def _hands(folder: Path) -> None:
    columns = [
        f"{part}_{{}}_{place}"
        for place in ("wrist_device", "palm_device")
        for part in ("tx", "ty", "tz", "nx", "ny", "nz")
    ]
    names = [f"{side}_tracking_confidence" for side in ("left", "right")]
    names += [name.format(side) for side in ("left", "right") for name in columns]
    rows = []
    for k in range(12):
        places = ["0.1", "0.2", "0.3", "0", "0", "1", "0.18", "0.2", "0.3", "0", "0", "1"]
        rows.append(",".join([str(10_000_000 + 33_333 * k), "0.9", "0.9", *places, *places]))
    (folder / "wrist_and_palm_poses.csv").write_text(
        "\n".join([",".join(["tracking_timestamp_us", *names]), *rows]) + "\n"
    )


def _read_hands(folder: Path):
    times = torch.tensor([9.0, 12.0], dtype=torch.float64)
    head = Trajectory(times, torch.eye(3).repeat(2, 1, 1), torch.zeros(2, 3))
    return aria_hands.read_hands([folder / "wrist_and_palm_poses.csv"], head)


def _adt_objects(folder: Path) -> None:
    (folder / "scene_objects.csv").write_text(
        "object_uid,timestamp[ns],t_wo_x[m],t_wo_y[m],t_wo_z[m],q_wo_w,q_wo_x,q_wo_y,q_wo_z\n"
        "9007199254740993,-1,1,2,3,1,0,0,0\n77,1000000000,0,0,0,1,0,0,0\n77,2000000000,1,0,0,1,0,0,0\n"
    )
    bounds = ",".join(f"p_local_obj_{axis}{end}[m]" for axis in "xyz" for end in ("min", "max"))
    (folder / "3d_bounding_box.csv").write_text(
        f"object_uid,timestamp[ns],{bounds}\n9007199254740993,-1,-1,1,-2,2,-3,3\n77,-1,0,1,0,1,0,1\n"
    )
    about = {
        uid: {"instance_name": name, "category": name, "motion_type": motion}
        for uid, name, motion in (("9007199254740993", "sofa", "static"), ("77", "cup", "dynamic"))
    }
    (folder / "instances.json").write_text(json.dumps(about))


def _xdata(path: Path) -> None:
    joints = swaying_motion(30, fps=240.0).T_world_joint
    quat = np.tile([1, 0, 0, 0], (30, 23)).astype(np.float32)
    np.savez(
        path,
        timestamps_us=np.arange(30) * 4167,
        frameCount=[30],
        frameRate=[240],
        segmentCount=[23],
        segment_tXYZ=joints.t.reshape(30, -1).numpy(),
        segment_qWXYZ=quat,
        foot_contacts=np.zeros((30, 4), np.int8),
    )


def _hand_detections(folder: Path) -> None:
    for name in ("HOD", "VISOR", "COCO"):
        (folder / f"{name}.json").write_text(json.dumps(getattr(test_hand_detections, name)))


def _vertex_contacts(folder: Path) -> None:
    np.savez(folder / "p.npz", contact=np.full((3, 8), 0.5, np.float32), frames=[1, 2, 4])
    (folder / "s.json").write_text('{"leftHand": [0, 1], "rightHand": [2], "rightHandIndex1": [3]}')


def _environment(folder: Path) -> None:
    mesh = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 2], [0, 0, 2]], np.float32)
    ply.write_ply(ply.Ply(mesh, None, np.array([[0, 1, 2], [0, 2, 3]], np.int32)), folder / "objects/door.ply")
    row = {
        "name": "door",
        "category": "door",
        "mesh": "objects/door.ply",
        "R_world_object": np.eye(3).tolist(),
        "t_world_object": [0, 0, 0],
        "freedom": {"kind": "hinge", "pivot": [0, 0, 0], "limits_deg": [-5, 90]},
    }
    (folder / "environment.json").write_text(json.dumps({"schema_version": 1, "objects": [row]}))


def _smpl(path: Path) -> None:
    random = np.random.default_rng(0)
    np.savez(path, v_template=random.normal(size=(30, 3)), shapedirs=random.normal(size=(30, 3, 4)),
             J_regressor=random.random((24, 30)), weights=random.random((30, 24)),
             kintree_table=np.stack([np.arange(24) - 1, np.arange(24)]), f=np.array([[0, 1, 2], [2, 3, 4]]))  # fmt: skip


def _joblib(folder: Path) -> None:
    one_object_files.write_omomo(folder, one_object_files.omomo_entry(seconds=0.5))


def _pictures(folder: Path) -> None:
    for name in ("a.png", "b.jpg"):
        Image.fromarray(np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8)).save(folder / name)


def _video(path: Path) -> None:
    video.write_frames(path, [np.full((32, 48, 3), 20 * k, np.uint8) for k in range(6)], 30.0)


def _c3d(path: Path) -> None:
    c3d_files.write_c3d(_markers(), path, analog=2)


def _markers() -> trc.Markers:
    places = torch.rand(5, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return trc.Markers(torch.arange(5, dtype=torch.float64) / 100, ("LASI", "RASI", "C7"), places)


def _cues(path: Path) -> None:
    times = torch.arange(5, dtype=torch.float64) / 30
    keypoint_files.write_keypoints({"left_wrist": Cue(times, "left_wrist", torch.rand(5, 3), torch.ones(5))}, path)


def _mocap_every(folder: Path) -> None:
    mocap_every_files.write_capture(folder, seconds=2.0)
    (folder / "config.yaml").write_text("start: 0\nmap: {a: [1, 2], b: x}\n")


def _amass(path: Path) -> None:
    amass.write_amass(swaying_motion(12, skeleton=smplh52()), path)


CLOCK = contact_labels.LabelClock.of("flat_1", torch.arange(600, dtype=torch.float64) / 60)
HCONTACT_JSON = json.dumps(hoi_files.smpl_content(hoi_files.motion(4)))
LENSES = {"cam0": ocam_files.lens(0.2), "cam1": ocam_files.lens(0.2)}
PICKLED = pickle.dumps({"a": [1, 2.5, "x", (None, True)], "b": np.arange(12.0).reshape(3, 4), "c": np.float32(2)})


def _foreign_walk(path: Path) -> None:
    """Bones along each joint's own x, position channels on every joint, a root on the ground."""
    foreign_bvh.write(path, foreign_bvh.CONVENTIONS["studio"], *foreign_bvh.walk(6))


READERS: dict[str, Reader] = {
    "adt_skeleton": made("s.json", test_adt.skeleton_file, adt.read_skeleton),
    "adt_objects": Reader(_adt_objects, adt.read_moving_objects),
    "amass": made("a.npz", _amass, amass.read_amass),
    "aria_closed_loop": made(
        "a.csv", lambda path: test_aria_mps.write(path, test_aria_mps.rows(12)), aria_mps.read_closed_loop
    ),
    "aria_points": one("a.csv.gz", gzip.compress(POINTS.encode(), mtime=0), aria_mps.read_points),
    "aria_mps": Reader(_mps, aria_mps.read_mps),
    "aria_hands": Reader(_hands, _read_hands),
    "asf": one("a.asf", test_asf_amc.ASF, asf_amc.read_asf),
    "amc": Reader(
        lambda folder: test_asf_amc.write(folder, amc=test_asf_amc.amc_text(4)),
        lambda folder: asf_amc.read_amc(asf_amc.read_asf(next(folder.glob("*.asf"))), next(folder.glob("*.amc"))),
    ),
    "behave": Reader(
        lambda folder: one_object_files.write_behave(folder, body={"gender": None}),
        lambda folder: behave.read_behave(folder, one_object_files.BEHAVE_NAME),
    ),
    "behave_mesh": Reader(one_object_files.write_behave, lambda folder: behave.read_behave_mesh(folder, "boxlarge")),
    "bvh": made("a.bvh", lambda path: bvh.write_bvh(swaying_motion(4), path), bvh.read_bvh_content),
    "foreign_bvh": made("a.bvh", _foreign_walk, foreign.read_foreign_motion),
    "camera_json": made("c.json", lambda path: camera_json.write_camera(LENS, path), camera_json.read_camera),
    "colmap_text": Reader(test_colmap.write_text_model, colmap.read_colmap),
    "colmap_binary": Reader(test_colmap.write_binary_model, colmap.read_colmap),
    "contact_labels": one("c.json", json.dumps(CONTACTS), lambda path: contact_labels.read_contact_labels(path, CLOCK)),
    "csv_table": one(
        "a.csv", "a,b,n\n1,x,3\n2.5,y,4\n", lambda path: csv_table.read_columns(path, ["a"], text=["b"], integers=["n"])
    ),
    "egohoi": Reader(
        lambda folder: test_egohoi.write_set(folder, FRAMES), lambda folder: egohoi.read_egohoi(folder, test_egohoi.ONE)
    ),
    "egohoi_locations": one("l.json", json.dumps(test_egohoi.SLID), egohoi.read_object_locations),
    "environment": Reader(_environment, environment.read_environment),
    "euroc": one("e.csv", EUROC, trajectory.read_trajectory),
    "hand_detections": Reader(
        _hand_detections,
        lambda folder: [hand_detections.read_hand_detections(path, 0.5) for path in sorted(folder.iterdir())],
    ),
    "vertex_contacts": Reader(
        _vertex_contacts, lambda folder: hand_detections.read_vertex_contacts(folder / "p.npz", folder / "s.json")
    ),
    "glb_rig": made("rig.vrm", lambda path: rig_files.write(path, vrm=True), glb_rig.read_glb_rig),
    "glb": one("a.glb", test_glb.glb(test_glb.content(nodes=NODES)), glb.read_glb),
    "hcontact": Reader(
        lambda folder: test_hcontact.write_set(folder, frames=FRAMES),
        lambda folder: hcontact.read_hcontact(folder, test_hcontact.DOOR),
    ),
    "hcontact_split": one(
        "s.json",
        json.dumps({"window_radius": 30, "train": [31, 99], "valid": [], "test": [150]}),
        hcontact.read_hcontact_split,
    ),
    "hps_motion": made("m.pkl", lambda path: hps_files.write_smpl(hps_files.motion(4), path), hps.read_hps_motion),
    "hps_subject": one(
        "s.json", json.dumps({"betas": [0.1] * 10, "gender": "male", "root_to_heel": 0.93}), hps.read_hps_subject
    ),
    "hps_starts": one("s.json", json.dumps({"cam_start": 3, "imu_start": 4}), hps.read_hps_starts),
    "hps_localization": made(
        "l.json",
        lambda path: hps_files.write_localization(hps_files.motion(20), path, 3, (4,)),
        hps.read_hps_localization,
    ),
    "hps_cameras": one("c.json", json.dumps(hps_files.CAMERA), hps.read_hps_cameras),
    "hps_scene": Reader(hps_files.write_scan, navvis.read_navvis_scan),
    "hps_sequence": Reader(
        lambda folder: hps_files.write_hps(folder, frames=FRAMES),
        lambda folder: hps.read_hps_sequence(folder, hps_files.NAME),
    ),
    "hps_unity": Reader(
        lambda folder: hps_files.write_unity(hps_files.motion(4), folder, "u"),
        lambda folder: hps.read_unity_motion(folder / "u_pose.txt", folder / "u_trans.txt"),
    ),
    "json_text": one("a.json", '{"a": [1, 2.5, null], "b": {"c": "x"}}', texts.read_json_object),
    "keypoints_csv": made("k.csv", _cues, keypoint_detectors.read_keypoints),
    "mocap_every": Reader(_mocap_every, mocap_every_folder.read_mocap_every_folder),
    "motion_npz": made("m.npz", lambda path: motion_npz.write_motion(swaying_motion(4), path), motion_npz.read_motion),
    "mvnx": one("m.mvnx", test_mvnx.mvnx(test_mvnx.sample(2)), mvnx.read_mvnx),
    "mvnx_packed": one(
        "m.mvnx.xz", lzma.compress(test_mvnx.mvnx(test_mvnx.sample(2)).encode(), preset=0), mvnx.read_mvnx
    ),
    "npz": made(
        "a.npz",
        lambda path: np.savez_compressed(path, a=np.arange(12.0), b=np.array("text"), c=np.asfortranarray(np.eye(3))),
        arrays.read_npz,
    ),
    "nymeria_xdata": made("x.npz", _xdata, nymeria.read_xdata),
    "nymeria_metadata": Reader(
        lambda folder: (folder / "metadata.json").write_text('{"fake_name": "a", "participant_height_cm": 160}'),
        nymeria.read_metadata,
    ),
    "sensor_frame": one(
        "s.xml",
        ocam_files.xml_of(LENSES),
        lambda path: [model.camera() for model in ocamcalib.read_sensor_frame(path).values()],
    ),
    "omomo": Reader(_joblib, lambda folder: [omomo.omomo_take(one, folder, 30.0) for one in omomo.read_omomo(folder)]),
    "pcd_ascii": one("a.pcd", PCD + "ascii\n0 0 0 1\n1 2 3 4\n2 3 4 5\nnan nan nan 0\n", pcd.read_pcd),
    "pcd_binary": one("a.pcd", (PCD + "binary\n").encode() + bytes(64), pcd.read_pcd),
    "pcd_compressed": one("a.pcd", _compressed_pcd(), pcd.read_pcd),
    "photos": Reader(
        lambda folder: camera_json.write_photos([Photo(Path("a.png"), LENS, POSE)], folder), camera_json.read_photos
    ),
    "pictures": Reader(_pictures, lambda folder: list(video.read_pictures(folder, 2))),
    "ply_ascii": one("a.ply", ASCII_PLY, ply.read_ply),
    "ply_even": made(
        "a.ply",
        lambda path: ply.write_ply(ply.Ply(_points(), None, np.array([[0, 1, 2]] * 4, np.int32)), path),
        ply.read_ply,
    ),
    "ply_little": one("a.ply", _uneven_ply("little"), ply.read_ply),
    "ply_big": one("a.ply", _uneven_ply("big"), ply.read_ply),
    "pickle": one("a.pkl", PICKLED, pickles.read_pickle),
    "pickle_packed": one("a.pkl", zlib.compress(PICKLED), pickles.read_pickle),
    "pickle_joblib": Reader(_joblib, lambda folder: pickles.read_pickle(next(folder.glob("*.p")))),
    "scan": made("s.ply", lambda path: ply.write_ply(ply.Ply(_points(300)), path), scene_folder.read_scan),
    "scene_folder": Reader(hps_files.write_scan, scene_folder.read_scene),
    "smpl_files": made("m.npz", _smpl, smpl.read_smpl),
    "smpl_json": one("m.json", HCONTACT_JSON, hcontact.read_smpl_json),
    "smpl_json_zip": made("m.json.zip", lambda path: hoi_files.write_zip(HCONTACT_JSON, path), hcontact.read_smpl_json),
    "text": one(
        "a.txt.gz",
        gzip.compress(b"some words\nof text\n", mtime=0),
        lambda path: (texts.read_text(path), list(texts.numbered_lines(path))),
    ),
    "totalcapture": Reader(
        lambda folder: totalcapture_files.write_totalcapture(folder, frames=6),
        lambda folder: totalcapture.read_totalcapture(totalcapture.totalcapture_files(folder)[0]),
    ),
    **{
        f"trajectory_{name}": Reader(
            lambda folder, write=write, file=file: write(folder / file, *short_walk.walk(seconds=1.0)),
            lambda folder, file=file: trajectory.read_trajectory(folder / file),
        )
        for name, file, write in (
            ("colmap_text", "images.txt", short_walk.colmap_text),
            ("colmap_binary", "images.bin", short_walk.colmap_binary),
            ("hloc", "poses.txt", short_walk.hloc),
            ("droid", "poses.npy", short_walk.droid),
            ("droid_archive", "poses.npz", short_walk.droid_archive),
            ("kitti", "poses.txt", short_walk.kitti),
            ("mps", "closed_loop_trajectory.csv", short_walk.mps),
        )
    },
    "headset_csv": made("h.csv", _headset_csv, headset_log.read_headset_log),
    "headset_tables": made("h.csv", _headset_csv, headset_tables.read_rows),
    "bsor": made("a.bsor", lambda path: test_headset_layouts.replay(path.parent), bsor.read_bsor),
    "camera_frames": one("transforms.json", NERF, lambda path: list(camera_frames.read_camera_frames(path)[1])),
    "headset_json": made("h.json", lambda path: _headset_json(path, json.dumps), headset_log.read_headset_log),
    "headset_lines": made(
        "h.jsonl",
        lambda path: _headset_json(path, lambda frames: "\n".join(map(json.dumps, frames))),
        headset_log.read_headset_log,
    ),
    "x_imu": Reader(_x_imu, lambda folder: watch_log.read_inertial_log(folder / "Inertial.csv", "left_wrist")),
    "watch_calibration": one("c.json", WORN, watch_calibration.read_watch_calibration),
    **({"c3d": made("m.c3d", _c3d, c3d_markers.read_c3d)} if find_spec("c3d") else {}),
    "trc": made("m.trc", lambda path: marker_person.write_trc(_markers(), path), trc.read_trc),
    "tum": one("t.txt", TUM, trajectory.read_trajectory),
    "tum_gz": one("t.txt.gz", gzip.compress(TUM.encode(), mtime=0), trajectory.read_trajectory),
    "tum_xz": one("t.txt.xz", lzma.compress(TUM.encode()), trajectory.read_trajectory),
    "ui_prmd": one("m01_s01_e01.txt", "".join(",".join(["1.5"] * 117) + "\n" for _ in range(4)), ui_prmd.read_ui_prmd),
    "ui_prmd_packed": made("m.npy", lambda path: np.save(path, np.ones((6, 117), np.int32)), ui_prmd.read_ui_prmd),
    "image": made("a.png", lambda path: _pictures(path.parent), video.read_image),
    "video_frames": made("a.mp4", _video, lambda path: list(video.read_frames(path))),
    "video_info": made("a.mp4", _video, video.video_info),
    "watch_log_logger": made(
        "w.csv",
        lambda path: test_watch_log.sensor_logger(test_watch_log.moved(20), path),
        lambda path: watch_log.read_watch_log(path, "left_wrist"),
    ),
    "watch_log_log": made(
        "w.csv",
        lambda path: test_watch_log.sensor_log(test_watch_log.moved(20), path),
        lambda path: watch_log.read_watch_log(path, "left_wrist"),
    ),
    "wavefront": one("a.obj", one_object_files.obj_text(), wavefront.read_obj),
}
"""Readers by name. Aria's VRS recordings are left out: they are read by projectaria-tools."""
