"""``armcal compensate`` as a user meets it: files, messages, exit codes."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path

import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal.calibration.compensation import Compensator, Options, sent
from armcal.cli.main import cli
from armcal.plugins import discover
from armcal.run.compensate import Answer, Bench
from click.testing import CliRunner, Result
from made_calibrations import made_calibration, written
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from small_arms import CONFIGS, calibration, compensator, drawn, predicted


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is compiled, not even behind the scenes."""
    monkeypatch.setattr("armcal.functions.compiler.find_compiler", lambda: None)


def armcal(*arguments: object) -> Result:
    """One command in this process."""
    return CliRunner().invoke(cli, [str(each) for each in arguments])


def told(result: Result, code: int = 0) -> str:
    """What was said; a fault that nobody caught is shown as it is."""
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.output


class Desk:
    """A folder with a calibration and places that its arm reaches."""

    def __init__(self, folder: Path, name: str = "three", count: int = 5) -> None:
        self.folder, self.name = folder, name
        self.calibration = written(calibration(name), folder / "calibration.yaml")
        self.out = folder / "out.csv"
        self.tools = compensator(name).forward(drawn(compensator(name), count))
        self.places_mm = 1000 * self.tools[:, :3, 3]

    def file(self, header: str = "x_mm,y_mm,z_mm", rows=None, name: str = "targets.csv") -> Path:
        lines = [",".join(str(cell) for cell in row) for row in (self.places_mm if rows is None else rows)]
        path = self.folder / name
        path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
        return path

    def ask(self, targets: Path, *more: object) -> Result:
        return armcal("compensate", self.calibration, "--targets", targets, "--out", self.out, *more)

    def answers(self) -> list[dict[str, str]]:
        with self.out.open(encoding="utf-8", newline="") as stream:
            return list(csv.DictReader(stream))

    def commands(self, unit: str = "deg") -> np.ndarray:
        """As the file has them (rad)."""
        joints = compensator(self.name).joints
        rows = np.array([[float(row[f"{joint}_{unit}"]) for joint in joints] for row in self.answers()])
        return np.radians(rows) if unit == "deg" else rows


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(tmp_path)


def places(rows: list[dict[str, str]], name: str = "tool") -> np.ndarray:
    return np.array([[float(row[f"{name}_{axis}_mm"]) for axis in "xyz"] for row in rows])


# -- what is written -----------------------------------------------------------------------------------------------


def test_the_commands_lead_where_the_targets_are(desk: Desk) -> None:
    text = told(desk.ask(desk.file()))
    assert "5 of 5 targets are reached" in text
    assert "nominal commands:" in " ".join(text.split())
    assert {row["reached"] for row in desk.answers()} == {"yes"}
    tools = predicted(calibration("three"), desk.commands())
    assert np.abs(1000 * tools[:, :3, 3] - desk.places_mm).max() < 2e-6
    assert np.abs(places(desk.answers()) - desk.places_mm).max() < 2e-6


@pytest.mark.slow
def test_what_was_written_can_be_predicted(desk: Desk) -> None:
    """``armcal predict`` reads the commands as they were meant."""
    told(desk.ask(desk.file()))
    seen = desk.folder / "predicted.csv"
    told(armcal("predict", desk.calibration, "--poses", desk.out, "--out", seen))
    rows = list(csv.DictReader(seen.open(encoding="utf-8")))
    read = np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in rows])
    given = Calibration.load(desk.calibration)
    columns = {f"arm.q{i + 1}": desk.commands()[:, i] for i in range(3)}
    expected = given.predict(Dataset(tuple(map(str, range(5))), columns))[0]
    assert np.abs(read / 1000 - np.stack([expected[f"tracker.{axis}"] for axis in "xyz"], axis=1)).max() < 1e-8


@pytest.mark.slow
def test_poses_by_quaternion_and_by_angles_are_the_same(desk: Desk) -> None:
    turned = Rotation.from_matrix(desk.tools[:, :3, :3])
    quaternions = np.column_stack([desk.places_mm, turned.as_quat(scalar_first=True)])
    told(desk.ask(desk.file("x_mm,y_mm,z_mm,qw,qx,qy,qz", quaternions)))
    one = desk.commands()
    assert {row["reached"] for row in desk.answers()} == {"yes"}
    angles = np.column_stack([desk.places_mm, turned.as_euler("xyz", degrees=True)])
    told(desk.ask(desk.file("x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg", angles), "--angles", "rad"))
    assert np.abs(desk.commands("rad") - one).max() < 1e-6
    tools = predicted(calibration("three"), one)
    assert np.abs(tools - desk.tools).max() < 1e-7


def test_targets_may_be_in_metres(desk: Desk) -> None:
    told(desk.ask(desk.file("x_m,y_m,z_m", desk.places_mm / 1000)))
    assert np.abs(places(desk.answers()) - desk.places_mm).max() < 2e-6


def test_ids_and_columns_of_ones_own_are_kept(desk: Desk) -> None:
    rows = [[f"hole {i}", *place, "drill"] for i, place in enumerate(desk.places_mm)]
    told(desk.ask(desk.file("pose_id,x_mm,y_mm,z_mm,note", rows)))
    assert [row["pose_id"] for row in desk.answers()] == [f"hole {i}" for i in range(5)]
    assert {row["note"] for row in desk.answers()} == {"drill"}


def test_a_load_in_the_file_is_carried_and_told(desk: Desk) -> None:
    told(desk.ask(desk.file("x_mm,y_mm,z_mm,payload_g", [[*place, 200] for place in desk.places_mm])))
    assert {float(row["payload_g"]) for row in desk.answers()} == {200.0}
    tools = predicted(calibration("three"), desk.commands(), payload=0.2)
    assert np.abs(1000 * tools[:, :3, 3] - desk.places_mm).max() < 2e-6


def test_json_is_json_and_says_which_are_missed(desk: Desk) -> None:
    rows = [["far", 3000, 0, 0], ["lost", 1e8, 0, 0], ["near", *desk.places_mm[0]], ["empty", "", 0, 0]]
    result = desk.ask(desk.file("pose_id,x_mm,y_mm,z_mm", rows), "--json")
    told(result)
    found = json.loads(result.stdout, parse_constant=pytest.fail)
    assert (found["targets"], found["reached"]) == (3, 1)
    assert [each["id"] for each in found["missed"]] == ["far", "lost"]
    assert found["missed"][0]["nearest_mm"] == pytest.approx(2590, abs=10)
    assert "out of reach" in found["missed"][0]["reason"]
    assert len(found["set_aside"]) == 1
    row = desk.answers()[0]
    assert row["reached"] == "no"
    assert float(row["error_mm"]) >= float(row["bound_mm"]) > 2500


def test_joints_without_limits_are_named(desk: Desk) -> None:
    result = desk.ask(desk.file())
    assert "no limits are known of q1, q2, q3: commands may lie beyond them. Give --within CONFIG." in result.stderr


@pytest.mark.slow
def test_a_pose_file_may_hold_the_targets(desk: Desk) -> None:
    """As ``armcal simulate`` writes it: its commands, in any unit, give way to those that are found."""
    rows = [[1, 2, 3, *place] for place in desk.places_mm]
    assert "not used" not in told(desk.ask(desk.file("q1_deg,q2_rad,q3_deg,x_mm,y_mm,z_mm", rows)))
    assert not {"q1_rad", "q2_rad"} & set(desk.answers()[0])
    tools = predicted(calibration("three"), desk.commands())
    assert np.abs(1000 * tools[:, :3, 3] - desk.places_mm).max() < 2e-6


def test_what_is_missed_is_told_in_words(desk: Desk) -> None:
    text = told(desk.ask(desk.file(rows=[[3000, 0, 0]] * 1 + [[3000 + i, 0, 0] for i in range(1, 8)])))
    assert text.count("out of reach: no command comes nearer than") == 5
    assert "3 more targets cannot be reached; the file says why" in text
    assert "0 of 8 targets are reached" in text
    assert "error" not in text.splitlines()[-1]


def test_a_path_and_a_start(desk: Desk) -> None:
    found = compensator("three")
    along = np.linspace([0.2, 0.5, -0.8], [0.5, 0.7, -0.6], 6)
    targets = desk.file(rows=1000 * found.forward(along)[:, :3, 3])
    degrees = [f"--start=q{i + 1}={q} rad" for i, q in enumerate(along[0])]
    told(desk.ask(targets, "--path", *degrees))
    assert np.abs(desk.commands() - along).max() < 1e-5
    moves = [float(row["longest_move_deg"]) for row in desk.answers()]
    assert moves[1:] == pytest.approx(np.degrees(np.abs(np.diff(along, axis=0)).max(axis=1)), abs=1e-3)


def test_counts_and_pulses_stand_in_the_file_of_an_arm_with_servos(tmp_path: Path) -> None:
    desk = Desk(tmp_path, "mixed", 4)
    told(desk.ask(desk.file()))
    row = desk.answers()[0]
    assert "q2_counts" not in row
    table, clock = compensator("mixed").expression.servos["q1"]
    assert float(row["q1_pulse_us"]) == pytest.approx(1e6 * clock.tick * int(row["q1_counts"]), rel=1e-5)
    made = float(table.angle(int(row["q1_counts"]) * clock.tick))
    assert float(row["q1_deg"]) == pytest.approx(np.degrees(made), abs=1e-9)
    tools = predicted(calibration("mixed"), desk.commands())
    away = np.linalg.norm(1000 * tools[:, :3, 3] - desk.places_mm, axis=1)
    assert [float(each["error_mm"]) for each in desk.answers()] == pytest.approx(away, rel=1e-4, abs=1e-6)


@pytest.mark.slow
def test_what_a_controller_of_the_nominal_arm_is_sent(desk: Desk) -> None:
    """Its own inverse kinematics turns that into the commands again."""
    told(desk.ask(desk.file()))
    commands, stated = desk.commands(), [row["nominal_error_mm"] for row in desk.answers()]
    told(desk.ask(desk.file(), "--for", "nominal"))
    rows = desk.answers()
    assert not {f"{joint}_deg" for joint in compensator("three").joints} & set(rows[0]) and "turn_x_rad" not in rows[0]
    sent = np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in rows])
    shifts = np.array([[float(row[f"d{axis}_mm"]) for axis in "xyz"] for row in rows])
    assert sent - shifts == pytest.approx(desk.places_mm, abs=1e-9)
    assert np.abs(shifts).max() > 0.5
    nominal = Bench.of(Calibration.load(desk.calibration), None, None, discover()).nominal
    for place, start in zip(sent / 1000, commands, strict=True):

        def off(q: np.ndarray, place=place) -> np.ndarray:
            return nominal.forward(q)[0, :3, 3] - place

        solved = least_squares(off, start + 0.05, xtol=1e-14, gtol=1e-14)
        assert np.abs(solved.x - start).max() < 1e-6
    wrong = nominal.solve(nominal.targets(desk.places_mm / 1000), commands)
    away = predicted(calibration("three"), wrong.joint_angles)[:, :3, 3] - desk.places_mm / 1000
    assert [text != "" for text in stated] == wrong.reached.tolist()
    had = [float(text) for text in stated if text]
    assert had == pytest.approx(1000 * np.linalg.norm(away[wrong.reached], axis=1), rel=1e-3)


@pytest.mark.slow
def test_one_arm_of_two(tmp_path: Path) -> None:
    both = made_calibration(CONFIGS / "frida" / "dual_twists.yaml")
    path, out, targets = written(both, tmp_path / "c.yaml"), tmp_path / "out.csv", tmp_path / "t.csv"
    place = 1000 * both.forward(np.full((1, 7), 0.3), "right")[0, :3, 3]
    targets.write_text("x_mm,y_mm,z_mm\n" + ",".join(map(str, place)) + "\n", encoding="utf-8")
    asked = ("compensate", path, "--targets", targets, "--out", out)
    assert "found the arms left, right. Choose one with --arm NAME." in told(armcal(*asked), 2)
    told(armcal(*asked, "--arm", "right"))
    row = next(csv.DictReader(out.open(encoding="utf-8")))
    q = np.radians([[float(row[next(c for c in row if c.endswith(f"q{i}_deg"))]) for i in range(1, 8)]])
    assert np.abs(1000 * both.forward(q, "right")[0, :3, 3] - place).max() < 1e-5


# -- what is refused -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("header", "row", "said"),
    [
        ("x_mm,y_mm", [1, 2], "found no column for z"),
        ("x_mm,y_mm", [1, 2], "Give columns x_mm, y_mm, z_mm, for a rotation"),
        ("x_mm;y_mm;z_mm", ["1,5;2;3"], "with commas between them and decimal points"),
        ("x,y,z", [1, 2, 3], "x has no unit"),
        ("x_mm,y_mm,z_deg", [1, 2, 3], "z_deg"),
        ("x_mm,y_mm,z_mm", ["nan", 2, 3], "found no usable record"),
        ("x_mm,y_mm,z_mm", ["one", 2, 3], "found 'one', expected a number"),
        ("x_mm,y_mm,z_mm", ["1e300", 2, 3], "found 1e+297 m, expected a place that an arm could have"),
        ("x_mm,y_mm,z_mm,roll_deg,pitch_deg", [1, 2, 3, 0, 0], "it gives roll, pitch and not yaw"),
        ("x_mm,y_mm,z_mm,qw,qx,qy", [1, 2, 3, 1, 0, 0], "it gives qw, qx, qy and not qz"),
        ("x_mm,y_mm,z_mm,qw,roll_deg", [1, 2, 3, 1, 0], "it gives the rotation twice, by qw and by roll"),
        ("x_mm,y_mm,z_mm,qw,qx,qy,qz", [1, 2, 3, 1, 1, 0, 0], ":2, qw, qx, qy, qz: its quaternion has the norm 1.414"),
        ("x_mm,y_mm,z_mm,qw,qx,qy,qz", [1, 2, 3, 0, 0, 0, 0], "its quaternion has the norm 0"),
        ("x_mm,y_mm,z_mm,gravity_z_m_s2", [1, 2, 3, -1.62], "gravity has no gravity_x, gravity_y"),
        ("x_mm,y_mm,z_mm,approach1", [1, 2, 3, 5], "approach"),
        ("x_mm,y_mm,z_mm,payload_g", [200, 50, 300, -50], ":2, payload_g: found a payload of -50 g"),
        ("x_m,y_m,z_m", [200, 50, 300], "Check the unit in the column names: x_mm or x_m."),
        ("x_mm,y_mm,z_mm", [0.2, 0.05, 0.3], "Check the unit in the column names: x_mm or x_m."),
    ],
)
def test_files_of_targets_that_are_none(desk: Desk, header: str, row, said: str) -> None:
    text = told(desk.ask(desk.file(header, [row])), 2)
    assert said in text
    assert "Traceback" not in text
    assert not desk.out.exists()


def test_a_misspelt_column_is_noticed(desk: Desk) -> None:
    text = told(desk.ask(desk.file("x_mm,y_mm,z_mm,paylod_g", [[*place, 100] for place in desk.places_mm])))
    assert "the column paylod_g is kept but not used: was payload meant?" in text


def test_columns_that_mean_nothing_are_named(desk: Desk) -> None:
    """A rotation in a form that is not known, a quantity nobody asked for; not words, which need no unit."""
    rows = [[*place, 20, 30, "left"] for place in desk.places_mm]
    text = told(desk.ask(desk.file("x_mm,y_mm,z_mm,rx_deg,speed_mm,note", rows)))
    assert "columns that mean nothing to this arm are not used: rx_deg, speed_mm." in text


@pytest.mark.parametrize(
    ("content", "said"),
    [(b"", "it is empty"), (b"x_mm,y_mm,z_mm\n", "no records"), (b"x_mm,y_mm,z_mm\n\xff,1,2\n", "not UTF-8")],
)
def test_files_that_are_no_tables(desk: Desk, content: bytes, said: str) -> None:
    path = desk.folder / "bad.csv"
    path.write_bytes(content)
    assert said in told(desk.ask(path), 2)


@pytest.mark.slow
def test_paths_that_lead_nowhere(desk: Desk) -> None:
    targets = desk.file()
    assert "there is no such file" in told(desk.ask(desk.folder / "none.csv"), 2)
    assert "it is a directory" in told(desk.ask(desk.folder), 2)
    for bad, said in (
        (desk.folder / "none.yaml", "there is no such file"),
        (targets, "expected keys and values"),
        (CONFIGS / "lrm_arm" / "arm.yaml", "found calibration schema None"),
    ):
        assert said in told(armcal("compensate", bad, "--targets", targets, "--out", desk.out), 2)
    for out, said in (
        (desk.folder / "no" / "out.csv", "it cannot be written (No such file or directory)"),
        (desk.folder, "expected a file or nothing there"),
        (targets, "it is one of the inputs"),
        (desk.calibration, "it is one of the inputs"),
    ):
        before = {path: path.read_bytes() for path in (targets, desk.calibration)}
        assert said in told(armcal("compensate", desk.calibration, "--targets", targets, "--out", out), 2)
        assert all(path.read_bytes() == kept for path, kept in before.items())


@pytest.mark.parametrize(
    ("option", "said"),
    [
        (["--arm", "left"], "no arm is called 'left'. The arms are arm."),
        (["--start", "q1=10"], "'10' has no unit"),
        (["--start", "q1"], "expected JOINT=ANGLE with a joint of q1, q2, q3"),
        (["--start", "elbow=1 deg"], "expected JOINT=ANGLE with a joint of q1, q2, q3"),
        (["--start", "q1=10 mm"], "has a unit of length"),
        (["--start", "q1=nan deg"], "is not a number with a unit"),
        (["--within", str(CONFIGS / "lrm_arm" / "arm.yaml")], "found no plan"),
        (["--within", str(CONFIGS / "lrm_arm" / "plan.yaml")], "those of the calibration q1, q2, q3"),
        (["--within", "none.yaml"], "there is no such file"),
    ],
)
def test_options_that_do_not_fit(desk: Desk, option: list[str], said: str) -> None:
    text = told(desk.ask(desk.file(), *option), 2)
    assert said in text
    assert "Traceback" not in text
    assert not desk.out.exists()


@pytest.mark.slow
def test_an_elastic_arm_must_know_what_hangs_on_it(desk: Desk) -> None:
    """As for a prediction; the column says it."""
    unsaid = calibration("three", "statics.payload_g=null")
    path = written(unsaid, desk.folder / "unsaid.yaml")
    asked = ("compensate", path, "--out", desk.out, "--targets")
    assert "its payload is not stated. Add a column payload_g" in told(armcal(*asked, desk.file()), 2)
    told(armcal(*asked, desk.file("x_mm,y_mm,z_mm,payload_g", [[*place, 5] for place in desk.places_mm])))
    with pytest.raises(Exception, match="its payload is not stated"):
        unsaid.compensate(desk.places_mm / 1000)


@pytest.mark.slow
def test_limits_of_the_plan_are_kept(tmp_path: Path) -> None:
    """Clearance too: the plan of the LRM arm has both."""
    given = made_calibration(CONFIGS / "lrm_arm" / "arm.yaml")
    desk = tmp_path / "c.yaml"
    written(given, desk)
    bench = Bench.of(Calibration.load(desk), None, CONFIGS / "lrm_arm" / "plan.yaml", discover())
    assert bench.options.limits["q2"] == pytest.approx((-np.radians(50), np.radians(50)))
    assert bench.options.allowed is not None
    found = bench.compensator()
    q = drawn(found, 60)
    q = q[bench.options.allowed(q.T)][:4]
    assert len(q) == 4
    commands = found.solve(found.targets(found.forward(q)[:, :3, 3]))
    assert commands.reached.all()
    assert bench.options.allowed(commands.joint_angles.T).all()
    assert (np.abs(commands.joint_angles[:, 1]) <= np.radians(50) + 1e-12).all()


def test_a_write_that_fails_leaves_what_was_there(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """As when the process is stopped before the new file takes the old one's place."""
    desk.out.write_text("kept", encoding="utf-8")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert "it cannot be written (No space left on device)" in told(desk.ask(desk.file()), 2)
    assert desk.out.read_text(encoding="utf-8") == "kept"
    assert not [path for path in desk.folder.iterdir() if path.name.endswith(".tmp")]


def test_nothing_is_printed_when_nothing_is_asked(desk: Desk) -> None:
    assert told(desk.ask(desk.file(), "-q")) == ""


# -- poses for a controller of the nominal arm -----------------------------------------------------------------------


AXES = ((170, 195, 220), (-20, 0, 20), (160, 180, 200))
TURNED = Rotation.from_euler("xyz", [0, 90, 0], degrees=True)


@pytest.fixture(scope="module")
def arms(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Compensator, Compensator]:
    """The LRM arm's calibration as a file, the arm as it is, and what its controller takes it for."""
    given = made_calibration(CONFIGS / "lrm_arm" / "arm.yaml")
    path = written(given, tmp_path_factory.mktemp("table") / "calibration.yaml")
    nominal = Bench.of(Calibration.load(path), None, None, discover()).nominal
    return path, given.compensator(options=Options(), choice="interpreted"), nominal


def box(folder: Path, axes=AXES) -> Path:
    """The nodes of a grid, plane by plane and row by row."""
    nodes = [(x, y, z) for x in axes[0] for y in axes[1] for z in axes[2]]
    path = folder / "nodes.csv"
    path.write_text(
        "x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg\n" + "".join(f"{x},{y},{z},0,90,0\n" for x, y, z in nodes)
    )
    return path


@pytest.mark.slow
def test_nodes_of_a_grid_correct_a_region_at_them_and_between_them(tmp_path: Path, arms) -> None:
    path, real, nominal = arms
    out = tmp_path / "sent.csv"
    told(armcal("compensate", path, "--targets", box(tmp_path), "--path", "--for", "nominal", "--out", out))
    rows = list(csv.DictReader(out.open(encoding="utf-8")))
    names = ("dx_mm", "dy_mm", "dz_mm", "turn_x_rad", "turn_y_rad", "turn_z_rad")
    table = np.array([[float(row[name]) for name in names] for row in rows])
    interpolated = RegularGridInterpolator([np.array(axis, dtype=float) for axis in AXES], table.reshape(3, 3, 3, 6))
    points = np.array([[170.0, -20, 160], [195, 0, 180], [220, 20, 200], [181, 7, 171]])
    told(armcal("compensate", path, "--targets", box(tmp_path), "--path", "--out", out))
    first = next(csv.DictReader(out.open(encoding="utf-8")))
    start = np.radians([float(first[f"q{i}_deg"]) for i in range(1, 7)])
    for i, point in enumerate(points):
        correction = interpolated(point)[0]
        place = (point + correction[:3]) / 1000
        turned = (Rotation.from_rotvec(correction[3:]) * TURNED).as_matrix()

        def off(q: np.ndarray, place=place, turned=turned) -> np.ndarray:
            tool = nominal.forward(q)[0]
            left = Rotation.from_matrix(tool[:3, :3].T @ turned).as_rotvec()
            return np.concatenate([tool[:3, 3] - place, 0.2 * left])

        solved = least_squares(off, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert np.abs(solved.fun).max() < 1e-9
        tool = real.forward(solved.x)[0]
        away = np.linalg.norm(1000 * tool[:3, 3] - point)
        turn = Rotation.from_matrix(tool[:3, :3].T @ TURNED.as_matrix()).magnitude()
        assert (away < 1e-4 and turn < 1e-6) if i < 3 else (away < 1.0 and turn < 0.02)
        start = solved.x


def test_nothing_is_sent_for_targets_that_are_not_reached(tmp_path: Path, arms) -> None:
    out = tmp_path / "sent.csv"
    targets = box(tmp_path, ((170, 520), (0,), (180,)))
    text = told(armcal("compensate", arms[0], "--targets", targets, "--for", "nominal", "--out", out))
    rows = list(csv.DictReader(out.open(encoding="utf-8")))
    assert [row["reached"] for row in rows] == ["yes", "no"] and "1 of 2 targets are reached" in text
    columns = [name for name in rows[0] if name.startswith(("d", "turn_", "q")) or name in ("x_mm", "y_mm", "z_mm")]
    assert len(columns) == 13
    assert all(rows[0][name] for name in columns) and not any(rows[1][name] for name in columns)


def test_the_nominal_arm_itself_is_sent_its_targets(arms) -> None:
    nominal = arms[2]
    targets = nominal.targets(np.array([[0.17, -0.02, 0.16], [0.22, 0.02, 0.2]]), np.array([TURNED.as_matrix()] * 2))
    commands = nominal.solve(targets)
    poses = sent(nominal, commands)
    assert commands.reached.all()
    assert np.abs(poses[:, :3, 3] - targets.positions).max() < 1e-8
    assert np.abs(poses[:, :3, :3] - TURNED.as_matrix()).max() < 1e-7


def test_assessing_needs_no_prediction_of_errors() -> None:
    """A calibration that keeps nothing of its errors gives no radii, and says nothing of them."""
    found = compensator("three")
    targets = found.targets(found.forward(drawn(found, 3))[:, :3, 3])
    bench = Bench.of(calibration("three"), None, None, discover())
    answer = Answer(bench, found, targets, found.solve(targets))
    assert answer.radii is None
    assert answer.summary()["radius_95_mm"] is None
