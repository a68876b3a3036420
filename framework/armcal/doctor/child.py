"""What a check finds, and a process of its own to do it in.

A library that crashes, hangs or ends the process then costs that check alone.
"""

import json
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from types import MappingProxyType
from typing import Any, Literal

State = Literal["ok", "note", "warning", "fault"]
_NOTHING: Mapping[str, Any] = MappingProxyType({})

LONGEST_S = 120.0
"""A check takes a few seconds on a slow machine."""
_MARK = "\x1earmcal-doctor "
_START = "import sys; from armcal.doctor.child import answer; answer(sys.argv[1], sys.argv[2:])"


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


def ask(probe: str, *arguments: str, longest_s: float = LONGEST_S) -> Mapping[str, Any]:
    """What a function of ``armcal.doctor.probes`` gives, done in a fresh interpreter.

    Gives ``{"fault": one line}`` where it raises, crashes or does not end.
    """
    # -P: a file of the working directory called like a library is not taken for it, as it is not by the command.
    command = [sys.executable, "-P", "-c", _START, probe, *arguments]
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=longest_s,
            check=False,
            stdin=subprocess.DEVNULL,
        )
    except subprocess.TimeoutExpired:
        return {"fault": f"it did not end within {longest_s:.0f} s"}
    except OSError as fault:
        return {"fault": f"no process could be started ({one_line(fault)})"}
    for line in reversed(done.stdout.split("\n")):
        if line.startswith(_MARK):
            content: dict[str, Any] = json.loads(line.removeprefix(_MARK))
            return content
    if done.returncode < 0:
        try:
            name = signal.Signals(-done.returncode).name
        except ValueError:
            name = f"signal {-done.returncode}"
        return {"fault": f"the process crashed ({name})"}
    last = next((line.strip() for line in reversed(done.stderr.splitlines()) if line.strip()), "")
    said = f" ({last[:160]})" if last else ""
    return {"fault": f"the process ended with {done.returncode} and no answer{said}"}


def answer(probe: str, arguments: list[str]) -> None:
    """The child's side: do it, and write what it gave as the last line."""
    try:
        answer_content = getattr(import_module("armcal.doctor.probes"), probe)(*arguments)
    except BaseException as fault:  # a broken library may raise anything, or try to leave
        answer_content = {"fault": one_line(fault)}
    sys.stdout.write(f"\n{_MARK}{json.dumps(answer_content)}\n")
    sys.stdout.flush()


def one_line(fault: BaseException) -> str:
    """An exception in one line, cut to what a terminal shows well."""
    text = " ".join(f"{type(fault).__name__}: {fault}".split())
    return text if len(text) <= 200 else text[:197] + "..."
