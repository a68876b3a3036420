"""The exported node: it is lint-free, and between stubs of ROS 2 it feeds a recalibration and asks a server."""

from __future__ import annotations

import ast
import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import recorded_bags as bags
from armcal.calibration.calibration import Calibration
from armcal.cli.calibration import export
from armcal.cli.run import run
from armcal.errors import ConfigError
from click.testing import CliRunner


@pytest.fixture(scope="module")
def tour(tmp_path_factory: pytest.TempPathFactory) -> bags.Tour:
    return bags.made_tour(tmp_path_factory.mktemp("tour"), rests=25)


@pytest.fixture(scope="module")
def calibration(tour: bags.Tour) -> Path:
    out = tour.config.with_name("run")
    done = CliRunner().invoke(run, [str(tour.config), "--out", str(out)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return out / "calibration.yaml"


def exported(calibration: Path, *options: str) -> Path:
    out = calibration.with_name(f"node{len(list(calibration.parent.glob('node*')))}.py")
    given = [part for option in options for part in ("--option", option)]
    arguments = [str(calibration), "--format", "ros2-node", "--out", str(out), *given]
    done = CliRunner().invoke(export, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return out


class Message(SimpleNamespace):
    """Stands for any message: its parts are there when they are asked for."""

    OK, WARN, ERROR = b"\x00", b"\x01", b"\x02"

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        part = Message()
        setattr(self, name, part)
        return part


class Node:
    """Stands for ``rclpy.node.Node``."""

    now = bags.BEGIN_S

    def __init__(self, name: str) -> None:
        self.subscriptions: dict[str, Any] = {}
        self.published: dict[str, list[Any]] = {}

    def declare_parameter(self, name: str, value: Any) -> Any:
        return SimpleNamespace(value=value)

    def create_subscription(self, kind: Any, topic: str, callback: Any, depth: int) -> None:
        self.subscriptions[topic] = callback

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        sent = self.published.setdefault(topic, [])
        return SimpleNamespace(publish=sent.append)

    def create_timer(self, seconds: float, callback: Any) -> None:
        pass

    def get_clock(self) -> Any:
        stamp = bags.header(self.now).stamp
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: stamp))


@pytest.fixture
def stubs(monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = {
        "rclpy": {"init": None},
        "rclpy.node": {"Node": Node},
        "diagnostic_msgs.msg": dict.fromkeys(("DiagnosticArray", "DiagnosticStatus", "KeyValue"), Message),
        "geometry_msgs.msg": dict.fromkeys(("PoseStamped", "PointStamped"), Message),
        "sensor_msgs.msg": {"JointState": Message},
    }
    for name, content in kinds.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name.split(".")[0], sys.modules.get(name.split(".")[0], module))
        monkeypatch.setitem(sys.modules, name, module)


def made_node(path: Path) -> Any:
    """The node of a file, as ROS would make it."""
    names: dict[str, Any] = {"__name__": "node_file"}
    exec(compile(path.read_text(), str(path), "exec"), names)
    return names["ArmcalNode"]()


def play(node: Any, tour: bags.Tour, answer: Any = lambda: None) -> None:
    """All messages of a tour in their order; answers are looked for 20 times a second."""
    looked = 0.0
    for received, topic, _, message in sorted(tour.sent(), key=lambda entry: entry[0]):
        Node.now = received
        node.subscriptions["joint_states" if topic == "/joint_states" else "measured"](message)
        if received - looked > 0.05:
            answer()
            node.on_answers()
            looked = received


def test_the_file_compiles_and_is_lint_free(calibration: Path) -> None:
    path = exported(calibration)
    ast.parse(path.read_text(), feature_version=(3, 10))
    lint = [sys.executable, "-m", "ruff", "check", "--isolated", "--select", "E,F,W,I,B,SIM,C4", "--ignore", "B905"]
    done = subprocess.run([*lint, "--line-length", "120", str(path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert "--from socket --out kept" in path.read_text() and "@" not in path.read_text()


@pytest.mark.slow
@pytest.mark.usefixtures("stubs")
def test_rests_become_records_in_order_each_until_it_is_acknowledged(
    tour: bags.Tour, calibration: Path, tmp_path: Path
) -> None:
    node = made_node(exported(calibration, f"folder={tmp_path}"))
    records: list[dict[str, Any]] = []
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(tmp_path / "control.sock"))
    listener.listen()
    listener.setblocking(False)
    connections: list[socket.socket] = []

    def acknowledge() -> None:
        try:
            if not connections:
                connections.append(listener.accept()[0])
                connections[0].setblocking(False)
            data = connections[0].recv(65536)
        except BlockingIOError:
            return
        records.append(json.loads(data.splitlines()[0]))
        reply = {"ok": True, "acknowledged": len(records), "id": records[-1]["id"]}
        if len(records) % 3:  # every third time it goes away without an answer
            connections[0].sendall(json.dumps(reply).encode() + b"\n")
        else:
            connections.pop().close()
            node.on_answers()
            node.on_second()

    play(node, tour, acknowledge)
    by_id = {record["id"]: record for record in records}
    times = [record["time_s"] for record in by_id.values()]
    assert times == sorted(times) and len(by_id) == len(tour.rests) < len(records)
    exact = bags.Experiment.load(tour.config).read()
    angles = np.array([[record[f"arm.q{i}_rad"] for i in range(1, 7)] for record in by_id.values()])
    np.testing.assert_allclose(angles, exact.stacked(bags.CHANNELS).T, atol=2e-4)
    sides = np.array([[record[f"arm.approach{i}"] for i in range(1, 7)] for record in by_id.values()])
    np.testing.assert_array_equal(sides[1:], np.sign(np.diff(angles, axis=0)))
    seen = np.array([[record[f"tracker.{axis}_m"] for axis in "xyz"] for record in by_id.values()])
    assert np.sqrt(((seen - exact.stacked([f"tracker.{axis}" for axis in "xyz"]).T) ** 2).mean()) < 0.3e-3


@pytest.mark.slow
@pytest.mark.usefixtures("stubs")
def test_targets_become_commands_and_faults_are_reported(tour: bags.Tour, calibration: Path, tmp_path: Path) -> None:
    path = str(tmp_path / "arm.sock")
    node = made_node(exported(calibration, f"serve_socket={path}"))
    play(node, tour)
    server = socket.socket(socket.AF_UNIX)
    server.bind(path)
    server.listen()
    server.settimeout(5)
    connection: Any = None
    target = Message()
    target.pose.position, target.pose.orientation = Message(x=0.3, y=0.1, z=0.2), Message(x=0.0, y=0.0, z=0.0, w=1.0)
    for reached in (True, False):
        node.subscriptions["target"](target)
        connection = connection or server.accept()[0]
        request = json.loads(connection.recv(65536))
        assert request["targets"] == [{"position_m": [0.3, 0.1, 0.2], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}]
        assert request["units"] == "rad" and len(request["start_rad"]) == 6
        command = {
            "joint_angles_rad": [0.1] * 6,
            "reached": reached,
            "why_not": "" if reached else "it is too far away",
        }
        connection.sendall(json.dumps({"id": request["id"], "ok": True, "commands": [command]}).encode() + b"\n")
        time.sleep(0.01)
        node.on_answers()
    connection.close()
    server.close()
    (message,) = node.published["joint_command"]
    assert message.name == list(bags.NAMES) and message.position == [0.1] * 6
    (tmp_path / "status.json").write_text(json.dumps({"level": "lost", "why": "the gripper was bent."}))
    node.on_second()
    node.set["folder"] = str(tmp_path)
    node.on_second()
    first, second = (array.status[0] for array in node.published["/diagnostics"])
    assert first.level == Message.WARN and "it is too far away" in first.message
    assert "records are not acknowledged" in first.message
    assert second.level == Message.ERROR and "the calibration is lost: the gripper was bent." in second.message


def test_a_calibration_without_a_tip_measurement_is_refused(calibration: Path) -> None:
    with pytest.raises(ConfigError, match=r"found the measurements tracker \(tip_position\), expected other"):
        exported(calibration, "measurement=other")


@contextmanager
def armcal(*arguments: str | Path) -> Iterator[subprocess.Popen[bytes]]:
    """A command that runs until the end of the block."""
    command = [sys.executable, "-m", "armcal.cli", *map(str, arguments)]
    going = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield going
    finally:
        going.terminate()
        going.wait(30)


def until(node: Any, done: Callable[[], bool], ask: Callable[[], None]) -> None:
    ends = time.monotonic() + 120
    while not done() and time.monotonic() < ends:
        ask()
        time.sleep(0.2)
        node.on_answers()
    assert done()


@pytest.mark.slow
@pytest.mark.usefixtures("stubs")
def test_a_real_recalibration_and_a_real_server(tour: bags.Tour, calibration: Path, tmp_path: Path) -> None:
    kept, count, path = tmp_path / "kept", len(tour.rests), tmp_path / "arm.sock"
    node = made_node(exported(calibration, f"folder={kept}", f"serve_socket={path}"))
    with armcal("recalibrate", calibration, "--from", "socket", "--out", kept):
        play(node, tour)
        until(node, lambda: not node.waiting, node.on_second)
        assert node.counts == {"records": count, "acknowledged": count, "refused": 0}
        time.sleep(1.5)
        assert {value.key: value.value for value in node.report().values}["level"] in ("nominal", "watch")
    verdicts = [e["verdict"] for e in map(json.loads, (kept / "events.jsonl").open()) if e["event"] == "record"]
    assert len(verdicts) == count and verdicts.count("accepted") > 20
    commands, target = np.array([[0.3, -0.4, 0.5, 0.2, 0.6, -0.1]]), Message()
    ((*_, place),) = Calibration.load(kept / "calibration.yaml").forward(commands)[:, :3].transpose(0, 2, 1)
    target.pose.position, target.pose.orientation = (
        Message(**dict(zip("xyz", map(float, place), strict=True))),
        Message(w=1.0, x=0.0, y=0.0, z=0.0),
    )
    with armcal("serve", kept / "calibration.yaml", "--socket", path):
        until(node, lambda: bool(node.published["joint_command"]), lambda: node.subscriptions["target"](target))
    reached = Calibration.load(kept / "calibration.yaml").forward([node.published["joint_command"][0].position])
    np.testing.assert_allclose(reached[0, :3, 3], place, atol=1e-6)
    np.testing.assert_allclose(reached[0, :3, :3], np.eye(3), atol=1e-6)
