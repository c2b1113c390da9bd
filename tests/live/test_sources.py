"""All sources: random and damaged packets never raise, and what is delivered is valid; the page on adapters is right."""

import json
import re
import socket
import struct
import subprocess
import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path

import mvn_datagrams
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from serving import Served

from ports import free_port
from wearcap.apps.live.packets import Packet
from wearcap.apps.live.source import DatagramSource
from wearcap.apps.live.sources import SOURCES, source_of
from wearcap.sensors.packets import MAX_ACC_M_S2, MAX_POSITION_M

PAGE = (Path(__file__).parents[2] / "docs" / "live_adapters.md").read_text(encoding="utf-8")
PARSING = sorted(name for name, source in SOURCES.items() if issubclass(source, DatagramSource))


def osc(address: str, tags: str, *values) -> bytes:
    """An OSC message, written by hand."""
    data = b""
    for text in (address, "," + tags):
        raw = text.encode()
        data += raw + b"\0" * (4 - len(raw) % 4)
    for tag, value in zip(tags, values):
        data += struct.pack(f">{tag}", value) if tag in "ifd" else value.encode() + b"\0" * (4 - len(value) % 4)
    return data


SEEDS = {
    "vmc": [osc("/VMC/Ext/Hmd/Pos", "sfffffff", "h", 1, 2, 3, 0, 0, 0, 1), osc("/VMC/Ext/T", "f", 1.0)],
    "osctrackers": [osc("/tracking/trackers/1/position", "fff", 1, 2, 3), osc("/tracking/trackers/1/rotation", "fff", 9, 9, 9)],
    "mvn": [*mvn_datagrams.pose(1), *mvn_datagrams.size()],
    "watch": [json.dumps({"deviceId": "a", "payload": [{"name": "gravity", "time": 1, "values": {"x": 0, "y": 0, "z": 1}}]}).encode()],
    "json": [json.dumps(each | {"position": [1, 2, 3], "rotation_wxyz": [1, 0, 0, 0]}).encode() for each in ({"device": "head"}, {"object": "box"}, {"active_object": "box"})],
}  # fmt: skip
SEEDS |= {"watch+http": SEEDS["watch"], "ws": SEEDS["json"]}


def assert_valid(packet: Packet) -> None:
    assert np.isfinite(packet.sample.timestamp if hasattr(packet.sample, "timestamp") else 0.0)
    for name in ("T_world_device", "T_world_joint", "T_world_cam", "T_world_object"):
        pose = getattr(packet.sample, name, None)
        if pose is not None:
            assert float(pose.t.abs().max()) <= MAX_POSITION_M
            assert np.allclose(pose.R @ pose.R.T, np.eye(3), atol=0.1)
    acc = getattr(packet.sample, "acc_world", None)
    assert acc is None or float(acc.abs().max()) <= MAX_ACC_M_S2


@pytest.mark.parametrize("scheme", PARSING)
@given(data=st.data())
def test_damaged_packets_never_raise(scheme, data):
    source, refused = source_of(scheme), Counter()
    assert isinstance(source, DatagramSource)
    for number in range(6):
        packet = bytearray(data.draw(st.sampled_from([*SEEDS[scheme], b""])))
        for _ in range(data.draw(st.integers(0, 4))):
            place = data.draw(st.integers(0, len(packet)))
            packet[place : place + data.draw(st.integers(0, 8))] = data.draw(st.binary(max_size=8))
        packets = source.parse(bytes(packet), 10.0 + number, lambda why: refused.update([why]))
        for each in packets:
            assert_valid(each)


def test_the_page_names_every_source():
    for scheme, source in SOURCES.items():
        if issubclass(source, DatagramSource):
            assert f"`{scheme}://…:{source.port}`" in PAGE


def test_the_adapter_of_the_page_sends_what_it_says():
    code = re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert code is not None
    assert len(code[1].strip().splitlines()) <= 25
    port = free_port(socket.SOCK_DGRAM)
    with Served(f"json://127.0.0.1:{port}") as served:
        adapter = subprocess.Popen([sys.executable, "-c", code[1].replace("9100", str(port))])
        try:
            packets = served.packets(120, 20.0)
        finally:
            adapter.kill()
            adapter.wait()
    assert not served.inbox.refused
    heads = [packet for packet in packets if packet.device == "head"]
    assert {packet.device for packet in packets} == {"head", "left_wrist"}
    for before, packet in pairwise(heads):
        assert packet.sent_s - before.sent_s == pytest.approx(1 / 60)
        assert packet.sample.T_world_device.t[0] == pytest.approx(0.5 * packet.sent_s, abs=1e-4)
    # It keeps its pace: the last of the packets arrives when its time says so, and a busy machine may be late.
    spent = heads[-1].arrived_s - heads[0].arrived_s
    assert spent > 0.8 * (heads[-1].sent_s - heads[0].sent_s) - 0.2
