"""The page that `wearcap export format=web` writes, in headless Chromium: poses are Python's, in a replay, of a file that is
dropped, and live in an emulated headset; it works offline and reaches no other host.

Meta's Immersive Web Emulation Runtime (`iwer`) plays the headset.
"""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import wearcap
from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import Skeleton, skeleton_of_height
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import matrix_from_quat_wxyz
from wearcap.io.devices.aria_mps import T_HEAD_DEVICE
from wearcap.reading import read
from wearcap.runtime.system import CaptureInput
from wearcap.runtime.wearer import Wearer
from wearcap.sensors.samples import HeadSample, WristSample
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.tracking.stature import estimate_stature
from wearcap_browser import Chromium, chromium
from web_page import node_modules, served, simulated, write

pytestmark = [pytest.mark.browser, pytest.mark.slow]
ROOT = Path(__file__).parents[2]
LONG_S = 240.0
"""Time that a page may take where many share the processor."""
WAITING = "globalThis.wearcap?.motion?.times.length"


@pytest.fixture(scope="module")
def system() -> HMD2:
    return replace(wearcap.load("hmd2_online"), runtime="eager", precision="float32", use=["hands"])


@pytest.fixture(scope="module")
def recording():
    return simulated(4.0)


@pytest.fixture(scope="module")
def page(system, recording, tmp_path_factory) -> Path:
    return write(system, tmp_path_factory.mktemp("web") / "page", recording)


def captured(
    browser: Chromium, skeleton: Skeleton, motion: str = "wearcap.motion"
) -> tuple[torch.Tensor, torch.Tensor]:
    """Times, and places of all joints, of the motion that the page captured."""
    text = browser.evaluate(f"JSON.stringify({motion}.rows.map((row) => Array.from(row)))")
    rows = torch.tensor(json.loads(text), dtype=torch.float64)
    joints = len(skeleton)
    xyzw = rows[:, 4 : 4 + 4 * joints].unflatten(1, (joints, 4))
    T = forward_kinematics(skeleton, matrix_from_quat_wxyz(xyzw.roll(1, -1)), rows[:, 1:4])
    return rows[:, 0], T.t


def whole(browser: Chromium, frames: int) -> bool:
    assert not browser.evaluate("globalThis.wearcap?.errors.length"), browser.evaluate("wearcap.errors[0]")
    return (browser.evaluate(WAITING) or 0) >= frames


def test_a_replay_is_what_python_captures_and_works_offline(system, recording, page, tmp_path):
    motion = system.motions([CaptureInput(recording)], [0])[0]
    with served(page) as (url, server, asked), chromium(tmp_path, url, (640, 400)) as browser:
        browser.poll(lambda: whole(browser, len(motion)), LONG_S)
        times, joints = captured(browser, motion.skeleton)
        assert len(times) == len(motion)
        assert (joints - motion.T_world_joint.t).norm(dim=-1).max() < 1e-3
        assert browser.evaluate("wearcap.bodies.truth.duration") == pytest.approx(
            motion.timestamps[-1].item(), abs=0.02
        )
        browser.poll(lambda: not browser.evaluate("document.getElementById('offline').hidden"), LONG_S)
        count = len(asked)
        server.shutdown()
        server.server_close()
        browser.go(url)
        browser.poll(lambda: whole(browser, len(motion)), LONG_S)
        assert (captured(browser, motion.skeleton)[1] - joints).norm(dim=-1).max() < 1e-6
        assert len(asked) == count
        assert not browser.exceptions


def test_nothing_leaves_the_page(page, tmp_path):
    """Neither the page nor a worker of it reaches another host."""
    script = "fetch('{url}?secret').then(() => 'reached', () => 'refused')"
    with served(page) as (url, _, _), served(page) as (other, _, asked), chromium(tmp_path, url, (640, 400)) as browser:
        browser.poll(lambda: browser.evaluate(WAITING), LONG_S)

        def result(expression: str) -> str:
            reply = browser.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
            return reply["result"]["value"]

        assert result(script.format(url=other)) == "refused"
        inside = script.format(url=other).replace("'", '\\"')
        worker = f"""new Promise((done) => {{
            const text = "{inside}.then((found) => postMessage(found))";
            const worker = new Worker(URL.createObjectURL(new Blob([text], {{type: "text/javascript"}})), {{type: "module"}});
            worker.onmessage = ({{data}}) => done(data);
        }})"""
        assert result(worker) == "refused"
        loaded = json.loads(
            browser.evaluate("JSON.stringify(performance.getEntriesByType('resource').map((e) => e.name))")
        )
        assert all(name.startswith((url, "blob:", "data:")) for name in loaded)
        assert not asked


def drop(browser: Chromium, name: str, content: bytes) -> None:
    """Drop a file on the page, as a hand does."""
    browser.evaluate(f"""(() => {{
        const files = new DataTransfer();
        files.items.add(new File([new Uint8Array({list(content)})], {json.dumps(name)}));
        window.dispatchEvent(new DragEvent("drop", {{dataTransfer: files, cancelable: true, bubbles: true}}));
    }})()""")


def test_a_dropped_file_is_captured_as_python_captures_it(system, page, tmp_path):
    log = ROOT / "examples/headset_walk.csv"
    rows = log.read_text().splitlines()[:200]
    file = tmp_path / "log.csv"
    file.write_text("\n".join(rows))
    with served(page) as (url, _, _), chromium(tmp_path / "profile", url, (640, 400)) as browser:
        browser.poll(lambda: browser.evaluate(WAITING), LONG_S)
        drop(browser, "<b>bad</b>.csv", b"time,head_pos_x\n0,1\n1,2\n2,3\n")
        browser.poll(lambda: browser.evaluate("!document.getElementById('error').hidden"), LONG_S)
        assert "head" in browser.evaluate("document.getElementById('error').textContent")
        assert browser.evaluate("document.querySelector('#error b, #title b, #status b')") is None
        browser.evaluate("wearcap.errors.length = 0")
        drop(browser, "<i>walk</i>.csv", file.read_bytes())
        browser.poll(lambda: browser.evaluate("wearcap.recording.name") == "<i>walk</i>.csv", LONG_S)
        assert browser.evaluate("document.getElementById('title').textContent") == "<i>walk</i>.csv"
        browser.poll(lambda: browser.evaluate("wearcap.height?.height > 0 && wearcap.motion.times.length > 0"), LONG_S)
        height = browser.evaluate("wearcap.height.height")
        walk = read(file)
        found = estimate_stature(walk, system.model.skeleton)
        assert height == pytest.approx(found.height_m, abs=0.03)
        walk = replace(walk, skeleton=skeleton_of_height(height, system.model.skeleton))
        motion = streamed(system, walk, 0.0)
        browser.poll(lambda: whole(browser, len(motion)), LONG_S)
        times, joints = captured(browser, walk.skeleton)
        assert len(times) == len(motion)
        assert (joints - motion.T_world_joint.t).norm(dim=-1).max() < 1e-3
        assert not browser.exceptions


def streamed(system: HMD2, walk, floor_m: float):
    """A recording's capture on a floor that is known, as a stream knows it."""
    samples = [
        HeadSample(time.item(), Rigid(R, t), floor_height=floor_m)
        for time, R, t in zip(walk.head.timestamps, walk.head.R_world_device, walk.head.t_world_device)
    ]
    wrists = [
        WristSample(joint, time.item(), Rigid(R, t))
        for joint, track in walk.tracked.items()
        for time, R, t in zip(track.timestamps, track.R_world_body.float(), track.t_world_body.float())
    ]
    return session_of(system, walk.skeleton, walk.head.R_head_device, walk.head.t_head_device, [*wrists, *samples])


def session_of(system: HMD2, skeleton: Skeleton, R_head_device, t_head_device, samples):
    from wearcap.recording.timing import joined
    from wearcap.systems.hmd2.stream import HMD2Session

    session = HMD2Session(system, [Wearer(skeleton, R_head_device, t_head_device)], [0])
    found = []
    time_of = lambda sample: sample.timestamp  # noqa: E731
    for sample in sorted(samples, key=time_of):
        session.push([[sample]])
        found += [motion for motion in session.poses() if motion is not None]
    found += [motion for motion in session.poses(ended=True) if motion is not None]
    return joined(found)


HEADSET = """(() => {
    const device = new IWER.XRDevice(IWER.metaQuest3);
    device.installRuntime({forceInstall: true});
    device.stereoEnabled = false;
    globalThis.headset = device;
    const move = () => {
        const t = performance.now() / 1000;
        device.position.set(0.1 * Math.sin(1.3 * t), 1.6 + 0.01 * Math.sin(5 * t), -0.1 * Math.cos(t));
        const turn = 0.2 * Math.sin(0.7 * t);
        device.quaternion.set(0, Math.sin(turn / 2), 0, Math.cos(turn / 2));
        device.controllers.left.position.set(-0.25 + 0.05 * Math.sin(t), 1.2 + 0.08 * Math.sin(1.5 * t), -0.25);
        device.controllers.right.position.set(0.25, 1.15 + 0.08 * Math.cos(t), -0.22);
    };
    move();
    setInterval(move, 10);
})()"""
KEEP = """(() => {
    wearcap.kept = [];
    const post = wearcap.worker.postMessage.bind(wearcap.worker);
    wearcap.worker.postMessage = (message, ...rest) => {
        if (message.kind === "sample") wearcap.kept.push(message.sample);
        post(message, ...rest);
    };
})()"""


def test_a_headset_drives_the_body_that_python_captures(system, page, tmp_path):
    emulator = (node_modules() / "iwer/build/iwer.min.js") if (node_modules() / "iwer").is_dir() else None
    if emulator is None:
        pytest.skip("no iwer: run `npm ci` in integrations/web")
    with served(page) as (url, _, _), chromium(tmp_path, "about:blank", (640, 400)) as browser:
        browser.call("Page.enable")
        browser.call("Page.addScriptToEvaluateOnNewDocument", source=f"{emulator.read_text()};{HEADSET}")
        browser.go(url)
        browser.poll(lambda: browser.evaluate(WAITING), LONG_S)
        browser.evaluate(KEEP)
        browser.press("Enter the headset", lambda: browser.evaluate("!!wearcap.headset.session"))
        browser.poll(lambda: browser.evaluate("(wearcap.headset.motion?.times.length ?? 0) > 150"), LONG_S)
        # The body is on the head and wrists of now, in every frame, whatever the network's pace.
        pose = json.loads(
            browser.evaluate("""(() => {
            const {head, wrists, time} = wearcap.kept[wearcap.kept.length - 1];
            const {skeleton} = wearcap.headset;
            const {local, root} = wearcap.headset.posed(head, wrists);
            const {R, t} = skeleton.forward(local, root);
            return JSON.stringify({head: t[skeleton.head], device: head, wrists: wrists.map((wrist) => wrist.t),
                own: ["left_wrist", "right_wrist"].map((name) => t[skeleton.index(name)]), soles: skeleton.soles({R, t}),
                height: skeleton.stature, determinant: wearcap.scene.stage.matrix.determinant()});
        })()""")
        )
        head = torch.tensor(pose["device"]["t"]) - torch.tensor(pose["device"]["R"]).reshape(3, 3) @ T_HEAD_DEVICE.t
        assert (torch.tensor(pose["head"]) - head).norm() < 1e-4
        assert (torch.tensor(pose["own"]) - torch.tensor(pose["wrists"])).norm(dim=-1).max() < 0.02
        assert min(point[2] for point in pose["soles"]) == pytest.approx(0, abs=0.08)
        assert 1.6 < pose["height"] < 1.85
        assert pose["determinant"] == pytest.approx(-1)
        # What the worker captured is the stream's own motion of the same samples.
        skeleton = skeleton_of_height(pose["height"], system.model.skeleton)
        samples = json.loads(browser.evaluate("JSON.stringify(wearcap.kept)"))
        times, joints = captured(browser, skeleton, "wearcap.headset.motion")
        browser.evaluate("wearcap.headset.session.end()")
        browser.poll(lambda: browser.evaluate("!wearcap.headset.session"), LONG_S)
        browser.poll(lambda: browser.evaluate(WAITING), LONG_S)  # the sample again
        assert not browser.exceptions
    known = [sample for sample in samples if sample["time"] >= times[0].item() - 1e-6]
    T_of = lambda pose: Rigid(torch.tensor(pose["R"]).reshape(3, 3), torch.tensor(pose["t"]))  # noqa: E731
    heads = [HeadSample(sample["time"], T_of(sample["head"]), floor_height=0.0) for sample in known]
    wrists = [
        WristSample(joint, sample["time"], T_of(pose))
        for sample in known
        for joint, pose in zip(("left_wrist", "right_wrist"), sample["wrists"])
        if pose
    ]
    live = replace(system, overlap=replace(system.overlap, lookahead=4))
    motion = session_of(live, skeleton, T_HEAD_DEVICE.R, T_HEAD_DEVICE.t, [*wrists, *heads])
    count = min(len(times), len(motion))
    assert count > 120
    assert (joints[:count] - motion.T_world_joint.t[:count]).norm(dim=-1).max() < 1e-3


def test_the_benchmark_counts_frames(page):
    found = measured(page, 1.0, (320, 200))
    assert found["value"] > 0
    assert 0 < found["window_ms"] < 60_000
