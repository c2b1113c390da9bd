"""AvatarPoser-style regression from tracked points (Jiang et al. 2022): a baseline of HMD²'s tables."""
