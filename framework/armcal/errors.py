"""What armcal raises: every message says what was found, what was expected, where, and what to do next."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

EXIT_DONE = 0
EXIT_FAULT = 1
EXIT_BAD_INPUT = 2
EXIT_NOT_CONVERGED = 3
EXIT_DO_NOT_USE = EXIT_NOT_CONVERGED  # a calibration whose verdict is bad is as little use as none
EXIT_INCOMPLETE = 3  # a part of what was asked for is missing: tables, poses, or the safety of a rehearsal
EXIT_STOPPED = 4  # a measuring run held or parked before its end; it can be resumed
EXIT_INTERRUPTED = 130  # Ctrl-C: 128 and the number of SIGINT, as shells have it


@dataclass(frozen=True)
class Location:
    """Where in what a user gave: a file, and in it a line (from 1), a field (dotted) or a data row (from 1)."""

    file: str | None = None
    line: int | None = None
    field: str | None = None
    row: int | None = None

    def __str__(self) -> str:
        place = self.file or ""
        if self.line is not None:
            place += f":{self.line}" if place else f"line {self.line}"
        parts = [place] if place else []
        if self.row is not None:
            parts.append(f"row {self.row}")
        if self.field:
            parts.append(self.field)
        return ", ".join(parts)


class CalibrationWarning(UserWarning):
    """A calibration can be used, and its user should know something of it."""


class ArmcalError(Exception):
    """The root of armcal's own errors.

    Args:
        message: what was found and what was expected.
        where: the place in the user's input.
        hint: what to do next, a full sentence.
    """

    exit_code = EXIT_FAULT

    def __init__(self, message: str, *, where: Location | None = None, hint: str = "") -> None:
        self.message = message
        self.where = where
        self.hint = hint
        super().__init__(str(self))

    def __str__(self) -> str:
        place = str(self.where) if self.where else ""
        text = f"{place}: {self.message}" if place else self.message
        return f"{text} {self.hint}".rstrip()


class InputError(ArmcalError):
    """Something a user gave is refused."""

    exit_code = EXIT_BAD_INPUT


@contextmanager
def noted(warnings: Iterable[str]) -> Iterator[None]:
    """Give what is refused inside the warnings that came before it, as notes: one of them may be its cause."""
    try:
        yield
    except InputError as fault:
        for text in warnings:
            fault.add_note(text)
        raise


class ConfigError(InputError):
    """A configuration is refused."""


class DataError(InputError):
    """A dataset is refused."""


class PluginError(InputError):
    """A plugin that was asked for is missing, broken or ambiguous."""


class BrokenPluginError(PluginError):
    """A plugin's code failed; its cause is what Python raised, which is shown with its traceback."""


class ProblemError(InputError):
    """The data and the parameters asked for do not make a problem that can be solved."""


class NotConvergedError(ArmcalError):
    """A solver or the elastic equilibrium did not converge."""

    exit_code = EXIT_NOT_CONVERGED
