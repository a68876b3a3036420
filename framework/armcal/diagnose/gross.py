"""What is grossly wrong with a calibration: its error, its arm beside the nominal one, records that did not train."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation as Turns
from scipy.special import stdtr, stdtrit

from armcal.arm.statics import plausible_compliance
from armcal.base.arrays import Array
from armcal.base.domains import Pose, Rotation, ScrewAxis
from armcal.base.parameters import Parameters
from armcal.base.units import digits, readable
from armcal.diagnose.checks import Finding, Grade, first_few
from armcal.diagnose.fit import MOST_RECORDS, Fit, only_places, thinned, unconfigured
from armcal.diagnose.residual_structure import WORTHWHILE, ResidualStructure, Structure, percent, structure
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import Estimate
from armcal.estimate.identifiability import Measure, at_random_poses
from armcal.estimate.start import BETTER
from armcal.estimate.validation import Halves, halves, record_errors
from armcal.problem.problem import Problem
from armcal.problem.rigid_alignment import FEWEST, hand_eye, rigid_fit, sighting_of, spread_of, tools, tools_of

_MM = 1000.0
BEYOND, FAR_BEYOND, IMPLAUSIBLE = 4.0, 20.0, 100.0
"""Standard deviations of a prior, or typical corrections where there is none: what is worth a look, what is gross. Of
what is no length or angle: how many times a plausible size is worth a look."""
_POSES = 60
_FEWEST_LENGTHS = 3
AS_MUCH, BY_SHARES = 0.004, 0.05
"""Levels at which lengths are off in proportion: against each off by as much, and each by a share of its own."""


@dataclass(frozen=True)
class Displaced:
    name: str  # of its coordinate
    amount: float  # how far, in ``unit``
    unit: str  # that people are shown
    times: float  # how many standard deviations of its prior, or typical corrections
    by: str  # ``prior``; ``geometry``, or ``place`` of what only moves base or tool point; ``size`` of anything else


@dataclass(frozen=True)
class Proportion:
    """By how much lengths of the arm are longer than nominal, all in proportion, as a scale that is off makes them.

    Attributes:
        freedoms: all lengths less one, and as many as carry the share, less one: one long one that is off is no scale.
    """

    count: int  # how many lengths
    share: float  # of each length, by which it is longer
    sd: float  # of the share: lengths that differ from nominal each by its own, and how well they are known
    freedoms: tuple[float, float]

    @classmethod
    def of(cls, lengths: Array, values: Array, covariance: Array) -> Self:
        """Regression of what lengths are off on their nominal values (n each, m; n x n, m^2)."""
        squares = lengths**2
        weights, count = lengths / squares.sum(), len(lengths)
        share = float(weights @ values) - 1
        own = float(np.sum((values - (1 + share) * lengths) ** 2) / (count - 1) / squares.sum())
        # Kish's effective number: lengths that are off by a share of their own pull by their squares.
        carrying = float(squares.sum() ** 2 / np.sum(squares**2))
        sd = float(np.sqrt(own + weights @ covariance @ weights))
        return cls(count, share, sd, (count - 1.0, carrying - 1.0))

    @property
    def is_clear(self) -> bool:
        t, levels = -abs(self.share) / max(self.sd, 1e-300), (AS_MUCH, BY_SHARES)
        return all(2 * stdtr(freedom, t) < level for freedom, level in zip(self.freedoms, levels, strict=True))


@dataclass(frozen=True)
class Figure:
    """The calibrated arm beside the nominal one.

    Attributes:
        size: extent of the calibrated tool positions by that with nominal lengths and all else calibrated: a joint's
            wrong zero is no size; nan where they do not move.
        moved_mm, turned_deg: how the calibrated arm as a whole stands away from where the configuration has it.
    """

    reach_mm: float  # largest distance of the nominal tool from the first joint, over the poses
    size: float
    moved_mm: float
    turned_deg: float
    displaced: tuple[Displaced, ...]  # parameters beyond what their priors say, the farthest first
    proportion: Proportion | None = None  # of its free lengths; None where they are too few


def figure(fit: Fit) -> Figure:
    """Of the first tool of all, at random poses about the recorded ones: what touches a socket hardly moves in them."""
    problem, estimate = fit.problem.subset(thinned(fit.split.train)), fit.estimate
    poses = at_random_poses(problem).subset(np.arange(_POSES, dtype=np.intp))
    try:
        nominal, calibrated, bent = _places(poses, estimate)
    except NotConvergedError:
        poses = problem
        nominal, calibrated, bent = _places(poses, estimate)
    arm = problem.blueprint.arms[problem.blueprint.measurements[problem.kernels[0].factor.name].arms[0]]
    chain = arm.nominal_chain
    first = np.array(ca.evalf((chain.base_T_mount @ chain.joints[0].parent_T_joint).translation)).ravel()
    extent, turn, shift = spread_of(bent), *rigid_fit(nominal, calibrated)
    reach = float(np.max(np.linalg.norm(nominal - first[:, None], axis=0)))
    return Figure(
        reach_mm=reach * 1000.0,
        size=spread_of(calibrated) / extent if extent > 0 else float("nan"),
        moved_mm=float(np.linalg.norm(turn @ first + shift - first)) * 1000.0,
        turned_deg=float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1.0, 1.0)))),
        displaced=_displaced(poses, estimate, reach),
        proportion=proportion(poses, estimate),
    )


def _places(problem: Problem, estimate: Estimate) -> tuple[Array, Array, Array]:
    """Places of the first tool (3 x N, m): as configured, calibrated, and calibrated but for its lengths."""
    parameters, configured = problem.parameters, problem.blueprint.parameters.nominal()
    bent = estimate.values.copy()
    for block in parameters.free:
        if block.unit == "m" or isinstance(block.domain, ScrewAxis | Pose):
            own = parameters.entries_of(block.name)
            bent[own] = configured[own]
    nominal, calibrated, bent_places = (tools(problem, values)[0][0] for values in (configured, estimate.values, bent))
    return nominal, calibrated, bent_places


def _displaced(problem: Problem, estimate: Estimate, reach_m: float) -> tuple[Displaced, ...]:
    """Coordinates that are too far from their nominal values for their priors, or for what is plausible without one.

    What nobody configured is nowhere far from.
    """
    parameters = problem.parameters
    moved = parameters.coordinates(parameters.local(estimate.values))
    far = []
    for i, block in enumerate(parameters.coordinate_blocks):
        name, geometric = parameters.coordinate_names[i], block.unit in ("m", "rad")
        size, limit = block.prior_sd or block.scale, BEYOND if block.prior_sd or geometric else IMPLAUSIBLE
        arm = problem.blueprint.arms.get(name.partition(".")[0])
        mass = sum(own.mass for own in arm.masses) if arm else 0.0
        load_Nm = float(reach_m * mass * np.linalg.norm(problem.blueprint.environment.gravity))
        if limit == IMPLAUSIBLE and block.unit == "rad_per_Nm" and load_Nm > 0:
            interval = estimate[name].interval
            plausible = max(
                plausible_compliance(load_Nm), _typical_compliance(parameters, estimate, name.partition(".")[0])
            )
            # An arm may be soft: a compliance that data determine to be so large is what it is.
            if interval.lower <= plausible and interval.upper >= -plausible:
                size = max(plausible, *map(abs, block.nominal))
        times = abs(float(moved[i])) / size
        if times <= limit or (block.nuisance and not block.prior_sd) or unconfigured(problem, block.name):
            continue
        amount, unit = Measure(block.unit, 1.0).shown(float(moved[i]))
        places = geometric and only_places(problem, estimate.values, i)
        own = "prior" if block.prior_sd else "place" if places else "geometry" if geometric else "size"
        far.append(Displaced(name, amount, unit, times, own))
    return tuple(sorted(far, key=lambda coordinate: -coordinate.times))


def _typical_compliance(parameters: Parameters, estimate: Estimate, arm: str) -> float:
    """The median of an arm's compliances that the data distinguishes from zero (rad/(N m)); zero without any."""
    blocks = [b for b in parameters.free if b.unit == "rad_per_Nm" and b.name.startswith(f"{arm}.")]
    own = [estimate[name] for block in blocks for name in block.entry_names]
    return float(np.median([one.value for one in own if one.interval.lower > 0] or [0.0]))


def proportion(problem: Problem, estimate: Estimate) -> Proportion | None:
    """By how much free lengths of an arm are longer than nominal in proportion; None where they are too few."""
    parameters, nominal = problem.parameters, problem.blueprint.parameters.nominal()
    chosen = [
        problem.free_names.index(block.name)
        for i, block in enumerate(parameters.coordinate_blocks)
        if block.unit == "m"
        and block.domain.dof == 1
        and nominal[parameters.entries_of(block.name)].all()
        and not only_places(problem, estimate.values, i)
    ]
    if len(chosen) < _FEWEST_LENGTHS:
        return None
    entries = np.array(parameters.free_entries)[chosen]
    return Proportion.of(nominal[entries], estimate.values[entries], estimate.covariance[np.ix_(chosen, chosen)])


OF_REACH = 0.03
"""An error beyond this share of the arm's reach, or of a radian, is gross, whatever the arm and its instrument."""
PREDICTED_OF_REACH, EXPLAINED_OF_REACH, EXPLAINED = 0.01, 0.02, 1 / 3
"""Where other poses predict a third of the variance of the residuals, the model lacks what noise does not make: gross
beyond the first share of the reach, or beyond the second where one structure makes up a third of the error, as gravity
does of a printed arm whose base is rigid. A jump that makes up a third of the error is gross, however small."""
OVERFITTED = 3.0
"""Times the noise that training records show, from which on errors of records that did not train are the fit's."""
FEWEST_JUDGED = 10
_JUMPS = frozenset({"step", "slip", "bump"})
_OVER_TIME = _JUMPS | {"order"}
_NO_EXCUSE = _OVER_TIME | {"scale", "held"}
"""Kinds of structure that explain no gross error: something may have moved, a frame or what is held be wrong."""
_LOOK = (
    "Look at what is configured and held (armcal identify --fixed), and at how records and joints were paired: armcal "
    "check says how well the nominal arm fits."
)
_MOVED = (
    "The error depends on when a record was measured: the base, the tracker or the target moved or drifted. Measure "
    "again what differs, or calibrate the records before and after by themselves. parameters.drift models a slow drift."
)
SIZE, GROSS_SIZE = 0.02, 0.05
"""How far the calibrated arm may be larger or smaller than the nominal one: worth a look, and gross."""
EXACT = 1e-5  # Of the reach, 10 um a metre: no arm follows a model so closely, and no instrument measures it so well
MOST_NAMED = 3


def gross(fit: Fit) -> list[Finding]:
    """Errors of records that did not train beside the reach, whatever noise was stated.

    Where nothing measured is a length, angles stand beside a radian (what the reach is at the distance of the reach),
    pixels beside a thousand. Forces and torques have no such size, and are not judged here.
    """
    if not fit.converged:
        return []
    seen, left, unit = fit.judged_mm[np.isfinite(fit.judged_mm)], fit.of(structure), fit.unit
    reach = fit.of(figure).reach_mm, "the arm's reach"
    wholes = {"mm": reach, "mrad": (1000.0, "a radian"), "px": (1000.0, "a thousand px")}
    if not len(seen) or reach[0] <= 0 or unit not in wholes:
        return []
    mean, (whole, name) = float(np.mean(seen)), wholes[unit]
    share = mean / whole
    error = f"The mean error of records that did not train is {digits(mean)} {unit}, {100 * share:.2g} % of {name}"
    if share > OF_REACH:
        test = f"mean, limit {100 * OF_REACH:g} % of {whole:.0f} {unit}"
        return [Finding("bad", f"{error}: the values do not describe this arm.", test, _LOOK)]
    if left is None or left.share < EXPLAINED:
        return []
    explained = max((_share(s, left) for s in left.worthwhile if s.kind not in _NO_EXCUSE), default=0.0)
    limit = EXPLAINED_OF_REACH if explained >= EXPLAINED else PREDICTED_OF_REACH
    if share <= limit:
        return []
    text = f"{error}, and {100 * left.share:.0f} % of its variance is not noise: the model misses it."
    test = (
        f"limits {100 * limit:g} % and {100 * EXPLAINED:.0f} %; one cause explains {100 * explained:.0f} % of the error"
    )
    return [Finding("bad", text, test, _MOVED if left.goes_with_time else _LOOK)]


def jumped(fit: Fit) -> list[Finding]:
    """Records that contradict one another: a jump makes up a third of the error, and no order of the poses imitates it.

    Of what depends on time the jump is the largest: a drift has a remedy of its own.
    """
    left = fit.of(structure)
    if left is None or left.in_order:
        return []
    over_time = [s for s in left.worthwhile if s.kind in _OVER_TIME]
    most = max(over_time, key=lambda s: s.falls_mm, default=None)
    if most is None or most.kind not in _JUMPS or _share(most, left) < EXPLAINED:
        return []
    text = f"The records contradict one another: the residuals depend on {most.words}"
    text += f"; without it the mean training error would be {100 * _share(most, left):.0f} % less."
    test = f"score test; limit {100 * EXPLAINED:.0f} % of the error, poses in no order"
    return [Finding("bad", text, test, _MOVED)]


def _share(structure: Structure, left: ResidualStructure) -> float:
    return structure.falls_mm / max(left.mean_mm, 1e-12)


def turns(fit: Fit) -> list[Finding]:
    """Errors of orientations beside a radian, as those of lengths stand beside the reach; and the nominal arm's.

    Where no record judges, those that trained do.
    """
    own, held = fit.errors.turns, fit.split.holdout
    if own is None:
        return []
    unseen = own.cross_validated_deg.copy()
    unseen[held] = own.calibrated_deg[held]
    worse = worse_than_nominal(unseen, own.rival_deg, fit.spent, "deg")
    seen = unseen[np.isfinite(unseen)]
    which, seen = ("that did not train", seen) if len(seen) else ("that trained", own.calibrated_deg[fit.split.train])
    mean = float(np.mean(seen))
    if not np.radians(mean) > OF_REACH:
        return worse
    text = f"The mean orientation error of records {which} is {digits(mean)} deg: the values do not describe this arm."
    test = f"mean, limit {100 * OF_REACH:g} % of a radian, {np.degrees(OF_REACH):.1f} deg"
    return [Finding("bad", text, test, fit.of(held_turn) or _LOOK), *worse]


def held_turn(fit: Fit) -> str:
    """What to free where measured bodies are turned on their tools and their rotations are held; empty if none is.

    Bodies so mounted must turn as the nominal arm's tools do.
    """
    problem, nominal = fit.problem, fit.problem.parameters.nominal()
    for number, kernel in enumerate(problem.kernels):
        own = f"{kernel.factor.name}."
        names = [b.name for b in problem.parameters.blocks if b.name.startswith(own) and isinstance(b.domain, Rotation)]
        sighting = sighting_of(problem, fit.dataset, number, MOST_RECORDS)
        if sighting is None or sighting.turned is None or len(sighting.chosen) < FEWEST:
            continue
        if not names or problem.parameters[names[0]].free:
            continue
        tools = tools_of(problem.subset(sighting.chosen), nominal, number)
        base, mounted = hand_eye(tools.rotations, sighting.turned)
        left = np.swapaxes(base @ tools.rotations @ mounted, 1, 2) @ sighting.turned
        turn, scatter = (float(np.median(Turns.from_matrix(t).magnitude())) for t in (mounted, left))
        if turn > max(OF_REACH, BETTER * scatter):
            return (
                f"Free the target's rotation ({names[0]}), or state it: the measured body is turned by "
                f"{digits(float(np.degrees(turn)), 2)} deg on the tool from where the configuration has it."
            )
    return ""


def aligned(fit: Fit) -> list[Finding]:
    """Errors of records that did not train beside what was left before the fit (medians).

    Alignment has nine numbers, and parameters that spend p of m equations make errors 1 / sqrt(1 - p / (m - 1)) times
    as large (``spent`` is the quotient).
    """
    alignment = fit.ready.start.alignment
    if alignment is None or fit.unit != "mm":
        return []
    seen, left_mm = fit.judged_mm[np.isfinite(fit.judged_mm)], alignment.left * _MM
    spent = fit.spent + 3 / max(len(seen), 1)
    after = float(np.median(seen)) if len(seen) else 0.0
    if spent >= 1 or after <= BETTER * left_mm / np.sqrt(1 - spent):
        return []
    text = (
        f"Far worse than the nominal arm as it was aligned before the fit: typically {digits(after)} mm on records "
        f"that did not train, {digits(left_mm)} mm aligned."
    )
    test = f"medians, limit {BETTER / np.sqrt(1 - spent):.2g} times"
    action = "Something that places the arm or its target is held, or has a prior, elsewhere: free it, or correct it."
    free = "" if fit.errors.turns is None else fit.of(held_turn)
    return [Finding("bad", text, test, free or action)]


def overfitted(
    trained_mm: Array, judged_mm: Array, nominal_mm: Array, equations: int, freedom: float, unit: str = "mm"
) -> list[Finding]:
    """Errors of records that did not train beside those that did (nan where unknown), parameters counted.

    It is bad where the nominal arm, which the same records placed, is as good.

    A fit that spends p of m equations leaves sqrt(1 - p/m) of the noise in the records that train it, so that their
    errors by sqrt(m / (m - p)) are the noise. Records that did not train have sqrt(1 + p / (m - p - 1)) times that
    where poses are alike [Breiman1983]: three times only if p is eight ninths of m, or if poses are not alike.
    """
    judged, trained = judged_mm[np.isfinite(judged_mm)], trained_mm[np.isfinite(trained_mm)]
    if min(len(judged), len(trained)) < FEWEST_JUDGED or freedom <= 0:
        return []
    noise = float(np.median(trained)) * float(np.sqrt(max(equations, freedom) / freedom))
    after = float(np.median(judged))
    if after <= OVERFITTED * noise:
        return []
    text = (
        f"Overfitted: records that did not train have an error of {after:.3g} {unit}, {after / noise:.1f} times what "
        f"the training records lead one to expect ({noise:.3g} {unit})."
    )
    test = f"medians; {equations - freedom:.0f} of {equations} equations are spent on parameters; limit {OVERFITTED:g}"
    action = "Measure more poses, more different ones; free fewer parameters; or give priors."
    both = np.isfinite(judged_mm) & np.isfinite(nominal_mm)
    gains = both.any() and np.mean(judged_mm[both]) < np.mean(nominal_mm[both])
    return [Finding("warning" if gains else "bad", text, test, action)]


def size_findings(figure: Figure) -> list[Finding]:
    off, lengths = abs(figure.size - 1), figure.proportion
    action = "Check the units and values of known distances and positions, and the tracker's scale."
    if off > SIZE:
        text = f"The calibrated arm is {figure.size:.3g} times as large as the nominal one."
        test = f"extent of the tool's positions by lengths, limits {100 * SIZE:g} and {100 * GROSS_SIZE:g} %"
        return [Finding("bad" if off > GROSS_SIZE else "warning", text, test, action)]
    if lengths is None or not lengths.is_clear:
        return []
    share, sd = 100 * abs(lengths.share), 100 * lengths.sd
    text = (
        f"The {lengths.count} free lengths of the arm are {share:.2g} % (sd {sd:.1g} %) "
        f"{'longer' if lengths.share > 0 else 'shorter'} than nominal, in proportion: a known distance or an "
        "instrument's scale that is off by as much shows in nothing else."
    )
    levels = f"{100 * AS_MUCH:g} % against lengths off by as much, {100 * BY_SHARES:g} % by shares of their own"
    return [Finding("warning", text, f"regression on the nominal lengths, t, {levels}", action)]


def computed_findings(nominal_mm: Array, judged_mm: Array, figure: Figure) -> list[Finding]:
    """Tips that are computed from the joints: errors of the nominal arm and judged ones (N; nan where there are none).

    Those of the nominal arm leave nothing to calibrate. Those of another model, a controller's, give that.
    """
    limit = EXACT * figure.reach_mm
    medians = [
        np.median(errors[known]) if (known := np.isfinite(errors)).any() else limit
        for errors in (nominal_mm, judged_mm)
    ]
    if not min(medians) < limit:
        return []
    grade: Grade = "bad" if medians[0] < limit else "warning"
    text = (
        f"The measured tips follow the {'nominal' if grade == 'bad' else 'calibrated'} arm to "
        f"{digits(float(min(medians)))} mm, as no measured tip of an arm does: they seem to be computed from the "
        "joints, by the controller, robot_state_publisher or a simulation."
    )
    test = f"median, limit {limit:.2g} mm, {EXACT:g} of the arm's reach"
    return [Finding(grade, text, test, "Give what an instrument measured, not the pose that the robot reports.")]


def displaced(fit: Fit) -> list[Finding]:
    """Parameters that contradict their priors, or are implausibly far from their nominal values."""
    every = fit.of(figure).displaced if fit.converged else ()
    gross = [one for one in every if one.by == "prior" or (one.by == "geometry" and one.times > FAR_BEYOND)]
    beyond = [one for one in every if one.by == "geometry" and one not in gross]
    elsewhere = [one for one in every if one.by == "place" and one.times > FAR_BEYOND]
    large = [one for one in every if one.by == "size"]
    test = f"limit {BEYOND:g} sd of the prior; without a prior {BEYOND:g} and {FAR_BEYOND:g} typical corrections"
    action = "If the arm is so, correct the nominal values or the prior; else look for a joint's zero, sign, or unit."
    far = "Far from the nominal values: {}."
    place = (
        "The base or the tool's point is far from where the configuration has it: {}. These data do not determine "
        "whether it is there, or the instrument's frame or target is elsewhere: it has no prior."
    )
    sized = f"limit {IMPLAUSIBLE:g} times: what a joint gives that bends by 2 mrad under half of its arm's weight at "
    sized += "full reach, or as the arm's other joints do, where the interval reaches as low; else a typical correction"
    rows: tuple[tuple[Grade, str, list[Displaced], str, str], ...] = (
        ("bad", far, gross, test, action),
        ("warning", far, beyond, test, action),
        ("warning", place, elsewhere, test, "Look for an offset or a unit; else correct the nominal values."),
        (
            "warning",
            "Larger than is plausible: {}.",
            large,
            sized,
            "Give it a prior, fix it, or measure what shows it.",
        ),
    )
    return [Finding(grade, text.format(_listed(own)), how, do) for grade, text, own, how, do in rows if own]


def _listed(group: Sequence[Displaced]) -> str:
    measures = {"prior": "its prior", "size": "what is plausible"}
    texts = []
    for one in group:
        measure = f"{one.times:.0f} times {measures.get(one.by, 'a typical correction')}"
        texts.append(f"{one.name} by {digits(one.amount)} {one.unit} ({measure})")
    return first_few(texts, MOST_NAMED)


def computed(fit: Fit) -> list[Finding]:
    channels = [kernel.factor.position_channels for kernel in fit.problem.kernels]
    read = any(own and all(map(fit.dataset.has, own)) for own in channels)
    if not fit.converged or fit.unit != "mm" or not read:
        return []  # a contact reads no position: it may agree with itself exactly
    return computed_findings(fit.errors.nominal_mm, fit.judged_mm, fit.of(figure))


def size(fit: Fit) -> list[Finding]:
    return size_findings(fit.of(figure)) if fit.converged else []


def worse(fit: Fit) -> list[Finding]:
    return worse_than_nominal(fit.unseen_mm, fit.errors.rival_mm, fit.spent, fit.unit)


def overfit(fit: Fit) -> list[Finding]:
    """Of a pose residual it is not known how much freedom it takes up, and its own folds judged it."""
    errors, arms = fit.errors, fit.problem.blueprint.arms
    if any(arm.residual is not None and arm.residual.is_learned for arm in arms.values()):
        return []
    trained = (errors.calibrated_mm if errors.at_rest_mm is None else errors.at_rest_mm)[fit.split.train]
    equations, freedom = fit.fitted.problem.equations(), fit.estimate.degrees_of_freedom
    return overfitted(trained, fit.judged_mm, errors.rival_mm, equations, freedom, fit.unit)


def by_halves(fit: Fit) -> Halves | None:
    return halves(fit.acting, fit.inner, fit.estimate.values) if fit.converged else None


def weights(fit: Fit) -> list[Finding]:
    """Whether the declared noise gives better values than estimated variances do.

    Where a pose is to be known and most of the residuals is the joints', by how far fits to halves have it apart.
    """
    fitted, estimated = fit.fitted, fit.of(by_halves)
    if fitted.components is None or fitted.as_declared is None:
        return []
    if estimated is not None and fitted.components.mostly_joints:
        declared = halves(fit.ready.training.weighted(fitted.weights), fit.inner, fitted.as_declared)
        assert declared is not None
        return [f for name in estimated.apart for f in steadier_weights(name, estimated, declared, fit.unit)]
    if not len(fit.split.holdout):
        return []
    declared_mm = record_errors(fit.problem, fitted.as_declared) * _MM
    return worse_than_declared(fit.judged_mm, declared_mm, fit.unit)


WORSE, POWER = 0.005, 0.9
"""Level of a loss against the nominal arm, and which share of losses of the size stated is found."""
_VALUES_BY_DECLARED = "Leave out noise.estimate for the values, and use it to learn where the noise comes from."


def worse_than_declared(judged_mm: Array, declared_mm: Array, unit: str = "mm") -> list[Finding]:
    """Where held-out records are missed by more than by the fit with the declared noise (N each; nan elsewhere)."""
    seen = np.isfinite(judged_mm) & np.isfinite(declared_mm)
    more, before = judged_mm[seen] - declared_mm[seen], float(np.mean(declared_mm[seen])) if seen.any() else 0.0
    if len(more) < 2 or np.mean(more) <= max(_by_chance(more), WORTHWHILE * before):
        return []
    text = (
        f"Estimated variances make predictions worse: held-out records have an error of "
        f"{readable(before + float(np.mean(more)))} {unit} on average, {readable(before)} {unit} by the declared noise."
    )
    test = "paired differences, one-sided, 5 %, and 1 % of the error"
    return [Finding("note", text, test, _VALUES_BY_DECLARED)]


def steadier_weights(name: str, estimated: Halves, declared: Halves, unit: str) -> list[Finding]:
    """Which weights keep the pose of a measurement nearer between halves of the records, where joints err most.

    Residuals are then the joints' errors, which the pose takes up: smaller ones are no sign of a better pose.
    """
    ours, others = estimated.apart[name], declared.apart[name]
    seen = np.isfinite(ours).all(axis=1) & np.isfinite(others).all(axis=1)
    if seen.sum() < 2:
        return []
    more = ours[seen] - others[seen]
    for sign, action in ((1, _VALUES_BY_DECLARED), (-1, "Keep noise.estimate.")):
        mm, deg = sign * more.T
        if np.mean(mm) <= max(_by_chance(mm), WORTHWHILE * np.mean(others[seen, 0])) or np.mean(deg) <= 0:
            continue
        parts = [
            f"{readable(float(pose[0]))} mm and {readable(float(pose[1]))} deg ({readable(float(error))} {unit})"
            for pose, error in (
                (np.mean(halves.apart[name][seen], axis=0), np.mean(halves.errors[seen]))
                for halves in (estimated, declared)
            )
        ]
        text = (
            f"{name}: its pose differs between halves of the records by {parts[0]} with estimated variances, by "
            f"{parts[1]} with the declared noise; in brackets the error of records by the fit to the other half, "
            "which is the joints' and does not rank poses."
        )
        return [Finding("note", text, f"{seen.sum()} divisions, paired differences, one-sided, 5 %, and 1 %", action)]
    return []


def _by_chance(differences: Array, level: float = 0.05) -> float:
    count = len(differences)
    return float(stdtrit(count - 1, 1 - level) * np.std(differences, ddof=1) / np.sqrt(count))


def worse_than_nominal(judged_mm: Array, nominal_mm: Array, spent: float = 0.0, unit: str = "mm") -> list[Finding]:
    """Where records that did not train are missed by more than by the nominal arm (N each; nan where not judged).

    Parameters that spend p of m equations make errors sqrt(1 + p / (m - p - 1)) times as large [Breiman1983] though
    nothing is wrong: ``spent`` is p / (m - 1). What is more than that, and more than chance, is worse.
    """
    seen = np.isfinite(judged_mm) & np.isfinite(nominal_mm)
    if np.count_nonzero(seen) < 2 or spent >= 1:
        return []
    after, before = float(np.mean(judged_mm[seen])), float(np.mean(nominal_mm[seen]))
    if after <= before:
        return []
    factor = 1 / np.sqrt(1 - spent)
    more = judged_mm[seen] - factor * nominal_mm[seen]
    least = _by_chance(more, WORSE) + _by_chance(more, 1 - POWER)
    which = f"on {len(more)} records that did not train it: {readable(after)} {unit} on average, {readable(before)} of "
    which += "the nominal arm, placed by the records that trained as far as it may move."
    test = (
        f"paired differences, one-sided, {100 * WORSE:g} %, beyond the {percent(factor - 1)} that so many parameters "
        f"make; {100 * POWER:g} % of losses of {readable(least)} {unit} would show"
    )
    if np.mean(more) <= _by_chance(more, WORSE):
        action = "Nothing is gained by it on poses like these: keep the nominal arm, or measure more poses."
        return [Finding("note", f"No better than the nominal arm {which}", test, action)]
    action = "Do not use it. Look at what trained: too few postures, too much alike, or some of them wrong."
    return [Finding("bad", f"Worse than the nominal arm {which}", test, action)]
