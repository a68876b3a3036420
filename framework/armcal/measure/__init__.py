"""Measurements, groups and readers: what one record constrains, and how records are read."""
