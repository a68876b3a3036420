"""The entries of the golden set: what each runs through the command line, and which files are read of it.

A step is a command of armcal, in which ``{out}`` is the entry's folder and ``{shared}`` that of data that are not part
of the repository, or a function that makes files for it or of it. The table is at the end.
"""

from __future__ import annotations

import contextlib
import csv
import itertools
import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tests.recordings import postures, still_lines

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "data"
FORK = get_context("fork")
APART = ("recalibrate", "serve", "record")
LONGEST_S = 1200.0


@dataclass
class Place:
    """Where an entry runs: a folder with a copy of ``configs`` and, in ``runs``, a folder for each entry."""

    root: Path
    name: str
    outputs: list[str] = field(default_factory=list)  # standard output of each command
    codes: list[int] = field(default_factory=list)  # exit code of each

    @property
    def out(self) -> Path:
        return self.root / "runs" / self.name

    def filled(self, text: str) -> str:
        return text.replace("{out}", f"runs/{self.name}").replace("{shared}", str(SHARED))

    def armcal(self, line: str, given: str = "", until: Callable[[], bool] | None = None) -> None:
        """Run a command to its end, or kill it (SIGKILL) as soon as something holds."""
        words = shlex.split(self.filled(line))
        ended, number = time.monotonic() + LONGEST_S, len(self.codes)
        files = [self.out.with_name(f"{self.name}.{number}.{end}") for end in ("in", "out", "err")]
        files[0].write_text(given)
        process = (_Apart if words[0] in APART else FORK.Process)(target=_in_fork, args=(words, self.root, files))
        process.start()
        while process.exitcode is None and time.monotonic() < ended and not (until and until()):
            process.join(0.02 if until else LONGEST_S)
        if process.exitcode is None:
            process.kill()
            process.join()
        self.codes.append(int(process.exitcode or 0))
        self.outputs.append(files[1].read_text())
        if "Traceback (most" in (said := files[2].read_text()):
            raise RuntimeError(f"armcal {line}\nexit {process.exitcode}\n{said[-2000:]}")


class _Apart:
    """A process of its own in place of a fork, for commands that speak by descriptors."""

    def __init__(self, target: object, args: tuple[list[str], Path, list[Path]]) -> None:
        self.words, self.root, self.files = args
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        streams = [path.open(mode) for path, mode in zip(self.files, ("rb", "wb", "wb"), strict=True)]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "armcal.cli", *self.words],
            cwd=self.root,
            **dict(zip(("stdin", "stdout", "stderr"), streams, strict=True)),
        )

    @property
    def exitcode(self) -> int | None:
        return self.process.poll()

    def join(self, timeout: float | None = None) -> None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout)

    def kill(self) -> None:
        self.process.kill()


def _in_fork(words: list[str], root: Path, files: list[Path]) -> None:
    from armcal.cli.main import main
    from joblib.externals.loky import get_reusable_executor

    os.chdir(root)
    for path, number in zip(files, range(3), strict=True):
        os.dup2(os.open(path, os.O_RDWR | os.O_CREAT), number)
    sys.stdin, sys.stdout, sys.stderr = (open(n, m, closefd=False) for n, m in enumerate("rww"))  # noqa: SIM115
    sys.argv = ["armcal", *words]
    try:
        main()
    finally:
        get_reusable_executor().shutdown(wait=True)


Step = str | Callable[[Place], None]


@dataclass(frozen=True)
class Entry:
    name: str
    does: str
    steps: tuple[Step, ...]  # commands of armcal (``{out}`` is the entry's folder), or functions
    reads: tuple[str, ...]  # its files, globs too (``FILE:COLUMN,...``); ``0.out``: what the first command printed
    needs: tuple[str, ...] = ()  # entries whose folders it uses

    @property
    def shared(self) -> str:
        found = [m[1] for step in self.steps if isinstance(step, str) if (m := re.search(r"\{shared\}/(\w+)", step))]
        return found[0] if found else ""


# ---------------------------------------------------------------- steps

FIT = ("calibration.yaml", "metrics.json", "residuals.csv")


def entry(name: str, does: str, *steps: Step, reads: Sequence[str] = FIT, needs: Sequence[str] = ()) -> Entry:
    return Entry(name, does, steps, tuple(reads), tuple(needs))


def page(name: str, *titles: str) -> Step:
    """Files that a page of the documentation shows, into the entry's folder."""

    def files(place: Place) -> None:
        text = (ROOT / "docs" / name).read_text()
        for title in titles:
            found = re.search(rf'^```\w+ title="{re.escape(title)}"\n(.*?)^```', text, re.M | re.S)
            assert found, title
            (place.out / title).write_text(found[1])

    return files


def text(name: str, content: str) -> Step:
    """A file in the entry's folder."""

    def file(place: Place) -> None:
        (place.out / name).write_text(content)

    return file


def grid(name: str, *levels: Sequence[float]) -> Step:
    """Targets at the nodes of a grid, row by row to and fro, the tool turned by half a turn, with 50 g."""

    def nodes(place: Place) -> None:
        number = {node: i for i, node in enumerate(itertools.product(*levels), 1)}
        rows = ["pose_id,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg,payload_g"]
        for i, x in enumerate(levels[0]):
            for j, y in enumerate(levels[1][:: (-1) ** i]):
                for z in levels[2][:: (-1) ** (i * len(levels[1]) + j)]:
                    rows.append(f"{number[x, y, z]},{x},{y},{z},0,0,180,50")
        (place.out / name).write_text("\n".join(rows) + "\n")

    return nodes


def thinned(source: str, name: str, every: int) -> Step:
    """Each so many rows of a CSV file, into the entry's folder."""

    def rows(place: Place) -> None:
        head, *lines = (place.root / source).read_text().splitlines()
        (place.out / name).write_text("\n".join([head, *lines[::every]]) + "\n")

    return rows


def typed(line: str, given: str) -> Step:
    """A command, and what it reads from its standard input."""

    def command(place: Place) -> None:
        place.armcal(line, given)

    return command


def killed_on_bench(line: str) -> Step:
    """A rehearsal that is killed (SIGKILL) once its simulated bench has kept its state, ten seconds on."""

    def command(place: Place) -> None:
        place.armcal(line, until=(place.out / "acquired" / "bench" / "truth.json").exists)

    return command


def none_lost(place: Place) -> None:
    """Of a run that was killed and resumed, against one that was not: poses, angles, and places within half a mm."""
    tables = [place.out / "acquired" / "dataset.csv", place.root / "runs" / "rehearsed" / "rehearsed" / "dataset.csv"]
    one, other = ({row["pose_id"]: row for row in csv.DictReader(path.open())} for path in tables)
    apart = [math.dist(*([float(rows[i][f"{x}_mm"]) for x in "xyz"] for rows in (one, other))) for i in one]
    angles = {i: [float(row[f"q{k}_deg"]) for k in range(1, 7)] for i, row in one.items()}
    told = {"killed": place.codes[0] < 0, "poses": sorted(one), "same": one.keys() == other.keys(), "angles": angles}
    (place.out / "lost.json").write_text(json.dumps({**told, "places agree": max(apart) < 0.5}))


def stream(name: str, good: int, slipped: int) -> Step:
    """Records of the demonstration a minute apart, the last of them after joint 3 slipped by 9 deg."""

    def records(place: Place) -> None:
        head, *rows = (place.root / "configs" / "lrm_arm" / "demo.csv").read_text().splitlines()
        q3, lines = head.split(",").index("q3_deg"), [f"{head},time_s"]
        for i, row in enumerate(rows[: good + slipped]):
            cells = row.split(",")
            cells[q3] = str(float(cells[q3]) - 9.0 * (i >= good))
            lines.append(",".join([*cells, str(1.9e9 + 60 * i)]))
        (place.out / name).write_text("\n".join(lines) + "\n")
        (place.out / "online.yaml").write_text("evaluator: interpreted\n")

    return records


def killed_after(count: int, line: str) -> Step:
    """A recalibration that is killed (SIGKILL) once it took so many records, the rest of which came later."""

    def command(place: Place) -> None:
        events, poses = place.out / "kept" / "events.jsonl", place.out / "poses.csv"
        whole = poses.read_text()
        poses.write_text("".join(whole.splitlines(keepends=True)[: count + 1]))
        place.armcal(line, "", lambda: events.exists() and events.read_text().count('"event": "record"') >= count)
        poses.write_text(whole)

    return command


def decisions(place: Place) -> None:
    """What a recalibration decided, when, and what it took; and its calibration, before anything else is done to it."""
    told = [json.loads(line) for line in (place.out / "kept" / "events.jsonl").read_text().splitlines()]
    taken = [f"{event['id']} {event['verdict']}" for event in told if event["event"] == "record"]
    found = [event for event in told if event["event"] in ("decision", "level", "alarm")]
    (place.out / "decisions.json").write_text(json.dumps({"records": taken, "decisions": found}))
    shutil.copy(place.out / "kept" / "calibration.yaml", place.out)


FAULTS = ("metres", "radians", "missing", "word")


def faulty(place: Place) -> None:
    """The demonstration's data, each with another fault."""
    rows = list(csv.DictReader((place.root / "configs" / "lrm_arm" / "demo.csv").open()))[:40]
    for fault in FAULTS:
        table = [dict(row) for row in rows]
        for i, row in enumerate(table):
            for name in row:
                if (fault, name[-3:]) == ("metres", "_mm"):
                    row[name] = repr(float(row[name]) / 1000)
                if (fault, name[-4:]) == ("radians", "_deg"):
                    row[name] = repr(math.radians(float(row[name])))
            if fault == "missing":
                del row["q4_deg"]
            if fault == "word" and i == 7:
                row["x_mm"] = "far"
        with (place.out / f"{fault}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(table[0]))
            writer.writeheader()
            writer.writerows(table)


def two_arm_log(place: Place) -> None:
    """A continuous log of both arms' motors, which rest at each recorded pose: turned by gears, in another order."""
    order, ratios = (1, 2, 7, 3, 4, 5, 6), (100, 100, -100, 100, -101, 100, 100)
    rows = list(csv.DictReader((place.root / "configs" / "frida" / "dual_known_clamp.csv").open()))
    rests = [
        [math.radians(float(row[f"{arm}.q{i}_deg"])) for arm in ("left", "right") for i in range(1, 8)] for row in rows
    ]
    lines = list[str]()
    for before, here in zip([rests[0], *rests], rests, strict=False):
        way = [[a + (b - a) * i / 6 for a, b in zip(before, here, strict=True)] for i in range(1, 6)]
        for angles in [*way, *[here] * 60]:
            cells = [0.0] * 14
            for i, angle in enumerate(angles):
                cells[i // 7 * 7 + order[i % 7] - 1] = angle * ratios[i % 7]
            lines.append(",".join([*map(repr, cells), f"{0.01 * len(lines):.2f}", "one"]))
    (place.out / "motors.log").write_text("\n".join(lines) + "\n")


def tip_poses(place: Place) -> None:
    """Poses of a flange in its base frame, and of a board on it in a camera's frame somewhere else, with noise."""
    random = np.random.default_rng(5)
    turns = Rotation.from_euler("zyx", random.uniform(-40, 40, (25, 3)) + np.array([0, 0, 180]), degrees=True)
    places = random.uniform([0.35, -0.3, 0.3], [0.65, 0.3, 0.6], (25, 3))
    camera, at = Rotation.from_rotvec([0.4, -1.1, 2.0]), np.array([0.9, -0.5, 0.7])
    mounted, there = Rotation.from_rotvec([0.2, 0.1, -1.3]), np.array([0.02, 0.045, 0.11])
    seen = camera.inv().apply(places + turns.apply(there) - at) + random.normal(scale=2e-4, size=(25, 3))
    turned = camera.inv() * turns * mounted * Rotation.from_rotvec(random.normal(scale=5e-4, size=(25, 3)))
    columns = np.c_[places, turns.as_euler("ZYX", degrees=True), seen, turned.as_quat()]
    head = "arm.x_m,arm.y_m,arm.z_m,arm.rz_deg,arm.ry_deg,arm.rx_deg,tracker.x_m,tracker.y_m,tracker.z_m,qx,qy,qz,qw"
    lines = [head, *(",".join(f"{number:.9f}" for number in row) for row in columns)]
    (place.out / "pairs.csv").write_text("\n".join(lines) + "\n")


def c_self_test(place: Place) -> None:
    """The exported C code and its test program, compiled and run."""
    for source in sorted(place.out.glob("*_test.c")):
        files = [source, source.with_name(source.name.replace("_test.c", ".c"))]
        program = source.with_suffix("")
        subprocess.run(["cc", "-std=c99", "-O1", *files, "-lm", "-o", program], check=True)
        done = subprocess.run([program], check=False, capture_output=True, text=True)
        program.with_suffix(".txt").write_text(f"exit {done.returncode}\n{done.stdout}")


LRM = "{shared}/lrm_arm/poses.csv"
MUKCA = {
    "panda-front_center": "panda_2_clean",
    "kuka-front": "kuka_14",
    "kuka-left_back": "kuka_14",
    "kinova-left": "dinova_1",
    "kinova-lower_left": "dinova_1",
    "kinova-front": "dinova_1",
}
RANKS = (
    "one_known_point",
    "one_unknown_point",
    "several_points",
    "dual_known_clamp",
    "dual_one_known_arm",
    "dual_twists",
    "dual_twists_tools_held",
    "twists_and_offsets",
    "wrong_clamp",
)
LEAST = (
    "identify configs/lrm_arm/all_45.yaml --data configs/lrm_arm/demo.csv --most 28 --prefer 'arm.mdh.alpha[2-5]'"
    " --prefer 'arm.spring.k?' --prefer 'arm.mdh.a[3-5]' --prefer 'arm.mdh.theta?' --prefer 'arm.mdh.d[45]'"
    " --prefer 'arm.mdh.base_[xyz]' --prefer 'arm.mdh.tool_[yz]' --prefer arm.mdh.after2_z --json"
)
POSES = (
    "pose_id,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg\n1,403,90,67,180,0,90\n2,240,-60,260,180,10,0\n3,900,0,0,0,0,0\n"
)
LOADED = "pose_id,x_mm,y_mm,z_mm,payload_g\nnone,200,50,300,0\nsome,200,50,300,60\nmuch,200,50,300,130\n"
ASKED = "\n".join(
    map(
        json.dumps,
        [
            {"id": 1, "do": "forward", "joint_angles_deg": [10, -20, 30, 40, -50, 60]},
            {"id": 2, "do": "forward", "joint_angles_deg": [10, -20, 30, 40, -50, 60], "payload_g": 100},
            {"id": 3, "do": "compensate", "targets": [{"position_mm": [403, 90, 67]}], "units": "deg"},
            {"id": 4, "do": "compensate", "targets": [{"position_mm": [1403, 90, 67]}], "units": "deg"},
            {"id": 5, "do": "compensate", "targets": [{"position_mm": [403, 90, 67], "rpy_deg": [180, 0, 90]}],
             "start_deg": [0, 0, 0, 0, 0, 0]},
            {"id": 6, "do": "compensate", "path": True, "targets": [{"position_mm": [240, y, 260]} for y in (-9, 9)]},
            {"id": 7, "do": "forward", "joint_angels_deg": [1]},
            {"id": 8, "do": "forward", "joint_angles_deg": [10, -20]},
        ],
    )
)  # fmt: skip

WAYS = ("demo", "sockets", "camera", "ruler")
HAND = """name: pairs
data: {type: pose_csv, path: pairs.csv, quaternion: {columns: [qx, qy, qz, qw], order: xyzw}}
arms: {arm: {model: {type: flange_pose}, placement: {position_m: [0, 0, 0], rpy_deg: [0, 0, 0]}}}
measurements:
  tracker: {type: tip_pose, noise_mm: 0.2, orientation_noise_deg: 0.03, target_mm: [0, 0, 0]}
parameters: {free: ["arm.placement_*", "tracker.target_*"]}
validation: {folds: 5}
"""
SMALL = """pose_id,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg
p1,0,0,0,0,0,0
p2,40,-30,60,-50,30,20
p3,-60,20,90,40,-40,-30
p4,20,40,-50,80,60,10
"""
MOTORS = "{columns: %s, order: [1, 2, 7, 3, 4, 5, 6], gear_ratios: [100, 100, -100, 100, -101, 100, 100]}"
LOG = (
    "data={type: two_arm_log, path: {out}/motors.log, arms: {left: "
    + MOTORS % "[1, 2, 3, 4, 5, 6, 7]"
    + ", right: "
    + MOTORS % "[8, 9, 10, 11, 12, 13, 14]"
    + "}, time: 15, labels: {clamp: 16}, still: {window_s: 0.3, spread_deg: 0.01}}"
)
BENCH = "configs/lrm_arm/bench.yaml"
QUICK = "--set bench.acquisition.period_s=0.04"
LEVELS = "--set 'plan.levels.q1=[0 deg]' --set plan.sweeps=10"
KEPT = "recalibrate runs/lrm-demo/calibration.yaml --from {out}/poses.csv --config {out}/online.yaml --out {out}/kept"
PLUGINS = "--plugin {out}/gear_wave.py --plugin {out}/total_station.py"
MINE = "runs/plugin/runs/experiment/calibration.yaml"

ENTRIES: tuple[Entry, ...] = (
    entry("lrm-demo", "the simulated LRM arm, option 1", "run configs/lrm_arm/demo.yaml --out {out} -q"),
    *(
        entry(
            f"lrm-option{i}",
            f"option {i} on the 313 measured poses",
            f"run configs/lrm_arm/option{i}.yaml --data {LRM} --out {{out}} -q --accept",
        )
        for i in range(1, 6)
    ),
    entry(
        "lrm-published-50",
        "option 1 on the published 50 poses, k0 to k6",
        f"run configs/lrm_arm/option1.yaml --data {LRM} --out {{out}} -q --accept --set parameters.bounds=none"
        " --set validation.train_ids={shared}/lrm_arm/published_50.csv",
    ),
    entry("lrm-check", "what is known before solving", "check configs/lrm_arm/demo.yaml --json", reads=["0.out"]),
    entry("identify", "which of 45 parameters are determined; 28 of them", LEAST, reads=["0.out"]),
    entry(
        "study",
        "three variants compared",
        "study configs/lrm_arm/study_demo.yaml --out {out} -q",
        reads=["*.json", "*.csv"],
    ),
    entry(
        "load-transfer",
        "fitted with one payload, judged with another, both ways",
        "study configs/lrm_arm/load_transfer.yaml --out {out} -q",
        reads=["study.csv"],
    ),
    entry(
        "capability-designs",
        "designs of the arm compared",
        "capability configs/lrm_arm/designs.yaml --out {out} -q --set capability.samples=200"
        " --set capability.voxel_mm=100 --set capability.postures=2",
        reads=["areas.csv", "capability.json"],
    ),
    entry(
        "predict",
        "where the calibrated arm goes",
        "predict runs/lrm-demo/calibration.yaml --poses configs/lrm_arm/demo.csv --out {out}/predicted.csv",
        reads=["predicted.csv"],
        needs=["lrm-demo"],
    ),
    entry(
        "compensate-position",
        "commands that reach positions, within limits and clearance",
        "compensate runs/lrm-demo/calibration.yaml --targets configs/lrm_arm/targets.csv"
        " --within configs/lrm_arm/plan.yaml --out {out}/commands.csv --json",
        reads=["0.out", "commands.csv"],
        needs=["lrm-demo"],
    ),
    entry(
        "compensate-pose",
        "commands that reach poses, one of them too far",
        text("targets.csv", POSES),
        "compensate runs/lrm-demo/calibration.yaml --targets {out}/targets.csv --out {out}/commands.csv --json",
        reads=["0.out", "commands.csv"],
        needs=["lrm-demo"],
    ),
    entry(
        "compensate-path",
        "commands along a path",
        "compensate runs/lrm-demo/calibration.yaml --targets configs/lrm_arm/path.csv --path"
        " --within configs/lrm_arm/plan.yaml --out {out}/commands.csv --json",
        reads=["0.out", "commands.csv"],
        needs=["lrm-demo"],
    ),
    entry(
        "compensate-payload",
        "commands under three payloads",
        text("targets.csv", LOADED),
        "compensate runs/lrm-demo/calibration.yaml --targets {out}/targets.csv --out {out}/commands.csv --json"
        " --start 'q1=10 deg' --angles rad",
        reads=["0.out", "commands.csv"],
        needs=["lrm-demo"],
    ),
    entry(
        "compensate-nominal",
        "what to send to a controller that only knows the nominal arm, over a grid",
        grid("targets.csv", [220, 240, 260, 280], [-30, -10, 10, 30], [300, 320, 340]),
        "compensate runs/lrm-demo/calibration.yaml --targets {out}/targets.csv --path --for nominal"
        " --within configs/lrm_arm/plan.yaml --out {out}/sent.csv -q",
        reads=["sent.csv:pose_id,dx_mm,dy_mm,dz_mm,turn_x_rad,turn_y_rad,turn_z_rad"],
        needs=["lrm-demo"],
    ),
    entry(
        "export-c",
        "C code of the calibrated arm, and its self-test",
        "export runs/lrm-demo/calibration.yaml --format c --out {out}/lrm.c --json",
        c_self_test,
        reads=["0.out", "lrm_test.txt"],
        needs=["lrm-demo"],
    ),
    entry(
        "export-others",
        "the calibrated arm as YAML and JSON",
        "export runs/lrm-demo/calibration.yaml --format yaml --out {out}/arm.yaml --json",
        "export runs/lrm-demo/calibration.yaml --format json --out {out}/arm.json --json",
        reads=["0.out", "1.out", "arm.yaml", "arm.json"],
        needs=["lrm-demo"],
    ),
    entry(
        "convert",
        "the nominal arm in other forms",
        "convert configs/lrm_arm/arm.yaml --to poe --json",
        "convert configs/lrm_arm/arm.yaml --to mdh --convention craig --json",
        "convert configs/lrm_arm/arm.yaml --to urdf --json",
        reads=["0.out", "1.out", "2.out"],
    ),
    entry(
        "serve",
        "answers of the server, refusals among them",
        typed("serve runs/lrm-demo/calibration.yaml --evaluator interpreted", ASKED + "\n"),
        reads=["0.out"],
        needs=["lrm-demo"],
    ),
    entry(
        "frida-ranks",
        "which parameters one arm and two arms in contact determine",
        *(thinned(f"configs/frida/{name.removesuffix('_tools_held')}.csv", f"{name}.csv", 4) for name in RANKS),
        *(f"identify configs/frida/{name}.yaml --data {{out}}/{name}.csv --json" for name in RANKS),
        reads=[f"{i}.out" for i in range(len(RANKS))],
    ),
    entry("two-arms", "two arms joined by a clamp", "run configs/frida/dual_known_clamp.yaml --out {out} -q"),
    entry("two-arms-wrong-clamp", "the clamp found too", "run configs/frida/wrong_clamp.yaml --out {out} -q"),
    *(
        entry(
            f"mukca-{name}",
            f"a {name.partition('-')[0]}'s ball in sockets, trained on {name.partition('-')[2]}",
            f"run configs/mukca/{name.partition('-')[0]}.yaml --data {{shared}}/mukca/{folder} --out {{out}} -q"
            f" --accept --set validation.train_groups=[{name.partition('-')[2]}]",
        )
        for name, folder in MUKCA.items()
    ),
    entry("ball", "a simulated arm of seven joints, its ball in sockets", "run configs/ball/demo.yaml --out {out} -q"),
    entry(
        "export-urdf",
        "the arm's own URDF, calibrated",
        "export runs/ball/calibration.yaml --format urdf --out {out}/arm.urdf --json",
        reads=["0.out", "arm.urdf"],
        needs=["ball"],
    ),
    entry("camera", "a camera on the hand", "run configs/camera/demo.yaml --out {out} -q"),
    entry(
        "lrm-best",
        "the best model: compliances, gains, backlash, cubic springs, drift",
        f"run configs/lrm_arm/best.yaml --data {LRM} --out {{out}} -q",
    ),
    *(
        entry(
            f"bound-{name}",
            f"a compliance that is negative without bounds: {does}",
            f"run configs/lrm_arm/demo.yaml --out {{out}} -q --accept --set validation.folds=0 {sets}",
        )
        for name, does, sets in (
            ("none", "without", "--set parameters.bounds=none"),
            ("ipopt", "at its bound by ipopt", "--set estimator.type=ipopt"),
            ("cvxpy", "at its bound by cvxpy", "--set estimator.type=cvxpy"),
        )
    ),
    entry(
        "plan",
        "poses by exchange: with clearance, approach sides and given records",
        f"plan {BENCH} --poses 20 --out {{out}}/first.csv --json {LEVELS}",
        f"plan {BENCH} --poses 8 --given {{out}}/first.csv --out {{out}}/next.csv --json {LEVELS}",
        reads=["0.out", "1.out", "first.csv", "next.csv"],
    ),
    entry(
        "plugin",
        "an effect and a measurement of one file each: run, predict, compensate, C code",
        page("write_a_plugin.md", "gear_wave.py", "total_station.py", "experiment.yaml", "truth.yaml"),
        page("write_a_plugin.md", "poses.csv", "targets.csv"),
        f"simulate {{out}}/experiment.yaml --out {{out}}/records.csv {PLUGINS}",
        f"run {{out}}/experiment.yaml --out {{out}}/runs/experiment -q {PLUGINS}",
        f"predict {MINE} --poses {{out}}/poses.csv --out {{out}}/predicted.csv {PLUGINS}",
        f"compensate {MINE} --targets {{out}}/targets.csv --out {{out}}/commands.csv {PLUGINS}",
        f"export {MINE} --format c --out {{out}}/arm.c {PLUGINS}",
        c_self_test,
        reads=[*(f"runs/experiment/{file}" for file in FIT), "predicted.csv", "commands.csv", "arm_test.txt"],
    ),
    entry(
        "two-arm-log",
        "a log of both arms' motors in radians: order, gear ratios, rests",
        two_arm_log,
        f'run configs/frida/dual_known_clamp.yaml --out {{out}}/run -q --set "{LOG}"',
        reads=[f"run/{file}" for file in FIT],
    ),
    entry(
        "base-of-poses",
        "a base that is placed from poses of the tip",
        text("pairs.yaml", HAND),
        tip_poses,
        "run {out}/pairs.yaml --out {out}/run -q",
        reads=[f"run/{file}" for file in FIT],
    ),
    entry(
        "rehearsed",
        "a measuring run rehearsed",
        text("small.csv", SMALL),
        f"acquire {BENCH} --plan {{out}}/small.csv --dry-run --json",
        f"rehearse {BENCH} --plan {{out}}/small.csv --out {{out}}/rehearsed --json {QUICK}",
        reads=["0.out", "rehearsed/summary.json", "rehearsed/dataset.csv"],
    ),
    entry(
        "acquired-killed",
        "the same, killed and resumed",
        text("small.csv", SMALL),
        killed_on_bench(f"rehearse {BENCH} --plan {{out}}/small.csv --out {{out}}/acquired {QUICK}"),
        f"rehearse {BENCH} --plan {{out}}/small.csv --out {{out}}/acquired --resume {QUICK}",
        none_lost,
        reads=["lost.json", "acquired/summary.json"],
        needs=["rehearsed"],
    ),
    entry(
        "compensate-counts",
        "counts for a servo board that are searched together",
        f"run {BENCH} --data configs/lrm_arm/demo.csv --out {{out}}/run -q --accept --set validation.folds=0",
        "compensate {out}/run/calibration.yaml --targets configs/lrm_arm/targets.csv --within configs/lrm_arm/plan.yaml"
        " --out {out}/commands.csv --json",
        reads=["1.out", "commands.csv", "run/metrics.json"],
    ),
    entry(
        "servo-tracked",
        "servo tables found with a tracker, default settings",
        f"rehearse {BENCH} --servo tracked --out {{out}}/servo",
        reads=["servo/servo.json"],
    ),
    entry(
        "servo-guided",
        "servo tables of two joints, set by eye",
        typed(
            f"rehearse {BENCH} --servo guided --out {{out}}/servo --set 'bench.servo.joints=[q1, q3]'",
            "+10\n-3\nok\n" * 20,
        ),
        reads=["servo/servo.json"],
    ),
    entry(
        "record-sockets",
        "postures of a ball in sockets, recorded by hand",
        typed(
            "record configs/ball/demo.yaml --from - --out {out}/recording --capture still --json",
            still_lines(postures()[:8]),
        ),
        reads=["0.out", "recording/dataset.csv"],
    ),
    entry(
        "recalibrate",
        "a joint slips; killed, gone on, rolled back",
        stream("poses.csv", 40, 12),
        killed_after(25, KEPT),
        KEPT,
        decisions,
        "control {out}/kept rollback good --json",
        reads=["decisions.json", "calibration.yaml", "2.out", "kept/calibration.yaml"],
        needs=["lrm-demo"],
    ),
    entry(
        "recalibrate-extended",
        "the same by the filter that is named",
        stream("poses.csv", 16, 8),
        f"{KEPT} --set 'estimator={{type: extended}}'",
        decisions,
        reads=["decisions.json", "calibration.yaml"],
        needs=["lrm-demo"],
    ),
    entry(
        "so101",
        "a kit arm by sockets, by a camera, by a ruler",
        *(
            f"run configs/so101/{way}.yaml --out {{out}}/{way} -q --accept"
            for way in ("demo", "sockets", "camera", "ruler")
        ),
        reads=[f"{way}/{file}" for way in ("demo", "sockets", "camera", "ruler") for file in FIT[1:]],
    ),
    entry(
        "residual",
        "a pose residual is learned and judged",
        "run configs/lrm_arm/demo.yaml --out {out} -q --set arms.arm.residual.type=gaussian_process"
        " --set arms.arm.effects.spring.base_axis=null --set 'parameters.fixed=[arm.spring.*]'"
        " --set validation.folds=3 --accept",
    ),
    entry(
        "noise",
        "outliers rejected; components of the noise; intervals by bootstrap",
        "run configs/lrm_arm/demo.yaml --out {out}/reject -q --set noise.loss=reject --set validation.folds=0",
        "run configs/lrm_arm/demo.yaml --out {out}/estimate -q --set noise.estimate=true --set validation.folds=0",
        "run configs/lrm_arm/demo.yaml --out {out}/bootstrap -q --set uncertainty.bootstrap=4 --set validation.folds=0",
        reads=["reject/metrics.json", "estimate/metrics.json", "bootstrap/metrics.json", "bootstrap/calibration.yaml"],
    ),
    entry(
        "acceptance",
        "accuracy and repeatability by ISO 9283, planned and measured",
        "plan configs/lrm_arm/plan.yaml --iso-cube auto --cycles 4 --out {out}/iso.csv --json",
        "simulate configs/lrm_arm/demo.yaml --poses {out}/iso.csv --out {out}/measured.csv --json",
        "acceptance runs/lrm-demo/calibration.yaml {out}/measured.csv --out {out}/acceptance --json",
        reads=["0.out", "iso.csv", "measured.csv", "acceptance/acceptance.json", "acceptance/acceptance.csv"],
        needs=["lrm-demo"],
    ),
    entry(
        "refusals",
        "data that cannot be used: metres, radians, a joint that is missing, a word among numbers",
        faulty,
        *(f"run configs/lrm_arm/demo.yaml --data {{out}}/{name}.csv --out {{out}}/run --json" for name in FAULTS),
        "run nowhere.yaml --json",
        "run configs/lrm_arm/demo.yaml --out {out}/run --set estimator.type=ipotp --json",
        reads=[f"{i}.out" for i in range(len(FAULTS) + 2)],
    ),
)
