"""The version of armcal, at the bottom of the house: every room may name it."""

from __future__ import annotations

from pathlib import Path

__version__ = "0.1.0"
JSON_SCHEMA = {"schema_version": 1}
"""Stands first in what ``--json`` prints; the number grows when a key goes or changes its meaning."""
SOURCES = Path(__file__).parent  # Where the core is installed
