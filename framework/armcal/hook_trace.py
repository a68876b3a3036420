"""Tracing of hook calls: which plugins answered, in which order, how long each took."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pluggy

from armcal.errors import ConfigError, Location

VARIABLE = "ARMCAL_TRACE_HOOKS"
"""The environment variable: ``1`` traces to standard error, a file's name appends to that file; empty or ``0``: off."""

_OFF, _STANDARD_ERROR = ("", "0"), "1"
_LONGEST_TEXT = 60


@dataclass(frozen=True)
class Answer:
    """What one plugin's hook did: how long it took (s), and what it raised, in words; nothing if it did not."""

    plugin: str
    seconds: float
    fault: str = ""

    def __str__(self) -> str:
        raised = f", raised {self.fault}" if self.fault else ""
        return f"{self.plugin} {_told(self.seconds)}{raised}"


@dataclass(frozen=True)
class HookTrace:
    """Writes one line a hook call.

    Attributes:
        path: the file that lines are appended to; None for standard error.
        active: whether anything is written at all.
    """

    path: Path | None = None
    active: bool = True

    @classmethod
    def from_environment(cls) -> HookTrace:
        """As the environment variable asks.

        Raises:
            ConfigError: the file that it names cannot be written.
        """
        text = os.environ.get(VARIABLE, "").strip()
        if text in _OFF or text == _STANDARD_ERROR:
            return cls(None, text == _STANDARD_ERROR)
        trace = cls(Path(text).expanduser().absolute())
        try:
            trace._append("")
        except (OSError, ValueError) as fault:
            reason = fault.strerror if isinstance(fault, OSError) else str(fault)
            raise ConfigError(
                f"found {text!r}, which cannot be written ({reason}).",
                where=Location(VARIABLE),
                hint="Give 1 for standard error, or a file that can be written.",
            ) from fault
        return trace

    def watch(self, manager: pluggy.PluginManager) -> None:
        """Trace every hook call of a plugin manager; one plugin answers each of its hooks."""
        if not self.active:
            return
        began: list[float] = []

        def before(hook: str, answering: Sequence[Any], arguments: Mapping[str, Any]) -> None:
            began.append(time.perf_counter())

        def after(outcome: Any, hook: str, answering: Sequence[Any], arguments: Mapping[str, Any]) -> None:
            seconds = time.perf_counter() - began.pop()
            if answering:
                fault = _raised(outcome.exception)
                in_order = [plugin.plugin_name for plugin in reversed(answering)]  # pluggy calls the last one first
                self.write(hook, arguments, [Answer(" then ".join(in_order), seconds, fault)], seconds)

        manager.add_hookcall_monitoring(before, after)

    def write(self, hook: str, arguments: Mapping[str, Any], answers: Sequence[Answer], seconds: float) -> None:
        """One line: hook, arguments in short, who answered in which order, and how long all of it took (s)."""
        if not self.active:
            return
        given = ", ".join(f"{name}={_short(value)}" for name, value in arguments.items())
        line = f"armcal hook {hook}({given}): {'; '.join(map(str, answers)) or 'no listener'}"
        line = f"{line}; all {_told(seconds)}\n" if len(answers) > 1 else f"{line}\n"
        try:
            self._append(line)
        except (OSError, ValueError):  # a full disk or a closed pipe must not cost anybody a calibration
            return

    def _append(self, line: str) -> None:
        if self.path is None:
            sys.stderr.write(line)
            return
        with self.path.open("a", encoding="utf-8") as file:
            file.write(line)


def _told(seconds: float) -> str:
    return f"{1e3 * seconds:.3f} ms"


def _raised(fault: BaseException | None) -> str:
    return "" if fault is None else type(fault).__name__


def _short(value: Any) -> str:
    """An argument in a few characters: text and numbers themselves, of the rest what they are."""
    if value is None or isinstance(value, (str, int, float)):
        text = repr(value)
        return text if len(text) <= _LONGEST_TEXT else f"{text[: _LONGEST_TEXT - 3]}..."
    return f"<{getattr(value, '__name__', type(value).__name__)}>"
