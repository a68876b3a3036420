"""Datagrams of DTrack, written by hand after its manual, and everything that is not one."""

from __future__ import annotations

import random
from collections.abc import Iterator

import numpy as np
import pytest
from armcal.devices.live import REPEATED
from armcal_tracker.trackers import LATE, FrameCounter, UnreadableError, messages
from scipy.spatial.transform import Rotation

# The example of the manual: one body. Its angles stand in the wrong order there: those of its matrix, from the last on.
MATRIX = "-0.940508 -0.339238 -0.019025 0.333599 -0.932599 0.137735 -0.064467 0.123194 0.990286"
BODY = f"[0 1.000][326.848 -187.216 109.503 -160.4704 -3.6963 -7.0913][{MATRIX}]"
FRAME = (
    f"fr 21753\r\nts 39596.024831\r\n6dcal 3\r\n6d 1 {BODY}\r\n3d 1 [79 1.000][210.730 -90.669 -108.554]\r\n".encode()
)


def refusal(data: bytes) -> str:
    with pytest.raises(UnreadableError) as caught:
        messages(data)
    return str(caught.value)


def test_the_manuals_example_is_read() -> None:
    [found] = messages(FRAME)
    assert found.counter == 21753
    assert found.stamp == 39596.024831
    assert list(found.bodies) == ["0"] and not found.wrong
    pose = found.bodies["0"]
    assert pose is not None
    np.testing.assert_allclose(pose[:3, 3], [0.326848, -0.187216, 0.109503], rtol=0, atol=1e-12)
    columns = np.array([float(x) for x in MATRIX.split()]).reshape(3, 3)
    np.testing.assert_array_equal(pose[:3, :3], columns.T)
    np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])


def test_columns_are_columns_by_the_angles_that_stand_beside_them() -> None:
    angles = (10.0, -20.0, 30.0)
    rotation = Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()
    printed = " ".join(f"{x:.6f}" for x in rotation.T.ravel())
    [found] = messages(f"fr 1\r\n6d 1 [4 1.000][1 2 3 10.0000 -20.0000 30.0000][{printed}]\r\n".encode())
    pose = found.bodies["4"]
    assert pose is not None
    np.testing.assert_allclose(pose[:3, :3], rotation, atol=1e-6)
    assert found.stamp is None


def test_an_inertial_line_tells_states() -> None:
    zeros = "0.000000 " * 8 + "0.000000"
    blocks = [
        f"[0 2 0.000][1.000 2.000 3.000][{MATRIX}]",
        f"[1 0 0.000][0.000 0.000 0.000][{zeros}]",
        f"[2 1 2.135][1.000 2.000 3.000][{MATRIX}]",
        f"[3 3 0.100][1.000 2.000 3.000][{MATRIX}]",
    ]
    [found] = messages(f"fr 2\r\n6di 4 {' '.join(blocks)}\r\n".encode())
    assert [name for name, pose in found.bodies.items() if pose is not None] == ["0", "3"]
    assert found.wrong == ("a body tracked by its gyroscopes alone",)


def test_the_inertial_line_stands_above_the_ordinary_one() -> None:
    zeros = "0.000000 " * 8 + "0.000000"
    data = f"fr 2\r\n6d 1 {BODY}\r\n6di 1 [0 0 0.000][0.000 0.000 0.000][{zeros}]\r\n"
    assert messages(data.encode())[0].bodies == {"0": None}


def test_lost_bodies() -> None:
    assert messages(b"fr 3\r\n6d 0 \r\n")[0].bodies == {}
    assert messages(b"fr 3\r\n6d 0\r\n")[0].bodies == {}
    assert messages(f"fr 3\r\n6d 1 {BODY.replace('[0 1.000]', '[0 -1.000]')}\r\n".encode())[0].bodies == {"0": None}


@pytest.mark.parametrize(
    "matrix",
    [
        "0 0 0 0 0 0 0 0 0",
        "-1 0 0 0 1 0 0 0 1",
        "1 0 0 0 1 0 0 0 1.002",
        "1 0 0 0 1 0.002 0 0 1",
        "2 0 0 0 2 0 0 0 2",
    ],
)
def test_a_matrix_that_is_no_rotation_loses_the_body_and_is_counted(matrix: str) -> None:
    [found] = messages(f"fr 3\r\n6d 1 [0 1.000][0 0 0 0 0 0][{matrix}]\r\n".encode())
    assert found.bodies == {"0": None}
    assert found.wrong == ("a matrix that is no rotation",)


def test_several_frames_in_a_datagram() -> None:
    assert [m.counter for m in messages(FRAME + FRAME.replace(b"21753", b"21754"))] == [21753, 21754]


@pytest.mark.parametrize("end", ["\r\n", "\n", "\r", "\r\n\0", ""])
def test_line_ends(end: str) -> None:
    assert messages(f"fr 3{end.rstrip(chr(0)) or chr(10)}6d 1 {BODY}{end}".encode())[0].bodies["0"] is not None


def test_the_datagram_cut_anywhere_is_refused_until_its_bodies_are_whole() -> None:
    whole = FRAME.index(b"]\r\n3d") + 1
    for length in range(whole):
        refusal(FRAME[:length])
    for length in range(whole, len(FRAME) + 1):
        assert messages(FRAME[:length])[0].bodies["0"] is not None


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("6d 1", "another number of bodies"),
        (f"6d 2 {BODY}", "another number of bodies"),
        (f"6d 1 {BODY} {BODY}", "another number of bodies"),
        (f"6d 1 x{BODY}", "another number of bodies"),
        (f"6d 2 {BODY} {BODY}", "a body twice"),
        (f"6d -1 {BODY}", "without its number of bodies"),
        (f"6d 1e3 {BODY}", "without its number of bodies"),
        (f"6d 99999999999999999999 {BODY}", "without its number of bodies"),
        (f"6d 1 {BODY.replace('326.848', 'nan')}", "not finite"),
        (f"6d 1 {BODY.replace('326.848', '1e400')}", "not finite"),
        (f"6d 1 {BODY.replace('326.848', '3_26.848')}", "another number of values"),
        (f"6d 1 {BODY.replace('326.848', '326,848')}", "no number"),
        (f"6d 1 {BODY.replace('326.848 ', '')}", "another number of values"),
        (f"6d 1 {BODY.replace('[0 ', '[0.5 ')}", "without its number"),
        (f"6d 1 {BODY.replace('[0 ', '[-3 ')}", "without its number"),
        (f"6d 1 {BODY}\r\n6d 1 {BODY}", "two lines"),
        (f"ts 90000\r\n6d 1 {BODY}", "no time of day"),
        (f"ts x\r\n6d 1 {BODY}", "no number"),
        ("3d 0", "no line of bodies"),
    ],
)
def test_what_is_refused(line: str, why: str) -> None:
    assert why in refusal(f"fr 7\r\n{line}\r\n".encode())


def test_white_space_of_any_kind_is_passed_over() -> None:
    assert messages(FRAME.replace(b"fr 2", b"fr \x1f \t2"))[0].counter == 21753


def test_other_beginnings_are_refused() -> None:
    for data in (b"", b"\r\n", b"ts 1\r\n" + FRAME, b"fr\r\n6d 0\r\n", b"fr x\r\n6d 0\r\n", b"fr -1\r\n6d 0\r\n"):
        refusal(data)
    assert "ASCII" in refusal(FRAME.replace(b"fr", b"f\xff"))


def test_a_body_beyond_reason_is_lost() -> None:
    [found] = messages(f"fr 3\r\n6d 1 {BODY.replace('326.848', '1e300')}\r\n".encode())
    assert found.bodies == {"0": None} and len(found.wrong) == 1


def mutated(random_source: random.Random, count: int) -> Iterator[bytes]:
    """Bytes that are near a datagram, or far from one."""
    words = (
        b"fr ",
        b"6d ",
        b"6di ",
        b"ts ",
        b"[",
        b"]",
        b"\r\n",
        b" ",
        b"-",
        b"1e308",
        b"nan",
        b"0",
        b"\0",
        b"[0 1.000]",
    )
    for _ in range(count):
        data = bytearray(FRAME)
        kind = random_source.randrange(5)
        if kind == 0:
            data = bytearray(random_source.randbytes(random_source.randrange(200)))
        elif kind == 1:
            data = bytearray(b"".join(random_source.choices(words, k=random_source.randrange(40))))
        for _ in range(random_source.randrange(1, 6)):
            at, length = random_source.randrange(len(data) + 1), random_source.randrange(1, 30)
            piece = random_source.choice((b"", random_source.choice(words), random_source.randbytes(1), data[:length]))
            data[at : at + random_source.randrange(3) * length] = piece
        yield bytes(data)


def survives(seed: int, count: int) -> None:
    reasons = set()
    for data in mutated(random.Random(seed), count):
        try:
            found = messages(data)
        except UnreadableError as fault:
            reasons.add(str(fault))
            continue
        for message in found:
            for pose in message.bodies.values():
                assert pose is None or (pose.shape == (4, 4) and np.isfinite(pose).all())
    assert len(reasons) < 40


def test_no_datagram_is_an_exception_and_reasons_are_few() -> None:
    survives(1, 20_000)


@pytest.mark.slow
def test_no_datagram_of_a_million_is_an_exception() -> None:
    survives(2, 1_000_000)


def test_a_datagram_of_the_largest_size_is_read_or_refused() -> None:
    zeros = " ".join("0" * 9)
    many = "".join(f"[{i} -1][0 0 0 0 0 0][{zeros}]" for i in range(1000))
    assert len(messages(f"fr 1\n6d 1000 {many}".encode())[0].bodies) == 1000
    for filler in (b"[", b"]", b"[]", b" ", b"\n", b"9", b"fr 1\n"):
        refusal(b"fr 1\n6d 1 " + filler * (65000 // len(filler)))


def test_counters_of_frames() -> None:
    counter = FrameCounter()
    faults = [counter.fault(n) for n in (5, 6, 6, 9, 8, 10)]
    assert faults == ["", "", REPEATED, "", LATE, ""]


def test_a_counter_that_begins_anew() -> None:
    counter = FrameCounter()
    assert [counter.fault(n) for n in (5000, 1, 2)] == ["", "", ""]
    counter = FrameCounter()  # so early that it might be late frames: a few are lost until it is sure
    assert [counter.fault(n) for n in (50, 1, 2, 3, 4)] == ["", LATE, LATE, "", ""]
