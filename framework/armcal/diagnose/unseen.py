"""What residuals may not show: an instrument's scale, one that a fit holds (a board's printed size), a payload, an arm
that is wrong away from its contacts.

Where lengths of the arm are free they grow with the scale and no residual shows it; only their priors do. Springs take
up a payload that nobody stated. So each is estimated beside the free parameters, to first order at the fit, and stated
with what would not show.

Joint angles that were rounded when they were recorded: the arm stood between them.

Where all recorded angles of some joints are whole multiples of one step, each may be off by up to half of it. Such
errors are carried to what is measured by the joints' slopes. What they would leave is compared with what is left: in
size and, by likelihood, in how it is spread over poses and directions. Servos that stand at whole commands leave less.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from armcal.arm.assembly import command_channels
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.base.units import digits, display_unit, from_unit, readable, si_unit, to_unit, unit
from armcal.diagnose.causes import OFF, held_scales, predicted_positions
from armcal.diagnose.checks import Finding, first_few
from armcal.diagnose.fit import Fit, FitRows, sampled_rows, thinned
from armcal.diagnose.gross import Figure, figure
from armcal.diagnose.residual_structure import CLEAR, structure
from armcal.estimate.estimator import Estimate
from armcal.estimate.identifiability import OF_PRIOR, determined_in_words
from armcal.planning.candidates import whitened_rows
from armcal.problem.problem import Problem
from armcal.problem.rigid_alignment import along, apart_from, tools, unseen_motions
from armcal.problem.variants import LOADS, Motion

LEVEL = 0.05
COMPARABLE = 2.0  # Variances, each less than so many times the other
_RESOLUTION = 1e-9
"""Of the steps that are looked for, in units of the file: finer than readings of joints, coarser than floats."""
_NOISES = np.logspace(-4, 0, 41)
"""What the instrument may leave beside the rounding, in shares of the variance that is left."""


@dataclass(frozen=True)
class Rounding:
    """Commands of joints that seem to have been rounded.

    Attributes:
        leaves: what the rounding alone leaves, root mean square over records, in thousandths of the SI unit of errors.
    """

    step: float  # of which they are whole multiples (rad or m)
    unit: str  # in which it was sought
    joints: tuple[str, ...]  # by channel
    leaves: float
    residual: float  # what the fit leaves, likewise
    log_odds: float  # of this rounding beside even noise, against even noise alone


def rounding(fit: Fit) -> Rounding | None:
    """The likeliest rounding that explains what a fit leaves beyond the declared noise; None where none does.

    What other records predict of the residuals is no rounding.
    """
    if not fit.converged:
        return None
    left, train, estimate = fit.of(structure), fit.split.train, fit.estimate
    predicted = left.share if left is not None else 0.0
    problem = fit.few.subset(train).weighted(fit.fitted.weights)
    dataset, motion = fit.ready.trained, fit.motion.subset(train)
    share = min(1.0, max(estimate.degrees_of_freedom, 1.0) / max(problem.equations(), 1))
    chosen = thinned(np.arange(len(dataset)))
    problem, dataset, motion = problem.subset(chosen), dataset.subset(chosen), motion.subset(chosen)
    rows = FitRows.of(problem, estimate)
    left = rows.residual[rows.by_record] / np.sqrt(share)
    count = int(np.count_nonzero(left))
    variance = float(np.sum(left**2)) / max(count, 1)
    if variance * share * count <= chdtri(max(share * count, 1.0), LEVEL / 2):
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
    """Of residuals (N x rows) from errors (N x rows x joints) beside even noise, against even noise alone.

    Both have one variance that is free, that of the even noise. Entries that are absent are 0.
    """
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
    text = (
        f"All recorded {'angles' if turning else 'travels'} of {first_few(names, len(names))} are multiples of {step} "
        f"{rounds.unit}. If they were rounded while the arm stood between them, that alone leaves "
        f"{digits(rounds.leaves)} {fit.unit} (root mean square); the fit leaves {digits(rounds.residual)} "
        f"{fit.unit}, spread over poses and directions as errors of rounding are."
    )
    test = f"variances within a factor of {COMPARABLE:g}; likelihood against even noise, over 20 to 1"
    action = "Record where the joints stand, with all digits."
    if turning:
        sd = digits(to_unit(rounds.step / np.sqrt(12), "deg"))
        keys = " and ".join(f"arms.{arm}.joint_noise_deg: {sd}" for arm in arms)
        action += f" If that cannot be, state what they are off by: {keys}."
    return [
        Finding("warning", text, test, f"{action} If nothing was rounded, the joints miss their commands by as much.")
    ]


UNSEEN = 0.2  # An error of a scale that is larger than this and would not show is said to be of any size
_HIDDEN = 0.5  # Where more than this share of what a payload does is left, the score tests of unstated loads see it
_LEAST_SHARE = 0.1  # A parameter that takes up less of it is not named
_MOST_NAMED = 3


@dataclass(frozen=True)
class HiddenPayload:
    """A mass at the payload's place."""

    sd: float  # its standard deviation if it were free beside the parameters and their priors (kg)
    taken_up: float  # the share of what it does to the residuals that parameters make up for
    by: tuple[str, ...]  # those that make up most of it, the first most


@dataclass(frozen=True)
class Elsewhere:
    """How well contacts determine the tool away from them, where their own errors say nothing."""

    rms_mm: float  # root mean square of the tool's distance from where it is predicted, for the parameters' uncertainty
    poses: int  # how many unseen poses were looked at
    up_to: str  # motions that were left out, because nothing that was measured sees them; empty where none were

    @property
    def in_words(self) -> str:
        return f"Away from the contacts the tool is known to {readable(self.rms_mm)} mm (root mean square)"


def scale_deviation(
    problem: Problem, rows: FitRows, positions: Sequence[Array], noise_scale: float, values: Array
) -> float | None:
    """Standard deviation of an instrument's scale, or of all known distances', if it were free beside the parameters.

    None with neither positions nor distances.

    Args:
        problem: of the fit.
        rows: of the fit, priors among them.
        positions: what each factor should read (3 x N, or 0 x N; m), in the same records.
        noise_scale: residuals in units of the declared noise.
        values: of the fit.
    """
    raw, tied = (
        [np.zeros((len(k.factor.noise), len(rows.by_record), 1)) for k in problem.kernels],
        problem.tie_rows(values),
    )
    for column, position in zip(raw, positions, strict=True):
        column[: len(position), :, 0] = position
    scaled = rows.columns(raw)
    if not any(map(len, positions)):
        if not len(tied.residual):
            return None
        # A distance of places is what it changes by as these grow in proportion [Euler's theorem].
        own = slice(len(rows.record_of), len(rows.record_of) + len(tied.residual))
        scaled[own, 0] = tied.jacobian @ values[list(problem.parameters.free_entries)] - tied.residual
    left = float(np.linalg.norm(apart_from(rows.slopes, scaled)))
    return noise_scale / left if left > 0 else float("inf")


def scale(fit: Fit) -> list[Finding]:
    """In which frame the answer is, which error of a scale would not show, and which held scale the data contradict."""
    if not fit.converged:
        return []
    (problem, rows), estimate, own = fit.of(sampled_rows), fit.estimate, fit.of(figure)
    read = predicted_positions(problem, estimate.values, fit.dataset.subset(thinned(fit.split.train)))
    instrument_sd = scale_deviation(problem, rows, read, estimate.noise_scale, estimate.values)
    findings, test = [], "two standard deviations of a scale beside the parameters"
    if instrument_sd is not None and not any(map(len, read)):  # no instrument has a scale, but known distances have
        text = (
            "The arm's size rests on the known distances alone: 1 % of them is 1 % of all its lengths "
            f"({digits(0.01 * own.reach_mm, 2)} mm at the arm's reach), and an error of them "
        )
        action = "Measure these distances again, by other means; or train on a longer one."
        findings.append(Finding("note", f"{text}{_unseen(instrument_sd, own)}.", test, action))
    elif instrument_sd is not None:
        text = (
            f"The answer is in the instrument's frame: in it the arm stands {digits(own.moved_mm)} mm and "
            f"{digits(own.turned_deg, 2)} deg from where the configuration has it. An error of the instrument's scale "
        )
        action = "Measure a known length with the instrument, if the scale matters."
        findings.append(Finding("note", f"{text}{_unseen(instrument_sd, own)}.", test, action))
    for one, check in fit.of(held_scales):
        contradicts = one.p_value < OFF
        put = f"records and priors put it {100 * one.off:+.2g} +- {100 * one.sd:.2g} % from there"
        text = f"{one.name} is held, {'although' if contradicts else 'and'} {put}."
        if 2 * one.sd > UNSEEN:
            text = f"{one.name} is held: an error of it {_unseen(one.sd, own)}."
        elif not contradicts:
            text += f" An error {_unseen(one.sd, own)}."
        test = f"the scale beside the free parameters, records as clusters, t, {100 * OFF:g} %"
        findings.append(
            Finding("warning" if contradicts else "note", text, test, f"{check}; or free the scale with a prior.")
        )
    return findings


def _unseen(sd: float, own: Figure) -> str:
    if 2 * sd > UNSEEN:
        return "would not show in these data at all"
    return f"of up to {200 * sd:.2g} % would not show ({digits(2 * sd * own.reach_mm, 2)} mm at the arm's reach)"


def hidden_payload(fit: Fit) -> HiddenPayload | None:
    """By a fit's weighted training records; None where no payload moves the arm, or records or parameters state it."""
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
    text = (
        f"A payload of up to {digits(2000 * hidden.sd, 2)} g that hangs at the tool without being stated would not "
        f"show: {first_few(hidden.by, _MOST_NAMED)} would take up {100 * hidden.taken_up:.0f} % of what it does."
    )
    test = "two standard deviations of a mass beside the free parameters"
    return [Finding("note", text, test, "Weigh what hangs on the tool, and state it: statics.payload_g.")]


def away(fit: Fit) -> list[Finding]:
    away = fit.of(elsewhere)
    if away is None:
        return []
    text = f"{away.in_words}: the error of contacts is only by how much postures at one place disagree."
    test = f"from the parameters' covariance, at {away.poses} poses of recorded joint positions"
    test += f", up to {away.up_to}" if away.up_to else ""
    action = "If that is too little: train on more places, farther apart, with the joints turned as far as they go."
    return [Finding("note", text, test, action)]


UNSEEN_POSES = 400  # That are looked at, of each kind
UP_TO_FRAMES = "where the base stands and which point of the tool is meant"
FEW_NAMED = 2  # So many combinations that only priors hold are named in the verdict; armcal identify names all
MOST_TOLD = 5
NEGLIGIBLE_SHARE = 0.1  # Of the typical error: what moves the tip by less than this does not matter to it
_MM = 1000.0


@dataclass(frozen=True)
class PriorsAlone:
    """What combinations that only priors hold do to the tip.

    Attributes:
        between_mm: the same at any pose: where joints stand between recorded positions too, approached from either
            recorded side.
    """

    worst_mm: float  # the largest standard deviation of the tip that they leave, over the poses looked at
    between_mm: float
    poses: int  # how many unseen poses of each kind were looked at


def unseen_poses(dataset: Dataset, channels: Sequence[str], between: bool = False) -> Dataset:
    """Poses that combine what single joints did in the records: a joint's command and approach are of one of them.

    ``between``: a joint stands anywhere between its recorded ends instead, approached as in any of its records.
    """
    random = np.random.default_rng(0)
    together = random.integers(0, len(dataset), UNSEEN_POSES)
    values = {name: column[together] for name, column in dataset.channels.items()}
    for channel in channels:
        arm, _, joint = channel.partition(".")
        known = np.flatnonzero(np.isfinite(dataset.column(channel)))  # of two arms one may not be recorded
        if not len(known):
            continue
        drawn = known[random.integers(0, len(known), UNSEEN_POSES)]
        for own in (channel, f"{arm}.approach.{joint}"):
            if dataset.has(own):
                values[own] = dataset.column(own)[drawn]
        if between:
            recorded = dataset.column(channel)[known]
            values[channel] = random.uniform(recorded.min(), recorded.max(), UNSEEN_POSES)
    return Dataset(tuple(str(i) for i in range(UNSEEN_POSES)), values)


def priors_alone(fit: Fit) -> PriorsAlone | None:
    """How far the tip at both kinds of ``unseen_poses`` depends on what priors hold.

    None where they hold nothing, or where nothing holds a parameter.
    """
    if not fit.converged or {*fit.estimate.sources.values()} in ({"data"}, set()):
        return None
    channels = [*command_channels(fit.problem.blueprint.arms)]
    at, between = (tip_by_priors(fit, unseen_poses(fit.ready.trained, channels, own)) for own in (False, True))
    if at is None or between is None:
        return None
    return PriorsAlone(at, max(at, between), UNSEEN_POSES)


def tip_by_priors(fit: Fit, poses: Dataset) -> float | None:
    """The largest standard deviation (mm) of the tip that is left by what priors hold; None: nothing holds a parameter.

    Of the directions in which data and priors are independent, those that keep as much of their prior's standard
    deviation as a parameter that it holds: the undetermined ones, and those of which the data says hardly more.
    """
    estimate = fit.estimate
    information, prior = estimate.square_root_information, estimate.parameters.prior_information()
    if "nothing" in estimate.sources.values():
        return None
    root = np.linalg.inv(information)
    share, directions = np.linalg.eigh(root.T @ (prior[:, None] * root))  # of what is known in each direction
    alone = (root @ directions[:, share > OF_PRIOR**2]).T / estimate.parameters.scales()
    if not len(alone):
        return 0.0
    moved = _tip_motions(fit.problem, estimate.values, poses, alone)
    return float(np.sqrt(np.max(np.einsum("trnk,trnk->tn", moved, moved)))) * _MM


def elsewhere(fit: Fit) -> Elsewhere | None:
    """How far tools at unseen poses are off for the parameters' uncertainty; None where no record is a contact."""
    if not fit.converged or not fit.problem.blueprint.groups:
        return None
    poses = unseen_poses(fit.ready.trained, [*command_channels(fit.problem.blueprint.arms)])
    return away_from_contacts(fit.problem, fit.estimate, poses)


def away_from_contacts(problem: Problem, estimate: Estimate, poses: Dataset) -> Elsewhere | None:
    scales = estimate.parameters.scales()
    of_arm = np.array([not block.nuisance for block in estimate.parameters.coordinate_blocks], dtype=bool)
    root = np.linalg.pinv(estimate.parameters.entries_jacobian(estimate.values) * scales)
    covariance = (root @ estimate.covariance @ root.T)[np.ix_(of_arm, of_arm)]
    sizes, vectors = np.linalg.eigh(covariance)
    kept = sizes > np.finfo(float).eps * sizes.max(initial=0.0)
    if not kept.any():
        return None
    directions = np.zeros((int(kept.sum()), len(scales)))
    directions[:, of_arm] = (vectors[:, kept] * np.sqrt(sizes[kept])).T
    moved = _tip_motions(problem, estimate.values, poses, directions)
    rms = float(np.sqrt(np.mean(np.sum(moved**2, axis=(1, 3))))) * _MM
    return Elsewhere(rms, len(poses), "" if _position_rows(problem) else UP_TO_FRAMES)


def _tip_motions(problem: Problem, values: Array, poses: Dataset, null: Array) -> Array:
    """How the tips (T, or the one position that is read) move along the directions (T x 3 x N x K; m)."""
    if rows := _position_rows(problem):
        noise = np.concatenate([kernel.factor.noise for kernel in problem.kernels])
        return np.asarray((whitened_rows(problem, values, poses)[rows] * noise[rows, None, None] @ null.T)[None])
    problem = problem.of(poses)  # nothing reads a position: of the tools, up to what no contact could see
    at, axes = tools(problem, values)
    moves = np.array([along(problem, values, direction).ravel() for direction in null]).T
    return apart_from(np.array(unseen_motions(at, axes)).T, moves).reshape(len(at), 3, -1, moves.shape[1])


def _position_rows(problem: Problem) -> list[int]:
    start = 0
    for kernel in problem.kernels:
        factor = kernel.factor
        if factor.position_channels and factor.dimensions[:3] == ("length",) * 3:
            return list(range(start, start + 3))
        start += len(factor.noise)
    return []


def determined(fit: Fit) -> list[Finding]:
    judged, plain = fit.judged_mm[np.isfinite(fit.judged_mm)], fit.before or fit  # a pose residual determines nothing
    alone, typical_mm = plain.of(priors_alone), np.median(judged) if len(judged) else None
    up_to = "" if alone is None or _position_rows(fit.problem) else UP_TO_FRAMES
    return [determined_finding(plain.estimate, alone, typical_mm, up_to)]


def determined_finding(
    estimate: Estimate, alone: PriorsAlone | None, typical_mm: float | None, up_to: str = ""
) -> Finding:
    sources, combinations = estimate.sources, estimate.identifiability.undetermined
    test = "rank of the Jacobian in typical scales"
    if not sources:
        text = "No parameter was free: the nominal model was judged, nothing was calibrated."
        return Finding("warning", text, test, "Free parameters: parameters.free.")
    text = determined_in_words(sources)
    if {*sources.values()} == {"data"}:
        return Finding("good", f"{text}.", test)
    test += f", and standard deviations of {100 * OF_PRIOR:g} % of the priors'"
    if combinations and (alone is None or len(combinations) <= FEW_NAMED):
        text += f" ({'; '.join(map(str, combinations[:MOST_TOLD]))})"
    if alone is None:
        return Finding("bad", f"{text}.", test, "Free fewer parameters, or measure what armcal identify asks for.")
    test = f"{test}; the tip at {alone.poses} poses of recorded joint positions, and at as many between them"
    test += f"; positions, not orientations, up to {up_to}, which nothing measured shows" if up_to else ""
    negligible = np.inf if typical_mm is None else NEGLIGIBLE_SHARE * typical_mm
    if alone.between_mm <= negligible:
        most = f"{alone.between_mm:.2g}" if alone.between_mm >= 0.001 else "0.001"
        text += f". The tip at unseen poses does not depend on them (at most {most} mm, 1 sd)."
        return Finding("note", text, test, "Nothing for the tip; armcal identify names them.")
    text += f". The tip at unseen poses depends on them, by up to {alone.between_mm:.2g} mm (1 sd)"
    action = "armcal identify names them, and armcal plan finds the poses that determine them."
    if alone.worst_mm <= negligible:
        text += ", where a joint stands between its recorded positions, or is approached from another side there"
        action = "Measure each joint between its recorded positions too, from both sides; armcal identify names them."
    return Finding("warning", f"{text}.", test, action)
