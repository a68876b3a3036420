"""Trackers: tip positions, and the CSV files they are kept in."""
