"""Simulated sensors of the simulated wearer: suit, SLAM points, keypoints in view."""
