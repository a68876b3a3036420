"""Orientations in CSV files: quaternions of either order, matrices, and what cannot be this arm's orientation."""

from __future__ import annotations

import re

import numpy as np
import pytest
from armcal.arm.assembly import Arm
from armcal.errors import DataError
from armcal.measure.reader import ReadRequest, requested_channels
from armcal_mdh.model import MdhModel, MdhSettings
from armcal_tracker.csv_reader import ORDERS, PoseCsvReader, PoseCsvSettings, misfit, nominal_rotations
from armcal_tracker.position import TipPose, TipPoseSettings
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

XYZW = {"columns": ["a", "b", "c", "d"], "order": "xyzw"}
WXYZ = {"columns": ["a", "b", "c", "d"], "order": "wxyz"}
MATRIX = {"columns": [f"m{i}" for i in range(9)]}
ROWS = [{"d": 0.2}, {"alpha": 1.5, "a": 0.03}, {"a": 0.3}, {"alpha": -1.5, "d": 0.25}]
BODY, STAND = Rotation.from_rotvec([0.5, -1.2, 2.0]), Rotation.from_rotvec([-2.0, 0.3, 1.0])


def arm(name="arm"):
    return Arm(name, "mdh", MdhModel(MdhSettings.si(convention="craig", rows=ROWS)), {}, ())


def request(measured=True, **others):
    arms = {"arm": arm()}
    found = {"tracker": TipPose(TipPoseSettings.si(noise=1e-3, orientation_noise=1e-3), ("arm",)), **others}
    return ReadRequest(arms, found, requested_channels(arms, found, measured))


def joints(count, seed=1):
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (count, 4))


def seen(angles, error_deg=0.5, seed=2):
    """What a tracker sees of a body set anyhow on the tool, of an arm set anyhow, that is not quite nominal."""
    random, found = np.random.default_rng(seed), []
    for q in angles:
        turn = STAND
        for row, angle in zip(ROWS, q, strict=True):
            turn = turn * Rotation.from_rotvec([row.get("alpha", 0), 0, 0]) * Rotation.from_rotvec([0, 0, angle + 0.03])
        found.append(turn * BODY * Rotation.from_rotvec(np.radians(error_deg) * random.normal(size=3)))
    return Rotation.concatenate(found)


def quaternions(rotations, order="xyzw"):
    return rotations.as_quat()[:, ["xyzw".index(part) for part in order]]


def table(angles, numbers, names="abcd"):
    lines = ["pose_id,q1_rad,q2_rad,q3_rad,q4_rad,x_mm,y_mm,z_mm," + ",".join(names)]
    for i, (q, values) in enumerate(zip(angles, numbers, strict=True)):
        cells = [
            f"p{i}",
            *map(repr, q.tolist()),
            str(i),
            "2",
            "3",
            *("" if np.isnan(v) else repr(float(v)) for v in values),
        ]
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


def read(folder, text, asked=None, **settings):
    path = folder / "poses.csv"
    path.write_text(text, encoding="utf-8")
    return PoseCsvReader(PoseCsvSettings.model_validate({"path": path, **settings})).read(asked or request())


def refusal(folder, text, asked=None, **settings):
    with pytest.raises(DataError) as caught:
        read(folder, text, asked, **settings)
    assert caught.value.exit_code == 2 and str(folder) in str(caught.value) and caught.value.hint.endswith(".")
    return str(caught.value)


def rotations_of(dataset):
    w, x, y, z = dataset.stacked([f"tracker.q{part}" for part in "wxyz"])
    assert np.abs(w**2 + x**2 + y**2 + z**2 - 1).max() < 1e-15 * 10 and (w >= 0).all()
    return Rotation.from_quat(np.array([x, y, z, w]).T)


@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
def test_quaternions_of_either_order_and_sign_are_the_same_rotations(tmp_path, order):
    angles = joints(40)
    truth = seen(angles)
    numbers = quaternions(truth, order) * np.random.default_rng(3).choice([-1, 1], 40)[:, None]
    dataset = read(tmp_path, table(angles, numbers), quaternion={"columns": list("abcd"), "order": order})
    assert (rotations_of(dataset).inv() * truth).magnitude().max() < 1e-14
    assert "tracker.r11" not in dataset.channels and len(dataset) == 40
    flipped = int((numbers[:, order.index("w")] < 0).sum())
    assert dataset.warnings[-1].endswith(
        f"{flipped} of 40 quaternions had qw below 0 and were negated, which is the same rotation."
    )
    np.testing.assert_allclose(dataset.column("tracker.x"), np.arange(40) / 1000)


@pytest.mark.parametrize("unit", ["deg", "rad"])
@pytest.mark.parametrize("kind", ["rpy", "rotation_vector"])
def test_angles_and_rotation_vectors_are_the_same_rotations(tmp_path, kind, unit):
    """Roll, pitch and yaw by hand: Rz Ry Rx. Columns may say their unit."""
    angles = joints(40)
    truth = seen(angles)
    columns, scale = [f"{name}_{unit}" for name in ("u", "v", "w")], 180 / np.pi if unit == "deg" else 1.0
    numbers = truth.as_rotvec()
    if kind == "rpy":
        r = truth.as_matrix()
        pitch = np.arctan2(-r[:, 2, 0], np.hypot(r[:, 0, 0], r[:, 1, 0]))
        numbers = np.stack([np.arctan2(r[:, 2, 1], r[:, 2, 2]), pitch, np.arctan2(r[:, 1, 0], r[:, 0, 0])], axis=1)
    text = table(angles, scale * numbers, columns)
    dataset = read(tmp_path, text, **{kind: {"columns": columns, "unit": unit}})
    assert (rotations_of(dataset).inv() * truth).magnitude().max() < 1e-12
    other = "rad" if unit == "deg" else "deg"
    assert f"unit: {unit}" in refusal(tmp_path, text, **{kind: {"columns": columns, "unit": other}})


def about(axis, angle):
    """Rotation matrices about a base axis, by hand."""
    c, s, place = np.cos(angle), np.sin(angle), "xyz".index(axis.lower())
    matrices = np.tile(np.eye(3), (len(angle), 1, 1))
    i, j = (place + 1) % 3, (place + 2) % 3
    matrices[:, i, i], matrices[:, i, j], matrices[:, j, i], matrices[:, j, j] = c, -s, s, c
    return matrices


@pytest.mark.parametrize("order", ["XYZ", "xyz", "ZYX", "zyz", "ZXZ"])
def test_euler_angles_are_products_of_turns_in_their_order(tmp_path, order):
    """Capitals multiply from the left to the right, small letters from the right to the left."""
    angles = joints(40)
    truth = seen(angles)
    numbers = truth.as_euler(order, degrees=True)
    turns = [about(axis, np.radians(column)) for axis, column in zip(order, numbers.T, strict=True)]
    turns = turns if order.isupper() else turns[::-1]
    np.testing.assert_allclose(turns[0] @ turns[1] @ turns[2], truth.as_matrix(), atol=1e-12)
    text = table(angles, numbers, "abc")
    euler = {"columns": list("abc"), "order": order, "unit": "deg"}
    assert (rotations_of(read(tmp_path, text, euler=euler)).inv() * truth).magnitude().max() < 1e-12
    told = refusal(tmp_path, text, euler={**euler, "order": order.swapcase()})
    assert f"order: {order}" in told


def test_the_wrong_order_is_refused_although_the_body_hardly_turns(tmp_path):
    """A probe that must face its tracker: the declared order is off by under 5 degrees, the true one by far less."""
    angles = 0.15 * joints(60)
    truth = seen(angles, error_deg=0.02)
    text = table(angles, truth.as_euler("XYZ", degrees=True), "abc")
    euler = {"columns": list("abc"), "unit": "deg"}
    assert len(read(tmp_path, text, euler={**euler, "order": "XYZ"})) == 60
    told = refusal(tmp_path, text, euler={**euler, "order": "xyz"})
    assert 0.5 < float(told.partition("are off by ")[2].split()[0]) < 5.0 and "order: XYZ by 0." in told


@pytest.mark.parametrize("order", ["XXY", "Xyz", "XY", "xyzw", ""])
def test_an_order_that_is_none_is_refused(tmp_path, order):
    with pytest.raises(ValidationError, match="order"):
        read(
            tmp_path,
            table(joints(3), np.zeros((3, 3)), "abc"),
            euler={"columns": list("abc"), "order": order, "unit": "deg"},
        )


def test_decimal_commas(tmp_path):
    angles = joints(40)
    truth = seen(angles)
    text = table(angles, truth.as_euler("XYZ", degrees=True), "abc").replace(",", ";").replace(".", ",")
    euler = {"columns": list("abc"), "order": "XYZ", "unit": "deg"}
    dataset = read(tmp_path, text, euler=euler, delimiter=";", decimal=",")
    assert (rotations_of(dataset).inv() * truth).magnitude().max() < 1e-12


def test_angles_of_the_other_order_and_inverse_vectors_are_refused(tmp_path):
    angles = joints(40)
    truth = seen(angles)
    moving = table(angles, truth.as_euler("XYZ"), "abc")
    told = refusal(tmp_path, moving, rpy={"columns": list("abc"), "unit": "rad"})
    assert "with R = Rx(roll) Ry(pitch) Rz(yaw) by" in told
    inverse = table(angles, truth.inv().as_rotvec(), "abc")
    told = refusal(tmp_path, inverse, rotation_vector={"columns": list("abc"), "unit": "rad"})
    assert "as that of body_T_base" in told


def test_a_rotation_vector_and_three_angles_are_distinguished(tmp_path):
    """A UR writes its TCP's orientation as a rotation vector, in columns rx, ry and rz as others write angles."""
    angles = joints(40)
    truth, three = seen(angles), {"columns": list("abc"), "unit": "rad"}
    assert "with it as rotation_vector by" in refusal(tmp_path, table(angles, truth.as_rotvec(), "abc"), rpy=three)
    assert "with it as rpy by" in refusal(tmp_path, table(angles, truth.as_euler("xyz"), "abc"), rotation_vector=three)


def test_a_pose_that_is_not_turned_is_kept(tmp_path):
    angles = joints(40)
    numbers = seen(angles).as_rotvec()
    numbers[7] = 0.0
    dataset = read(tmp_path, table(angles, numbers, "abc"), rotation_vector={"columns": list("abc"), "unit": "rad"})
    assert len(dataset) == 40


def test_matrices_row_by_row(tmp_path):
    angles = joints(40)
    truth = seen(angles)
    numbers = truth.as_matrix().reshape(-1, 9) + 1e-5 * np.random.default_rng(3).normal(size=(40, 9))
    dataset = read(tmp_path, table(angles, numbers, MATRIX["columns"]), rotation=MATRIX)
    assert (rotations_of(dataset).inv() * truth).magnitude().max() < 1e-4
    assert not dataset.warnings and not any(".r" in name for name in dataset.channels)


def test_columns_may_be_called_as_the_channels_are(tmp_path):
    angles, names = joints(10), ["qx", "qy", "qz", "qw"]
    text = table(angles, quaternions(seen(angles)), names)
    dataset = read(tmp_path, text, quaternion={"columns": names, "order": "xyzw"})
    assert (rotations_of(dataset).inv() * seen(angles)).magnitude().max() < 1e-14


@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
def test_the_other_order_is_refused_with_both_figures(tmp_path, order):
    angles, other = joints(40), {"xyzw": "wxyz", "wxyz": "xyzw"}[order]
    text = table(angles, quaternions(seen(angles), other))
    found = refusal(tmp_path, text, quaternion={"columns": list("abcd"), "order": order})
    assert (
        f"with order: {order} the turns between records are off by" in found and f"with order: {other}, or as" in found
    )
    assert "deg (median)" in found


def test_the_inverse_rotation_is_refused(tmp_path):
    angles = joints(40)
    found = refusal(tmp_path, table(angles, quaternions(seen(angles).inv())), quaternion=XYZW)
    assert "with order: wxyz, or as body_T_base, by" in found
    columns = np.swapaxes(seen(angles).as_matrix(), 1, 2).reshape(-1, 9)
    found = refusal(tmp_path, table(angles, columns, MATRIX["columns"]), rotation=MATRIX)
    assert "with it column by column, that is as body_T_base, by" in found


def test_an_arm_that_is_far_from_nominal_is_not_taken_for_another_order(tmp_path):
    """Errors of 20 deg from pose to pose are beyond the 5 deg, but no other reading fits much better."""
    angles = joints(40)
    assert len(read(tmp_path, table(angles, quaternions(seen(angles, error_deg=20))), quaternion=XYZW)) == 40


def test_few_records_or_turns_about_one_axis_tell_nothing(tmp_path):
    angles = joints(3)
    assert len(read(tmp_path, table(angles, quaternions(seen(angles), "wxyz")), quaternion=XYZW)) == 3
    one_axis = np.zeros((30, 4))
    one_axis[:, 1] = np.linspace(-1, 1, 30)
    assert len(read(tmp_path, table(one_axis, quaternions(seen(one_axis))), quaternion=XYZW)) == 30


def test_angles_between_records_alone_tell_neither_order_nor_inverse():
    """Why whole rotation vectors are compared: exchanged components and inverses leave every angle as it is."""
    truth = seen(joints(40))
    for other in (Rotation.from_quat(quaternions(truth, "wxyz")), truth.inv()):
        angles = [(r[:-1].inv() * r[1:]).magnitude() for r in (truth, other)]
        np.testing.assert_allclose(*angles, rtol=0, atol=1e-9)


def test_the_other_order_is_an_inverse_between_two_fixed_rotations():
    truth = seen(joints(60))
    assert misfit(Rotation.from_quat(quaternions(truth, "wxyz")), truth.inv()) < 1e-12
    assert misfit(Rotation.from_quat(quaternions(truth, "wxyz")), truth) > 0.5


def test_the_misfit_knows_neither_base_nor_body():
    angles = joints(60)
    nominal = nominal_rotations(arm(), read_like(angles))
    assert misfit(STAND * nominal * BODY, nominal) < 1e-12
    assert misfit(nominal, nominal) < 1e-12
    assert misfit(STAND * nominal.inv() * BODY, nominal) > 0.5
    bent = nominal * Rotation.from_rotvec(np.random.default_rng(5).normal(scale=0.01, size=(60, 3)))
    assert 0.005 < misfit(STAND * bent * BODY, nominal) < 0.05


def read_like(angles):
    from armcal.base.dataset import Dataset

    return Dataset(tuple(map(str, range(len(angles)))), {f"arm.q{i + 1}": angles[:, i] for i in range(4)})


def test_quaternions_that_are_none_are_set_aside(tmp_path):
    angles = joints(60)
    numbers = quaternions(seen(angles))
    numbers[[3, 20, 21]] = 0
    numbers[7] *= 1.01
    numbers[9] *= 1.0009
    numbers[11, 2] = np.nan
    dataset = read(tmp_path, table(angles, numbers), quaternion=XYZW)
    why = {aside.record_id: aside.reason for aside in dataset.set_aside}
    assert why["p3"] == why["p20"] == why["p21"] == "its quaternion is zero"
    assert why["p7"] == "its quaternion is off by 0.01"
    assert set(why) == {"p3", "p7", "p11", "p20", "p21"} and len(dataset) == 55
    rotations_of(dataset)


def test_too_many_that_are_none_are_refused(tmp_path):
    angles = joints(60)
    numbers = quaternions(seen(angles))
    numbers[[5, 6, 7, 8]] *= 0.9
    found = refusal(tmp_path, table(angles, numbers), quaternion=XYZW)
    assert "poses.csv:7: found 4 of 60 orientations that are no quaternion, the first off by 0.1 (more" in found
    euler = np.degrees(seen(angles).as_euler("xyz"))
    assert "no quaternion" in refusal(tmp_path, table(angles, np.column_stack([euler, euler[:, 0]])), quaternion=XYZW)
    assert "found no usable record" in refusal(tmp_path, table(angles, np.zeros((60, 4))), quaternion=XYZW)


def test_matrices_that_are_none(tmp_path):
    angles, names = joints(60), MATRIX["columns"]
    matrices = seen(angles).as_matrix()
    mirrored = matrices @ np.diag([1, 1, -1])
    found = refusal(tmp_path, table(angles, mirrored.reshape(-1, 9), names), rotation=MATRIX)
    assert "poses.csv:2: found 60 of 60 rotation matrices that are reflections (determinant -1)" in found
    matrices[4, 0, 1] += 0.05
    matrices[6] = 0
    dataset = read(tmp_path, table(angles, matrices.reshape(-1, 9), names), rotation=MATRIX)
    assert [aside.record_id for aside in dataset.set_aside] == ["p4", "p6"]
    assert "rotation matrix is zero" in dataset.set_aside[1].reason


def test_rows_of_another_measurement_have_no_orientation(tmp_path):
    """A second instrument keeps the record; where the quaternion is missing the pose was not measured."""
    from armcal_contact.contacts import BallInSocket, BallInSocketSettings

    ball = BallInSocket(BallInSocketSettings.si(noise=1e-3), ("arm",))
    angles = joints(30)
    numbers = quaternions(seen(angles))
    numbers[[2, 5]] = np.nan
    dataset = read(tmp_path, table(angles, numbers), request(ball=ball), quaternion=XYZW)
    assert len(dataset) == 30
    assert np.flatnonzero(np.isnan(dataset.column("tracker.qw"))).tolist() == [2, 5]
    assert np.flatnonzero(np.isnan(dataset.column("tracker.x"))).tolist() == [2, 5]


def test_which_measurement_reads_orientations(tmp_path):
    angles = joints(10)
    text = table(angles, quaternions(seen(angles)))
    none = ReadRequest({"arm": arm()}, {}, ())
    assert "found no measurement to read orientations, expected one" in refusal(tmp_path, text, none, quaternion=XYZW)
    second = TipPose(TipPoseSettings.si(noise=1e-3, orientation_noise=1e-3), ("arm",))
    both = request(second=second)
    assert "found tracker, second to read" in refusal(tmp_path, text, both, quaternion=XYZW)
    assert "expected third" in refusal(tmp_path, text, both, quaternion=XYZW, measurement="third")


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({}, "expected one of quaternion"),
        ({"quaternion": XYZW, "rotation": MATRIX}, "expected one of quaternion"),
        ({"quaternion": {"columns": list("abcd")}}, "order"),
        ({"quaternion": {"columns": list("abc"), "order": "xyzw"}}, "columns"),
        ({"quaternion": {"columns": list("abcd"), "order": "wxzy"}}, "order"),
        ({"rotation": {"columns": list("abcd")}}, "columns"),
    ],
    ids=str,
)
def test_settings_that_make_no_sense(settings, said):
    with pytest.raises(ValidationError, match=said):
        PoseCsvSettings.model_validate({"path": "poses.csv", **settings})


@pytest.mark.parametrize(("order", "signs"), [("ZXY", (1, 1, 1)), ("ZYZ", (1, 1, 1)), ("xyz", (-1, 1, 1))])
def test_any_order_of_the_turns_and_signs_of_the_angles_are_tried(tmp_path, order, signs):
    """Some are one another's, up to fixed rotations of base and body: what is named fits as well."""
    angles = joints(40)
    written = table(angles, seen(angles).as_euler(order) * signs, "abc")
    told = refusal(tmp_path, written, rpy={"columns": list("abc"), "unit": "rad"})
    declared, named = (float(x) for x in re.findall(r"by (\d+\.\d+) deg", told))
    assert named < 3.0 < 20.0 < declared, told


@pytest.mark.parametrize("tables", [10, pytest.param(200, marks=pytest.mark.slow)])
def test_sound_angles_of_a_rough_arm_are_not_refused(tmp_path, tables):
    """Of 8 to 40 records, with turns off by up to 3 deg."""
    for number in range(tables):
        drawn = np.random.default_rng(number)
        angles = joints(int(drawn.integers(8, 41)))
        off = Rotation.from_rotvec(np.deg2rad(10 ** drawn.uniform(-2, 0.5)) * drawn.normal(size=(len(angles), 3)))
        order = ORDERS[number % len(ORDERS)]
        text = table(angles, (seen(angles) * off).as_euler(order, suppress_warnings=True), "abc")
        read(tmp_path, text, euler={"columns": list("abc"), "order": order, "unit": "rad"})
