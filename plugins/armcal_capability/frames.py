"""What was commanded beside what was attained, in one frame: where the instrument stood, stated or found."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from armcal.base.arrays import Array
from armcal.base.quaternions import nearest_turn, rotation_matrix
from armcal.diagnose.readings import check_reach
from armcal.errors import DataError, Location, NotConvergedError
from armcal.estimate.start import BETTER, FAR, placings, pose_words
from armcal.problem.problem import Problem
from armcal.problem.rigid_alignment import FEWEST, Sighting, Tools, alignments, sighting_of, tools_of, undetermined
from armcal.report.numbers import plural
from scipy.spatial.transform import Rotation

from armcal_capability.visits import COMMANDED, COMMANDED_TURN, ArmToJudge, Visits, refuse_strangers

FrameChoice = Literal["auto", "stated", "found"]
FRAMES = get_args(FrameChoice)
_COMPILED_FROM = 5000
_MM = 1000.0


@dataclass(frozen=True)
class Comparison:
    """Commanded and attained poses of the measured target by one model of the arm (N records), in one frame."""

    words: str  # where the base is in the instrument's frame
    fitted: int  # how many numbers were found from the positions; 0: base and target are as stated
    commanded: Array  # N x 3; m
    attained: Array  # N x 3; m
    turns: Array | None  # rotation vectors from commanded to attained (N x 3; rad); None: only positions were measured
    warnings: tuple[str, ...] = ()

    @property
    def errors(self) -> Array:
        """Attained minus commanded positions (N x 3; m)."""
        return self.attained - self.commanded


def compare(subject: ArmToJudge, model: str, visits: Visits, choice: FrameChoice) -> Comparison:
    """The comparison by one model of the arm.

    Raises:
        DataError: positions of the records cannot be compared, or no frame can be found.
    """
    system, parameters, dataset = subject.system, subject.models[model], visits.dataset
    evaluator: Literal["auto", "interpreted"] = "interpreted" if len(dataset) < _COMPILED_FROM else "auto"
    problem = Problem.build(
        system.arms, system.measurements, parameters, system.environment, dataset, evaluator, groups={}
    )
    records, where = problem.records(dataset), Location(dataset.source)
    try:
        sighting = sighting_of(problem, records, dataset, 0, len(dataset))
        if sighting is None or len(sighting.chosen) < len(dataset):
            raise DataError(
                f"{next(iter(system.measurements))} does not read the position of a target in a frame in each record.",
                where=where,
                hint="Judge by a measurement tip_position or tip_pose, and leave out rows without positions.",
            )
        tools = tools_of(problem, parameters.nominal(), records[0], 0)
        if model == "nominal":
            tools = _stated(tools, visits)
            refuse_strangers(visits, sighting.measured.T, float(np.median(np.linalg.norm(tools.places, axis=0))))
        basis, is_turned = np.eye(3), True
        if choice == "auto":
            placing, _ = placings(problem, records, sighting)
            basis, is_turned = placing.basis, bool(set(placing.target) - {name for name, _ in placing.shifts})
        if choice == "found" or (choice == "auto" and placing.stands_anywhere):
            return _aligned(tools, sighting, basis, is_turned, where)
        check_reach(problem, records, dataset)
    except NotConvergedError as fault:
        hint = "Check payload, gravity and compliances, and their units."
        raise DataError(f"the {model} arm has no equilibrium ({fault.message})", where=where, hint=hint) from fault
    return _as_stated(tools, sighting)


def _stated(tools: Tools, visits: Visits) -> Tools:
    """With the commanded poses that the records state, where they do."""
    dataset, places, rotations = visits.dataset, tools.places, tools.rotations
    if dataset.has(COMMANDED[0]):
        places = dataset.stacked(COMMANDED)
    if dataset.has(COMMANDED_TURN[0]):
        rotations = np.array([rotation_matrix(q / np.linalg.norm(q)) for q in dataset.stacked(COMMANDED_TURN).T])
    return Tools(places, rotations)


def _as_stated(tools: Tools, sighting: Sighting) -> Comparison:
    """As the description has base and target; with a warning where the records have them elsewhere."""
    off, warnings = sighting.off(tools), []
    if off > FAR * sighting.size:
        ranked = alignments(tools, sighting.measured, np.zeros((3, 0)))
        if ranked and ranked[0].left * BETTER < off:
            warnings.append(
                f"typically {off * _MM:.3g} mm are between commanded and attained positions, and "
                f"{ranked[0].left * _MM:.3g} mm where the records themselves place the base, at "
                f"{pose_words(ranked[0])}. Either the arm is as far off, or the instrument's frame is not the stated "
                "one: then give --frame found."
            )
    words = "as stated: nothing was fitted to these records"
    turns = None if sighting.turned is None else _turns(tools.rotations, sighting.turned)
    return Comparison(words, 0, tools.places.T, sighting.measured.T, turns, tuple(warnings))


def _aligned(tools: Tools, sighting: Sighting, basis: Array, is_turned: bool, where: Location) -> Comparison:
    """With the base, and the target along a basis (3 x k) and turned on the tool, where the records have them."""
    poses = np.unique(np.round(tools.places, 4), axis=1).shape[1]
    ranked = alignments(tools, sighting.measured, basis, sighting.turned)
    if not ranked or poses < 3:
        raise DataError(
            f"found {len(sighting.chosen)} records of {plural(poses, 'pose')}, expected {FEWEST} of three or more: the "
            "instrument's frame cannot be found from fewer.",
            where=where,
            hint="Measure more poses, or state where the instrument is and give --frame stated.",
        )
    best = ranked[0]
    fitted = 6 + basis.shape[1] - len(undetermined(tools, best, basis))
    commanded = (tools.places + np.einsum("nij,j->in", tools.rotations, best.offset)).T
    words = f"found from these records: the described base frame at {pose_words(best)} in the instrument's frame"
    if basis.shape[1]:
        x, y, z = best.offset * _MM
        words += f", the target ({x:.2f}, {y:.2f}, {z:.2f}) mm from where it is stated on the tool"
    turns = None
    if sighting.turned is not None:
        seen, mounted = best.turn.T @ sighting.turned, np.eye(3)
        if is_turned:
            mounted = nearest_turn(np.einsum("nji,njk->ik", tools.rotations, seen))
            a, b, c = Rotation.from_matrix(mounted).as_rotvec(degrees=True)
            words += f", turned by ({a:.2f}, {b:.2f}, {c:.2f}) deg"
        turns = _turns(tools.rotations @ mounted, seen)
    warnings: tuple[str, ...] = ()
    remaining = 1 - fitted / (3 * poses)
    if remaining <= 0.75:
        much = f"by about {100 * (1 - np.sqrt(remaining)):.0f} %" if remaining > 0 else "to nothing, whatever it does"
        warnings = (
            f"{fitted} numbers of base and target were found from the {3 * poses} coordinates of {poses} poses, which "
            f"makes AP smaller, {much}. RP, AD, RD and vAP depend on it little or not at all. "
            "State the frame (--frame stated), or measure more poses.",
        )
    return Comparison(words, fitted, commanded, best.back(sighting.measured).T, turns, warnings)


def _turns(commanded: Array, attained: Array) -> Array:
    """Rotation vectors (N x 3) from rotations to others (N x 3 x 3 each), in the frame's axes."""
    return np.asarray(Rotation.from_matrix(attained @ np.swapaxes(commanded, 1, 2)).as_rotvec())
