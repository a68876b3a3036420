"""The version of armcal, at the bottom of the house: every room may name it."""

from __future__ import annotations

from pathlib import Path

__version__ = "0.1.0"
SOURCES = Path(__file__).parent
"""Where the core is installed."""
