"""Damaged files and packets, kills, floods and long runs."""
