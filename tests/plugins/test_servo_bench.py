"""The simulated bench as a whole: its time, its determinism, its faults, and what it holds for unsafe."""

from __future__ import annotations

import json
import os
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from armcal.arm.servo import PulseClock
from armcal.config.servo_file import load_servo_file
from armcal.devices.framed import Frame, FrameDecoder, encoded
from armcal.errors import ArmcalError
from armcal.io.json_server import JsonServer
from armcal.run.experiment import Experiment, clearance_check
from servo_bench_parts import ADDRESS, read_all

from tests.bench_runs import overrides_for, serve
from tests.simulated_lines.line_world import LineWorld
from tests.simulated_lines.servo_bench import PulseBench, ServoBenchAtLine, ServoBenchSettings

LRM = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
JOINTS = tuple(f"q{j}" for j in range(1, 7))
STATED = load_servo_file(LRM / "servos.yaml")
CLOCK = PulseClock(25e6, 121)
HELLO, WRITE, READ, SET, BEAT, GUARD = 0x01, 0x10, 0x11, 0x12, 0x20, 0x21


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return Experiment.load(LRM / "plan.yaml")


@pytest.fixture
def ear() -> Iterator[socket.socket]:
    """Where the tracker sends to."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.bind(("127.0.0.1", 0))
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        own.setblocking(False)
        yield own


def heard(ear: socket.socket) -> list[str]:
    found = []
    while True:
        try:
            found.append(ear.recv(65536).decode())
        except BlockingIOError:
            return found


class Host:
    """A host of a bench in this process: raw frames, counts, time."""

    def __init__(self, world: LineWorld, folder: Path) -> None:
        self.world, self.folder = world, folder
        self.port = os.open(folder / "board", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self.sequence, self.replies = 0, b""

    def ask(self, kind: int, payload: bytes = b"") -> Frame | None:
        self.sequence = (self.sequence + 1) % 256
        os.write(self.port, encoded(Frame(kind, self.sequence, payload)))
        self.world.attend_line()
        said = read_all(self.port)
        self.replies += said
        found = FrameDecoder().feed(said)
        return found[-1] if found else None

    def write(self, *data: int) -> None:
        self.ask(WRITE, bytes([ADDRESS, *data]))

    def advance(self, seconds: float) -> dict[str, Any]:
        return self.world.answer({"advance": seconds})

    @property
    def state(self) -> dict[str, Any]:
        return self.world.answer({"state": True})

    def fault(self, **fault: Any) -> None:
        self.world.answer({"fault": fault})

    def wake(self) -> None:
        self.write(0, 0x31)
        self.write(0xFE, 121)
        self.write(0, 0x21)
        self.advance(0.001)

    def command(self, **degrees: float) -> None:
        payload = b""
        for joint, angle in degrees.items():
            servo = STATED.servos[joint]
            on = 200 * servo.channel
            off = (on + int(CLOCK.counts(servo.table.pulse(np.radians(angle))))) % 4096
            payload += bytes([ADDRESS, servo.channel]) + on.to_bytes(2, "little") + off.to_bytes(2, "little")
        self.ask(SET, payload)

    def energise(self, **degrees: float) -> None:
        """All joints, one by one, at zero where nothing else is said."""
        self.wake()
        for joint in JOINTS:
            self.command(**{joint: degrees.get(joint, 0.0)})
            self.advance(0.8)

    def ramp(self, start: dict[str, float], end: dict[str, float], rate: float = 20.0) -> None:
        """In a straight line, the fastest joint at this rate (deg/s), a command every 20 ms."""
        steps = max(1, int(np.ceil(max(abs(end[j] - start[j]) for j in end) / rate / 0.02)))
        for step in range(1, steps + 1):
            self.command(**{j: start[j] + (end[j] - start[j]) * step / steps for j in end})
            self.advance(0.02)

    @property
    def log(self) -> list[dict[str, Any]]:
        path = self.folder / "safety.jsonl"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


Make = Callable[..., Host]


@pytest.fixture
def make(experiment: Experiment, tmp_path: Path, ear: socket.socket) -> Iterator[Make]:
    hosts: list[Host] = []

    def build(**given: Any) -> Host:
        folder = tmp_path / f"bench{len(hosts)}"
        folder.mkdir()
        world = PulseBench(bench_settings(ear, **given), experiment, folder)
        world.start(folder / "board")
        hosts.append(Host(world, folder))
        return hosts[-1]

    yield build
    for host in hosts:
        os.close(host.port)
        host.world.close()


def bench_settings(ear: socket.socket, **given: Any) -> ServoBenchSettings:
    tracker = {"port": ear.getsockname()[1], **given.pop("tracker", {})}
    content = {"servos": str(LRM / "bench_servos.yaml"), "truth": str(LRM / "truth.yaml"), "tracker": tracker}
    return ServoBenchSettings.model_validate({**content, **given})


class TestTime:
    def test_nothing_happens_while_no_time_passes(self, make: Make, ear: socket.socket) -> None:
        host = make()
        host.energise()
        heard(ear)
        before = host.state
        for angle in (5.0, 10.0, 15.0):
            host.command(q3=angle)
        after = host.state
        assert after["pulses_s"]["q3"] != before["pulses_s"]["q3"]
        assert after["joints"]["q3"].pop("target_rad") != before["joints"]["q3"].pop("target_rad")
        assert after["joints"] == before["joints"] and after["base_T_tool"] == before["base_T_tool"]
        assert after["now"] == before["now"] and heard(ear) == []

    @pytest.mark.slow
    def test_the_same_requests_give_the_same_bytes(self, make: Make, ear: socket.socket) -> None:
        found = []
        for _ in range(2):
            host = make(seed=5, tracker={"noise_mm": 0.1, "lost_frames": 0.1})
            host.fault(kind="flip", count=2, after=9)
            host.energise()
            host.ramp(dict.fromkeys(JOINTS, 0.0), dict.fromkeys(JOINTS, 10.0))
            state = json.dumps(host.state)
            found.append((host.replies, state, heard(ear)))
        assert found[0] == found[1] and len(found[0][2]) > 200

    def test_another_seed_gives_other_noise(self, make: Make, ear: socket.socket) -> None:
        found = []
        for seed in (1, 2):
            make(seed=seed).advance(0.1)
            found.append(heard(ear))
        assert found[0] != found[1]

    @pytest.mark.slow
    def test_the_way_time_is_cut_up_changes_nothing(self, make: Make, ear: socket.socket) -> None:
        whole, cut = make(), make()
        said = []
        for host, steps in ((whole, [3.0]), (cut, [0.02] * 150)):
            host.energise(q2=30, q4=-60)
            host.command(q4=-50.0)
            heard(ear)
            for seconds in steps:
                host.advance(seconds)
            said.append(len(heard(ear)))
        one, other = whole.state, cut.state
        assert said == [180, 180]
        for joint in JOINTS:
            assert other["joints"][joint]["angle_rad"] == pytest.approx(one["joints"][joint]["angle_rad"], abs=1e-12)
            assert other["joints"][joint]["winding"] == pytest.approx(one["joints"][joint]["winding"], rel=1e-9)

    @pytest.mark.parametrize("seconds", [-1, float("nan"), float("inf"), 1e9, "1", None, True])
    def test_time_that_cannot_pass_is_refused(self, make: Make, seconds: Any) -> None:
        with pytest.raises(ValueError, match="expected seconds"):
            make().advance(seconds)


class TestArm:
    def test_before_the_first_pulse_it_hangs_and_rests(self, make: Make) -> None:
        host = make(start={"q2": "20 deg"})
        first = host.state
        host.advance(5.0)
        later = host.state
        assert {j: v["angle_rad"] for j, v in first["joints"].items()} == {
            j: v["angle_rad"] for j, v in later["joints"].items()
        }
        at_stop = 2.4 - 1e-9
        assert all(abs(v["torque_Nm"]) <= 0.05 or abs(v["angle_rad"]) >= at_stop for v in later["joints"].values())
        assert later["base_T_tool"][2][3] < -0.1, "it hangs down"
        assert not any(v["powered"] for v in later["joints"].values())

    def test_it_stands_at_the_angle_of_its_true_pulse_table(self, make: Make) -> None:
        host = make()
        host.energise(q2=20.0, q3=-35.0)
        true = load_servo_file(LRM / "bench_servos.yaml")
        state = host.state
        for joint in JOINTS:
            pulse = state["pulses_s"][joint]
            assert state["joints"][joint]["angle_rad"] == pytest.approx(float(true.servos[joint].table.angle(pulse)))
        counts = CLOCK.counts(STATED.servos["q3"].table.pulse(np.radians(-35.0)))
        assert state["pulses_s"]["q3"] == pytest.approx(float(counts) * 122 / 25.06e6, rel=1e-12)

    def test_the_tracker_sees_the_tool_where_it_is(self, make: Make, ear: socket.socket) -> None:
        world = {"position_mm": [400, -250, 900], "rpy_deg": [0, 0, 30]}
        host = make(world_T_base=world, tracker={"noise_mm": 0.0, "orientation_noise_deg": 0.0})
        host.energise(q2=25.0, q4=40.0)
        heard(ear)
        host.advance(0.1)
        text = heard(ear)[-1]
        numbers = [[float(x) for x in group.split()] for group in re.findall(r"\[([^\]]*)\]", text)]
        bodies = [numbers[start : start + 3] for start in range(0, len(numbers), 3)]
        seen = {int(head[0]): (np.array(place[:3]) / 1000, np.array(m).reshape(3, 3).T) for head, place, m in bodies}
        (base, turn), (tool, rotation) = seen[1], seen[2]
        assert np.allclose(base, [0.4, -0.25, 0.9]) and np.allclose(turn[:2, 0], [np.cos(np.pi / 6), 0.5], atol=1e-5)
        expected = np.array(host.state["base_T_tool"])
        assert np.allclose(turn.T @ (tool - base), expected[:3, 3], atol=2e-6)
        assert np.allclose(turn.T @ rotation, expected[:3, :3], atol=3e-6)

    def test_released_it_drops_and_that_is_told(self, make: Make) -> None:
        host = make()
        host.energise()
        high = host.state["base_T_tool"][2][3]
        host.write(0xFD, 0x10)
        host.advance(3.0)
        assert host.state["base_T_tool"][2][3] < high - 0.1
        dropped = {line["joint"] for line in host.log if line.get("event") == "drop"}
        assert "q2" in dropped and host.state["offences"] == {}

    def test_a_servo_that_gets_too_hot_fails_and_lets_go(self, make: Make) -> None:
        host = make(joints={"q2": {"continuous_Nm": 0.3}}, tracker={"rate_hz": 1.0})
        host.energise(q2=45.0)
        stood = host.state["joints"]["q2"]["angle_rad"]
        host.advance(600.0)
        state = host.state
        assert state["failed"] == ["q2"] and state["offences"]["heat"] == 1
        assert abs(state["joints"]["q2"]["angle_rad"] - stood) > 0.3
        assert [line["joint"] for line in host.log if line.get("offence") == "heat"] == ["q2"]


class TestSafety:
    @pytest.mark.slow
    def test_slow_ramps_of_all_joints_over_their_range_are_safe(self, make: Make, experiment: Experiment) -> None:
        host = make(safety={"clearance_slack_mm": 1000})
        host.energise()
        here = dict.fromkeys(JOINTS, 0.0)
        assert experiment.settings.plan is not None
        limits = {j: np.degrees(pair) for j, pair in experiment.settings.plan.limits.items()}
        for end in (0, 1):
            there = {j: float(limits[j][end]) for j in JOINTS}
            host.ramp(here, there)
            here = there
        assert host.state["offences"] == {} and host.state["violations"] == 0
        assert host.state["events"] == {"first_pulse": 6}

    @pytest.mark.parametrize("rate", [24.0, 40.0])
    def test_a_ramp_that_is_too_fast_is_an_offence(self, make: Make, rate: float) -> None:
        host = make()
        host.energise()
        host.ramp({"q3": 0.0}, {"q3": 60.0}, rate)
        (line,) = (line for line in host.log if "offence" in line)
        assert line["offence"] == "speed" and line["joint"] == "q3" and line["value"] > line["limit"]

    def test_a_jump_by_raw_bytes_is_an_offence_although_no_time_passes(self, make: Make) -> None:
        host = make()
        host.energise()
        on, off = 400, 400 + int(CLOCK.counts(1555e-6))
        channel = 0x06 + 4 * 2
        host.write(channel, on & 255, on >> 8, (off + 100) & 255, (off + 100) >> 8)
        host.write(channel, on & 255, on >> 8, off & 255, off >> 8)
        host.advance(1.0)
        assert host.state["offences"]["speed"] >= 1

    def test_a_glitch_between_two_bytes_is_an_offence(self, make: Make) -> None:
        host = make()
        host.energise()
        host.write(0x08 + 4 * 2, 0x00)
        assert {line["joint"] for line in host.log if line.get("offence") == "speed"} == {"q3"}

    def test_an_angle_beyond_its_limits_is_an_offence_and_one_at_them_is_none(self, make: Make) -> None:
        host = make(safety={"clearance_slack_mm": 1000})
        host.energise()
        host.ramp({"q2": 0.0}, {"q2": 50.0})
        assert host.state["offences"] == {}
        host.ramp({"q2": 50.0}, {"q2": 55.0})
        assert set(host.state["offences"]) == {"limits"}

    @pytest.mark.slow
    def test_a_pose_that_is_too_near_is_an_offence(self, make: Make, experiment: Experiment) -> None:
        plan = experiment.settings.plan
        assert plan is not None and plan.clearance is not None
        check = clearance_check(plan.clearance, experiment.system.arms, experiment.source)
        low, high = (np.array([plan.limits[j][end] for j in JOINTS])[:, None] for end in (0, 1))
        poses = low + (high - low) * np.random.default_rng(1).random((6, 3000))
        near = poses[:, int(np.argmin(check(poses).margins.min(axis=0)))]
        host = make()
        host.energise()
        host.ramp(dict.fromkeys(JOINTS, 0.0), dict(zip(JOINTS, map(float, np.degrees(near)), strict=True)))
        assert set(host.state["offences"]) == {"clearance"}

    def test_two_joints_that_begin_at_once_are_an_offence(self, make: Make) -> None:
        host = make()
        host.wake()
        host.command(q1=0.0)
        host.advance(0.05)
        host.command(q2=0.0)
        assert host.state["offences"] == {"energised_together": 1}

    def test_a_first_pulse_is_told_with_its_jump(self, make: Make) -> None:
        host = make()
        hung = host.state["joints"]["q2"]["angle_rad"]
        host.wake()
        host.command(q2=10.0)
        (line,) = host.log
        assert line["event"] == "first_pulse" and line["value"] == pytest.approx(np.radians(10) - hung, abs=0.02)


class TestFaults:
    def test_a_reset_leaves_the_pulses_and_a_brown_out_ends_them(self, make: Make) -> None:
        host = make()
        host.energise()
        pulses = host.state["pulses_s"]
        host.fault(kind="reset")
        assert host.state["board"]["boots"] == 2 and host.state["pulses_s"] == pulses
        host.fault(kind="brown_out")
        assert set(host.state["pulses_s"].values()) == {None} and host.state["board"]["boots"] == 3

    def test_the_boot_counter_outlives_the_bench(
        self, experiment: Experiment, tmp_path: Path, ear: socket.socket
    ) -> None:
        boots = []
        for _ in range(3):
            world = PulseBench(bench_settings(ear), experiment, tmp_path)
            world.start(tmp_path / "board")
            boots.append(world.answer({"state": True})["board"]["boots"])
            world.close()
        assert boots == [1, 2, 3]

    def test_a_fault_waits_for_its_time(self, make: Make) -> None:
        host = make()
        host.fault(kind="stuck", at=1.0, seconds=0.5)
        for seconds, stuck in ((0.9, False), (0.2, True), (0.5, False)):
            host.advance(seconds)
            reply = host.ask(BEAT)
            assert reply is not None and bool(reply.payload[4] & 4) is stuck

    def test_a_refused_byte_can_be_planned(self, make: Make) -> None:
        host = make()
        host.wake()
        host.fault(kind="nack", byte=2, after=1)
        kinds = []
        for _ in range(3):
            reply = host.ask(WRITE, bytes([ADDRESS, 6, 0, 0, 44, 1]))
            kinds.append(reply.kind if reply else None)
        assert kinds == [0x90, 0xFF, 0x90]

    def test_unplugged_and_plugged_in_again(self, make: Make) -> None:
        host = make()
        host.energise()
        before = (host.folder / "board").readlink()
        host.fault(kind="unplug")
        with pytest.raises(OSError):
            os.write(host.port, b"\0")
        assert not (host.folder / "board").exists()
        host.fault(kind="replug")
        assert (host.folder / "board").readlink() != before
        os.close(host.port)
        host.port = os.open(host.folder / "board", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        reply = host.ask(HELLO, b"\x01")
        assert reply is not None and reply.kind == 0x81
        assert all(pulse is not None for pulse in host.state["pulses_s"].values())

    def test_a_host_that_dies_while_it_has_the_port_to_itself_leaves_it_free(self, make: Make) -> None:
        import fcntl
        import termios

        host = make()
        fcntl.ioctl(host.port, termios.TIOCEXCL)
        host.ask(HELLO, b"\x01")
        os.close(host.port)
        host.world.attend_line()
        host.port = os.open(host.folder / "board", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        assert host.ask(HELLO, b"\x01") is not None

    def test_the_trackers_faults(self, make: Make, ear: socket.socket) -> None:
        host = make()
        host.advance(0.1)
        heard(ear)
        host.fault(kind="silent")
        host.advance(0.1)
        assert heard(ear) == []
        host.fault(kind="seen")
        host.fault(kind="frozen", counter="same")
        host.advance(0.1)
        assert len(set(heard(ear))) == 1
        host.fault(kind="seen")
        host.advance(0.1)
        moving = heard(ear)
        assert len(set(moving)) == len(moving) == 6

    @pytest.mark.parametrize(
        "fault", [{"kind": "rain"}, {"at": 1}, {"kind": "drop", "count": 0}, [], {"kind": "drop", "x": 1}]
    )
    def test_a_fault_that_is_none_is_refused(self, make: Make, fault: Any) -> None:
        with pytest.raises(ValueError, match="fault"):
            make().world.answer({"fault": fault})

    @pytest.mark.parametrize(
        ("fault", "said"),
        [
            ({"kind": "unplg", "at": 5}, "kind 'unplg', expected one of drop"),
            ({"kind": "lost", "body": "tol"}, "body 'tol', expected one of base, tool"),
            ({"kind": "brown_out", "joint": "qq3"}, "no joint is called 'qq3'"),
            ({"kind": "jam", "joint": "q3"}, "kind 'jam', expected one of drop"),
        ],
    )
    def test_a_misspelt_fault_is_refused_with_the_names_that_there_are(self, make: Make, fault: Any, said: str) -> None:
        with pytest.raises(ValueError, match=said):
            make().world.answer({"fault": fault})

    def test_the_board_parks_the_arm_slowly_when_its_host_is_silent(self, make: Make) -> None:
        host = make()
        host.energise()
        park = int(CLOCK.counts(STATED.servos["q3"].table.pulse(np.radians(30.0))))
        rate = round(16 * 15 / 0.53)
        guard = (500).to_bytes(2, "little") + bytes([1, ADDRESS, 2]) + rate.to_bytes(2, "little")
        host.ask(GUARD, guard + b"\x01" + park.to_bytes(2, "little"))
        host.advance(5.0)
        state = host.state
        assert state["board"]["took_over"] and state["offences"] == {}
        assert np.degrees(state["joints"]["q3"]["angle_rad"]) == pytest.approx(30, abs=1.0)


class Client:
    def __init__(self, path: Path) -> None:
        until = time.monotonic() + 60
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.settimeout(60)
        while True:
            try:
                self.socket.connect(str(path))
                break
            except OSError:
                assert time.monotonic() < until
                time.sleep(0.01)
        self.answers = self.socket.makefile("r")

    def say(self, text: str) -> dict[str, Any]:
        self.socket.sendall(text.encode() + b"\n")
        found: dict[str, Any] = json.loads(self.answers.readline())
        return found

    def ask(self, **request: Any) -> dict[str, Any]:
        return self.say(json.dumps(request))

    def close(self) -> None:
        self.answers.close()
        self.socket.close()


class TestServer:
    @pytest.fixture
    def path(self, experiment: Experiment, tmp_path: Path, ear: socket.socket) -> Iterator[Path]:
        bench = ServoBenchAtLine(bench_settings(ear))
        thread = threading.Thread(target=bench.serve, args=(experiment, tmp_path))
        thread.start()
        yield tmp_path / "clock"
        if (tmp_path / "clock").exists():
            client = Client(tmp_path / "clock")
            client.ask(stop=True)
            client.close()
        thread.join(30)
        assert not thread.is_alive() and not (tmp_path / "clock").exists() and not (tmp_path / "board").exists()

    def test_clients_come_and_go_and_time_stands_still_between_them(self, path: Path) -> None:
        first = Client(path)
        assert first.ask(advance=1.5)["now"] == 1.5
        first.close()
        second = Client(path)
        assert second.ask(advance=0.0)["now"] == 1.5
        third = Client(path)
        assert third.ask(advance=0.5)["wall"] - second.ask(advance=0.0)["wall"] == 0.0
        second.close()
        third.close()

    def test_a_client_that_dies_in_the_middle_of_a_line_does_no_harm(self, path: Path) -> None:
        first = Client(path)
        first.socket.sendall(b'{"advance": 10')
        first.close()
        second = Client(path)
        assert second.ask(advance=0.25)["now"] == 0.25
        second.close()

    @pytest.mark.quick("\\xff", '{"fault": 3}', "{}")
    @pytest.mark.parametrize("line", ["[]", "{", "{}", '{"advance": "x"}', "\xff", "[" * 20000, '{"fault": 3}'])
    def test_a_request_that_is_none_is_answered_by_an_error(self, path: Path, line: str) -> None:
        client = Client(path)
        assert "error" in client.say(line)
        assert client.ask(advance=0.5)["now"] == 0.5
        client.close()

    def test_the_board_is_there_before_the_clock(
        self, experiment: Experiment, tmp_path: Path, ear: socket.socket, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """However long it takes to plug the board in: who waits for the clock finds both."""
        start, early = LineWorld.start, []

        def slowly(world: LineWorld, path: Path) -> None:
            early.append((tmp_path / "clock").exists())
            start(world, path)

        monkeypatch.setattr(LineWorld, "start", slowly)
        bench = ServoBenchAtLine(bench_settings(ear))
        thread = threading.Thread(target=bench.serve, args=(experiment, tmp_path))
        thread.start()
        client = Client(tmp_path / "clock")
        assert early == [False] and (tmp_path / "board").exists()
        client.ask(stop=True)
        client.close()
        thread.join(30)
        assert not thread.is_alive()

    def test_bytes_to_the_board_are_done_before_time_passes(self, path: Path) -> None:
        """Without an answer to wait for: each write must be there when the advance after it begins."""
        client = Client(path)
        port = os.open(path.with_name("board"), os.O_RDWR | os.O_NOCTTY)
        for number, data in enumerate(([0, 0x31], [0xFE, 121], [0, 0x21]), start=1):
            os.write(port, encoded(Frame(WRITE, number, bytes([ADDRESS, *data]))))
        client.ask(advance=0.001)
        for number in range(200):
            off = 300 + number
            data = bytes([ADDRESS, 6, 0, 0, off & 255, off >> 8])
            os.write(port, encoded(Frame(WRITE, 4 + number, data)))
            client.ask(advance=0.0)
            assert client.ask(state=True)["pulses_s"]["q1"] == pytest.approx(off * 122 / 25.06e6)
            read_all(port)
        os.close(port)
        client.close()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("bench.simulator.joints={q9: {speed_deg_per_s: 100}}", "no joint is called 'q9'"),
        ("bench.simulator.measurement=camera", "bench.simulator.measurement: found camera"),
        ("bench.simulator.without_effects=[quantum]", "no effect of arm is called 'quantum'"),
        ("bench.simulator.servos=missing.yaml", "missing.yaml"),
        ("bench.simulator.joints={all: {stall_Nm: 0}}", "stall"),
    ],
)
def test_settings_that_do_not_fit_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str, told: str
) -> None:
    monkeypatch.setattr(JsonServer, "serve", lambda *given: pytest.fail("a bench runs"))
    with pytest.raises(ArmcalError, match=re.escape(told)):
        serve(Experiment.load(LRM / "bench.yaml", (*overrides_for(tmp_path), change)), tmp_path)
