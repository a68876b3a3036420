"""Measuring runs: a pose plan driven, measured and journalled."""
