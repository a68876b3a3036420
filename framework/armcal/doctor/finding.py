"""What a check found."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

State = Literal["ok", "note", "warning", "fault"]
_NOTHING: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class Finding:
    """One line of the doctor's report.

    Attributes:
        section: which part of the report it belongs to.
        subject: what was looked at.
        state: ``ok``; ``note``: not there and not needed; ``warning``: something that armcal can do without is broken
            or out of range; ``fault``: no arm can be calibrated like this.
        text: what was found, and what that costs.
        hint: what to do next, a full sentence; empty where nothing is to be done.
        detail: the same for programs, by name.
    """

    section: str
    subject: str
    state: State
    text: str
    hint: str = ""
    detail: Mapping[str, Any] = field(default_factory=lambda: _NOTHING)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        content = {"section": self.section, "subject": self.subject, "state": self.state, "text": self.text}
        return {**content, "hint": self.hint or None, **self.detail}
