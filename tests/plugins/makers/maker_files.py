"""Makers' files as robots wrote them, and the forward kinematics that they mean, computed by other means.

``UR5_DELTAS`` are those of a UR5's controller, published by its owner in a thread of ur_modern_driver. ``UR5_YAML`` and
``UR5E_YAML`` are what ur_calibration wrote for a UR5 and a UR5e, as their owners published it. ``UR10_DELTAS`` are
those of three UR10 in the tests of ur_calibration.
"""

from __future__ import annotations

from pathlib import Path

import armcal_makers
import numpy as np
import yaml
from armcal_makers.files import nominal_arms, six_of

UR5_DELTAS = (
    (
        2.07750978653505926e-05,
        0.96821571555565844,
        -1.85685385014877657,
        0.888647901450376643,
        5.66106114887767484e-05,
        -7.46310764096455082e-05,
    ),
    (
        0.000393621049984383038,
        0.184093300397451837,
        0.14493953300732923,
        -6.43297403642304399e-05,
        7.76709040084077299e-06,
        0,
    ),
    (
        4.00263097760228392e-05,
        278.244144925623573,
        -183.695513914913732,
        -94.5471513669751289,
        0.000304782681775556119,
        0.000123737941387466743,
    ),
    (
        -0.000271624944216508624,
        0.00125856505456124258,
        -0.00322052070697146503,
        0.00065153016530383745,
        -0.00058700465721117645,
        0,
    ),
)
UR10_DELTAS = (
    (
        (
            -7.290070070824746e-05,
            -0.01713897289704999,
            -0.03707159413492756,
            0.054279462160583214,
            1.488984e-07,
            1.5515e-05,
        ),
        (4.6311376834935676e-05, -0.00012568315331862312, 0.00186216581161458, 9.918593870679266e-05, 4.215462e-06, 0),
        (
            0.00065609212979853,
            1.4442162376284788,
            0.854147723854608,
            -2.2989425877563705,
            -1.5734987e-05,
            1.9072436e-05,
        ),
        (
            0.000211987863869334,
            -0.0072553625957652995,
            -0.013483226769541364,
            0.0013495820227329425,
            -0.001263136163,
            0,
        ),
    ),
    (
        (
            1.59613525316931737e-07,
            -0.917209621528830232,
            7.12936131346499469,
            0.0710299029424392298,
            -1.642589e-06,
            9.17e-08,
        ),
        (
            0.000108651068627930392,
            0.240324175250532346,
            0.00180628180213493472,
            2.63076149165684402e-05,
            3.966386e-06,
            0,
        ),
        (
            -0.000144894975118076141,
            303.469135666158195,
            -309.88394307789747,
            6.41459904397394975,
            -4.4823290e-05,
            -0.00087071,
        ),
        (
            -0.000444781952841921679,
            -0.00160215112531214153,
            0.00631917793331091861,
            -0.00165055247340828,
            0.00076368251,
            0,
        ),
    ),
    (
        (
            -2.41478068943590252e-07,
            1.60233952386694556,
            -1.68607190752171299,
            0.0837331147700118711,
            -1.012603e-07,
            3.919e-08,
        ),
        (
            2.12234865571205891e-05,
            0.632017132627700651,
            0.00229833638891230319,
            -4.61409023720933908e-05,
            -6.39280053e-05,
            0,
        ),
        (
            -0.000160188285741325043,
            439.140974079900957,
            -446.027059806332147,
            6.88618689642360149,
            -3.8658849e-05,
            -0.00087908,
        ),
        (
            -0.000650246557584166496,
            0.00139416666825590402,
            0.00693818880325995126,
            -0.000811641562390219562,
            0.00041112,
            0,
        ),
    ),
)
"""delta_theta, delta_a, delta_d, delta_alpha; the last two of a row to fewer digits."""

_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
UR5E_ROWS = (
    (0, 0, 0.1627122445743823, 0, 0, 5.707382499074709e-08),
    (0.0001820110310317555, 0, 0, 1.571314866107557, 0, 1.12157791523139e-06),
    (-0.425170344631444, 0, 0, 0.001444320579376547, -0.0004261037597356073, 4.642343028998144e-06),
    (
        -0.392646598028507,
        -0.0004030322688786401,
        0.1331063119537431,
        0.003027888244224887,
        -0.001185722601572754,
        -2.5e-06,
    ),
    (-7.071306960874342e-06, -0.09960359635829828, -3.198591184007791e-07, 1.570799538115874, 0, 1.304820282092834e-06),
    (
        1.369362273278849e-05,
        0.09958483828527664,
        9.521789789182917e-05,
        1.571752475045119,
        3.141592653589793,
        3.14159251083,
    ),
)
UR5_ROWS = (
    (0, 0, 0.089201138580847966, 0, 0, 1.5413963267648517e-05),
    (8.28481932000539e-05, 0, 0, 1.5702793305568989, 0, 9.4248239648454113e-05),
    (-0.42514603197027351, 0, 0, 0.00027727163297603633, 0.00074181659174685764, 8.2061777589927939e-05),
    (
        -0.39231335412023205,
        0.00070367842866065884,
        0.11004902881674888,
        3.1351985141209435,
        -3.1400954402443415,
        3.14151856,
    ),
    (
        3.6501405590628345e-05,
        -0.094721186124807052,
        0.0001791428279527357,
        1.5689050644312028,
        0,
        -1.320607040336194e-05,
    ),
    (
        0.00015399008043081661,
        0.082421327089370319,
        0.00012632686207930083,
        1.5723290218826846,
        3.1415926535897931,
        -3.14158677,
    ),
)
XARM6_ROWS = (
    (0, 0, 0.26712, 1e-4, -2e-4, 3e-5),
    (1e-4, -2e-4, 3e-4, -1.5711, 2e-4, 1.1e-3),
    (0.05361, -0.28432, 1e-5, 1.2e-3, -4e-4, -9e-4),
    (0.07742, 0.34271, 2e-4, -1.5702, 3e-4, 5e-4),
    (1e-4, 3e-5, -1e-4, 1.5713, 0, -8e-4),
    (0.07607, 0.09692, 1e-4, -1.5704, 1e-4, 2e-4),
)
"""Made up: of the size that xArms have."""


def yaml_of(rows, keys=_LINKS, tail="  hash: calib_14698139022496758595\n"):
    """A kinematics YAML."""
    lines = ["kinematics:"]
    for key, row in zip(keys, rows, strict=True):
        lines += [f"  {key}:", *(f"    {name}: {value!r}" for name, value in zip(_KEYS, row, strict=True))]
    return "\n".join(lines) + "\n" + tail


UR5E_YAML, UR5_YAML = yaml_of(UR5E_ROWS), yaml_of(UR5_ROWS, tail="  hash: calib_15200003067234149431\n")
XARM6_YAML = yaml_of(XARM6_ROWS, [f"joint{i}" for i in range(1, 7)], tail="")


def turn(axis, angle):
    """About a coordinate axis, for each of some angles."""
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    matrix = np.zeros((*np.shape(angle), 4, 4))
    matrix[..., i, i] = matrix[..., 3, 3] = 1
    matrix[..., j, j] = matrix[..., k, k] = np.cos(angle)
    matrix[..., k, j], matrix[..., j, k] = np.sin(angle), -np.sin(angle)
    return matrix


def shift(x, y, z):
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def ur_rows(name):
    """theta, a, d, alpha (6 each; rad, m) of a nominal UR arm, from the numbers that its maker publishes."""
    tables = yaml.safe_load((Path(armcal_makers.__file__).parent / "arms.yaml").read_text())
    d1, a2, a3, d4, d5, d6 = tables["ur"][name]
    right = np.pi / 2
    return tuple(
        np.array(row, dtype=float)
        for row in ((0,) * 6, (0, a2, a3, 0, 0, 0), (d1, 0, 0, d4, d5, d6), (right, 0, 0, right, -right, 0))
    )


def dh_tip(rows, q):
    """The flange at angles (N x n) of standard rows (theta, a, d, alpha), term by term."""
    pose = np.eye(4)
    for theta, a, d, alpha, angle in zip(*rows, q.T, strict=True):
        pose = pose @ turn("z", theta + angle) @ shift(0, 0, d) @ shift(a, 0, 0) @ turn("x", alpha)
    return pose


def yaml_tip(rows, q, urdf=True):
    """The same of x, y, z, roll, pitch, yaw rows; else with the turns in the other order."""
    pose = np.eye(4)
    for (x, y, z, roll, pitch, yaw), angle in zip(rows, q.T, strict=True):
        turns = [turn("z", yaw), turn("y", pitch), turn("x", roll)]
        first, second, third = turns if urdf else turns[::-1]
        pose = pose @ shift(x, y, z) @ first @ second @ third @ turn("z", angle)
    return pose


def poses(count=1000, joints=6):
    return np.random.default_rng(7).uniform(-np.pi, np.pi, (count, joints))


def full_urdf():
    """A UR5e as ur_description has it: half a turn on its base link, a gripper behind its flange."""
    arm = nominal_arms()["ur5e"]
    links = ["base_link_inertia", "a", "b", "c", "d", "e", "wrist_3_link"]
    joints = [("base_link", "base_link_inertia", "0 0 0", "0 0 3.141592653589793", "half", "fixed")]
    for name, frame, parent, child in zip(arm.joints, arm.frames, links[:-1], links[1:], strict=True):
        six = [repr(x) for x in six_of(frame)]
        joints.append((parent, child, " ".join(six[:3]), " ".join(six[3:]), name, "revolute"))
    joints.append(("wrist_3_link", "gripper", "0 0.01 0.15", "0 0 0.3", "grip", "fixed"))
    lines = ['<robot name="cell">', *(f'<link name="{link}"/>' for link in ["base_link", *links, "gripper"])]
    for parent, child, xyz, rpy, name, kind in joints:
        limit = '<limit lower="-6.28" upper="6.28" effort="1" velocity="1"/>' if kind == "revolute" else ""
        lines.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/>{limit}</joint>'
        )
    return "\n".join([*lines, "</robot>"])
