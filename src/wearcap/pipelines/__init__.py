"""A Recording goes in, a Motion comes out: each file shows its paper's steps in order."""
