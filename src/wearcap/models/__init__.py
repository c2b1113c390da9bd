"""Pure networks: tensors in, tensors out; no Lightning, no losses, no schedules."""
