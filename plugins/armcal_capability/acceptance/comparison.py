"""What was commanded beside what was attained, in one frame: where the instrument stood, stated or found."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from armcal.base.arrays import Array
from armcal.base.quaternions import nearest_turn, rotation_matrix
from armcal.diagnose.readings import check_reach
from armcal.errors import DataError, Location, NotConvergedError
from armcal.estimate.placing import placings
from armcal.estimate.start import BETTER, FAR, pose_words
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.rigid_alignment import FEWEST, Tools, alignments, undetermined
from armcal.problem.sighting import Sighting, sighting_of, tools_of
from armcal.report.numbers import plural
from scipy.spatial.transform import Rotation

from armcal_capability.acceptance.records import COMMANDED, COMMANDED_TURN, Visits
from armcal_capability.acceptance.subject import ArmToJudge
from armcal_capability.acceptance.suspects import moved_commands, refuse_strangers

FrameChoice = Literal["auto", "stated", "found"]
FRAMES = get_args(FrameChoice)
_COMPILED_FROM = 5000
_MM = 1000.0


@dataclass(frozen=True)
class Frame:
    """Where what is commanded and what is attained are compared.

    Attributes:
        aligned: whether these records placed the instrument, else the description or the calibration did.
        words: where the base is in the instrument's frame, and what was found beside it.
        fitted: how many numbers were found from the positions.
    """

    aligned: bool
    words: str
    fitted: int = 0


@dataclass(frozen=True)
class Comparison:
    """Commanded and attained poses of the measured target by one model of the arm (N records).

    Attributes:
        frame: in which they are.
        commanded, attained: positions (N x 3; m).
        turns: rotation vectors from the commanded to the attained orientation, in the frame's axes (N x 3; rad); None
            where only positions were measured.
        warnings: for the user.
    """

    frame: Frame
    commanded: Array
    attained: Array
    turns: Array | None
    warnings: tuple[str, ...] = ()

    @property
    def errors(self) -> Array:
        """Attained minus commanded positions (N x 3; m)."""
        return self.attained - self.commanded


def compare(subject: ArmToJudge, visits: Visits, choice: FrameChoice) -> Mapping[str, Comparison]:
    """The comparison by each model of the arm.

    Raises:
        DataError: positions of the records cannot be compared, or no frame can be found.
    """
    return {name: _compared(subject, name, visits, choice) for name in subject.models}


def _compared(subject: ArmToJudge, model: str, visits: Visits, choice: FrameChoice) -> Comparison:
    system, parameters, dataset = subject.system, subject.models[model], visits.dataset
    evaluator: Literal["auto", "interpreted"] = "interpreted" if len(dataset) < _COMPILED_FROM else "auto"
    problem = Problem.build(
        system.arms, system.measurements, parameters, system.environment, dataset, evaluator, groups={}
    )
    records = problem.records(dataset)
    where = Location(dataset.source)
    try:
        sighting = sighting_of(problem, records, dataset, 0, len(dataset))
        if sighting is None or len(sighting.chosen) < len(dataset):
            raise DataError(
                f"{subject.measurement[0]} does not read the position of a target in a frame in each record.",
                where=where,
                hint="Judge by a measurement tip_position or tip_pose, and leave out rows without positions.",
            )
        tools = tools_of(problem, parameters.nominal(), records[0], 0)
        strangers: tuple[str, ...] = ()
        if model == "nominal":
            if dataset.has(COMMANDED[0]):
                tools = replace(tools, places=dataset.stacked(COMMANDED))
            if dataset.has(COMMANDED_TURN[0]):
                quaternions = dataset.stacked(COMMANDED_TURN).T
                turned = np.array([rotation_matrix(q / np.linalg.norm(q)) for q in quaternions])
                tools = replace(tools, rotations=turned)
            reach = float(np.median(np.linalg.norm(tools.places, axis=0)))
            strangers = refuse_strangers(visits, sighting.measured.T, reach)
            strangers += moved_commands(visits, tools.places.T, sighting.measured.T)
        basis, axes = _basis(problem, records, sighting, choice)
        if basis is None:
            check_reach(problem, records, dataset)
    except NotConvergedError as fault:
        hint = "Check payload, gravity and compliances, and their units."
        raise DataError(f"the {model} arm has no equilibrium ({fault.message})", where=where, hint=hint) from fault
    compared = _as_stated(tools, sighting) if basis is None else _aligned(tools, sighting, basis, axes, where)
    return replace(compared, warnings=(*strangers, *(f"{model}: {text}" for text in compared.warnings)))


def _basis(
    problem: Problem, records: tuple[FactorRecords, ...], sighting: Sighting, choice: FrameChoice
) -> tuple[Array | None, bool]:
    """Directions (3 x k) along which the target is sought on the tool, and whether its turn is; None: all is stated."""
    if choice == "stated":
        return None, False
    if choice == "found":
        return np.eye(3), True
    placing, _ = placings(problem, records, sighting)
    if not placing.stands_anywhere:
        return None, False
    return placing.basis, bool(set(placing.target) - {name for name, _ in placing.shifts})


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
    return Comparison(Frame(False, words), tools.places.T, sighting.measured.T, turns, tuple(warnings))


def _aligned(tools: Tools, sighting: Sighting, basis: Array, axes: bool, where: Location) -> Comparison:
    """With the base, and the target along a basis, where the records themselves have them."""
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
    gauges = undetermined(tools, best, basis)
    fitted = 6 + basis.shape[1] - len(gauges)
    commanded = (tools.places + np.einsum("nij,j->in", tools.rotations, best.offset)).T
    words = f"found from these records: the described base frame at {pose_words(best)} in the instrument's frame"
    if basis.shape[1]:
        x, y, z = best.offset * _MM
        words += f", the target ({x:.2f}, {y:.2f}, {z:.2f}) mm from where it is stated on the tool"
    if gauges:
        ways = plural(len(gauges), "direction")
        words += f" (these poses leave open in {ways} which of base and target it is; that changes no figure)"
    turns = None
    if sighting.turned is not None:
        seen, mounted = best.turn.T @ sighting.turned, np.eye(3)
        if axes:
            mounted = nearest_turn(np.einsum("nji,njk->ik", tools.rotations, seen))
            a, b, c = Rotation.from_matrix(mounted).as_rotvec(degrees=True)
            words += f", turned by ({a:.2f}, {b:.2f}, {c:.2f}) deg"
        turns = _turns(tools.rotations @ mounted, seen)
    attained = best.back(sighting.measured).T
    return Comparison(Frame(True, words, fitted), commanded, attained, turns, _left_over(fitted, poses))


def _turns(commanded: Array, attained: Array) -> Array:
    """Rotation vectors (N x 3) from rotations to others (N x 3 x 3 each), in the frame's axes."""
    return np.asarray(Rotation.from_matrix(attained @ np.swapaxes(commanded, 1, 2)).as_rotvec())


def _left_over(fitted: int, poses: int) -> tuple[str, ...]:
    left = 1 - fitted / (3 * poses)
    if left > 0.75:
        return ()
    much = f"by about {100 * (1 - np.sqrt(left)):.0f} %" if left > 0 else "to nothing, whatever the arm does"
    return (
        f"{fitted} numbers of base and target were found from the {3 * poses} coordinates of {poses} poses, which "
        f"makes AP smaller, {much}. RP, AD, RD and vAP depend on it little or not at all. "
        "State the frame (--frame stated), or measure more poses.",
    )
