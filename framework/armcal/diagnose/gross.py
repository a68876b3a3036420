"""What is grossly wrong with a calibration: its error, its arm beside the nominal one, records that did not train; and
what residuals may not show.

Free lengths of an arm grow with an instrument's scale, springs take up a payload that nobody stated, and no residual
shows it: each is estimated beside the free parameters, to first order, and stated with what would not show.

Where all recorded angles of some joints are whole multiples of one step, each may be off by up to half of it. What that
would leave is compared with what is left: in size and, by likelihood, in how it is spread over poses and directions.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation as Turns
from scipy.special import chdtri, stdtr, stdtrit

from armcal.arm.statics import plausible_compliance
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.base.domains import Pose, Rotation, ScrewAxis
from armcal.base.units import digits, display_unit, from_unit, readable, si_unit, to_unit, unit
from armcal.diagnose.causes import OFF, held_scales, predicted_positions
from armcal.diagnose.checks import Finding, Grade, first_few
from armcal.diagnose.fit import MOST_RECORDS, Fit, FitRows, only_places, sampled_rows, thinned, unconfigured
from armcal.diagnose.residual_structure import CLEAR, WORTHWHILE, ResidualStructure, Structure, percent, structure
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import Estimate, Estimator
from armcal.estimate.identifiability import Measure, at_random_poses
from armcal.estimate.robust import Weighing
from armcal.estimate.start import BETTER
from armcal.estimate.validation import Halves, halves, record_errors
from armcal.problem import rigid_alignment as rigid
from armcal.problem.problem import Problem
from armcal.problem.variants import LOADS, Motion

_MM = 1000.0
BEYOND, FAR_BEYOND, IMPLAUSIBLE = 4.0, 20.0, 100.0
"""Standard deviations of a prior, or typical corrections: what is worth a look, and gross; times a plausible size."""
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
    """By how much lengths of the arm are longer than nominal, all in proportion, as a scale that is off makes them."""

    count: int  # how many lengths
    share: float  # of each length, by which it is longer
    sd: float  # of the share: lengths that differ from nominal each by its own, and how well they are known
    freedoms: tuple[float, float]  # all lengths less one; as many as carry the share less one: a long one is no scale

    @classmethod
    def of(cls, lengths: Array, values: Array, covariance: Array) -> Self:
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
    reach_mm: float  # largest distance of the nominal tool from the first joint, over the poses
    size: float  # extent of the tool's positions by that with nominal lengths, all else calibrated; nan if they rest
    moved_mm: float  # how far the calibrated arm as a whole stands from where the configuration has it
    turned_deg: float
    displaced: tuple[Displaced, ...]  # parameters beyond what their priors say, the farthest first
    proportion: Proportion | None = None  # of its free lengths; None where they are too few


def figure(fit: Fit) -> Figure:
    """Of the first tool of all, at random poses about the recorded ones: what touches a socket hardly moves in them."""
    problem, estimate = fit.problem.subset(thinned(fit.split.train)), fit.estimate
    parameters, configured, bent = problem.parameters, problem.blueprint.parameters.nominal(), estimate.values.copy()
    for block in parameters.free:
        if block.unit == "m" or isinstance(block.domain, ScrewAxis | Pose):
            own = parameters.entries_of(block.name)
            bent[own] = configured[own]
    vectors, poses = (configured, estimate.values, bent), at_random_poses(problem).subset(np.arange(_POSES))
    try:
        nominal, calibrated, with_lengths = (rigid.tools(poses, values)[0][0] for values in vectors)
    except NotConvergedError:
        poses = problem
        nominal, calibrated, with_lengths = (rigid.tools(poses, values)[0][0] for values in vectors)
    chain = problem.blueprint.arms[problem.blueprint.measurements[problem.kernels[0].factor.name].arms[0]].nominal_chain
    first = np.array(ca.evalf((chain.base_T_mount @ chain.joints[0].parent_T_joint).translation)).ravel()
    extent, turn, shift = rigid.spread_of(with_lengths), *rigid.rigid_fit(nominal, calibrated)
    reach = float(np.max(np.linalg.norm(nominal - first[:, None], axis=0)))
    return Figure(
        reach_mm=reach * _MM,
        size=rigid.spread_of(calibrated) / extent if extent > 0 else float("nan"),
        moved_mm=float(np.linalg.norm(turn @ first + shift - first)) * _MM,
        turned_deg=float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1.0, 1.0)))),
        displaced=_displaced(poses, estimate, reach),
        proportion=proportion(poses, estimate),
    )


def _displaced(problem: Problem, estimate: Estimate, reach_m: float) -> tuple[Displaced, ...]:
    """Coordinates that are too far from their nominal values for their priors, or for what is plausible without one.
    What nobody configured is nowhere far from."""
    parameters, far = problem.parameters, []
    moved = parameters.coordinates(parameters.local(estimate.values))
    for i, block in enumerate(parameters.coordinate_blocks):
        name, geometric = parameters.coordinate_names[i], block.unit in ("m", "rad")
        size, limit = block.prior_sd or block.scale, BEYOND if block.prior_sd or geometric else IMPLAUSIBLE
        owner = name.partition(".")[0]
        arm = problem.blueprint.arms.get(owner)
        mass = sum(own.mass for own in arm.masses) if arm else 0.0
        load_Nm = float(reach_m * mass * np.linalg.norm(problem.blueprint.environment.gravity))
        if limit == IMPLAUSIBLE and block.unit == "rad_per_Nm" and load_Nm > 0:
            # As large as is plausible, or as the arm's compliances that the data distinguishes from zero (median).
            springs = [b for b in parameters.free if b.unit == "rad_per_Nm" and b.name.startswith(f"{owner}.")]
            known = [estimate[entry] for spring in springs for entry in spring.entry_names]
            typical = float(np.median([one.value for one in known if one.interval.lower > 0] or [0.0]))
            interval, plausible = estimate[name].interval, max(plausible_compliance(load_Nm), typical)
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


def proportion(problem: Problem, estimate: Estimate) -> Proportion | None:
    parameters, nominal, chosen = problem.parameters, problem.blueprint.parameters.nominal(), []
    for i, block in enumerate(parameters.coordinate_blocks):
        is_length = block.unit == "m" and block.domain.dof == 1 and nominal[parameters.entries_of(block.name)].all()
        if is_length and not only_places(problem, estimate.values, i):
            chosen.append(problem.free_names.index(block.name))
    if len(chosen) < _FEWEST_LENGTHS:
        return None
    entries = np.array(parameters.free_entries)[chosen]
    return Proportion.of(nominal[entries], estimate.values[entries], estimate.covariance[np.ix_(chosen, chosen)])


OF_REACH = 0.03  # An error beyond this share of the reach, or of a radian, is gross, whatever arm and instrument are
PREDICTED_OF_REACH, EXPLAINED_OF_REACH, EXPLAINED = 0.01, 0.02, 1 / 3
"""Where other poses predict a third of the variance an error is gross beyond the first share of the reach, beyond the
second where one structure makes up a third of it, as gravity does of a printed arm; a jump that does so is always."""
OVERFITTED = 3.0  # Times the noise of training records: larger errors of records that did not train are the fit's
FEWEST_JUDGED = 10
_JUMPS = frozenset({"step", "slip", "bump"})
_OVER_TIME = _JUMPS | {"order"}
_NO_EXCUSE = _OVER_TIME | {"scale", "held"}
"""Kinds of structure that explain no gross error: something may have moved, a frame or what is held be wrong."""
_LOOK = "Look at what is configured and held (armcal identify --fixed), and at how records and joints were paired: "
_LOOK += "armcal check says how well the nominal arm fits."
_MOVED = "The error depends on when a record was measured: the base, the tracker or the target moved or drifted. "
_MOVED += "Measure again what differs, or calibrate the records before and after by themselves. parameters.drift "
_MOVED += "models a slow drift."
SIZE, GROSS_SIZE = 0.02, 0.05  # How much larger or smaller than the nominal arm is worth a look, and gross
EXACT = 1e-5  # Of the reach, 10 um a metre: no arm follows a model so closely, and no instrument measures it so well
MOST_NAMED = 3


def gross(fit: Fit) -> list[Finding]:
    """Errors of records that did not train beside the reach, whatever noise was stated; angles beside a radian (the
    reach at the distance of the reach), pixels beside a thousand. Forces and torques have no such size."""
    if not fit.converged:
        return []
    seen, left, unit = fit.judged_mm[np.isfinite(fit.judged_mm)], fit.of(structure), fit.unit
    wholes = {"mm": (fit.of(figure).reach_mm, "the arm's reach"), "mrad": (1000.0, "a radian")}
    whole, name = {**wholes, "px": (1000.0, "a thousand px")}.get(unit, (0.0, ""))
    if not len(seen) or wholes["mm"][0] <= 0 or not whole:
        return []
    mean = float(np.mean(seen))
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
    test = f"limits {100 * limit:g} % and {100 * EXPLAINED:.0f} %; one cause explains {100 * explained:.0f} % of the "
    return [Finding("bad", text, f"{test}error", _MOVED if left.goes_with_time else _LOOK)]


def jumped(fit: Fit) -> list[Finding]:
    """Records that contradict one another: a jump makes up a third of the error, and no order of the poses imitates it.
    Of what depends on time the jump is the largest: a drift has a remedy of its own."""
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
    """Errors of orientations beside a radian, and the nominal arm's; of those that trained where no record judges."""
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
    """What to free where measured bodies are turned on their tools, and must turn as the nominal arm's tools do, while
    their rotations are held; empty if none is."""
    problem, nominal = fit.problem, fit.problem.parameters.nominal()
    for number, kernel in enumerate(problem.kernels):
        own = f"{kernel.factor.name}."
        names = [b.name for b in problem.parameters.blocks if b.name.startswith(own) and isinstance(b.domain, Rotation)]
        sighting = rigid.sighting_of(problem, fit.dataset, number, MOST_RECORDS)
        if sighting is None or sighting.turned is None or len(sighting.chosen) < rigid.FEWEST:
            continue
        if not names or problem.parameters[names[0]].free:
            continue
        tools = rigid.tools_of(problem.subset(sighting.chosen), nominal, number)
        base, mounted = rigid.hand_eye(tools.rotations, sighting.turned)
        left = np.swapaxes(base @ tools.rotations @ mounted, 1, 2) @ sighting.turned
        turn, scatter = (float(np.median(Turns.from_matrix(t).magnitude())) for t in (mounted, left))
        if turn > max(OF_REACH, BETTER * scatter):
            return (
                f"Free the target's rotation ({names[0]}), or state it: the measured body is turned by "
                f"{digits(float(np.degrees(turn)), 2)} deg on the tool from where the configuration has it."
            )
    return ""


def aligned(fit: Fit) -> list[Finding]:
    """Errors of records that did not train beside what was left before the fit (medians). Alignment has nine numbers,
    and parameters that spend p of m equations make errors 1 / sqrt(1 - p / (m - 1)) times as large."""
    alignment = fit.ready.start.alignment
    if alignment is None or fit.unit != "mm":
        return []
    seen, left_mm = fit.judged_mm[np.isfinite(fit.judged_mm)], alignment.left * _MM
    spent = fit.spent + 3 / max(len(seen), 1)
    after = float(np.median(seen)) if len(seen) else 0.0
    if spent >= 1 or after <= BETTER * left_mm / np.sqrt(1 - spent):
        return []
    text = f"Far worse than the nominal arm as it was aligned before the fit: typically {digits(after)} mm on records "
    text += f"that did not train, {digits(left_mm)} mm aligned."
    test = f"medians, limit {BETTER / np.sqrt(1 - spent):.2g} times"
    action = "Something that places the arm or its target is held, or has a prior, elsewhere: free it, or correct it."
    free = "" if fit.errors.turns is None else fit.of(held_turn)
    return [Finding("bad", text, test, free or action)]


def displaced(fit: Fit) -> list[Finding]:
    every, findings = fit.of(figure).displaced if fit.converged else (), []
    contradict = [one for one in every if one.by == "prior" or (one.by == "geometry" and one.times > FAR_BEYOND)]
    beyond = [one for one in every if one.by == "geometry" and one not in contradict]
    elsewhere = [one for one in every if one.by == "place" and one.times > FAR_BEYOND]
    test = f"limit {BEYOND:g} sd of the prior; without a prior {BEYOND:g} and {FAR_BEYOND:g} typical corrections"
    action = "If the arm is so, correct the nominal values or the prior; else look for a joint's zero, sign, or unit."
    place = (
        "The base or the tool's point is far from where the configuration has it: {}. These data do not determine "
        "whether it is there, or the instrument's frame or target is elsewhere: it has no prior."
    )
    sized = f"limit {IMPLAUSIBLE:g} times: what a joint gives that bends by 2 mrad under half of its arm's weight at "
    sized += "full reach, or as the arm's other joints do, where the interval reaches as low; else a typical correction"
    far, large = "Far from the nominal values: {}.", "Larger than is plausible: {}."
    give = "Give it a prior, fix it, or measure what shows it."
    rows: tuple[tuple[Grade, str, list[Displaced], str, str], ...] = (
        ("bad", far, contradict, test, action),
        ("warning", far, beyond, test, action),
        ("warning", place, elsewhere, test, "Look for an offset or a unit; else correct the nominal values."),
        ("warning", large, [one for one in every if one.by == "size"], sized, give),
    )
    of = {"prior": "its prior", "size": "what is plausible"}
    for grade, text, group, how, do in rows:
        times = [f"{one.times:.0f} times {of.get(one.by, 'a typical correction')}" for one in group]
        pairs = zip(group, times, strict=True)
        listed = [f"{one.name} by {digits(one.amount)} {one.unit} ({by})" for one, by in pairs]
        findings += [Finding(grade, text.format(first_few(listed, MOST_NAMED)), how, do)] if listed else []
    return findings


def computed(fit: Fit) -> list[Finding]:
    """Tips that are computed from the joints: those of the nominal arm leave nothing to calibrate; a controller's model
    gives that."""
    channels = [kernel.factor.position_channels for kernel in fit.problem.kernels]
    read = any(own and all(map(fit.dataset.has, own)) for own in channels)
    if not fit.converged or fit.unit != "mm" or not read:
        return []  # a contact reads no position: it may agree with itself exactly
    limit, errors = EXACT * fit.of(figure).reach_mm, (fit.errors.nominal_mm, fit.judged_mm)
    medians = [np.median(own[known]) if (known := np.isfinite(own)).any() else limit for own in errors]
    if not min(medians) < limit:
        return []
    grade: Grade = "bad" if medians[0] < limit else "warning"
    text = f"The measured tips follow the {'nominal' if grade == 'bad' else 'calibrated'} arm to "
    text += f"{digits(float(min(medians)))} mm, as no measured tip of an arm does: they seem to be computed from the "
    text += "joints, by the controller, robot_state_publisher or a simulation."
    test = f"median, limit {limit:.2g} mm, {EXACT:g} of the arm's reach"
    return [Finding(grade, text, test, "Give what an instrument measured, not the pose that the robot reports.")]


def size(fit: Fit) -> list[Finding]:
    if not fit.converged:
        return []
    own = fit.of(figure)
    off, lengths = abs(own.size - 1), own.proportion
    action = "Check the units and values of known distances and positions, and the tracker's scale."
    if off > SIZE:
        text = f"The calibrated arm is {own.size:.3g} times as large as the nominal one."
        test = f"extent of the tool's positions by lengths, limits {100 * SIZE:g} and {100 * GROSS_SIZE:g} %"
        return [Finding("bad" if off > GROSS_SIZE else "warning", text, test, action)]
    if lengths is None or not lengths.is_clear:
        return []
    share, sd = 100 * abs(lengths.share), 100 * lengths.sd
    text = f"The {lengths.count} free lengths of the arm are {share:.2g} % (sd {sd:.1g} %) "
    text += f"{'longer' if lengths.share > 0 else 'shorter'} than nominal, in proportion: a known distance or an "
    text += "instrument's scale that is off by as much shows in nothing else."
    levels = f"{100 * AS_MUCH:g} % against lengths off by as much, {100 * BY_SHARES:g} % by shares of their own"
    return [Finding("warning", text, f"regression on the nominal lengths, t, {levels}", action)]


def _inner(fit: Fit) -> Estimator:
    return fit.estimator.inner if isinstance(fit.estimator, Weighing) else fit.estimator


def by_halves(fit: Fit) -> Halves | None:
    return halves(fit.acting, _inner(fit), fit.estimate.values) if fit.converged else None


def worse(fit: Fit) -> list[Finding]:
    return worse_than_nominal(fit.unseen_mm, fit.errors.rival_mm, fit.spent, fit.unit)


def overfit(fit: Fit) -> list[Finding]:
    """Errors of records that did not train beside those that did; bad where the nominal arm they placed is as good.

    A fit that spends p of m equations leaves sqrt(1 - p/m) of the noise in records that train, and in others like them
    sqrt(1 + p / (m - p - 1)) times the noise [Breiman1983]. How much freedom a pose residual takes up is not known.
    """
    errors, arms = fit.errors, fit.problem.blueprint.arms
    if any(arm.residual is not None and arm.residual.is_learned for arm in arms.values()):
        return []
    trained = (errors.calibrated_mm if errors.at_rest_mm is None else errors.at_rest_mm)[fit.split.train]
    equations, freedom = fit.fitted.problem.equations(), fit.estimate.degrees_of_freedom
    judged, trained = fit.judged_mm[np.isfinite(fit.judged_mm)], trained[np.isfinite(trained)]
    if min(len(judged), len(trained)) < FEWEST_JUDGED or freedom <= 0:
        return []
    noise = float(np.median(trained)) * float(np.sqrt(max(equations, freedom) / freedom))
    after = float(np.median(judged))
    if after <= OVERFITTED * noise:
        return []
    text = f"Overfitted: records that did not train have an error of {after:.3g} {fit.unit}, {after / noise:.1f} times "
    text += f"what the training records lead one to expect ({noise:.3g} {fit.unit})."
    test = f"medians; {equations - freedom:.0f} of {equations} equations are spent on parameters; limit {OVERFITTED:g}"
    action = "Measure more poses, more different ones; free fewer parameters; or give priors."
    both = np.isfinite(fit.judged_mm) & np.isfinite(errors.rival_mm)
    gains = both.any() and np.mean(fit.judged_mm[both]) < np.mean(errors.rival_mm[both])
    return [Finding("warning" if gains else "bad", text, test, action)]


def weights(fit: Fit) -> list[Finding]:
    """Whether the declared noise gives better values than estimated variances do: where a pose is to be known and most
    of the residuals is the joints', by how far fits to halves have it apart."""
    fitted, estimated = fit.fitted, fit.of(by_halves)
    if fitted.components is None or fitted.as_declared is None:
        return []
    if estimated is not None and fitted.components.mostly_joints:
        declared = halves(fit.ready.training.weighted(fitted.weights), _inner(fit), fitted.as_declared)
        assert declared is not None
        return [f for name in estimated.apart for f in steadier_weights(name, estimated, declared, fit.unit)]
    if not len(fit.split.holdout):
        return []
    declared_mm = record_errors(fit.problem, fitted.as_declared) * _MM
    return worse_than_declared(fit.judged_mm, declared_mm, fit.unit)


WORSE, POWER = 0.005, 0.9  # Level of a loss against the nominal arm; share of losses of the size stated that is found
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
    """Which weights keep the pose of a measurement nearer between halves of the records, where joints err most: smaller
    residuals, which the pose takes up, are then no sign of a better pose."""
    ours, others = estimated.apart[name], declared.apart[name]
    seen = np.isfinite(ours).all(axis=1) & np.isfinite(others).all(axis=1)
    if seen.sum() < 2:
        return []
    more, parts = ours[seen] - others[seen], []
    for own in (estimated, declared):
        (mm, deg), error = np.mean(own.apart[name][seen], axis=0), np.mean(own.errors[seen])
        parts.append(f"{readable(float(mm))} mm and {readable(float(deg))} deg ({readable(float(error))} {unit})")
    for sign, action in ((1, _VALUES_BY_DECLARED), (-1, "Keep noise.estimate.")):
        mm, deg = sign * more.T
        if np.mean(mm) > max(_by_chance(mm), WORTHWHILE * np.mean(others[seen, 0])) and np.mean(deg) > 0:
            text = (
                f"{name}: its pose differs between halves of the records by {parts[0]} with estimated variances, by "
                f"{parts[1]} with the declared noise; in brackets the error of records by the fit to the other half, "
                "which is the joints' and does not rank poses."
            )
            test = f"{seen.sum()} divisions, paired differences, one-sided, 5 %, and 1 %"
            return [Finding("note", text, test, action)]
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
    count = np.count_nonzero(seen)
    if count < 2 or spent >= 1:
        return []
    after, before = float(np.mean(judged_mm[seen])), float(np.mean(nominal_mm[seen]))
    if after <= before:
        return []
    factor = 1 / np.sqrt(1 - spent)
    more = judged_mm[seen] - factor * nominal_mm[seen]
    chance, missed = stdtrit(count - 1, [1 - WORSE, POWER]) * np.std(more, ddof=1) / np.sqrt(count)
    which = f"on {count} records that did not train it: {readable(after)} {unit} on average, {readable(before)} of "
    which += "the nominal arm, placed by the records that trained as far as it may move."
    test = f"paired differences, one-sided, {100 * WORSE:g} %, beyond the {percent(factor - 1)} that so many "
    test += f"parameters make; {100 * POWER:g} % of losses of {readable(float(chance + missed))} {unit} would show"
    if np.mean(more) <= chance:
        action = "Nothing is gained by it on poses like these: keep the nominal arm, or measure more poses."
        return [Finding("note", f"No better than the nominal arm {which}", test, action)]
    action = "Do not use it. Look at what trained: too few postures, too much alike, or some of them wrong."
    return [Finding("bad", f"Worse than the nominal arm {which}", test, action)]


_BEYOND_NOISE = 0.025  # Level at which residuals are more than the declared noise
COMPARABLE = 2.0  # Variances, each less than so many times the other
_RESOLUTION = 1e-9  # Of steps, in units of the file: finer than readings of joints, coarser than floats
_NOISES = np.logspace(-4, 0, 41)  # What the instrument may leave beside the rounding, in shares of the variance left
UNSEEN = 0.2  # An error of a scale that is larger than this and would not show is said to be of any size
_HIDDEN = 0.5  # Where more than this share of what a payload does is left, the score tests of unstated loads see it
_LEAST_SHARE = 0.1  # A parameter that takes up less of it is not named


@dataclass(frozen=True)
class Rounding:
    step: float  # of which they are whole multiples (rad or m)
    unit: str  # in which it was sought
    joints: tuple[str, ...]  # whose commands seem to have been rounded, by channel
    leaves: float  # what it alone leaves, root mean square over records, in thousandths of the SI unit of errors
    residual: float  # what the fit leaves, likewise
    log_odds: float  # of this rounding beside even noise, against even noise alone


def rounding(fit: Fit) -> Rounding | None:
    """The likeliest rounding that explains what a fit leaves beyond the declared noise; None where none does. What
    other records predict of the residuals is no rounding."""
    if not fit.converged:
        return None
    outcome, train, estimate = fit.of(structure), fit.split.train, fit.estimate
    predicted = outcome.share if outcome is not None else 0.0
    problem = fit.few.subset(train).weighted(fit.fitted.weights)
    share = min(1.0, max(estimate.degrees_of_freedom, 1.0) / max(problem.equations(), 1))
    chosen = thinned(train)
    dataset, motion = fit.dataset.subset(chosen), fit.motion.subset(chosen)
    problem = problem.subset(thinned(np.arange(len(train))))
    rows = FitRows.of(problem, estimate)
    left = rows.residual[rows.by_record] / np.sqrt(share)
    count = int(np.count_nonzero(left))
    variance = float(np.sum(left**2)) / max(count, 1)
    if variance * share * count <= chdtri(max(share * count, 1.0), _BEYOND_NOISE):
        return None
    slopes = rows.columns([np.nan_to_num(slope).transpose(0, 2, 1) for slope in motion.slopes]) / np.sqrt(12)
    roundings = []
    for name, step, joints in _steps(problem, dataset, motion):
        errors = step * slopes[:, joints]
        own = np.where(left[:, :, None] == 0, 0.0, errors[rows.by_record])
        size = float(np.sum(own**2)) / count
        if (variance - 1) / COMPARABLE <= size <= COMPARABLE * (1 - predicted) * variance:
            squares = [np.mean(rows.errors(rows.residual) ** 2) / share]
            squares.append(np.mean(np.sum([rows.errors(column) ** 2 for column in errors.T], axis=0)))
            residual, leaves = (1000 * np.sqrt(squares)).tolist()
            channels = tuple(np.array(motion.channels)[joints].tolist())
            roundings.append(Rounding(step, name, channels, leaves, residual, _log_odds(left, own)))
    best = max(roundings, key=lambda one: one.log_odds, default=None)
    return None if best is None or best.log_odds < CLEAR else best


def _steps(problem: Problem, dataset: Dataset, motion: Motion) -> Iterator[tuple[str, float, Mask]]:
    """The step of each joint that moved, in each unit, and the joints that have multiples of it (rad or m)."""
    by_unit = dict[str, Array]()
    for place, channel in enumerate(motion.channels):
        arm, _, joint = channel.partition(".")
        command = dataset.column(channel)
        command = command[np.isfinite(command)]
        dimension = problem.blueprint.arms[arm].commanded[joint]
        for name in (display_unit(dimension).name, si_unit(dimension).name) if np.ptp(command) > 0 else ():
            whole = np.round(to_unit(command, name) / _RESOLUTION).astype(np.int64)
            by_unit.setdefault(name, np.zeros(len(motion.channels), dtype=np.int64))[place] = np.gcd.reduce(whole)
    for name, steps in by_unit.items():
        for step in np.unique(steps[steps > 0]):
            yield name, from_unit(float(step) * _RESOLUTION, name), (steps > 0) & (steps % step == 0)


def _log_odds(left: Array, errors: Array) -> float:
    """Of residuals (N x rows) from errors (N x rows x joints) beside even noise of a free variance, against such noise
    alone. Entries that are absent are 0."""
    sizes, axes = np.linalg.eigh(errors @ errors.transpose(0, 2, 1))
    sizes, squares = np.maximum(sizes, 0.0), np.einsum("nsr,ns->nr", axes, left) ** 2
    present = int(np.count_nonzero(left))
    variance = float(np.sum(left**2)) / present
    both = [
        np.sum(np.log(noise + sizes) + squares / (noise + sizes)) - (left.size - present) * np.log(noise)
        for noise in variance * _NOISES
    ]
    return float(present * (np.log(variance) + 1) - min(both)) / 2


def rounded(fit: Fit) -> list[Finding]:
    rounds = fit.of(rounding)
    if rounds is None:
        return []
    arms = list(dict.fromkeys(channel.partition(".")[0] for channel in rounds.joints))
    names = [channel if len(arms) > 1 else channel.partition(".")[2] for channel in rounds.joints]
    turning, step = unit(rounds.unit).dimension == "angle", digits(to_unit(rounds.step, rounds.unit), 4)
    text = f"All recorded {'angles' if turning else 'travels'} of {first_few(names, len(names))} are multiples of "
    text += f"{step} {rounds.unit}. If they were rounded while the arm stood between them, that alone leaves "
    text += f"{digits(rounds.leaves)} {fit.unit} (root mean square); the fit leaves {digits(rounds.residual)} "
    text += f"{fit.unit}, spread over poses and directions as errors of rounding are."
    test = f"variances within a factor of {COMPARABLE:g}; likelihood against even noise, over 20 to 1"
    action = "Record where the joints stand, with all digits."
    if turning:
        sd = digits(to_unit(rounds.step / np.sqrt(12), "deg"))
        keys = " and ".join(f"arms.{arm}.joint_noise_deg: {sd}" for arm in arms)
        action += f" If that cannot be, state what they are off by: {keys}."
    action += " If nothing was rounded, the joints miss their commands by as much."
    return [Finding("warning", text, test, action)]


@dataclass(frozen=True)
class HiddenPayload:
    sd: float  # of a mass at the payload's place, if it were free beside the parameters and their priors (kg)
    taken_up: float  # the share of what it does to the residuals that parameters make up for
    by: tuple[str, ...]  # those that make up most of it, the first most


def scale_deviation(
    problem: Problem, rows: FitRows, positions: Sequence[Array], noise_scale: float, values: Array
) -> float | None:
    """Standard deviation of an instrument's scale, or of all known distances', if it were free beside the parameters;
    None with neither. ``positions`` is what each factor should read (3 x N, or 0 x N; m) in the rows' records."""
    tied, raw = problem.tie_rows(values), [np.zeros((len(k.factor.noise), problem.count, 1)) for k in problem.kernels]
    for column, position in zip(raw, positions, strict=True):
        column[: len(position), :, 0] = position
    scaled = rows.columns(raw)
    if not any(map(len, positions)):
        if not len(tied.residual):
            return None
        # A distance of places is what it changes by as these grow in proportion [Euler's theorem].
        own = slice(len(rows.record_of), len(rows.record_of) + len(tied.residual))
        scaled[own, 0] = tied.jacobian @ values[list(problem.parameters.free_entries)] - tied.residual
    left = float(np.linalg.norm(rigid.apart_from(rows.slopes, scaled)))
    return noise_scale / left if left > 0 else float("inf")


def scale(fit: Fit) -> list[Finding]:
    """In which frame the answer is, which error of a scale would not show, and which held scale the data contradict."""
    if not fit.converged:
        return []
    (problem, rows), estimate, own = fit.of(sampled_rows), fit.estimate, fit.of(figure)
    read = predicted_positions(problem, estimate.values, fit.dataset.subset(thinned(fit.split.train)))
    instrument_sd = scale_deviation(problem, rows, read, estimate.noise_scale, estimate.values)

    def unseen(sd: float) -> str:
        if 2 * sd > UNSEEN:
            return "would not show in these data at all"
        return f"of up to {200 * sd:.2g} % would not show ({digits(2 * sd * own.reach_mm, 2)} mm at the arm's reach)"

    findings = []
    if instrument_sd is not None:
        text = f"The answer is in the instrument's frame: in it the arm stands {digits(own.moved_mm)} mm and "
        text += f"{digits(own.turned_deg, 2)} deg from where the configuration has it. An error of the instrument's "
        text += "scale "
        action = "Measure a known length with the instrument, if the scale matters."
        if not any(map(len, read)):  # no instrument has a scale, but known distances have
            text = "The arm's size rests on the known distances alone: 1 % of them is 1 % of all its lengths "
            text += f"({digits(0.01 * own.reach_mm, 2)} mm at the arm's reach), and an error of them "
            action = "Measure these distances again, by other means; or train on a longer one."
        test = "two standard deviations of a scale beside the parameters"
        findings.append(Finding("note", f"{text}{unseen(instrument_sd)}.", test, action))
    for one, check in fit.of(held_scales):
        contradicts = one.p_value < OFF
        put = f"records and priors put it {100 * one.off:+.2g} +- {100 * one.sd:.2g} % from there"
        text = f"{one.name} is held, {'although' if contradicts else 'and'} {put}."
        if 2 * one.sd > UNSEEN:
            text = f"{one.name} is held: an error of it {unseen(one.sd)}."
        elif not contradicts:
            text += f" An error {unseen(one.sd)}."
        test = f"the scale beside the free parameters, records as clusters, t, {100 * OFF:g} %"
        free = f"{check}; or free the scale with a prior."
        findings.append(Finding("warning" if contradicts else "note", text, test, free))
    return findings


def hidden_payload(fit: Fit) -> HiddenPayload | None:
    if not fit.converged:
        return None
    problem, motion, estimate = fit.few_acting, fit.motion.subset(fit.split.train), fit.estimate
    is_free = any("payload" in block.name for block in problem.parameters.free)
    if not motion.by_load or is_free or any(name.startswith("payload") for name in fit.dataset.channels):
        return None
    rows, at = FitRows.of(problem, estimate), LOADS.index("mass")
    mass = rows.columns([slope[:, at, :, None] for slope in motion.by_load])[:, 0]
    slopes = rows.slopes / np.maximum(np.linalg.norm(rows.slopes, axis=0), 1e-300)
    shares = np.linalg.lstsq(slopes, mass, rcond=1e-9)[0]
    left, whole = float(np.linalg.norm(mass - slopes @ shares)), float(np.linalg.norm(mass))
    if not whole or left > _HIDDEN * whole:
        return None
    names = problem.parameters.coordinate_names
    most = [i for i in np.argsort(-np.abs(shares[: len(names)])) if abs(shares[i]) > _LEAST_SHARE * whole]
    return HiddenPayload(estimate.noise_scale / max(left, 1e-300), 1 - left / whole, tuple(names[i] for i in most))


def payload(fit: Fit) -> list[Finding]:
    hidden = fit.of(hidden_payload)
    if hidden is None:
        return []
    text = f"A payload of up to {digits(2000 * hidden.sd, 2)} g that hangs at the tool without being stated would not "
    text += f"show: {first_few(hidden.by, MOST_NAMED)} would take up {100 * hidden.taken_up:.0f} % of what it does."
    test = "two standard deviations of a mass beside the free parameters"
    return [Finding("note", text, test, "Weigh what hangs on the tool, and state it: statics.payload_g.")]
