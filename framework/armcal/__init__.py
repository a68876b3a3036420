"""armcal finds what a robot arm really is, and how sure it is of each number.

The names below are the public Python interface; each is imported when it is first used, so that
``import armcal`` stays light.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"
