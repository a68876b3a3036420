"""Completion in a shell: commands and options' values."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest


def completed(words: str, number: int) -> list[str]:
    code = "from armcal.cli.main import main\ntry:\n    main()\nexcept SystemExit:\n    pass\n"
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
def test_values_of_options_are_completed() -> None:
    assert {"plain,effect", "plain,model", "plain,reader"} <= set(completed("armcal new plugin a --kind ", 5))
    assert completed("armcal wat", 1) == ["plain,watch"]
    assert "plain,a4" in completed("armcal board chessboard --paper ", 4)
