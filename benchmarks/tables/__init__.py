"""What `tables.py` makes: a module per system or data, and what they share."""
