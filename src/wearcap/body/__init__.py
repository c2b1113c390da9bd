"""Skeletons, forward kinematics, body surfaces, retargeting."""
