"""Two arms of nobody's, on simulated benches over real ptys: `tower` has two boards and servos of 270 degrees.

Both files of servos are written as a user would: by hand, with comments, from data sheets.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml
from armcal.cli.main import cli
from click.testing import CliRunner, Result

from tests.bench_runs import BenchRun, overrides_for

TOWER_SERVOS = """\
# tower: the two strong ones turn 270 degrees (data sheet: 500 to 2500 us)
boards:
  low: {address: 0x40, oscillator_hz: 25000000.0, rate_hz: 50.0, id: "TOWER"}
  high: {address: 0x41, oscillator_hz: 25000000.0, rate_hz: 50.0, id: "TOWER"}   # on the forearm
servos:
  turn: {board: low, channel: 3, angles_deg: [-135.0, 0.0, 135.0], pulses_us: [500.0, 1500.0, 2500.0], \
pulse_range_us: [480.0, 2520.0]}      # by the data sheet
  # the shoulder hangs upside down, so its pulses fall
  lift:
    {board: low, channel: 7, angles_deg: [-135.0, 0.0, 135.0], pulses_us: [2500.0, 1500.0, 500.0],
     pulse_range_us: [480.0, 2520.0]}
  bend: {board: high, channel: 0, angles_deg: [-90.0, 0.0, 90.0], pulses_us: [600.0, 1500.0, 2400.0]}
  roll: {board: high, channel: 1, angles_deg: [-90.0, 0.0, 90.0], pulses_us: [600.0, 1500.0, 2400.0]}
"""
POST_SERVOS = """\
boards:
  only: {address: 0x42, oscillator_hz: 25000000.0, rate_hz: 50.0, id: "POST"}   # measured at pin 0
servos:
  a: {board: only, channel: 0, angles_deg: [-100.0, 0.0, 100.0], pulses_us: [600.0, 1500.0, 2400.0]}
  b: {board: only, channel: 1, angles_deg: [-100.0, 0.0, 100.0], pulses_us: [600.0, 1500.0, 2400.0]}   # new gears
  c: {board: only, channel: 2, angles_deg: [-100.0, 0.0, 100.0], pulses_us: [600.0, 1500.0, 2400.0]}
"""
TOWER: dict[str, Any] = {
    "joints": ("turn", "lift", "bend", "roll"),
    "lengths": ((90, 0, 90), (0, 160, 0), (0, 90, 90), (110, 0, 0)),
    "masses": ((2, 120, 80), (3, 90, 45), (4, 60, 0)),
    "limits": {"turn": 130, "lift": 120, "bend": 85, "roll": 85},
    "base": {"lift": 30, "bend": -40},
    "id": "TOWER",
    "servos": TOWER_SERVOS,
}
POST: dict[str, Any] = {
    "joints": ("a", "b", "c"),
    "lengths": ((80, 0, 90), (0, 140, 0), (0, 100, 0)),
    "masses": ((2, 80, 70), (3, 50, 50)),
    "limits": {"a": 90, "b": 60, "c": 90},
    "base": {"b": 30, "c": 20},
    "id": "POST",
    "servos": POST_SERVOS,
}


class OwnArm:
    """An arm's files in a folder, its bench, and armcal's commands on it."""

    def __init__(self, folder: Path, kind: dict[str, Any], **changes: Any) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.kind = folder, kind
        (folder / "servos.yaml").write_text(kind["servos"], encoding="utf-8")
        (folder / "true.yaml").write_text(kind["servos"], encoding="utf-8")
        config = folder / "arm.yaml"
        config.write_text(yaml.safe_dump(_config(kind), sort_keys=False), encoding="utf-8")
        self.run = BenchRun(folder, tuple(f"{key}={value}" for key, value in changes.items()), config)
        self.servos, self.out = folder / "servos.yaml", folder / "out"

    def swap(self, one: str, other: str) -> None:
        """Exchange two plugs: what is true differs from what the servo file says."""
        truth = yaml.safe_load(self.kind["servos"])["servos"]
        places = [{key: truth[joint][key] for key in ("board", "channel")} for joint in (one, other)]
        text = yaml.safe_load(self.kind["servos"])
        text["servos"][one].update(places[1])
        text["servos"][other].update(places[0])
        (self.folder / "true.yaml").write_text(yaml.safe_dump(text), encoding="utf-8")

    def plan(self, *poses: tuple[float, ...]) -> Path:
        """A plan in degrees."""
        head = ",".join(["pose_id", *(f"{joint}_deg" for joint in self.kind["joints"])])
        rows = [f"p{i}," + ",".join(map(str, pose)) for i, pose in enumerate(poses, start=1)]
        self.run.plan.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
        return self.run.plan

    def armcal(self, command: str, *words: str | Path, sets: tuple[str, ...] = (), **more: Any) -> Result:
        """A command as a user gives it; all but a rehearsal meet the bench that is there."""
        ports = [f"bench.tracker.port={self._port}"]
        there = overrides_for(self.run.bench) if command != "rehearse" else ()
        given = [word for text in (*self.run.sets, *ports, *there, *sets) for word in ("--set", text)]
        return CliRunner().invoke(cli, [command, str(self.run.config), *map(str, words), *given], **more)

    def pulses(self) -> dict[str, list[float]]:
        """Of the servo file (us)."""
        servos = yaml.safe_load(self.servos.read_text())["servos"]
        return {joint: servo["pulses_us"] for joint, servo in servos.items()}

    def safety(self) -> list[dict[str, Any]]:
        """What the bench wrote down of its arm."""
        log = self.run.bench / "safety.jsonl"
        return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []

    @property
    def _port(self) -> int:
        return int(self.run.experiment.settings.bench["tracker"]["port"])  # type: ignore[index]


def said_by(result: Result) -> str:
    """What a command printed, on one line."""
    return " ".join(result.output.split())


def _config(kind: dict[str, Any]) -> dict[str, Any]:
    rows = [{"alpha_deg": alpha, "a_mm": a, "theta_deg": 0, "d_mm": d} for d, a, alpha in kind["lengths"]]
    links = {
        f"link{row}": {"mass_g": mass, "com_mm": [-back, 0, 0], "frame": f"row{row}"}
        for row, mass, back in kind["masses"]
    }
    limits = {joint: [f"{-size} deg", f"{size} deg"] for joint, size in kind["limits"].items()}
    base = {joint: f"{angle} deg" for joint, angle in kind["base"].items()}
    servo_bench = {"type": "servo_bench", "servos": "true.yaml", "tracker": {"rate_hz": 15.0}, "seed": 3}
    return {
        "name": kind["id"].lower(),
        "arms": {
            "arm": {
                "model": {"type": "mdh", "joints": list(kind["joints"]), "convention": "standard", "rows": rows},
                "links": links,
            }
        },
        "statics": {"gravity_m_s2": [0, 0, -9.81], "payload_g": 0},
        "measurements": {"tracker": {"type": "tip_position", "noise_mm": 0.05}},
        "parameters": {"free": ["arm.mdh.theta[2-3]"]},
        "plan": {"limits": limits},
        "bench": {
            "link": {"type": "framed", "port": "/dev/ttyACM0"},
            "device": {"type": "pca9685", "servos": "servos.yaml"},
            "tracker": {"type": "dtrack", "port": 15000},
            "bodies": {"base": "1", "tool": "2"},
            "acquisition": {"period_s": 0.04, "park": dict(base), "settle": {"spread_mm": 1}},
            "servo": {"step_deg": 60, "period_s": 0.04, "sag": "none"},
            "simulator": {**servo_bench, "joints": {"all": {"travel": ["-2.4 rad", "2.4 rad"]}}},
        },
    }
