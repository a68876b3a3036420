"""Gaussian processes of joints and tool, learned from what a model leaves. [Rasmussen2006]

Of each turning joint's error over its own angle: a long one, and one of the likeliest finer length scale; the long one
holds on a little where no record stood. Of the tool's shifts, and of its turns, over all joints and directions of
approach: length scales maximise the marginal likelihood of some of the records; held by values at a few poses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import casadi as ca
import numpy as np
from armcal.arm.pose_residual import OF_TOOL, SURROUNDINGS, ModelErrors, PoseResidual, Postures, reached
from armcal.base.arrays import Array
from armcal.base.se3 import Expression
from armcal.base.settings import Settings
from pydantic import Field
from scipy.linalg import block_diag
from scipy.optimize import minimize
from typing_extensions import override

from armcal_residual.features import (
    Correlations,
    Input,
    Kind,
    ProcessSettings,
    Products,
    Regression,
    TermSettings,
    inverted,
    packed,
    regressed,
    roots_of,
    share_between,
    taken_root,
    unpacked,
)

_JOINT_LENGTHS = (1.0, 0.5, 0.25, 0.12, 0.06)  # Chords, about rad. The first stands beside each of the others.
_ROWS_PER_FEATURE = 2
_Key = tuple[int, int]  # A joint (from 0), and a place in ``_JOINT_LENGTHS``
_Places = tuple[int, ...]
_UNSEEN = 1e-6
_FEWEST = 12  # Records an input of the process
_STARTS = (0.4, 2.0)
_FIRST_NOISE = 0.7
_FIRST, _SECOND = 250, 500
"""Records by which its length scales are found, first from each start, then from the best of them."""
_STEPS = 20
_LENGTHS = (-2.3, 4.0)  # Bounds of the logarithm: a chord of 2 is half a turn
_NOISE = (-3.0, 3.0)
_GAIN = 3.0  # Logarithm of the odds, for each of its numbers, from which on a process is there
_LEFT = 0.01  # Of the noise's variance: so little of the process may be left between its poses


@dataclass(frozen=True)
class _JointProcess:
    """A process of one joint (from 0) over its angle, as features of the rows of the residuals."""

    joint: int
    inputs: tuple[Input, ...]
    poses: Array
    roots: Array
    rows: Array
    between: float  # the mean share of the variance that features leave

    @classmethod
    def over(cls, errors: ModelErrors, joint: int, length: float) -> _JointProcess:
        command = errors.postures.commands[joint]
        low, high = float(command.min()), float(command.max())
        count = max(1, int(np.ceil(min(high - low, 2 * np.pi) / length)))
        step = min(high - low, 2 * np.pi) / count
        poses = low + step * (0.5 + np.arange(count))
        inputs = (Input(of="angle", joint=joint + 1, scale=length),)
        correlations = Correlations.of(inputs, poses[None])
        roots = roots_of(correlations.at([poses]))
        features = correlations.at([command]).T @ roots
        slopes = errors.slopes[:, :, len(OF_TOOL) + joint]
        rows = -(slopes[:, :, None] * features[:, None, :]).reshape(-1, count)
        return cls(joint, inputs, poses, roots, rows, share_between(features))

    def term(self, share: float) -> TermSettings:
        return TermSettings(inputs=self.inputs, poses=packed(self.poses), share=share)


def of_joints(errors: ModelErrors, before: Sequence[ProcessSettings] = ()) -> tuple[list[ProcessSettings], Array]:
    """Processes of the joints that turn, and what they leave; lengths are looked for near those learned ``before``."""
    left = errors.residuals.ravel()
    turning = [i for i, kind in enumerate(errors.dimensions) if kind == "angle"]
    moved = _seen(errors, [i for i in turning if np.ptp(errors.postures.commands[i]) > _JOINT_LENGTHS[-1]])
    search = _LengthSearch(errors, moved, left)
    finest = {part.first - len(OF_TOOL): min(term.inputs[0].scale for term in part.terms) for part in before}
    chosen = search.likeliest(finest) if moved else None
    if chosen is None:
        return [], left.reshape(errors.residuals.shape)
    regression, processes, parts = search.regression(chosen), search.processes(chosen), list[ProcessSettings]()
    for joint in moved:
        blocks = [i for i, own in enumerate(processes) if own.joint == joint and regression.is_known(i)]
        if blocks:
            parts.append(_part([processes[i] for i in blocks], regression, blocks))
        for i in blocks:
            left = left - processes[i].rows @ regression.weights[i]
    return parts, left.reshape(errors.residuals.shape)


def _part(terms: Sequence[_JointProcess], regression: Regression, blocks: Sequence[int]) -> ProcessSettings:
    variances = regression.variances[list(blocks)]
    scale = float(np.sqrt(variances.sum()))
    shares = [float(own / variances.sum()) for own in variances]
    roots = block_diag(*(term.roots * np.sqrt(share) for term, share in zip(terms, shares, strict=True)))
    return ProcessSettings(
        first=len(OF_TOOL) + terms[0].joint,
        scales=(scale,),
        weights=packed(
            np.concatenate([own.roots @ regression.weights[i] for own, i in zip(terms, blocks, strict=True)])
        ),
        root=packed(taken_root(roots, regression.left_of(blocks))),
        terms=tuple(own.term(share) for own, share in zip(terms, shares, strict=True)),
        between=sum(share * own.between for own, share in zip(terms, shares, strict=True)),
    )


class _LengthSearch:
    """The likeliest length scale of each joint's process: first the same for all, then each joint's neighbours."""

    def __init__(self, errors: ModelErrors, joints: Sequence[int], left: Array) -> None:
        self._errors, self._joints, self._left = errors, joints, left
        self._processes: dict[_Key, _JointProcess] = {}
        self._products: dict[tuple[_Key, _Key], Array] = {}
        self._regressions: dict[_Places, Regression] = {}

    def likeliest(self, before: Mapping[int, float]) -> _Places | None:
        """Places in ``_JOINT_LENGTHS`` of the finer ones, one a joint; None where the records are too few for any."""
        begun = tuple(_JOINT_LENGTHS.index(before.get(joint, _JOINT_LENGTHS[0])) for joint in self._joints)
        possible = [begun] if any(begun) and self._is_possible(begun) else []
        if not possible:
            same = [(place,) * len(self._joints) for place in range(len(_JOINT_LENGTHS))]
            possible = [places for places in same if self._is_possible(places)]
        if not possible:
            return None
        best = max(possible, key=lambda places: self.regression(places).evidence)
        for i in range(len(self._joints)):
            near = best
            own = range(max(0, near[i] - 1), min(len(_JOINT_LENGTHS), near[i] + 2))
            tried = [(*near[:i], place, *near[i + 1 :]) for place in own]
            possible = [places for places in tried if self._is_possible(places)]
            best = max(possible, key=lambda places, near=near: self.regression(places, near).evidence)
        return best

    def processes(self, places: _Places) -> list[_JointProcess]:
        return [self._process(key) for key in self._keys(places)]

    def regression(self, places: _Places, near: _Places | None = None) -> Regression:
        if places not in self._regressions:
            keys, start = self._keys(places), None
            matrix = np.block([[self._product(a, b) for b in keys] for a in keys])
            vector = np.concatenate([self._process(key).rows.T @ self._left for key in keys])
            products = Products(matrix, vector, float(self._left @ self._left), len(self._left))
            if near is not None:
                known = dict(zip(self._keys(near), self._regressions[near].variances, strict=True))
                finer = dict(zip(self._joints, near, strict=True))
                variances = [known.get(key, known[key[0], finer[key[0]]]) for key in keys]
                start = np.array(variances), self._regressions[near].noise
            sizes = [len(self._process(key).poses) for key in keys]
            self._regressions[places] = regressed(products, sizes, start)
        return self._regressions[places]

    def _keys(self, places: _Places) -> list[_Key]:
        return list(
            dict.fromkeys([(joint, 0) for joint in self._joints] + list(zip(self._joints, places, strict=True)))
        )

    def _process(self, key: _Key) -> _JointProcess:
        if key not in self._processes:
            self._processes[key] = _JointProcess.over(self._errors, key[0], _JOINT_LENGTHS[key[1]])
        return self._processes[key]

    def _product(self, one: _Key, other: _Key) -> Array:
        if (one, other) not in self._products:
            self._products[one, other] = self._process(one).rows.T @ self._process(other).rows
            self._products[other, one] = self._products[one, other].T
        return self._products[one, other]

    def _is_possible(self, places: _Places) -> bool:
        features = sum(len(process.poses) for process in self.processes(places))
        return _ROWS_PER_FEATURE * features <= len(self._left)


def _seen(errors: ModelErrors, joints: Sequence[int]) -> list[int]:
    shown = {i: float(np.sum(errors.slopes[:, :, len(OF_TOOL) + i] ** 2)) for i in joints}
    return [i for i, square in shown.items() if square > _UNSEEN * max(shown.values())]


def of_tool(
    errors: ModelErrors, left: Array, most: int, before: Sequence[ProcessSettings] = ()
) -> list[ProcessSettings]:
    """Of the tool's shifts, and turns, where what is left of the residuals (N x rows) follows one."""
    pose, around, tool = *_inputs(errors), errors.of_tool
    known = {(part.first, len(part.terms[0].inputs)): part.terms[0].inputs for part in before}
    processes = []
    if tool:
        own = -np.einsum("ncr,nr->nc", np.linalg.pinv(errors.slopes[:, :, :tool]), left)
    # What load and temperature change is beside what they do not, which holds where they are others.
    for inputs in (pose, pose + around) if around else (pose,):
        if not tool or len(left) < _FEWEST * len(inputs):
            break
        for i in range(0, tool, 3):
            process, taught = _process(errors, own[:, i : i + 3], inputs, most, i, known.get((i, len(inputs)), ()))
            own[:, i : i + 3] -= taught
            processes += [] if process is None else [process]
    return processes


def _inputs(errors: ModelErrors) -> tuple[list[tuple[Kind, int]], list[tuple[Kind, int]]]:
    postures, joints = errors.postures, range(len(errors.dimensions))
    moved: list[tuple[Kind, int]] = [
        ("angle" if errors.dimensions[i] == "angle" else "length", i)
        for i in joints
        if np.ptp(postures.commands[i]) > 0
    ]
    moved += [("approach", i) for i in joints if np.ptp(postures.approaches[i]) > 0]
    return moved, [(kind, -1) for kind in SURROUNDINGS if np.ptp(postures.surroundings.get(kind, 0)) > 0]


def _squares(numbers: Array, inputs: Sequence[tuple[Kind, int]], to: Array | None = None) -> Array:
    """Squared chords and distances between records (inputs x N x N), or to some of them."""
    apart = numbers[:, :, None] - (numbers if to is None else to)[:, None, :]
    return np.array(
        [2 - 2 * np.cos(d) if kind == "angle" else d**2 for d, (kind, _) in zip(apart, inputs, strict=True)]
    )


def _process(
    errors: ModelErrors,
    own: Array,
    inputs: Sequence[tuple[Kind, int]],
    most: int,
    first: int,
    before: Sequence[Input],
) -> tuple[ProcessSettings | None, Array]:
    """Of three corrections of the tool (N x 3), and what it says of them."""
    postures = errors.postures
    recorded = (postures.commands, postures.approaches, postures.surroundings)
    raw = np.array([Input(of=kind, joint=i + 1, scale=1).number(*recorded) for kind, i in inputs])
    spans = np.array([1.0 if kind == "angle" else np.ptp(row) for row, (kind, _) in zip(raw, inputs, strict=True)])
    numbers, near = raw / spans[:, None], list[Array]()
    if [(known.of, known.joint - 1) for known in before] == list(inputs):
        near = [np.log(np.append([known.scale for known in before] / spans, _FIRST_NOISE))]
    likelihood, best = _sought(numbers, own, inputs, near)
    if likelihood.nothing - likelihood.cost(best) < _GAIN * len(best):
        return None, np.zeros_like(own)
    lengths, noise = np.exp(best[:-1]), float(np.exp(best[-1]))
    kept = _poses(numbers, inputs, lengths, most, noise)
    listed = [
        Input(of=kind, joint=i + 1, scale=float(length * span))
        for (kind, i), length, span in zip(inputs, lengths, spans, strict=True)
    ]
    features = Correlations.of(listed, raw[:, kept]).at(raw)
    roots = roots_of(features[:, kept])
    independent = features.T @ roots
    left = np.linalg.inv(independent.T @ independent / noise**2 + np.eye(len(kept)))
    weights = left @ (independent.T @ own / noise**2)
    part = ProcessSettings(
        first=first,
        scales=tuple(likelihood.scales(best).tolist()),
        weights=packed(roots @ weights),
        root=packed(taken_root(roots, left)),
        terms=(TermSettings(inputs=tuple(listed), poses=packed(raw[:, kept].T)),),
        between=share_between(independent),
    )
    return part, independent @ weights


def _sought(
    numbers: Array, own: Array, inputs: Sequence[tuple[Kind, int]], near: Sequence[Array]
) -> tuple[_Likelihood, Array]:
    order = np.random.default_rng(0).permutation(len(own))

    def of_first(count: int) -> _Likelihood:
        some = order[:count]
        return _Likelihood(_squares(numbers[:, some], inputs), own[some])

    if not near:
        starts = [np.log(np.append(np.full(len(inputs), length), _FIRST_NOISE)) for length in _STARTS]
        near = [_likeliest(of_first(_FIRST), start) for start in starts]
    likelihood = of_first(_SECOND)
    return likelihood, _likeliest(likelihood, min(near, key=likelihood.cost))


@dataclass(frozen=True)
class _Likelihood:
    """Negative logarithm of the marginal likelihood, each output's scale at its best, and the gradient."""

    squares: Array
    errors: Array

    @property
    def nothing(self) -> float:
        return len(self.errors) / 2 * float(np.sum(np.log(np.mean(self.errors**2, axis=0))))

    def cost(self, at: Array) -> float:
        return self(at)[0]

    def __call__(self, at: Array) -> tuple[float, Array]:
        (count, outputs), ratio = self.errors.shape, np.exp(2 * at[-1])
        kernel, inverse, size = self._factored(at)
        solved = inverse @ self.errors
        variances = np.maximum(np.mean(self.errors * solved, axis=0), 1e-300)
        value = outputs / 2 * size + count / 2 * np.sum(np.log(variances))
        by_kernel = outputs / 2 * inverse - (solved / variances) @ solved.T / 2
        slope = np.tensordot(self.squares, by_kernel * kernel, axes=2) * np.exp(-2 * at[:-1])
        # the kernel falls with its squares by half, and weights are exp(-2 l)
        return float(value), np.append(slope, 2 * ratio * np.trace(by_kernel))

    def scales(self, at: Array) -> Array:
        solved = self._factored(at)[1] @ self.errors
        return np.asarray(np.sqrt(np.maximum(np.mean(self.errors * solved, axis=0), 1e-24)))

    def _factored(self, at: Array) -> tuple[Array, Array, float]:
        kernel = np.exp(-np.tensordot(np.exp(-2 * at[:-1]), self.squares, axes=1) / 2)
        return kernel, *inverted(kernel + np.exp(2 * at[-1]) * np.eye(len(kernel)))


def _likeliest(likelihood: _Likelihood, start: Array) -> Array:
    bounds = [_LENGTHS] * (len(start) - 1) + [_NOISE]
    options = {"maxiter": _STEPS}
    return np.asarray(minimize(likelihood, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x)


def _poses(numbers: Array, inputs: Sequence[tuple[Kind, int]], lengths: Array, most: int, noise: float) -> list[int]:
    """Records at which a process is held: each where the most is left, until little is. [Fine2001]"""
    left, columns, kept = np.ones(numbers.shape[1]), list[Array](), list[int]()
    while len(kept) < min(most, numbers.shape[1]):
        place = int(np.argmax(left))
        if left[place] < _LEFT * noise**2:
            break
        squares = _squares(numbers, inputs, numbers[:, [place]])[:, :, 0]
        column = np.exp(-(lengths**-2 @ squares) / 2)
        for before in columns:
            column = column - before * before[place]
        columns.append(column / np.sqrt(left[place]))
        left = np.maximum(left - columns[-1] ** 2, 0.0)
        kept.append(place)
    return kept


_LEAST_RECORDS = 20
_AT_A_TIME = 4096


class GaussianProcessSettings(Settings):
    """At how many ``poses`` at most the tool's process is held, and what was learned (by armcal, not by hand).

    ``within`` has the smallest and largest command of each joint (rad or m) up to which what was learned acts.
    """

    poses: Annotated[int, Field(ge=10, le=1000)] = 100
    learned: tuple[ProcessSettings, ...] = ()
    within: tuple[tuple[float, float], ...] = ()


class GaussianProcess(PoseResidual):
    """The pose residual ``gaussian_process``."""

    Settings: ClassVar[type[GaussianProcessSettings]] = GaussianProcessSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"poses": 40}
    settings: GaussianProcessSettings

    def __init__(self, settings: GaussianProcessSettings, joint_names: Sequence[str]) -> None:
        super().__init__(settings, joint_names)
        self._correlations = {
            id(part): [Correlations.of(term.inputs, poses_of(term)) for term in part.terms] for part in settings.learned
        }
        around = {own.of for part in settings.learned for term in part.terms for own in term.inputs}
        self.conditions = tuple(name for name in SURROUNDINGS if name in around - {"payload"})
        self.knows_load = "payload" in around
        self._check()

    def _check(self) -> None:
        count, known = len(self.joint_names), len(self.settings.within)
        zeros = Postures(np.zeros((count, 1)), np.zeros((count, 1)))
        for part in self.settings.learned:
            if part.first + len(part.scales) > len(OF_TOOL) + count or known not in (0, count):
                raise ValueError(f"found corrections of {known} joints: it was learned on an arm of other joints")
            features = len(self._features(part, zeros))
            unpacked(part.weights, features, len(part.scales))
            unpacked(part.root, features, None)

    @property
    @override
    def is_learned(self) -> bool:
        return bool(self.settings.learned)

    @override
    def learned(self, errors: ModelErrors) -> GaussianProcess | None:
        if len(errors.residuals) < _LEAST_RECORDS:
            return None
        before = {
            joint: [part for part in self.settings.learned if (part.first >= len(OF_TOOL)) == joint]
            for joint in (True, False)
        }
        parts, left = of_joints(errors, before[True])
        parts += of_tool(errors, left, self.settings.poses, before[False])
        if not parts:
            return None
        update = {"learned": tuple(parts), "within": reached(errors.postures.commands)}
        return GaussianProcess(self.settings.model_copy(update=update), self.joint_names)

    @override
    def correction(
        self, commands: Expression, approaches: Expression, surroundings: Mapping[str, Expression]
    ) -> Expression:
        rows = [ca.SX(0)] * (len(OF_TOOL) + len(self.joint_names))
        for part in self.settings.learned:
            features = ca.vertcat(*[own(commands, approaches, surroundings) for own in self._correlations[id(part)]])
            weights = unpacked(part.weights, features.numel(), len(part.scales))
            for i, moved in enumerate(ca.vertsplit(ca.mtimes(ca.DM(weights.T), features))):
                rows[part.first + i] += ca.if_else(self._acts(part, commands), moved, 0)
        return ca.vertcat(*rows)

    @override
    def corrections(self, postures: Postures) -> Array:
        def moved(part: ProcessSettings, features: Array, acts: Array) -> Array:
            return np.where(acts, unpacked(part.weights, len(features), len(part.scales)).T @ features, 0.0)

        return self._summed(postures, moved)

    @override
    def deviations(self, postures: Postures) -> Array:
        """With all of a process where it does not act, and with what an unknown condition does within the records."""

        def left(part: ProcessSettings, features: Array, acts: Array) -> Array:
            taken = np.sum((unpacked(part.root, len(features), None).T @ features) ** 2, axis=0)
            prior = self._prior_variance(part, features)
            return np.outer(np.square(part.scales), np.where(acts, np.maximum(prior - taken, 0.0), prior))

        squares = self._summed(postures, left)
        for name in set(self.conditions) - set(postures.surroundings):
            ends = [
                self.corrections(replace(postures, surroundings={**postures.surroundings, name: column}))
                for column in self._spread(name)[:, None].repeat(postures.commands.shape[1], axis=1)
            ]
            squares += (ends[1] - ends[0]) ** 2 / 4
        return np.asarray(np.sqrt(squares))

    def _summed(self, postures: Postures, of_part: Callable[[ProcessSettings, Array, Array], Array]) -> Array:
        """What parts give, by correction (6 + joints x N), by their features and where they act; of some at a time."""
        total = np.zeros((len(OF_TOOL) + len(self.joint_names), postures.commands.shape[1]))
        for start in range(0, total.shape[1], _AT_A_TIME):
            here = slice(start, start + _AT_A_TIME)
            own = postures.subset(here)
            for part in self.settings.learned:
                rows = slice(part.first, part.first + len(part.scales))
                total[rows, here] += of_part(part, self._features(part, own), self._acts(part, own.commands))
        return total

    def _acts(self, part: ProcessSettings, commands: Any) -> Any:
        """Where a part does: of the tool, where no joint is beyond, of a joint, where no more than one other is.

        Errors of joints are learned together: where several are not known, the others alone may be worse than none.
        """
        ends = self.settings.within or ((-np.inf, np.inf),) * len(self.joint_names)
        beyond = [(commands[i] < low) + (commands[i] > high) for i, (low, high) in enumerate(ends)]
        joint = part.first - len(OF_TOOL)
        return sum(beyond) <= 0 if joint < 0 else beyond[joint] + sum(beyond) <= 1

    def _features(self, part: ProcessSettings, own: Postures) -> Array:
        known = (own.commands, own.approaches, own.surroundings)
        return np.vstack([correlations(*known) for correlations in self._correlations[id(part)]])

    def _prior_variance(self, part: ProcessSettings, features: Array) -> Array:
        """Of what features (M x N) hold, and more of the rest than records showed, in units of the squared scale."""
        held, first = np.zeros(features.shape[1]), 0
        for term, correlations in zip(part.terms, self._correlations[id(part)], strict=True):
            own = features[first : (first := first + len(correlations.matrix))]
            roots = roots_of(correlations.at(poses_of(term)))
            held += term.share * np.sum((roots.T @ own) ** 2, axis=0)
        return np.asarray(held + np.maximum(1 - held - part.between, 0.0))

    def _spread(self, name: str) -> Array:
        """A condition a standard deviation below and above its middle (2)."""
        numbers = [
            poses_of(term)[i]
            for part in self.settings.learned
            for term in part.terms
            for i, own in enumerate(term.inputs)
            if own.of == name
        ]
        whole = np.concatenate(numbers)
        return np.asarray(whole.mean() + whole.std() * np.array([-1.0, 1.0]))


def poses_of(term: TermSettings) -> Array:
    return unpacked(term.poses, None, len(term.inputs)).T
