"""What is released: wheel and source distribution, the same bytes anywhere, complete, working where nothing else is."""

from __future__ import annotations

import email
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from dataclasses import dataclass
from email.message import Message
from pathlib import Path

import pytest
import yaml

pytest.importorskip("hatchling", reason="hatchling is not installed here, and builds the release")

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("framework", "plugins")
LRM = ROOT / "configs" / "lrm_arm"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@dataclass(frozen=True)
class Release:
    """What a build left."""

    wheel: Path
    sdist: Path

    def metadata(self) -> Message:
        """The wheel's."""
        with zipfile.ZipFile(self.wheel) as wheel:
            name = next(n for n in wheel.namelist() if n.endswith(".dist-info/METADATA"))
            return email.message_from_bytes(wheel.read(name))


def build(tree: Path, place: Path, *options: str) -> Path:
    """Build a tree; where it went."""
    environment = {**os.environ, "SOURCE_DATE_EPOCH": "1577836800"}
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(place), *options]
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return place


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The checkout as it is now, so that nothing changes between two builds."""
    copy = tmp_path_factory.mktemp("tree") / "armcal"
    left_out = shutil.ignore_patterns(
        ".git", ".venv", ".hypothesis", "__pycache__", "*.egg-info", "runs", "site", "dist", ".*_cache"
    )
    shutil.copytree(ROOT, copy, ignore=left_out)
    return copy


@pytest.fixture(scope="module")
def release(tree: Path, tmp_path_factory: pytest.TempPathFactory) -> Release:
    place = build(tree, tmp_path_factory.mktemp("dist"))
    (wheel,), (sdist,) = place.glob("*.whl"), place.glob("*.tar.gz")
    return Release(wheel, sdist)


def held_by(tree: Path) -> set[str]:
    """Every file that the wheel must hold, by its name in the wheel."""
    found = set()
    for source in SOURCES:
        for path in (tree / source).rglob("*"):
            if path.is_file() and path.suffix not in (".pyc", ".md"):
                found.add(path.relative_to(tree / source).as_posix())
    for demonstration in ("ball", "camera", "lrm_arm", "so101"):
        for path in (tree / "configs" / demonstration).rglob("*"):
            found.add(f"armcal/demos/{path.relative_to(tree / 'configs').as_posix()}")
    return found


def test_the_wheel_holds_every_file_of_the_sources_and_nothing_else(tree: Path, release: Release) -> None:
    with zipfile.ZipFile(release.wheel) as wheel:
        names = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert names == held_by(tree)
    needed = {
        "armcal/functions/kernel_support.h",
        "armcal/report/page.html.j2",
        "armcal/report/style.css",
    }
    assert needed <= names
    assert not any(name.startswith(("test", "framework", "plugins", "configs")) for name in names)


def test_the_source_distribution_makes_the_same_wheel(release: Release, tmp_path: Path) -> None:
    shutil.unpack_archive(release.sdist, tmp_path)
    (unpacked,) = tmp_path.iterdir()
    again = next(build(unpacked, tmp_path / "dist", "-t", "wheel").glob("*.whl"))
    assert again.name == release.wheel.name
    assert again.read_bytes() == release.wheel.read_bytes()


@pytest.mark.slow
def test_two_builds_are_the_same_bytes_whatever_the_files_times(tree: Path, release: Release, tmp_path: Path) -> None:
    os.utime(tree / "framework" / "armcal" / "errors.py", (1, 1))
    place = build(tree, tmp_path)
    for built in (release.wheel, release.sdist):
        assert (place / built.name).read_bytes() == built.read_bytes(), built.name


def test_the_source_distribution_holds_what_a_checkout_needs(release: Release) -> None:
    with tarfile.open(release.sdist) as packed:
        names = {name.partition("/")[2] for name in packed.getnames()}
    for needed in (
        "Makefile",
        "LICENSE",
        "README.md",
        "CHANGELOG.md",
        "REFERENCES.md",
        "constraints.txt",
        "mkdocs.yml",
        "configs/lrm_arm/demo.csv",
        "docs/calibrate.md",
        "tests/conftest.py",
        "tests/data/scara_plugin/pyproject.toml",
        "benchmarks/__main__.py",
    ):
        assert needed in names, needed
    assert not any(name.startswith((".git/", "runs/", "dist/", "site/", ".venv/")) for name in names)


def test_the_metadata_says_what_the_project_says(release: Release) -> None:
    import armcal

    told = release.metadata()
    assert told["Name"] == "armcal" and told["Version"] == armcal.__version__
    assert told["Summary"] and told["License-Expression"] == "MIT" and told["Requires-Python"] == ">=3.11"
    assert "# armcal" in str(told.get_payload())
    assert set(told.get_all("Provides-Extra", [])) == set(PROJECT["optional-dependencies"])
    assert len(told.get_all("Requires-Dist", [])) == len(PROJECT["dependencies"]) + sum(
        len(needed) for needed in PROJECT["optional-dependencies"].values()
    )
    known = pytest.importorskip("trove_classifiers").classifiers
    assert set(told.get_all("Classifier", [])) <= known
    with zipfile.ZipFile(release.wheel) as wheel:
        assert any(name.endswith(".dist-info/licenses/LICENSE") for name in wheel.namelist())


def test_the_version_stands_in_one_place() -> None:
    import armcal

    assert "version" not in PROJECT
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert text.partition("\n## ")[2].startswith(armcal.__version__), "the newest heading of CHANGELOG.md"


def test_every_tool_that_is_pinned_is_declared_or_needed() -> None:
    """constraints.txt names versions of what pyproject.toml asks for, or of what that needs."""
    declared = PROJECT["dependencies"] + [n for needed in PROJECT["optional-dependencies"].values() for n in needed]
    names = {text.replace("[", ">").replace(";", ">").split(">")[0].split("=")[0].strip().lower() for text in declared}
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {line.split("==")[0].lower() for line in lines if "==" in line}
    indirect = {"clarabel"}
    assert pinned <= names | indirect
    assert {"figaroh", "roboticstoolbox-python", "smbus2"} >= names - pinned


# Installed


def new_environment(place: Path, *seen: Path) -> Path:
    """An environment without pip, whose interpreter sees these folders as well; its interpreter."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(place)], check=True, timeout=120)
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    (place / "lib" / version / "site-packages" / "seen.pth").write_text("".join(f"{folder}\n" for folder in seen))
    return place / "bin" / "python"


def pip(interpreter: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """This environment's pip, at work in another."""
    command = [sys.executable, "-m", "pip", "--python", str(interpreter), "install", "--quiet"]
    command += ["--disable-pip-version-check", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=1500, check=False)


def armcal_in(interpreter: Path, cwd: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """The installed command, without a compiler, without anything on the path, outside of the checkout."""
    environment = {"PATH": str(cwd / "nothing"), "HOME": str(cwd), "ARMCAL_CC": "none", "LANG": "C.UTF-8"}
    script = interpreter.parent / "armcal"
    start = [str(script)] if script.exists() else [str(interpreter), "-m", "armcal.cli"]
    command = [*start, *arguments]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300, check=False)


def simulate_and_run(interpreter: Path, place: Path) -> None:
    """The shipped demonstration from files alone: measurements made up, then calibrated."""
    for name in ("arm.yaml", "option1.yaml", "demo.yaml", "truth.yaml"):
        shutil.copy(LRM / name, place)
    made = armcal_in(interpreter, place, "simulate", "demo.yaml", "--out", "demo.csv")
    assert made.returncode == 0, made.stderr
    ran = armcal_in(interpreter, place, "run", "demo.yaml", "--out", "result", "-v", "--set", "validation.folds=0")
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "interpreted" in ran.stderr, "no compiler was there"
    truth = yaml.safe_load((place / "truth.yaml").read_text())
    content = yaml.safe_load((place / "result" / "calibration.yaml").read_text())
    found = {p["name"]: p for p in content["parameters"] if p["free"]}
    inside = [found[n]["lower"] <= float(text.split()[0]) <= found[n]["upper"] for n, text in truth.items()]
    assert sum(inside) >= 24
    assert (place / "result" / "report.html").stat().st_size > 10_000


@pytest.mark.slow
def test_the_wheel_runs_outside_of_the_checkout_without_a_compiler(release: Release, tmp_path: Path) -> None:
    pytest.importorskip("pip", reason="pip is not installed here, and installs the wheel")
    interpreter = new_environment(tmp_path / "env", Path(sysconfig.get_paths()["purelib"]))
    installed = pip(interpreter, "--no-deps", "--no-index", str(release.wheel))
    assert installed.returncode == 0, installed.stderr
    place = tmp_path / "work"
    place.mkdir()
    asked = "import armcal, armcal_mdh; print(armcal.__file__, armcal_mdh.__file__)"
    told = subprocess.run([str(interpreter), "-c", asked], cwd=place, capture_output=True, text=True, check=True).stdout
    assert all(path.startswith(str(tmp_path)) for path in told.split()), "it is the wheel that runs"
    simulate_and_run(interpreter, place)


@pytest.fixture(scope="module")
def empty(release: Release, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with the wheel and what it asks for, nothing else; its interpreter."""
    interpreter = new_environment(tmp_path_factory.mktemp("empty") / "env")
    installed = pip(interpreter, "-c", str(ROOT / "constraints.txt"), str(release.wheel))
    if installed.returncode:
        pytest.skip(f"pip could not fetch what armcal needs: {installed.stderr.strip().splitlines()[-1]}")
    return interpreter


@pytest.mark.slow
def test_an_empty_environment_is_all_it_takes(empty: Path, tmp_path: Path) -> None:
    simulate_and_run(empty, tmp_path)
    told = armcal_in(empty, tmp_path, "doctor")
    assert told.returncode == 0 and "warn" not in told.stdout, told.stdout
    for name in set(PROJECT["optional-dependencies"]) - {"all", "test", "dev", "docs", "bench"}:
        assert f"pip install 'armcal[{name}]'" in told.stdout, "it says what an extra that is missing would be good for"


WITH = {
    "all": "import cvxpy, filterpy, matplotlib, cv2, pyarrow, rosbags",
    "online": "from armcal_kalman.filters import ExtendedFilter",
    "convex": "from armcal_cvxpy.estimator import CvxpyEstimator",
    "figures": "from matplotlib.backends.backend_agg import FigureCanvasAgg",
    "lerobot": "import pyarrow.parquet",
    "i2c": "import smbus2; smbus2.i2c_msg.write(64, [0]); import armcal_pca9685.links",
    "mujoco": "import mujoco; mujoco.MjModel.from_xml_string('<mujoco><worldbody/></mujoco>')",
    "camera": "import cv2; cv2.aruco.CharucoBoard((5, 4), 0.04, 0.03, cv2.aruco.getPredefinedDictionary(0))",
    "ros2": "import rosbags.rosbag2, rosbags.typesys",
    "docs": "import mkdocs, material, pymdownx, latex2mathml",
    "dev": "import ruff, mypy.api, yaml",
    "test": "import pytest, hatchling, xdist, hypothesis, pinocchio",
    "bench": "import figaroh, pinocchio",
}
"""What works with an extra and not without it."""


def test_every_extra_is_tried() -> None:
    assert set(WITH) == set(PROJECT["optional-dependencies"])


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(WITH))
def test_an_extra_alone_brings_what_it_promises(name: str, empty: Path, release: Release, tmp_path: Path) -> None:
    def tried(interpreter: Path) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [str(interpreter), "-c", WITH[name]], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
        )

    without = tried(empty)
    assert without.returncode == 1, "it needs the extra"
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    interpreter = new_environment(tmp_path / "env", empty.parents[1] / "lib" / version / "site-packages")
    installed = pip(interpreter, "-c", str(ROOT / "constraints.txt"), f"armcal[{name}] @ {release.wheel.as_uri()}")
    if installed.returncode:
        pytest.skip(f"pip could not fetch the extra: {installed.stderr.strip().splitlines()[-1]}")
    done = tried(interpreter)
    assert done.returncode == 0, done.stderr
    ended = armcal_in(interpreter, tmp_path, "plugins", "list")
    assert ended.returncode == 0 and "does not load" not in ended.stdout


@pytest.mark.slow
def test_an_i2c_board_without_its_extra_is_refused_with_the_mend(empty: Path, tmp_path: Path) -> None:
    shutil.copytree(LRM, tmp_path / "lrm")
    bench = tmp_path / "lrm" / "bench.yaml"
    content = yaml.safe_load(bench.read_text(encoding="utf-8"))
    links = [section for section in _mappings(content) if section.get("type") == "framed"]
    assert links, "the shipped bench has a link"
    for link in links:
        link.clear()
        link.update({"type": "linux_i2c"})
    bench.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    told = armcal_in(empty, tmp_path, "servo", "lrm/bench.yaml", "--park", "--release", "--yes")
    assert told.returncode == 2, told.stderr
    assert "armcal[i2c]" in told.stderr and "Traceback" not in told.stderr


def _mappings(content: object) -> list[dict[str, object]]:
    """Every mapping in a configuration."""
    inner = content.values() if isinstance(content, dict) else content if isinstance(content, list) else ()
    own = [content] if isinstance(content, dict) else []
    return own + [found for part in inner for found in _mappings(part)]


@pytest.mark.slow
def test_an_application_can_be_a_distribution_of_its_own(tree: Path, tmp_path: Path) -> None:
    """The core without it knows nothing of it; beside the core it is an application like the others."""
    pytest.importorskip("pip", reason="pip is not installed here, and installs the wheels")
    core, own = Path(shutil.copytree(tree, tmp_path / "core")), tmp_path / "own"
    own.mkdir()
    shutil.move(core / "plugins" / "armcal_serve", own / "armcal_serve")
    text = (core / "pyproject.toml").read_text(encoding="utf-8")
    entry = 'serve = "armcal_serve.plugin"\n'
    assert entry in text
    (core / "pyproject.toml").write_text(text.replace(entry, ""), encoding="utf-8")
    (own / "pyproject.toml").write_text(
        '[build-system]\nrequires = ["hatchling"]\nbuild-backend = "hatchling.build"\n\n'
        '[project]\nname = "armcal-serve"\nversion = "7.1"\ndependencies = ["armcal"]\n\n'
        f"[project.entry-points.armcal]\n{entry}",
        encoding="utf-8",
    )
    interpreter = new_environment(tmp_path / "env", Path(sysconfig.get_paths()["purelib"]))
    for folder, known in ((core, False), (own, True)):
        (wheel,) = build(folder, tmp_path / "wheels" / folder.name, "-t", "wheel").glob("*.whl")
        installed = pip(interpreter, "--no-deps", "--no-index", str(wheel))
        assert installed.returncode == 0, installed.stderr
        helped = armcal_in(interpreter, tmp_path, "serve", "--help")
        assert helped.returncode == (0 if known else 2), helped.stderr
        assert known or "No such command 'serve'" in helped.stderr
    listed = armcal_in(interpreter, tmp_path, "plugins", "list", "--json")
    assert listed.returncode == 0, listed.stderr
    assert '"armcal-serve"' in listed.stdout and '"7.1"' in listed.stdout
    missing = armcal_in(interpreter, tmp_path, "serve", "calibration.yaml")
    assert missing.returncode == 2 and "calibration.yaml" in missing.stderr and "Traceback" not in missing.stderr
