"""Completion in a shell: the same options and values as the commands have, without what only running them needs."""

from __future__ import annotations

import os
import subprocess
import sys

import click
import pytest
from armcal.cli.completion import options_of
from armcal.cli.main import COMMANDS
from armcal.plugins import discover

HEAVY = ("numpy", "casadi", "scipy", "pydantic", "rich", "matplotlib", "cvxpy", "cv2")
TARGETS = {name: target for name, (target, _) in COMMANDS.items()} | {
    component.name: component.target for component in discover().components if component.kind == "command"
}


def leaves(command: click.Command) -> dict[str, click.Command]:
    """A command, or those of a group."""
    inner = command.commands if isinstance(command, click.Group) else {}
    return {"": command, **inner}


@pytest.mark.parametrize("name", sorted(TARGETS))
def test_what_is_completed_is_what_the_command_takes(name: str) -> None:
    module, _, attribute = TARGETS[name].partition(":")
    light = options_of(TARGETS[name])
    real = getattr(__import__(module, fromlist=[attribute]), attribute)
    assert light is not None and leaves(light).keys() == leaves(real).keys()
    for place, command in leaves(real).items():
        other = leaves(light)[place]
        assert [p.opts for p in other.params] == [p.opts for p in command.params]
        assert [type(p.type) for p in other.params] == [type(p.type) for p in command.params]
        context = click.Context(command)
        for ours, theirs in zip(other.params, command.params, strict=True):
            values = [[item.value for item in p.shell_complete(context, "")] for p in (ours, theirs)]
            assert values[0] == values[1], (place, ours.opts)


def completed(words: str, number: int, then: str = "") -> list[str]:
    code = f"from armcal.cli.main import main\ntry:\n    main()\nexcept SystemExit:\n    pass\n{then}"
    asked = {"_ARMCAL_COMPLETE": "bash_complete", "COMP_WORDS": words, "COMP_CWORD": str(number)}
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.argv[0] = 'armcal'\n{code}"],
        env={**os.environ, **asked},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    return done.stdout.split()


@pytest.mark.slow
def test_values_come_without_the_libraries_that_running_needs() -> None:
    loaded = (
        f"import sys; import os; os.write(1, ' '.join(['heavy:', *[m for m in {HEAVY} if m in sys.modules]]).encode())"
    )
    answer = completed("armcal export x.yaml --format ", 4, loaded)
    assert "plain,urdf" in answer and "plain,c" in answer
    assert answer[-1] == "heavy:", "no heavy library is loaded"
    assert {"plain,effect", "plain,model", "plain,reader"} <= set(completed("armcal new plugin a --kind ", 5))
    assert completed("armcal wat", 1) == ["plain,watch"]


def test_values_that_stand_in_a_plugins_other_file_are_completed_too() -> None:
    assert "plain,a4" in completed("armcal board chessboard --paper ", 4)
