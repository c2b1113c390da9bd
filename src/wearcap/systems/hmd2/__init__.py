"""HMD²: full-body motion from a head-mounted device by conditional motion diffusion (thesis ch. 6)."""
