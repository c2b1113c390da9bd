"""Sockets that say nothing, in a process of their own, and open again as soon as they are closed."""

import subprocess
import sys
from contextlib import contextmanager

ATTACK = """
import resource, socket, sys, time
port, count = int(sys.argv[1]), int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_NOFILE, (4096, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
held, begin, ready = {}, time.monotonic(), False
while time.monotonic() - begin < 60:
    for k in range(count):  # each is opened anew as soon as it has been closed
        try:
            if k not in held:
                held[k] = socket.socket()
                held[k].setblocking(False)
                held[k].connect_ex(("127.0.0.1", port))
            elif held[k].recv(100) == b"":
                held.pop(k).close()
        except BlockingIOError:
            pass
        except OSError:
            held.pop(k).close()
    if not ready:
        print("ready", flush=True)
        ready = True
    time.sleep(0.05)
"""


@contextmanager
def silent(port: int, count: int):
    """So many sockets that say nothing, in a process of their own, which open again when they are closed."""
    process = subprocess.Popen([sys.executable, "-c", ATTACK, str(port), str(count)], stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        process.stdout.readline()
        yield
    finally:
        process.kill()
        process.wait()
