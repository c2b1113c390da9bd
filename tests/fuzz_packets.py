"""Every source of `wearcap live` is given damaged packets: it must understand or count them, quickly, and keep nothing.

    python tests/fuzz_packets.py [SOURCE ...] [--packets 1000000] [--seed 0]

Prints one JSON line per source: packets given, samples delivered, what was refused, the processor time of a packet
(median, 99th percentile, longest), growth of the process's memory over the last nine tenths, and growth of Python's own
over 20,000 more. Every sample that is delivered is checked, and after all that sound packets must still be understood.
`watch+http` is given whole requests on its connections, the others what their `parse` is given. Leaves with 1 when
anything is wrong: an exception, an invalid sample, a packet that takes longer than 0.1 s (1 MiB of JSON: 0.5 s), growth
beyond 16 MiB or, of Python's own, 256 KiB.
"""

import argparse
import contextlib
import gc
import json
import math
import os
import random
import socket
import struct
import sys
import threading
import time
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from fuzz_mutate import FLOATS, NUMBER, VALUES, WHOLE, mutated
from sound_packets import SOUND
from wearcap.apps.live.packets import Inbox, Packet
from wearcap.apps.live.source import Budget, DatagramSource
from wearcap.apps.live.sources import SOURCES, source_of
from wearcap.apps.live.sources.parts import MAX_NAME
from wearcap.apps.live.sources.watches import _Posts
from wearcap.apps.web.connections import Connection, Connections
from wearcap.apps.web.guard import Guard
from wearcap.sensors.packets import MAX_ACC_M_S2, MAX_POSITION_M, pose_fault, time_fault, values_fault
from wearcap.sensors.samples import (
    ActiveObject,
    HeadSample,
    LocalizationSample,
    ObjectSample,
    SuitPiece,
    WatchSample,
    WristSample,
)

MAX_DATAGRAM = 65_507
LONGEST_S = {"ws": 0.5, "watch+http": 0.5}
"""Limits of a packet's time, where messages may have 1 MiB; else 0.1 s."""
GROWTH_MIB, OWN_KIB = 16.0, 256.0
ADVANCE = 500
SOUND_EVERY = 8
"""One of so many packets is sound, so that the sources' state is one of use."""


EXTREMES = [struct.pack(">f", value) for value in FLOATS if not abs(value) > 1e38]
EXTREMES += [bytes.fromhex(text) for text in ("7f800000", "ff800000", "7f800001", "7f7fffff", "00000001")]
EXTREMES += [(value % (1 << 32)).to_bytes(4, "big") for value in WHOLE]
"""Extreme numbers as big-endian bytes: infinite, signalling, largest and smallest floats, and whole numbers."""


# --- damage ---------------------------------------------------------------------------------------------------------


def nested(data: bytes, depth: int) -> bytes:
    """An OSC bundle in bundles."""
    heads = [b"#bundle\0" + struct.pack(">Qi", 1, len(data) + 20 * inner) for inner in range(depth)]
    return b"".join(reversed(heads)) + data


def damaged(name: str, pool: list[bytes], seed: random.Random) -> bytes:
    """A packet of the pool with damage, cut to what a packet may have."""
    packet, dice = seed.choice(pool), seed.random()
    if dice < 0.05 and name in ("vmc", "osctrackers"):
        return nested(packet, seed.choice((1, 3, 4, 5, 60, 2000)))[:MAX_DATAGRAM]
    if dice < 0.1:  # all that is done to files, long runs of brackets among it
        return mutated(packet, seed.choice(pool), seed)[: 1 << 20 if name in LONGEST_S else MAX_DATAGRAM]
    damage = bytearray(packet)
    for _ in range(seed.choice((1, 1, 1, 2, 3))):
        place = int(seed.random() * max(len(damage), 1))
        match int(seed.random() * 6):
            case 0:  # bits
                for at in (place, int(seed.random() * len(damage))) if damage else ():
                    damage[at] ^= 1 << int(seed.random() * 8)
            case 1:
                del damage[place:]
            case 2:  # twice
                damage += damage[place:]
            case 3:  # a splice
                other = seed.choice(pool)
                damage[place:] = other[int(seed.random() * len(other)) :]
            case 4:  # an extreme number, binary
                damage[place & ~3 : (place & ~3) + 4] = seed.choice(EXTREMES)
            case _:  # and in a text
                found = NUMBER.search(damage, place)
                if found:
                    damage[found.start() : found.end()] = seed.choice(VALUES)
    return bytes(damage[:MAX_DATAGRAM])


# --- one source -----------------------------------------------------------------------------------------------------


def fault_of(packet: Packet) -> str | None:
    """Why a delivered packet is none, or None."""
    sample: Any = packet.sample
    if any(not isinstance(text, str) or len(text) > 2 * MAX_NAME for text in packet[:3]):
        return "names"
    if packet.sent_s is not None and time_fault(packet.sent_s):
        return "time"
    match sample:
        case HeadSample():
            points = (
                None
                if sample.points_world is None
                else values_fault(sample.points_world, (len(sample.points_world), 3), MAX_POSITION_M)
            )
            return points or (None if sample.T_world_device is None else pose_fault(sample.T_world_device))
        case WristSample():
            return pose_fault(sample.T_world_joint)
        case LocalizationSample():
            return pose_fault(sample.T_world_cam)
        case ObjectSample():
            return "names" if len(sample.name) > MAX_NAME else pose_fault(sample.T_world_object)
        case ActiveObject():
            return "names" if len(sample.name or "") > MAX_NAME else time_fault(sample.timestamp)
        case WatchSample():
            return values_fault(sample.acc_world, (3,), MAX_ACC_M_S2)
        case SuitPiece():
            R, t = sample.suit.R_parent_joint, sample.suit.t_world_root
            return values_fault(R, (1, 23, 3, 3), 1.01) or values_fault(t, (1, 3), MAX_POSITION_M)
    return "sample"


def _say(connection: socket.socket, data: bytes) -> None:
    """Send all of it, as far as somebody listens, and nothing more."""
    with contextlib.suppress(OSError):
        connection.sendall(data)
        connection.shutdown(socket.SHUT_WR)


class Fed:
    """A source that is given packets, and what came of them."""

    def __init__(self, name: str):
        self.name, self.source, self.inbox = name, source_of(f"{name}://127.0.0.1:0"), Inbox()
        assert isinstance(self.source, DatagramSource)
        self.now_s = 1000.0
        self.delivered: Counter[str] = Counter()
        self.faults: Counter[str] = Counter()
        self._posts = _Posts(self.source, Guard("127.0.0.1", open=True), self.inbox)

    def give(self, data: bytes, step_s: float = 0.004) -> int:
        """Give a packet; its processor time (ns)."""
        self.now_s += step_s
        begin = time.thread_time_ns()
        try:
            if self.name == "watch+http":
                self._connect(data)
                packets = self.inbox.wait(0)
            else:
                packets = self.source.parse(data, self.now_s, lambda why: self.inbox.refuse(self.name, why))  # type: ignore[attr-defined]
        except Exception as error:
            self.faults[f"{type(error).__name__}: {error}"[:200]] += 1
            packets = []
        spent = time.thread_time_ns() - begin
        for packet in packets:
            self.delivered[type(packet.sample).__name__] += 1
            if fault := fault_of(packet):
                self.faults[f"invalid sample: {fault}"] += 1
        return spent

    def _connect(self, data: bytes) -> None:
        """A connection of its own for the bytes."""
        self.source.budget = Budget(parse_s=math.inf)  # the rate limit is not what is tried here
        ours, theirs = socket.socketpair()
        self._posts.places[ours] = Connection(Connections(1), lambda: None)
        sender = threading.Thread(target=_say, args=(theirs, data))
        sender.start()
        self._posts.process_request_thread(ours, None)
        theirs.close()
        sender.join()


def rss_mib() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / (1 << 20)


def stream(name: str, seed: random.Random) -> Iterator[bytes]:
    """Packets without end, most of them damaged."""
    pools = [SOUND[name](frame) for frame in range(400)]
    number = 0
    while True:
        pool = pools[number // 20 % len(pools)]
        yield seed.choice(pool) if number % SOUND_EVERY == 0 else damaged(name, pool, seed)
        number += 1


def understands(fed: Fed) -> bool:
    """Whether sound packets still give samples, once the names that were made up are forgotten."""
    fed.now_s += 200.0
    before = sum(fed.delivered.values())
    for frame in range(5000, 5400):
        for packet in SOUND[fed.name](frame):
            fed.give(packet)
    return sum(fed.delivered.values()) - before >= 200


def fuzz(name: str, count: int, seed: int, advance: Callable[[], None]) -> dict[str, Any]:
    fed, packets = Fed(name), stream(name, random.Random(f"{name} {seed}"))
    spent, begin_mib, begin_s = np.ones(count, np.int64), 0.0, time.monotonic()  # ones: all of its memory is in use
    for number in range(count):
        if number == count // 10:
            gc.collect()
            begin_mib = rss_mib()
        spent[number] = fed.give(next(packets))
        if number % ADVANCE == ADVANCE - 1:
            advance()
    gc.collect()
    growth, seconds = rss_mib() - begin_mib, time.monotonic() - begin_s
    tracemalloc.start()
    own = []
    for _ in range(2):
        for _ in range(min(10_000, count // 2)):
            fed.give(next(packets))
        gc.collect()
        own.append(tracemalloc.get_traced_memory()[0] / 1024)
    tracemalloc.stop()
    sound = understands(fed)
    longest = spent.max() / 1e9
    wrong = dict(fed.faults)
    if longest > LONGEST_S.get(name, 0.1):
        wrong["too slow"] = 1
    if growth > GROWTH_MIB or own[1] - own[0] > OWN_KIB:
        wrong["growth"] = 1
    if not sound:
        wrong["sound packets are not understood afterwards"] = 1
    median, late = np.percentile(spent, [50, 99]) / 1e3
    return {
        "source": name, "packets": count, "seed": seed, "delivered": dict(fed.delivered),
        "refused": dict(fed.inbox.refused), "median_us": round(median, 1), "p99_us": round(late, 1),
        "longest_ms": round(1e3 * longest, 2), "growth_mib": round(growth, 2), "own_growth_kib": round(own[1] - own[0], 1),
        "seconds": round(seconds), "wrong": wrong,
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sources", nargs="*", metavar="SOURCE", help=", ".join(SOUND))
    parser.add_argument("--packets", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    if unknown := set(given.sources) - set(SOUND):
        parser.error(f"no source {', '.join(sorted(unknown))}; there are {', '.join(SOUND)}")
    assert set(SOUND) <= set(SOURCES)
    torch.set_num_threads(1)
    gc.freeze()  # what was imported need not be looked at again, which would take longer than any packet
    failed = False
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        for name in given.sources or SOUND:
            bar = progress.add_task(name, total=given.packets)
            line = fuzz(name, given.packets, given.seed, lambda bar=bar: progress.advance(bar, ADVANCE))
            progress.remove_task(bar)
            print(json.dumps(line), flush=True)
            failed |= bool(line["wrong"])
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
