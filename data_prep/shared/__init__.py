"""What data sets share: the engine that makes recordings, and motion capture without sensors on training skeletons."""
