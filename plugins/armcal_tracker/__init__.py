"""Trackers: tip positions and poses, the CSV files they are kept in, and live frames."""
