"""Motions of a person who slides, carries, opens and uses objects."""
