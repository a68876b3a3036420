"""What tests of ``armcal new`` share: packages installed where only PYTHONPATH finds them, pages word for word."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import forked
import pytest

ROOT = Path(__file__).resolve().parents[1]
BIN = Path(sys.executable).parent
Ran = subprocess.CompletedProcess[str]
FILE = re.compile(r'^```\w+ title="([^"]+)"\n(.*?)^```$', re.DOTALL | re.MULTILINE)
COMMANDS = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def run(*command: str, cwd: Path, site: Path | None = None) -> Ran:
    """A command with this Python's own programs first; pip installs into ``site`` alone, and downloads nothing."""
    environment = {**os.environ, "PYTHONPATH": str(site or ""), **variables(site or cwd / "site")}
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=cwd, check=False)


def variables(site: Path) -> dict[str, str]:
    """Of the environment of each command."""
    return {
        "PATH": f"{BIN}{os.pathsep}{os.environ.get('PATH', '')}",
        "COLUMNS": "1000",
        "ARMCAL_CC": "none",
        "PIP_TARGET": str(site),
        "PIP_UPGRADE": "1",
        "PIP_NO_DEPS": "1",
        "PIP_NO_BUILD_ISOLATION": "0",  # pip's own words for --no-build-isolation
        "PIP_NO_INDEX": "1",
        "PIP_QUIET": "1",
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
        "PYTEST_ADDOPTS": "-p no:cacheprovider",
    }


def armcal(*arguments: str, cwd: Path, site: Path | None = None) -> Ran:
    """The command line, whether or not its script is installed."""
    return forked.armcal(*arguments, cwd=cwd, path=site, environment=variables(site or cwd / "site"))


def install(package: Path, site: Path) -> None:
    """Build and install a package as pip does; skips where it cannot."""
    need("pip", "hatchling")
    ran = run(sys.executable, "-m", "pip", "install", ".", cwd=package, site=site)
    assert ran.returncode == 0, ran.stderr


def need(*modules: str) -> None:
    """Skip without these."""
    for module in modules:
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"{module} is not installed here")


def page(name: str) -> str:
    """A page of the documentation."""
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def files_of(text: str) -> dict[str, str]:
    """Files that a page shows in full, by the title of their blocks."""
    return {match[1]: match[2] for match in FILE.finditer(text)}


def commands_of(text: str, kind: str) -> list[str]:
    """Commands that a page shows in blocks of a kind, in order."""
    blocks = [block for own, block in COMMANDS.findall(text) if own == kind]
    return [line[2:] for block in blocks for line in block.splitlines() if line.startswith("$ ")]


def do(command: str, cwd: Path, site: Path | None = None) -> Path:
    """Do a command as a reader would; gives where the reader is then."""
    if command.startswith("cd "):
        return (cwd / command[3:]).resolve()
    if shutil.which("bash") is None or not (BIN / "armcal").exists():
        pytest.skip("bash or the armcal script is not installed here")
    ran = run("bash", "-ec", command, cwd=cwd, site=site)
    assert ran.returncode == 0, f"{command}\n{ran.stdout}{ran.stderr}"
    return cwd
