"""What sensors on a moving body would say: head devices, inertial sensors, SLAM points."""
