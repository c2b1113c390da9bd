"""Seeded flats, sites, streets and hillsides, and the furniture and objects in them."""
