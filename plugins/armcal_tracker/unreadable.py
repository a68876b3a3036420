"""What came from a tracker and cannot be read."""

from __future__ import annotations


class UnreadableError(ValueError):
    """Says why in a few words, always the same for the same reason, so that reasons can be counted."""
