"""MocapEvery: full-body motion from two watches and a head camera."""
