"""Small arms that touch sockets, clamps and planes, and the same arms in plain numpy.

The numpy side shares no code with armcal: a product of elementary transforms, for many records at once. Parameters go
by armcal's full names (``arm.mdh.a2``), sockets too (``balls.front/hole_0.x``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from armcal.arm.assembly import Arm, prefixed
from armcal.arm.statics import Environment
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.measure.groups import group_blocks, groups_of
from armcal.problem.problem import Problem
from armcal_contact.contacts import BallInSocket
from armcal_mdh.model import MdhModel
from chain_oracle import ChainSpec, Row, elementary

HALF = np.pi / 2
ELBOW = ChainSpec(
    (
        Row(alpha=HALF, a=0.02, d=0.2),
        Row(a=0.3, theta=0.1),
        Row(a=0.25, alpha=0.1, d=0.03),
        Row(alpha=-HALF, a=0.08, d=0.05),
    ),
    tool=(("z", 0.06),),
)
"""Four joints: one more than a place needs."""
SEVEN = ChainSpec(
    (
        Row(alpha=HALF, d=0.2),
        Row(alpha=-HALF, a=0.04, d=0.05),
        Row(alpha=HALF, a=0.03, d=0.3),
        Row(alpha=-HALF, a=0.05),
        Row(alpha=HALF, a=0.02, d=0.25),
        Row(alpha=-HALF, a=0.03),
        Row(a=0.04, d=0.08),
    ),
)
"""Seven joints: one more than a pose needs."""
SURROUNDINGS = Environment((0.0, 0.0, -9.81))


def scaled(chain: ChainSpec, factor: float) -> ChainSpec:
    """The same arm in another size."""
    rows = tuple(replace(row, a=row.a * factor, d=row.d * factor) for row in chain.rows)
    base, tool = (
        tuple((kind, x if kind.startswith("r") else x * factor) for kind, x in steps)
        for steps in (chain.base, chain.tool)
    )
    return replace(chain, rows=rows, base=base, tool=tool)


def named(chain: ChainSpec, arm: str = "arm") -> dict[str, float]:
    """Every parameter of a chain by its full name."""
    own = {n: x for n, x in chain.nominal().items() if not n.startswith(("target", "offset", "gain"))}
    return {f"{arm}.mdh.{n}": x for n, x in own.items()}


def tool_poses(chain: ChainSpec, q: np.ndarray, v: Mapping[str, float] | None = None, arm: str = "arm") -> np.ndarray:
    """The tool in the base frame (N x 4 x 4) at joint angles (N x n)."""
    v = v or {}
    local = {n: v.get(f"{arm}.mdh.{n}", x) for n, x in chain.nominal().items()}
    here = np.eye(4)
    for kind, _ in chain.base:
        here = here @ elementary(kind, local[f"base_{kind}"])
    here = np.broadcast_to(here, (len(q), 4, 4))
    for i in range(len(chain.rows)):
        turn = local[f"theta{i + 1}"] + q[:, i]
        motion = np.tile(np.eye(4), (len(q), 1, 1))
        motion[:, 0, 0] = motion[:, 1, 1] = np.cos(turn)
        motion[:, 1, 0], motion[:, 0, 1] = np.sin(turn), -np.sin(turn)
        motion[:, 2, 3] = local[f"d{i + 1}"]
        link = elementary("x", local[f"a{i + 1}"]) @ elementary("rx", local[f"alpha{i + 1}"])
        here = here @ motion @ link
    for kind, _ in chain.tool:
        here = here @ elementary(kind, local[f"tool_{kind}"])
    return here


def points(
    chain: ChainSpec,
    q: np.ndarray,
    local: Sequence[float] = (0, 0, 0),
    v: Mapping[str, float] | None = None,
    arm: str = "arm",
) -> np.ndarray:
    """A point of the tool frame in the base frame (N x 3)."""
    return (tool_poses(chain, q, v, arm) @ np.array([*local, 1.0]))[:, :3]


def random_joints(chain: ChainSpec, count: int, seed: int, within: float = 1.2) -> np.ndarray:
    """Joint angles (count x n)."""
    return np.random.default_rng(seed).uniform(-within, within, (count, len(chain.rows)))


def at_rest(residual: Any, q: np.ndarray) -> np.ndarray:
    """Joint angles (N x n) moved by Newton steps of least length to where ``residual`` (of them, N x m) is zero."""
    for _ in range(25):
        sides = [(residual(q + h), residual(q - h)) for h in 1e-6 * np.eye(q.shape[1])]
        slopes = np.stack([(up - down) / 2e-6 for up, down in sides], axis=-1)
        step = np.einsum("nij,nj->ni", np.linalg.pinv(slopes, rcond=1e-6), residual(q))
        q = q - step * np.minimum(1.0, 0.3 / np.maximum(np.abs(step).max(axis=1), 1e-300))[:, None]
    return q


def touching(
    chain: ChainSpec, residual: Any, count: int, seed: int, v: Mapping[str, float] | None = None, arm: str = "arm"
) -> np.ndarray:
    """Joint angles (count x n) where ``residual`` (tool poses, N x 4 x 4, to N x m) is zero."""

    def left_open(q: np.ndarray) -> np.ndarray:
        return residual(tool_poses(chain, q, v, arm))

    random, found = np.random.default_rng(seed), np.zeros((0, len(chain.rows)))
    for _ in range(60):
        q = at_rest(left_open, random.uniform(-1.2, 1.2, (4 * count, len(chain.rows))))
        good = (np.abs(left_open(q)).max(axis=1) < 1e-12) & (np.abs(q).max(axis=1) < 2.6)
        found = np.vstack([found, q[good]])
        if len(found) >= count:
            return found[:count]
    raise AssertionError("the test's own postures do not reach")


def in_socket(place: Sequence[float], ball: Sequence[float] = (0, 0, 0)) -> Any:
    """What a ball at a point of the tool leaves open of a socket."""
    return lambda poses: (poses @ np.array([*ball, 1.0]))[:, :3] - np.array(place)


def the_arm(chain: ChainSpec, name: str = "arm", joint_noise: float = 0.0) -> Arm:
    """The chain as armcal has it."""
    model = MdhModel(MdhModel.Settings.si(**chain.settings()))
    return Arm(name, "mdh", model, {}, (), joint_noise=joint_noise)


def dataset(parts: Sequence[tuple[Mapping[str, np.ndarray], Mapping[str, str]]], **shared: Any) -> Dataset:
    """Records of several kinds below each other: columns and labels of each; what one lacks is empty there."""
    counts = [len(next(iter(columns.values()))) for columns, _ in parts]
    channels = {c: np.zeros(0) for columns, _ in parts for c in columns}
    extra: dict[str, tuple[str, ...]] = {label: () for _, labels in parts for label in labels}
    for (columns, labels), count in zip(parts, counts, strict=True):
        channels = {c: np.append(x, columns.get(c, np.full(count, np.nan))) for c, x in channels.items()}
        extra = {label: (*texts, *(labels.get(label, ""),) * count) for label, texts in extra.items()}
    return Dataset(tuple(str(i) for i in range(sum(counts))), channels, extra, **shared)


def joints(q: np.ndarray, arm: str = "arm") -> dict[str, np.ndarray]:
    """Joint angles (N x n) as channels."""
    return {f"{arm}.q{i + 1}": q[:, i] for i in range(q.shape[1])}


@dataclass(frozen=True)
class Bench:
    """Arms and what they touch; ``free`` are globs beside the groups, ``values`` and ``priors`` are by full name."""

    arms: Mapping[str, Arm]
    measurements: Mapping[str, Any]
    free: Sequence[str] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    priors: Mapping[str, float] = field(default_factory=dict)

    def parameters(self, data: Dataset) -> Parameters:
        """All blocks, those of the groups in the data included."""
        blocks = [block for arm in self.arms.values() for block in arm.parameters()]
        for name, measurement in self.measurements.items():
            blocks += prefixed(f"{name}.", measurement.parameters())
        blocks += group_blocks(self.measurements, groups_of(data, self.measurements))
        parameters = Parameters(tuple(blocks))
        chosen = {b.name for b in blocks if b.free} | set(parameters.select(self.free))
        nominal = parameters.nominal()
        for name, value in self.values.items():
            nominal[parameters.entries_of(name)] = value
        parameters = parameters.with_free(chosen).with_nominal(nominal)
        return parameters.replaced({n: replace(parameters[n], prior_sd=sd) for n, sd in self.priors.items()})

    def problem(self, data: Dataset, evaluator: Any = "interpreted") -> tuple[Problem, tuple[Any, ...]]:
        """The problem of these records, and the records as it reads them."""
        built = Problem.build(self.arms, self.measurements, self.parameters(data), SURROUNDINGS, data, evaluator)
        return built, built.of(data).records


def vector(parameters: Parameters, values: Mapping[str, float]) -> np.ndarray:
    """The nominal value vector with some numbers by name."""
    found = parameters.nominal()
    for name, value in values.items():
        found[parameters.entries_of(name)] = value
    return found


def by_name(parameters: Parameters, values: np.ndarray) -> dict[str, float]:
    """A value vector by entry name."""
    return dict(zip(parameters.entry_names, values.tolist(), strict=True))


def away(parameters: Parameters, size: float, seed: int) -> np.ndarray:
    """A value vector beside the nominal one, by so many typical scales of each free parameter."""
    steps = size * np.random.default_rng(seed).normal(size=len(parameters.increment_scales()))
    return parameters.retract(steps * parameters.increment_scales())


NOISE, TIE_NOISE, DISTANCE = 4e-4, 5e-5, 0.05
LEFT = ELBOW
RIGHT = replace(ELBOW, base=(("x", 0.5), ("y", 0.1), ("rz", 2.5)))
SPOTS = {
    "back/hole_1": (0.2, 0.21, 0.18),
    "back/hole_0": (0.24, 0.24, 0.18),
    "front/hole_0": (0.3, -0.12, 0.15),
    "front/hole_1": (0.25, -0.12, 0.15),
    "shelf/hole_0": (0.1, 0.3, 0.3),
}
BALL = (0.01, 0.0, 0.02)
FREE = ("left.mdh.a2", "left.mdh.theta2", "left.mdh.d1", "right.mdh.a3", "right.mdh.theta3", "balls.centre_z")


def ball(arms=("left", "right"), **settings):
    settings = {"noise": NOISE, "arm": arms[0], "centre": BALL, **settings}
    return BallInSocket(BallInSocket.Settings.si(**settings), arms)


def known_distance(distance=DISTANCE, noise=TIE_NOISE):
    return {"between": ("hole_0", "hole_1"), "distance": distance, "noise": noise}


TIED = (known_distance(),)


def bench(free=FREE, distances=TIED, mean_weight=1.0, **changed):
    """Two arms that touch the same sockets; the right one's ball sits where the flange is."""
    left = ball(distances=distances)
    right = ball(arm="right", centre=(0, 0, 0), sockets_of="balls")
    left.mean_weight = mean_weight
    arms = {"left": the_arm(LEFT, "left"), "right": the_arm(RIGHT, "right")}
    return Bench(arms, {"balls": left, "others": right}, free, **changed)


def touches(seed=0, counts=(3, 2), spots=tuple(SPOTS), scatter=2e-3):
    """Records of both arms near each socket, as far off as calibration errors leave them."""
    random, parts = np.random.default_rng(seed), []
    for number, key in enumerate(spots):
        position, socket = key.split("/")
        for arm, chain, place, count in (("left", LEFT, BALL, counts[0]), ("right", RIGHT, (0, 0, 0), counts[1])):
            count = count + number % 2 if count else 0
            if count:
                q = touching(chain, in_socket(SPOTS[key], place), count, 10 * seed + number)
                q = q + random.normal(0, scatter, q.shape)
                parts.append((joints(q, arm), {"position": position, "socket": socket}))
    return dataset(parts)


def near(problem, seed=1, size=0.2):
    """Values that fit nothing well, about the true sockets."""
    start = {f"balls.{key}.{axis}": x for key, spot in SPOTS.items() for axis, x in zip("xyz", spot, strict=True)}
    known = {name: x for name, x in start.items() if name in problem.parameters.names}
    parameters = problem.parameters.with_nominal(vector(problem.parameters, known))
    return away(parameters, size, seed)
