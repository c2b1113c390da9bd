"""Live capture: devices in, a system's session, engines out, while people move (`wearcap live`).

A packet's way: a source (`sources/`) parses it, `clocks` put its time on the head's clock, `setup` says who wears the
device and how, the system's session makes poses of the samples, and sinks (`sinks/`) send them on.
"""
