"""Simulated recordings of each system: people in places with the readings of their sensors and the truth."""
