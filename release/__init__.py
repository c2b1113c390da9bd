"""What a release takes: the registry of checkpoints, tests of the wheel in fresh environments, checks before a tag."""
