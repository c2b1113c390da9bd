"""Sources that run in a thread while a test sends to them."""

import asyncio
import threading
import time

from wearcap.apps.live.packets import Inbox
from wearcap.apps.live.sources import source_of


class Served:
    """A source that runs in a thread of its own while the `with` block runs."""

    def __init__(self, url: str):
        self.source, self.inbox = source_of(url), Inbox()
        self.error: BaseException | None = None
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._task = self._loop.create_task(self.source.run(self.inbox))
        try:
            self._loop.run_until_complete(self._task)
        except asyncio.CancelledError:
            pass
        except BaseException as error:
            self.error = error
        self._loop.close()

    def __enter__(self) -> "Served":
        self._thread.start()
        time.sleep(0.3)
        return self

    def __exit__(self, *_) -> None:
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._task.cancel)
        self._thread.join(10)
        assert not self._thread.is_alive()

    def packets(self, count: int, seconds: float = 5.0) -> list:
        """The packets that arrive until there are so many, or the time is over."""
        found, end = [], time.monotonic() + seconds
        while len(found) < count and time.monotonic() < end:
            found += self.inbox.wait(0.1)
        return found
