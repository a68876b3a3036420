"""The CSV reader: what it reads, what it refuses (file, line, column, mend), what it sets aside and warns of."""

from __future__ import annotations

import hashlib
import math
import random
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from armcal.arm.assembly import Arm
from armcal.base.dataset import Dataset
from armcal.base.units import from_unit
from armcal.config.validate import validate
from armcal.config.yaml_source import load_config
from armcal.errors import EXIT_BAD_INPUT, DataError
from armcal.measure.reader import ENVIRONMENT, ReadRequest, RequestedChannel, requested_channels
from armcal.measure.tables import MAX_BYTES, write_csv
from armcal_mdh.model import MdhModel, MdhSettings, Row
from armcal_tracker.csv_reader import CsvReader, CsvSettings
from armcal_tracker.position import TipPosition, TipPositionSettings
from pydantic import ValidationError

LRM_POSES = Path(__file__).parents[2].parent / "shared" / "data" / "lrm_arm" / "poses.csv"
HEADER = "pose_id,q1_deg,q2_deg,approach1,approach2,x_mm,y_mm,z_mm"


def wanted(joints: int = 2, measured: bool = True) -> tuple[RequestedChannel, ...]:
    found = []
    for i in range(1, joints + 1):
        found.append(RequestedChannel(f"arm.q{i}", (f"arm.q{i}", f"q{i}"), "angle", True))
        names = (f"arm.approach{i}", f"approach{i}", f"approach_q{i}")
        found.append(RequestedChannel(f"arm.approach.q{i}", names, "1", False))
    found += [RequestedChannel(name, (name,), dimension, False) for name, dimension in ENVIRONMENT]
    found += [RequestedChannel(f"tracker.{a}", (f"tracker.{a}", a), "length", measured) for a in "xyz"]
    return tuple(found)


def row(number: int, **changed: object) -> str:
    cells: dict[str, object] = {
        "pose_id": number,
        "q1_deg": 10.0 * number,
        "q2_deg": -7.5 * number,
        "approach1": (-1, 0, 1)[number % 3],
        "approach2": 1,
        "x_mm": 100.125 + number,
        "y_mm": 20.5 * number,
        "z_mm": 300.0 - number,
    }
    return ",".join(str(value) for value in (cells | changed).values())


def table(*rows: str, header: str = HEADER, count: int = 4) -> str:
    """A header and some lines; the given ones take the place of the first."""
    lines = [*rows, *(row(i) for i in range(len(rows) + 1, count + 1))]
    return "\n".join([header, *lines]) + "\n"


def read(
    folder: Path, content: str | bytes, want: Sequence[RequestedChannel] | None = None, **settings: object
) -> Dataset:
    path = folder / "poses.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    reader = CsvReader(CsvSettings(path=path, **settings))  # type: ignore[arg-type]
    return reader.read(ReadRequest({}, {}, tuple(want or wanted())))


def refusal(
    folder: Path, content: str | bytes, want: Sequence[RequestedChannel] | None = None, **settings: object
) -> str:
    with pytest.raises(DataError) as caught:
        read(folder, content, want, **settings)
    assert caught.value.exit_code == EXIT_BAD_INPUT
    assert caught.value.hint.endswith((".", "?"))
    assert str(folder) in str(caught.value)
    return str(caught.value)


def test_reads_si_values_ids_lines_and_hash(tmp_path: Path) -> None:
    text = table(row(1, q1_deg=-100.0, x_mm=3))
    dataset = read(tmp_path, text)
    assert dataset.ids == ("1", "2", "3", "4")
    assert dataset.rows == (2, 3, 4, 5)
    assert dataset.channels["arm.q1"][0] == math.radians(-100.0)
    assert dataset.channels["tracker.x"][0] == 0.003
    assert dataset.channels["arm.approach.q1"].tolist() == [0, 1, -1, 0]
    assert dataset.sha256 == hashlib.sha256(text.encode()).hexdigest()
    assert dataset.source == str(tmp_path / "poses.csv")
    assert not dataset.warnings and not dataset.set_aside and not dataset.extra


def test_every_kind_of_unit_and_extra_columns_as_text(tmp_path: Path) -> None:
    header = HEADER + ",payload_g,gravity_z_m_s2,time_ms,temperature_C,operator,q1_noise"
    rows = [row(i) + f',250,-1.62,{i}000,21.5,"Ann, B.",00{i}' for i in (1, 2)]
    dataset = read(tmp_path, table(*rows, header=header, count=2))
    assert dataset.channels["payload"].tolist() == [0.25, 0.25]
    assert dataset.channels["gravity_z"].tolist() == [-1.62, -1.62]
    assert dataset.channels["time"].tolist() == [1.0, 2.0]
    assert dataset.channels["temperature"].tolist() == [21.5, 21.5]
    assert dataset.extra == {"operator": ("Ann, B.", "Ann, B."), "q1_noise": ("001", "002")}


def test_bom_crlf_blank_lines_and_quotes(tmp_path: Path) -> None:
    lines = ["\ufeff" + '"pose_id",' + HEADER.partition(",")[2], "", row(1), "  ", row(2), ""]
    dataset = read(tmp_path, "\r\n".join(lines))
    assert dataset.ids == ("1", "2")
    assert dataset.rows == (3, 5)


def test_a_cell_with_a_line_break_does_not_shift_the_lines(tmp_path: Path) -> None:
    dataset = read(tmp_path, table(row(1) + ',"two\nlines"', row(2) + ",one", header=HEADER + ",note", count=2))
    assert dataset.rows == (2, 4)
    assert dataset.extra["note"] == ("two\nlines", "one")


def test_line_numbers_stand_in_for_ids(tmp_path: Path) -> None:
    rows = [row(i).partition(",")[2] for i in (1, 2)]
    assert read(tmp_path, table(*rows, header=HEADER.partition(",")[2], count=2)).ids == ("2", "3")
    assert read(tmp_path, table(header=HEADER.replace("pose_id", "id"), count=2)).ids == ("1", "2")


def test_columns_of_other_names(tmp_path: Path) -> None:
    text = table(header=HEADER.replace("q1_deg", "joint_1").replace("pose_id", "nr").replace("x_mm", "tracker.x_mm"))
    dataset = read(tmp_path, text, columns={"q1_deg": "joint_1", "pose_id": "nr"})
    assert dataset.channels["arm.q1"][1] == math.radians(20.0)
    assert dataset.ids[1] == "2"
    assert "tracker.x" in dataset.channels


def test_a_semicolon_file_when_it_is_declared(tmp_path: Path) -> None:
    assert len(read(tmp_path, table().replace(",", ";"), delimiter=";")) == 4


def test_measured_columns_may_be_absent_when_not_required(tmp_path: Path) -> None:
    text = "q1_deg,q2_deg\n10,20\n10,20\n30,40\n"
    dataset = read(tmp_path, text, wanted(measured=False))
    assert len(dataset) == 3  # poses to predict may repeat
    assert not dataset.has("tracker.x")


def test_the_unit_does_not_change_the_data(tmp_path: Path) -> None:
    random_ = np.random.default_rng(1)
    values = {w.channel: random_.uniform(-1, 1, 50) for w in wanted() if w.dimension in ("angle", "length")}
    ids = tuple(map(str, range(50)))
    kinds = ({"angle": "deg", "length": "mm"}, {"angle": "rad", "length": "m"}, {"angle": "mrad", "length": "um"})
    for units in kinds:
        write_csv(tmp_path / "w.csv", Dataset(ids, values), wanted(), units)
        got = read(tmp_path, (tmp_path / "w.csv").read_bytes())
        for channel, expected in values.items():
            assert (np.abs(got.channels[channel] - expected) <= np.spacing(np.abs(expected))).all(), (units, channel)


def test_millimetres_and_metres_of_one_decimal_are_the_same_float(tmp_path: Path) -> None:
    header = HEADER.replace("x_mm", "x_m")
    metres = read(tmp_path, table(row(1, x_mm="0.1001"), header=header, count=1))
    assert read(tmp_path, table(row(1, x_mm="100.1"), count=1)).channels["tracker.x"] == metres.channels["tracker.x"]


def test_round_trip(tmp_path: Path) -> None:
    header = HEADER + ",payload_g,gravity_z_m_s2,note"
    rows = [row(i) + f',{i}.5,-9.81,"a ""quoted"", {i}"' for i in range(1, 6)]
    first = read(tmp_path, table(*rows, header=header))
    write_csv(tmp_path / "again.csv", first, wanted())
    second = read(tmp_path, (tmp_path / "again.csv").read_bytes())
    assert second.ids == first.ids and second.extra == first.extra
    assert second.channels.keys() == first.channels.keys()
    for channel, values in first.channels.items():
        assert (np.abs(second.channels[channel] - values) <= np.spacing(np.abs(values))).all()
    assert (tmp_path / "again.csv").read_text().startswith("pose_id,q1_deg,approach1,q2_deg,approach2,gravity_z_m_s2")


REFUSED_HEADERS = {
    "number of joints, fewer": (
        HEADER.replace("q2_deg", "other"),
        ["poses.csv:1, q2:", "the file has 1 joint columns, the arm has 2", "Use this arm's file"],
    ),
    "more joints": (HEADER.replace("z_mm", "q3_deg"), [":1, q3_deg: the file has 3 joint columns, the arm has 2"]),
    "no unit": (HEADER.replace("q1_deg", "q1"), [":1, q1: q1 has no unit. Write q1_rad or q1_deg or q1_mrad."]),
    "dimension": (HEADER.replace("x_mm", "x_deg"), [":1, x_deg:", "of angle, expected a unit of length", "x_mm"]),
    "unit of none": (HEADER.replace("ach1", "ach1_deg"), [":1, approach1_deg:", "no unit", "Write approach1."]),
    "missing column": (
        HEADER.replace("x_mm", "X_mm"),
        ["poses.csv:1", "no column for tracker.x", "x_m or x_cm or x_mm", "nearest is X_mm", "columns: {x_mm: NAME}"],
    ),
    "two units": (HEADER.replace("z_mm", "q1_rad"), ["poses.csv:1", "both q1_rad and q1_deg", "Remove one."]),
    "name twice": (HEADER.replace("z_mm", "y_mm"), [":1, y_mm:", "y_mm twice (columns 7 and 8)", "Rename or"]),
    "nameless": (HEADER.replace("z_mm", " "), ["poses.csv:1", "column 8 has no name", "Name it"]),
    "no header": (row(1), ["poses.csv:1", "expected a header", "first line"]),
    "comment": ("# monday", ["poses.csv:1: found the comment '# monday', expected a header. Remove the line."]),
    "optional": (HEADER.replace("pose_id", "payload"), [":1, payload: payload has no unit. Write payload_kg"]),
}


@pytest.mark.parametrize("name", REFUSED_HEADERS)
def test_refused_headers(tmp_path: Path, name: str) -> None:
    header, expected = REFUSED_HEADERS[name]
    message = refusal(tmp_path, table(header=header))
    assert all(part in message for part in expected), message


REFUSED_ROWS = {
    "ragged, short": (row(3).rpartition(",")[0], ["poses.csv:4:", "found 7 cells, expected 8", "Complete the row"]),
    "ragged, long": (row(3) + ",5", ["poses.csv:4:", "found 9 cells, expected 8", "decimal point"]),
    "decimal comma": (row(3, x_mm='"12,5"'), [":4, x_mm: found '12,5', a decimal comma", "decimal points: 12.5."]),
    "text": (row(3, y_mm="abc"), ["poses.csv:4, y_mm:", "'abc', expected a number", "Correct it"]),
    "underscore": (row(3, y_mm="1_000"), ["poses.csv:4, y_mm:", "'1_000', expected a number"]),
    "other digits": (row(3, y_mm="\u0661\u0662"), ["poses.csv:4, y_mm:", "expected a number"]),
    "unit in the cell": (row(3, y_mm="12.5 mm"), ["poses.csv:4, y_mm:", "its unit belongs in the column's name"]),
    "row of units": ("-,[deg],,,,[mm],[mm],[mm]", [":4, q1_deg:", "looks like a row of units", "Remove it"]),
    "comment": ("# a pause", ["poses.csv:4:", "Remove the line: comments are not read."]),
    "header again": (HEADER, ["poses.csv:4, q1_deg: found the header again. Remove this line."]),
    "approach": (row(3, approach2=2), ["poses.csv:4, approach2:", "approach 2, expected -1, 0 or 1", "sign of"]),
    "same id": (row(1, x_mm=5), ["poses.csv:4:", "'1'", "line 2", "Give each record its own id"]),
    "open quote": (row(3, y_mm='"12'), ["poses.csv:4:", "not CSV", "Close every quote"]),
    "stray quote": (row(3, y_mm='"1"2'), ["poses.csv:4:", "not CSV", "Close every quote"]),
}


@pytest.mark.parametrize("name", REFUSED_ROWS)
def test_refused_rows(tmp_path: Path, name: str) -> None:
    line, expected = REFUSED_ROWS[name]
    message = refusal(tmp_path, table(row(1), row(2), line, row(4)))
    assert all(part in message for part in expected), message


REFUSED_BYTES = {
    "empty": (b"", ["it is empty", "Give a header"]),
    "blank": (b"\n \n\n", ["it is empty", "Give a header"]),
    "no records": (HEADER.encode() + b"\n", ["poses.csv:1:", "a header and no records", "Add one line"]),
    "latin-1": (table().encode().replace(b"\n3,", b"\n\xb0,"), ["poses.csv:4:", "byte 0xb0 at offset", "UTF-8"]),
    "utf-16": (table().encode("utf-16"), ["poses.csv:1:", "NUL byte at offset 3", "UTF-8"]),
    "nul": (table().encode() + b"\0" * 9, ["poses.csv:6:", "NUL byte at offset", "Save the table as CSV"]),
    "gzip": (b"\x1f\x8b\x08\x08", ["poses.csv:1:", "byte 0x8b at offset 1,", "Save the table as CSV"]),
    "long line": (b"a" * (2 << 20), ["poses.csv:1:", "more than 1 MiB"]),
    "old line ends": (table().encode().replace(b"\n", b"\r"), ["poses.csv:1:", "not CSV", "LF or CRLF"]),
    "semicolons": (table().encode().replace(b",", b";"), ["poses.csv:1:", "';' between", 'Set delimiter: ";"']),
    "tabs": (table().encode().replace(b",", b"\t"), ["poses.csv:1:", 'Set delimiter: "\\t"']),
    "semicolons and decimal commas": (
        table().replace(",", ";").replace(".", ",").encode(),
        ["poses.csv:1:", "decimal comma (10,0)", 'Set delimiter: ";"', 'and decimal: ","'],
    ),
    "columns": (",".join(f"c{i}" for i in range(4001)).encode(), ["poses.csv:1:", "4001 columns"]),
}


@pytest.mark.parametrize("name", REFUSED_BYTES)
def test_refused_files(tmp_path: Path, name: str) -> None:
    content, expected = REFUSED_BYTES[name]
    message = refusal(tmp_path, content)
    assert all(part in message for part in expected), message


def test_the_byte_offset_is_that_in_the_file(tmp_path: Path) -> None:
    content = b"\xef\xbb\xbf" + table().encode() + b"5,\xff"
    assert f"at offset {len(content) - 1}," in refusal(tmp_path, content)


def test_decimal_commas_with_the_right_delimiter(tmp_path: Path) -> None:
    text = table().replace(",", ";").replace(".", ",")
    message = refusal(tmp_path, text, delimiter=";")
    assert "poses.csv:2, q1_deg: found '10,0', a decimal comma. Write decimal points: 10.0. Or set decimal" in message
    with_points, with_commas = read(tmp_path, table()), read(tmp_path, text, delimiter=";", decimal=",")
    assert with_commas.ids == with_points.ids
    for name, column in with_points.channels.items():
        np.testing.assert_array_equal(with_commas.column(name), column)


@pytest.mark.parametrize("name", ["missing column", "semicolons", "decimal comma", "unknown name"])
def test_where_no_configuration_describes_the_file_the_caller_says_what_to_do(tmp_path: Path, name: str) -> None:
    content = {
        "missing column": table(header=HEADER.replace("x_mm", "X_mm")),
        "semicolons": table().replace(",", ";"),
        "decimal comma": table(row(1, x_mm='"12,5"')),
        "unknown name": table(),
    }[name]
    path = tmp_path / "poses.csv"
    path.write_text(content)
    reader = CsvReader(CsvSettings(path=path, columns={"x_mm": "nowhere"} if name == "unknown name" else {}))
    with pytest.raises(DataError) as caught:
        reader.read(ReadRequest({}, {}, wanted(), layout_hint="Name columns so."))
    hint = caught.value.hint
    assert "data section" not in hint and "configuration" not in hint
    assert hint == ("Write decimal points: 12.5." if name == "decimal comma" else "Name columns so.")


def test_points_among_decimal_commas_are_refused(tmp_path: Path) -> None:
    text = table().replace(",", ";").replace("10.0", "1.250,5", 1)
    message = refusal(tmp_path, text, delimiter=";", decimal=",")
    assert "poses.csv:2, q1_deg: found '1.250,5'" in message
    message = refusal(tmp_path, table().replace(",", ";"), delimiter=";", decimal=",")
    assert "expected a decimal comma" in message and 'leave decimal: "," out' in message


def test_a_comma_cannot_be_both(tmp_path: Path) -> None:
    with pytest.raises(ValidationError, match="a comma as delimiter and as decimal"):
        read(tmp_path, table(), decimal=",")


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ({"q1_deg": "joint1"}, ["no column 'joint1'", "Correct it under columns"]),
        ({"q1_deg": "q2_deg", "q2_deg": "q2_deg"}, ["q2_deg is mapped to both"]),
        ({"q9_deg": "x_mm"}, ["joint columns"]),
        ({"paylod_g": "pose_id"}, ["mapped to paylod_g, which nothing here uses", "payload_g"]),
        ({"q1_deg": "x_mm"}, ["the column q1_deg twice"]),
    ],
)
def test_refused_mappings(tmp_path: Path, columns: dict[str, str], expected: list[str]) -> None:
    message = refusal(tmp_path, table(), columns=columns)
    assert all(part in message for part in ["poses.csv:1", *expected]), message


def test_not_a_file(tmp_path: Path) -> None:
    request = ReadRequest({}, {}, wanted())
    with pytest.raises(DataError, match=r"gone\.csv: there is no such file\. Check the spelling"):
        CsvReader(CsvSettings(path=tmp_path / "gone.csv")).read(request)
    with pytest.raises(DataError, match=r"it is a directory, expected a CSV file\. Give the path"):
        CsvReader(CsvSettings(path=tmp_path)).read(request)
    with pytest.raises(DataError, match=r"a device or pipe, expected a CSV file"):
        CsvReader(CsvSettings(path=Path("/dev/zero"))).read(request)
    with pytest.raises(DataError, match=r"cannot be read .* Check its permissions"):
        CsvReader(CsvSettings(path=tmp_path / ("a" * 300))).read(request)
    with (tmp_path / "large.csv").open("wb") as sparse:
        sparse.truncate(MAX_BYTES + 1)
    with pytest.raises(DataError, match=r"large\.csv: it is larger than 2 GiB"):
        CsvReader(CsvSettings(path=tmp_path / "large.csv")).read(request)


@pytest.mark.parametrize("cell", ["", " ", "nan", "NaN", "N/A", "inf", "-inf", "1e999"])
def test_missing_values_are_set_aside(tmp_path: Path, cell: str) -> None:
    dataset = read(tmp_path, table(row(1), row(2, x_mm=cell)))
    assert dataset.ids == ("1", "3", "4")
    (aside,) = dataset.set_aside
    assert (aside.row, aside.record_id) == (3, "2") and "x_mm" in aside.reason
    assert "poses.csv: 1 of 4 records was set aside" in dataset.warnings[0] and "line 3" in dataset.warnings[0]


def test_a_record_without_an_id_is_set_aside(tmp_path: Path) -> None:
    dataset = read(tmp_path, table(row(1), ",,,,,,,", row(3)))
    assert [aside.reason for aside in dataset.set_aside] == ["its id is empty"]
    assert "poses.csv: 1 records without an id" in dataset.warnings[0]


def test_nothing_left_is_refused(tmp_path: Path) -> None:
    message = refusal(tmp_path, table(row(1, x_mm=""), count=1))
    assert "no usable record: all 1 were set aside, the first because x_mm is empty" in message


def test_general_checks_name_lines_and_columns(tmp_path: Path) -> None:
    dataset = read(tmp_path, table(row(1), row(2), row(2, pose_id=7)))
    assert dataset.set_aside[0].row == 4 and "duplicate of line 3" in dataset.set_aside[0].reason
    header = HEADER.replace("q1_deg", "q1_rad")
    assert "poses.csv:5, q1_rad: found 40 rad" in refusal(tmp_path, table(header=header))


def fuzzed(text: bytes, random_: random.Random) -> bytes:
    data = bytearray(text)
    for _ in range(random_.randint(1, 4)):
        at = random_.randrange(len(data) + 1)
        kind = random_.randrange(14)
        if kind == 0:
            data[at : at + 1] = bytes([random_.randrange(256)])
        elif kind == 1:
            data[at : at + random_.randint(1, 40)] = b""
        elif kind == 2:
            data[at:at] = random_.choice(
                [b",", b'"', b"\n", b"\r", b";", b"\0", b"nan", b"1e999", b"-", b"\xef\xbb\xbf"]
            )
        elif kind == 3:
            other = random_.randrange(len(data) + 1)
            data[at:at] = data[other : other + random_.randint(1, 200)]
        elif kind == 4:
            data = data[: max(at, 1)]
        elif kind == 5:
            data[at:at] = random_.choice([b"q1_deg", b"time_s", b"x_mm,", b"_mm", b"9" * 400, b"id,"])
        elif kind == 6:
            data = bytearray(data.replace(*random_.choice([(b",", b";"), (b".", b","), (b"_mm", b""), (b"1", b"2")])))
        else:
            digits = [i for i, byte in enumerate(data) if chr(byte).isdigit()]
            data[random_.choice(digits or [0])] = random_.choice(b"0123456789")
    return bytes(data)


@pytest.mark.slow
@pytest.mark.parametrize("trials", [400, pytest.param(1000, marks=pytest.mark.slow)])
def test_mutated_files_never_give_anything_else(tmp_path: Path, trials: int) -> None:
    random_ = random.Random(20240)
    base = table(count=20, header=HEADER).encode()
    timed = "\n".join(f"{line},{i if i else 'time_s'}" for i, line in enumerate(table(count=20).split("\n")[:-1]))
    outcomes = {"read": 0, "refused": 0}
    for trial in range(trials):
        content = fuzzed(base if trial % 2 else timed.encode(), random_)
        try:
            dataset = read(tmp_path, content)
        except DataError as refused:
            assert "poses.csv" in str(refused) and refused.hint
            outcomes["refused"] += 1
        else:
            assert len(dataset) and all(np.isfinite(values).all() for values in dataset.channels.values())
            outcomes["read"] += 1
    assert min(outcomes.values()) > trials // 20, outcomes


@pytest.mark.slow
@pytest.mark.parametrize("count", [20_000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_a_long_file_is_read_whole(tmp_path: Path, count: int) -> None:
    random_ = np.random.default_rng(0)
    numbers = random_.uniform(-100, 100, (count, 9)).round(4).tolist()
    header = ",".join(["pose_id", *(f"q{i}_deg" for i in range(1, 7)), *(f"approach{i}" for i in range(1, 7)), "x_mm"])
    lines = [f"{i},{','.join(map(str, n[:6]))},1,0,-1,1,0,-1,{n[6]},{n[7]},{n[8]}" for i, n in enumerate(numbers)]
    text = "\n".join([f"{header},y_mm,z_mm", *lines])
    (tmp_path / "poses.csv").write_text(text)
    reader = CsvReader(CsvSettings(path=tmp_path / "poses.csv"))
    dataset = reader.read(ReadRequest({}, {}, wanted(6)))
    assert len(dataset) == count


def test_settings_from_a_config(tmp_path: Path) -> None:
    config = tmp_path / "e.yaml"
    config.write_text("path: p.csv\ncolumns: {q1_deg: J1}\ndelimiter: ';'\n")
    settings = validate(CsvSettings, load_config(config))
    assert settings.path == tmp_path / "p.csv" and settings.columns == {"q1_deg": "J1"} and settings.delimiter == ";"


@pytest.mark.shared
@pytest.mark.skipif(not LRM_POSES.is_file(), reason=f"the measured data is not there: {LRM_POSES}")
def test_the_measured_arm() -> None:
    model = MdhModel(MdhSettings(convention="standard", rows=(Row(),) * 6))
    arms = {"arm": Arm("arm", "mdh", model, {}, ())}
    measurements = {"tracker": TipPosition(TipPositionSettings.si(noise=5e-4), ["arm"])}
    request = ReadRequest(arms, measurements, requested_channels(arms, measurements, True))
    dataset = CsvReader(CsvSettings(path=LRM_POSES)).read(request)
    assert len(dataset) == 313 and dataset.ids[-1] == "393" and dataset.rows[0] == 2
    assert not dataset.warnings and not dataset.set_aside and not dataset.extra
    assert dataset.channels["tracker.x"][0] == from_unit(278.1086, "mm")
    assert set(np.unique(dataset.stacked([f"arm.approach.q{i}" for i in range(1, 7)]))) == {-1.0, 0.0, 1.0}
