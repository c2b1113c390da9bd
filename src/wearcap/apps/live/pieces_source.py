"""A recording that still grows, as a recorder writes it piece by piece into a folder (`recording.pieces`)."""

import asyncio
import threading
import time
from collections import Counter
from pathlib import Path

from wearcap.apps.live.packets import HANDS, SUIT, Inbox, Packet
from wearcap.apps.live.source import Address, Source
from wearcap.errors import WearcapError
from wearcap.recording import Recording
from wearcap.recording.pieces import follow_pieces
from wearcap.runtime.system import System
from wearcap.sensors.samples import HandSample


class PiecesSource(Source):
    """Sends a folder's pieces of a suit as they appear, each once the one before has been captured."""

    scheme, port, hz = "pieces", 0, 60.0
    convention = "the recording's own"
    lossless = patient = True

    def __init__(self, folder: Path, system: System):
        """Waits for the first piece. Raises WearcapError where none appears, and for one that the system cannot follow."""
        super().__init__(Address("pieces", "127.0.0.1", 0))
        self.folder, self.system, self.kind = folder, system, system.session_class()
        self._refused: Counter[str] = Counter()
        self._stop = threading.Event()
        self._pieces = follow_pieces(folder, refused=self._refused, stop=self._stop)
        first = next(self._pieces, None)
        if first is None:
            raise WearcapError("a recording without pieces", folder, "piece-000000.safetensors, …")
        self.first, self._sample = first, self.kind.of_piece(system, first, folder, None)

    @property
    def name(self) -> str:
        return f"pieces:{self.folder.name}"

    async def run(self, inbox: Inbox) -> None:
        try:
            await self._send(inbox)
        finally:
            self._stop.set()
            for reason, count in self._refused.items():
                inbox.refused[f"{self.name}: {reason}"] += count

    async def _send(self, inbox: Inbox) -> None:
        piece: Recording | None = self.first
        sample = self._sample
        while piece is not None:
            if sample is not None and len(sample.suit):
                sent_s = sample.suit.timestamps[0].item()
                packets = [Packet(self.wearer, SUIT, self.name, sent_s, time.monotonic(), sample)]
                inbox.deliver(packets + self._hands(piece))
            while inbox.waiting:
                await asyncio.sleep(0.01)
            piece = await asyncio.to_thread(next, self._pieces, None)
            if piece is not None:
                sample = await asyncio.to_thread(self.kind.of_piece, self.system, piece, self.folder, self._refused)

    def _hands(self, piece: Recording) -> list[Packet]:
        """The packets of a piece's tracked hands."""
        packets = []
        for hand, side in HANDS.items():
            if (stream := piece.fingers.get(side)) is not None:
                for k, sent_s in enumerate(stream.timestamps.tolist()):
                    sample = HandSample(side, sent_s, stream.frame(k))
                    packets.append(Packet(self.wearer, hand, self.name, sent_s, time.monotonic(), sample))
        return packets
