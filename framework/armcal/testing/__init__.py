"""What a plugin must keep to, as checks: ``armcal plugins check NAME``, or ``contract.check_component``."""

from __future__ import annotations

from pathlib import Path

EXAMPLE_TRUTH = Path(__file__).with_name("truth.yaml")
"""A truth for a simulator's ``EXAMPLE``: values of the planar arm that the checks put before it."""
