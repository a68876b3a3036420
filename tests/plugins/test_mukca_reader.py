"""Folders of postures with a ball in sockets: what is read, what is refused and where, and damaged folders."""

from __future__ import annotations

import hashlib
import math
from collections import Counter

import numpy as np
import pytest
from armcal.arm.assembly import Arm
from armcal.errors import ArmcalError, DataError
from armcal.measure.reader import ReadRequest, requested_channels
from armcal_contact.contacts import BallInSocket, BallInSocketSettings
from armcal_contact.mukca_reader import MukcaReader, MukcaSettings
from armcal_mdh.model import MdhModel, MdhSettings

NOISE_M = 2e-4
JOINTS = 3
ROBOTS = {"panda_2_clean": 7, "kuka_14": 7, "dinova_1": 6}


def arm(name="arm", joints=JOINTS, **row):
    rows = [{"a": 0.1, **row}, *({"a": 0.1, "alpha": 1.0} for _ in range(joints - 1))]
    return Arm(name, "mdh", MdhModel(MdhSettings.si(convention="standard", rows=rows)), {}, ())


def request(arms=None, measured=True, **measurements):
    arms = arms or {"arm": arm()}
    ball = BallInSocket(BallInSocketSettings.si(noise=NOISE_M, arm=next(iter(arms))), tuple(arms))
    found = {"sockets": ball, **measurements}
    return ReadRequest(arms, found, requested_channels(arms, found, measured))


def postures(count, seed=0, joints=JOINTS):
    table = np.random.default_rng(seed).uniform(-3, 3, (count, joints))
    return "".join(",".join(f"{x:.18e}" for x in row) + "\n" for row in table)


def folder(place, files):
    """Files by their path below ``place``; a number stands for so many postures."""
    for seed, (name, content) in enumerate(files.items()):
        path = place / name
        path.parent.mkdir(parents=True, exist_ok=True)
        text = postures(content, seed) if isinstance(content, int) else content
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return place


def good(place, **changed):
    files = {"back/hole_0.csv": 4, "back/hole_1.csv": 6, "front/hole_0.csv": 3, "front/hole_1.csv": 3}
    return folder(place, files | {name.replace("__", "/") + ".csv": text for name, text in changed.items()})


def read(place, asked=None, **settings):
    return MukcaReader(MukcaSettings(path=place, **settings)).read(asked or request())


def refusal(place, asked=None, **settings):
    with pytest.raises(DataError) as caught:
        read(place, asked, **settings)
    assert caught.value.exit_code == 2 and caught.value.hint.endswith((".", "?"))
    return str(caught.value)


@pytest.mark.shared
@pytest.mark.parametrize("robot", ROBOTS)
def test_every_row_of_the_measured_robots_is_read_as_it_stands(shared_data, robot):
    place = shared_data / "mukca" / robot
    if not place.is_dir():
        pytest.skip(f"no recordings at {place}")
    dataset = read(place, request({"arm": arm(joints=ROBOTS[robot])}))
    files = sorted(place.glob("*/hole_*.csv"))
    counts = {(f.parent.name, f.stem): len(f.read_text().splitlines()) for f in files}
    found = Counter(zip(dataset.extra["position"], dataset.extra["socket"], strict=True))
    assert found == counts and len(dataset) == sum(counts.values())
    table = np.vstack([np.loadtxt(f, delimiter=",") for f in files])
    np.testing.assert_array_equal(dataset.stacked([f"arm.q{i + 1}" for i in range(ROBOTS[robot])]).T, table)
    assert dataset.sha256 == hashlib.sha256(b"".join(f.read_bytes() for f in files)).hexdigest()
    assert not dataset.warnings and not dataset.set_aside


def test_labels_ids_lines_and_source(tmp_path):
    text = "\ufeff0.1,0.2,0.3\r\n\r\n 0.4 , 0.5,-0.6\r\n"
    dataset = read(good(tmp_path, front__hole_1=text))
    assert dataset.ids[-3:] == ("front/hole_0/3", "front/hole_1/1", "front/hole_1/3")
    assert dataset.rows[-3:] == (3, 1, 3)
    assert dataset.extra["position"][-1] == "front" and dataset.extra["socket"][-1] == "hole_1"
    assert dataset.column("arm.q3")[-1] == -0.6
    assert dataset.source == str(tmp_path)


def test_any_number_of_positions_and_sockets(tmp_path):
    dataset = read(folder(tmp_path, {f"p{i}/hole_{j}.csv": 2 + i for i in range(12) for j in (0, 1, 7)}))
    assert len(dataset) == 3 * sum(range(2, 14))
    assert set(dataset.extra["socket"]) == {"hole_0", "hole_1", "hole_7"}


def test_positions_weigh_the_same_whatever_their_postures(tmp_path):
    """The sum over a position's records of 1/noise^2 is 1/declared^2 for each."""
    dataset = read(good(tmp_path), weights="positions")
    positions, weights = np.array(dataset.extra["position"]), dataset.column("sockets.noise") ** -2
    for position, count in {"back": 10, "front": 6}.items():
        assert (positions == position).sum() == count
        assert weights[positions == position].sum() == pytest.approx(NOISE_M**-2, rel=1e-12)
    assert not read(tmp_path).has("sockets.noise")
    assert not read(tmp_path, request(measured=False), weights="positions").has("sockets.noise")


def test_only_measurements_at_positions_get_a_noise(tmp_path):
    names = ("arm",)
    other = BallInSocket(BallInSocketSettings.si(noise=1.0, group_labels=("plane",)), names)
    twice = BallInSocket(BallInSocketSettings.si(noise=1.0, group_labels=("position",)), names)
    dataset = read(good(tmp_path), request(other=other, twice=twice), weights="positions")
    assert dataset.has("twice.noise") and dataset.has("sockets.noise") and not dataset.has("other.noise")
    np.testing.assert_allclose(dataset.column("twice.noise"), dataset.column("sockets.noise") / NOISE_M)


def test_a_robot_at_rest_is_read_twice_and_a_copied_file_is_refused(tmp_path):
    line = "0.1,0.2,0.3\n"
    assert len(read(good(tmp_path, front__hole_0=line + line))) == 15
    again = refusal(good(tmp_path, front__hole_0=postures(3, 9), front__hole_1=postures(3, 9)))
    assert "hole_1.csv: it is a copy of" in again and "front/hole_0.csv" in again


def test_a_posture_that_is_not_finite_is_set_aside(tmp_path):
    dataset = read(good(tmp_path, front__hole_0="0.1,nan,0.3\n0.1,0.2,0.3\n0.1,,0.3\ninf,1,1\n"))
    assert [(aside.record_id, aside.row) for aside in dataset.set_aside] == [
        ("front/hole_0/1", 1),
        ("front/hole_0/3", 3),
        ("front/hole_0/4", 4),
    ]
    assert len(dataset) == 14
    assert "(the first: front/hole_0/1)" in dataset.warnings[0]


def test_an_arm_among_two_and_what_the_other_reads_is_missing(tmp_path):
    both = {"left": arm("left"), "right": arm("right")}
    right = BallInSocket(BallInSocketSettings.si(noise=NOISE_M, arm="right"), tuple(both))
    asked = request(both, other=right)
    assert "there are 2 arms" in refusal(good(tmp_path), asked)
    assert "no arm is called 'middle'" in refusal(tmp_path, asked, arm="middle")
    dataset = read(tmp_path, asked, arm="left")
    assert len(dataset) == 16 and np.isfinite(dataset.column("left.q1")).all()
    assert np.isnan(dataset.column("right.q1")).all()


def test_only_a_sliding_joint_may_be_beyond_two_pi(tmp_path):
    place = good(tmp_path, front__hole_0="7,0.2,0.3\n")
    assert "more than one turn" in refusal(place)
    assert len(read(place, request({"arm": arm(kind="prismatic")}))) == 14


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("front__hole_0", "", "hole_0.csv: it is empty"),
        ("front__hole_0", "\n \n", "hole_0.csv: it is empty"),
        ("front__hole_0", "0.1,0.2,0.3\n0.1,0.2\n", "hole_0.csv:2: found 2 cells, expected 3 as in the first row"),
        (
            "back__hole_1",
            "0.1,0.2\n0.3,0.4\n",
            "hole_1.csv:1: found 2 columns, expected 3: a joint angle of the arm arm",
        ),
        ("back__hole_1", "1,2,3\n\n1,2,x3\n", "hole_1.csv:3, column 3 (q3): found 'x3', expected a number"),
        ("back__hole_1", "q1,q2,q3\n1,2,3\n", "hole_1.csv:1, column 1 (q1): found 'q1', expected a number"),
        ("back__hole_1", "1,2,3\n1,2,1_0\n", "found '1_0'"),
        (
            "back__hole_1",
            "1,2,3\n30,20,-45\n",
            "hole_1.csv:2, column 1 (q1): found 30 rad, more than one turn (2 pi rad)",
        ),
        ("back__hole_1", b"1,2,3\n1,\xff,3\n", "hole_1.csv:2: found the byte 0xff"),
        ("back__hole_1", b"1,2,3\n1,2\0,3\n", "hole_1.csv:2: found a NUL byte"),
    ],
)
def test_what_is_refused_and_where(tmp_path, name, text, said):
    found = refusal(good(tmp_path, **{name: text}))
    assert said in found and str(tmp_path / name.split("__")[0]) in found


def test_the_hint_for_a_header_says_that_there_is_none(tmp_path):
    assert "These files have no header." in refusal(good(tmp_path, front__hole_0="a,b,c\n"))


def test_folders_that_are_none(tmp_path):
    assert "there is no such folder" in refusal(tmp_path / "none")
    (tmp_path / "file.csv").write_text("1,2,3\n")
    assert "it is a file, expected a folder" in refusal(tmp_path / "file.csv")
    empty = tmp_path / "empty"
    (empty / "front").mkdir(parents=True)
    assert "found no position in it" in refusal(empty)
    good(tmp_path / "robot")
    assert "is it one position?" in refusal(tmp_path / "robot" / "front")


def test_other_tables_are_ignored_with_a_warning_and_one_socket_is_warned_of(tmp_path):
    files = {
        "front/notes.txt": "x",
        "notes.csv": "x",
        "front/.hole_0.csv": "x",
        "front/HOLE_0.csv": "x",
        ".git/a.csv": "x",
    }
    dataset = read(folder(good(tmp_path), files | {"side/hole_1.csv": 5, "top/other.csv": "x"}))
    assert len(dataset) == 21
    told = [text.removeprefix(str(tmp_path)) for text in dataset.warnings]
    assert sum("it is ignored; only" in text for text in told) == 4
    assert any(text.startswith("/side: the position has only hole_1.csv: nothing is known of") for text in told)
    assert any(text.startswith("/top: the position has no file hole_0.csv") for text in told)
    assert len(told) == 6


def damaged(place, random):
    """A folder with one or two faults of any kind somewhere."""
    good(place)
    for _ in range(random.integers(1, 3)):
        files = sorted(path for path in place.rglob("hole_*.csv") if path.is_file())
        if not files:
            break
        path = files[random.integers(len(files))]
        raw = bytearray(path.read_bytes())
        kind = random.integers(9)
        if kind == 0:
            path.unlink()
        elif kind == 1:
            path.write_bytes(raw[: random.integers(len(raw) + 1)])
        elif kind == 2:
            path.unlink()
            path.mkdir()
        elif kind == 3:
            path.write_bytes(
                raw.replace(b",", [b";", b"\t", b",,", b"\n"][random.integers(4)], int(random.integers(1, 9)))
            )
        elif kind == 4:
            path.write_bytes(random.bytes(200))
        elif kind == 5:
            path.rename(path.with_name("hole_00000000000000000009.csv"))
        elif kind == 6:
            path.write_bytes(raw.replace(b"e", [b"E+9", b"nan", b"'"][random.integers(3)]))
        elif kind == 7:
            path.unlink()
            path.symlink_to("nowhere.csv")
        elif raw:
            for at in random.integers(len(raw), size=5):
                raw[at] = random.integers(256)
            path.write_bytes(bytes(raw))
    return place


@pytest.mark.slow
def test_damaged_folders_are_read_or_refused_by_an_armcal_error(tmp_path):
    random, refused, asked = np.random.default_rng(5), 0, request()
    for number in range(200):
        place = damaged(tmp_path / str(number), random)
        try:
            dataset = read(place, asked, weights=("positions", "postures")[number % 2])
        except ArmcalError as fault:
            assert fault.exit_code == 2 and fault.hint
            refused += 1
        else:
            angles = dataset.stacked([f"arm.q{i}" for i in (1, 2, 3)])
            assert len(dataset) and np.isfinite(angles).all() and np.abs(angles).max() <= 2 * math.pi
    assert 20 < refused < 200
