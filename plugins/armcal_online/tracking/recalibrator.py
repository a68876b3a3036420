"""A calibration kept true: takes one record at a time, and says what it made of it.

What comes out is a function of the calibration, the settings and the records alone, times and arrival included: no
clock, no chance, no thread takes part, so that a journal of the records reproduces every state to the last bit.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.calibration.calibration import Calibration
from armcal.errors import ArmcalError, ConfigError, DataError, Location
from armcal.estimate.online import Linearised, OnlineEstimator, normalised_innovation_squared
from armcal.estimate.validation import error_unit
from armcal.measure.reader import ReadRequest
from armcal.plugins import PluginRegistry, discover
from pydantic import ValidationError

from armcal_online.sources.incoming import Incoming
from armcal_online.tracking import events
from armcal_online.tracking.advance import Advance
from armcal_online.tracking.clock import Tick, ticked
from armcal_online.tracking.directions import Steps, find_steps, probing_poses
from armcal_online.tracking.evaluator import identity
from armcal_online.tracking.health import Health, many_outliers, nis_limit
from armcal_online.tracking.hypotheses import HypothesisFilter, Recent, hypotheses
from armcal_online.tracking.judge import Judge
from armcal_online.tracking.observer import Reading
from armcal_online.tracking.projection import most_likely
from armcal_online.tracking.sentences import EXPLAINED, Decision
from armcal_online.tracking.settings import RecalibrateSettings
from armcal_online.tracking.start import FilterSetup, filter_setup
from armcal_online.tracking.state import REMEMBERED, State
from armcal_online.tracking.updated import calibration_text, deviations
from armcal_online.tracking.what_if import of_errors, worth

_TOO_MANY = 1e-3
"""More outliers than chance makes with this probability are a reason to watch."""
_FARTHEST_TURN = 100.0
"""rad; a larger angle is an error of the data."""


class Recalibrator:
    """A session: mutable, and nothing but a ``State`` changes in it."""

    def __init__(
        self,
        calibration: Calibration,
        settings: RecalibrateSettings,
        estimator: OnlineEstimator,
        setup: FilterSetup,
        steps: Steps,
    ) -> None:
        self._calibration, self._settings, self._estimator = calibration, settings, estimator
        self._setup, self.steps = setup, steps
        hypothesis_filter = HypothesisFilter(setup.observer, estimator, setup.process_noise, settings.outliers)
        changes = hypotheses(setup.space, steps, settings.changes, setup.observer.size)
        self._judge = Judge(setup.space, steps, hypothesis_filter, changes, settings)
        self._advance = Advance(setup, estimator, settings.levels.window)
        self.state = State(setup.belief, setup.belief)

    @classmethod
    def begin(
        cls, calibration: Calibration, settings: RecalibrateSettings, registry: PluginRegistry | None = None
    ) -> Recalibrator:
        """A session at its calibration.

        Raises:
            ConfigError: settings are refused, or the calibration keeps no covariance.
            PluginError: no such estimator.
        """
        estimator = _estimator(settings, registry or discover())
        setup = filter_setup(calibration, settings, shares=estimator.window == 1)
        if estimator.window > 1 and setup.space.cones:
            raise ConfigError(
                "found an estimator that holds records back, and 3x3 compliances: together they may come to no answer.",
                where=Location("estimator.type"),
                hint="Take extended, which looks at each record again from where it leads.",
            )
        return cls(calibration, settings, estimator, setup, _steps(calibration, setup))

    @property
    def setup(self) -> FilterSetup:
        """What it stands on."""
        return self._setup

    @property
    def request(self) -> ReadRequest:
        """What its records may hold."""
        return self._setup.request

    @property
    def evaluator(self) -> dict[str, Any]:
        """What evaluates it: with the same, a replay gives the same bits."""
        return identity(self._setup.problem, self._estimator)

    @property
    def values(self) -> Array:
        """The most likely values within all bounds (all canonical entries)."""
        return most_likely(self._setup.space, self.state.belief)

    def take(self, incoming: Incoming, sequence: int) -> tuple[dict[str, Any], ...]:
        """Take one record; what came of it, as events.

        Raises:
            ProblemError: the numbers of the belief are no longer sound.
        """
        state, tick, why = self._admitted(incoming, sequence)
        readings = () if why else self._setup.observer.readings(incoming.channels, incoming.labels)
        if not why and not readings:
            why = "no measurement can use it: numbers are missing, or its group is none that the calibration found"
        if why:
            self.state = _counted(state, "ignored")
            return (events.ignored(incoming, self.state, why),)
        judged = self._judged(incoming, replace(state, clock=tick.clock), readings, self._passed(incoming, tick))
        if tick.note:
            judged = (events.noted(self.state, "clock", tick.note), *judged)
        return judged

    def _admitted(self, incoming: Incoming, sequence: int) -> tuple[State, Tick, str]:
        """The state with the record known, what its time means, and why it is passed over, if it is."""
        said = _said(incoming)
        state = replace(self.state, sequence=sequence)
        time = incoming.channels.get("time")
        time = time if time is not None and math.isfinite(time) else None
        tick = ticked(state.clock, time, incoming.arrived, self._settings.clock)
        if incoming.fault:
            return state, tick, incoming.fault
        if (incoming.record_id, said) in state.ids:
            return state, tick, "the same record came before"
        state = replace(state, ids=(*state.ids, (incoming.record_id, said))[-REMEMBERED:])
        if tick.stale:
            return replace(state, clock=tick.clock), tick, tick.stale
        state = replace(state, at=incoming.arrived if time is None else time)
        return state, tick, self._absurd(incoming)

    def _absurd(self, incoming: Incoming) -> str:
        """What no arm can do."""
        for arm in self._calibration.system.arms.values():
            for joint in arm.commanded:
                angle = incoming.channels.get(f"{arm.name}.{joint}", 0.0)
                if not abs(angle) < _FARTHEST_TURN:
                    return f"{arm.name}.{joint} is {angle:g} rad: no joint reaches that"
        bad = [name for name, value in incoming.channels.items() if math.isinf(value)]
        return f"{bad[0]} is not finite" if bad else ""

    def _passed(self, incoming: Incoming, tick: Tick) -> dict[str, float]:
        """How far this record is from the last, in each channel."""
        place = incoming.channels.get("sequence", math.nan)
        before = self.state.place
        if not math.isfinite(place):
            return {"time": tick.passed, "record": 1.0, "sequence": 1.0}
        return {"time": tick.passed, "record": 1.0, "sequence": 1e9 if before is None else abs(place - before)}

    def _judged(
        self, incoming: Incoming, state: State, readings: tuple[Reading, ...], passed: Mapping[str, float]
    ) -> tuple[dict[str, Any], ...]:
        process_noise, space = self._setup.process_noise, self._setup.space
        before = process_noise.faded(state.belief, passed)
        anchor = process_noise.faded(state.anchor, passed) if state.held else before
        place = incoming.channels.get("sequence", math.nan)
        state = replace(state, place=place if math.isfinite(place) else state.place)
        try:
            noise = self._setup.observer.joint_noise(space.inside(before.values(space)), readings)
            first = self._advance.seen(before, readings, noise).at(before.gaussian.mean)
        except ArmcalError as fault:
            self.state = _counted(replace(state, belief=before, anchor=anchor), "ignored")
            return (events.ignored(incoming, self.state, fault.message.rstrip(".")),)
        covariance = first.slope @ before.gaussian.covariance @ first.slope.T + first.noise
        nis, dof = normalised_innovation_squared(first.innovation, covariance), len(first.innovation)
        limit = nis_limit(dof, self._settings.gate.probability, self._setup.observer.freedom(readings))
        rejected = self._settings.gating == "on" and not nis <= limit
        recent = Recent(state.sequence, readings, noise, passed, before, rejected, nis, dof)
        if rejected:
            after = replace(state, belief=before, anchor=anchor)
        else:
            try:
                after = self._advance.after(replace(state, anchor=anchor), recent)
            except ArmcalError as fault:
                self.state = _counted(replace(state, belief=before, anchor=anchor), "ignored")
                return (events.ignored(incoming, self.state, fault.message.rstrip(".")),)
        after = _counted(after, "rejected" if rejected else "accepted")
        return self._concluded(incoming, after, recent, first, limit)

    def _concluded(
        self, incoming: Incoming, state: State, recent: Recent, first: Linearised, limit: float
    ) -> tuple[dict[str, Any], ...]:
        """Judge, and tell of it."""
        decisions: tuple[Decision, ...] = ()
        state = replace(state, recent=(*state.recent, recent)[-self._settings.gate.window :])
        odd = sum(each.rejected for each in state.recent)
        if self._settings.gating == "on":
            state, decisions = self._judge.after(state)
        health = self._health(state.health, recent, odd, first, decisions)
        told = [events.judged(incoming, state, recent, first, limit, self._setup)]
        told += [events.decided(state, decision) for decision in decisions if self._is_news(decision)]
        if health.level != self.state.health.level:
            told.append(events.level_changed(state, self.state.health.level, health))
        self.state = replace(state, health=health)
        every = self._settings.output.estimate_every_records
        if decisions or (state.counts["accepted"] % every == 0 and not recent.rejected):
            told.append(self._estimate())
        return tuple(told)

    def _is_news(self, decision: Decision) -> bool:
        """Whether it was not said at the record before."""
        if decision.kind in ("unexplained", "model_no_longer_fits"):
            return self.state.health.level != decision.level
        return True

    def _health(
        self, health: Health, recent: Recent, rejected: int, first: Linearised, decisions: Sequence[Decision]
    ) -> Health:
        """Health after a record; ``rejected`` counts those among the last ones."""
        for decision in decisions:
            if decision.kind in EXPLAINED and health.level != "lost":
                # What was suspected is explained now.
                health = Health(decision.level, 0, decision.sentence)
            else:
                health = health.troubled(decision.level, decision.sentence)
        if decisions:
            return health
        if recent.rejected:
            window = self._settings.gate.window
            odd = many_outliers(rejected, window, self._settings.outliers.fraction) < _TOO_MANY
            return health.troubled(
                "watch" if odd else "nominal", f"{rejected} of the last {window} records do not fit."
            )
        limit = self._settings.levels.tip_sd
        if limit is not None:
            forecast = first.slope @ recent.before.gaussian.covariance @ first.slope.T
            sd = math.sqrt(max(float(np.linalg.eigvalsh(forecast)[-1]), 0.0))
            if sd > limit:
                text = f"What is predicted is known to {1000 * sd:.2f} mm only; {1000 * limit:.2f} mm are tolerable."
                return health.troubled("watch", text)
        return health.calmed(self._settings.levels.calm)

    def _estimate(self) -> dict[str, Any]:
        space, belief = self._setup.space, self.state.belief
        names = [space.parameters.entry_names[i] for i in space.entries]
        numbers = zip(names, self.values[space.entries], deviations(space, belief), strict=True)
        return events.estimated(self.state, {name: [float(v), float(sd)] for name, v, sd in numbers})

    def started_event(self, resumed: bool) -> dict[str, Any]:
        """What there is to tell at the beginning."""
        parameters = self._estimate()["parameters"]
        return events.started(self.state, self._setup, self._settings, parameters, resumed, self.steps)

    def status(self) -> dict[str, Any]:
        """What there is to say now."""
        state = self.state
        return {
            "level": state.health.level,
            "why": state.health.sentence,
            "counts": dict(state.counts),
            "record_time": state.at,
            "parameters": self._estimate()["parameters"],
            "evaluator": self._setup.problem.backend,
        }

    def what_if(self, joints: Mapping[str, float]) -> dict[str, Any]:
        """How much a record at these joint angles (by channel, rad or m) would tell.

        Raises:
            DataError: joints are missing, or no measurement reads a single pose.
        """
        observer = self._setup.observer
        texts = [f"{a.name}.{j}" for a in self._calibration.system.arms.values() for j in a.commanded]
        missing = [name for name in texts if name not in joints]
        if missing:
            raise DataError(f"found no angle for {', '.join(missing)}.", hint="Give one for each joint.")
        belief = self.state.belief
        readings = observer.predicted(belief.origin, joints)
        if not readings:
            raise DataError(
                "no measurement reads a single pose.", hint="Only instruments foretell what they would tell."
            )
        seen = self._advance.seen(belief, readings, ()).at(belief.gaussian.mean)
        told = worth(self._setup.space, belief, seen)
        known = worth(self._setup.space, belief, of_errors(observer.problem, readings, seen)).deviation
        return {
            "bits": told.bits,
            f"prediction_sd_{error_unit(observer.problem)}": 1000 * known,
            "tells_most": dict(told.tells_most),
        }

    def snapshot(self) -> dict[str, Any]:
        """The state as JSON, to the last bit."""
        return self.state.kept()

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Take up a state.

        Raises:
            DataError: it is not one of this calibration with these settings.
        """
        try:
            state = State.of(snapshot)
        except (KeyError, TypeError, ValueError, AttributeError, IndexError) as fault:
            raise DataError(f"what the journal keeps is no state of a recalibration ({fault}).") from fault
        if len(state.belief.gaussian.mean) != self._setup.observer.size:
            raise DataError(
                f"the journal's state has {len(state.belief.gaussian.mean)} numbers, the calibration and its settings "
                f"ask for {self._setup.observer.size}.",
                hint="Replay with the calibration and settings of the journal.",
            )
        self.state = state

    def digest(self) -> str:
        """A hash of the state."""
        return self.state.digest()

    def calibration_text(self) -> str:
        """The updated calibration, as the text of its file."""
        state = self.state
        told = {
            "records": dict(state.counts),
            "sequence": state.sequence,
            "time_s": state.at,
            "level": state.health.level,
            "why": state.health.sentence,
        }
        return calibration_text(self._calibration, self._setup.space, state.belief, told)


def _estimator(settings: RecalibrateSettings, registry: PluginRegistry) -> OnlineEstimator:
    section = dict(settings.estimator)
    name = section.pop("type", None)
    if not isinstance(name, str):
        raise ConfigError("found no type for this estimator.", where=Location("estimator"), hint="Name one.")
    component = registry.find("online", name).load()
    try:
        built: OnlineEstimator = component(component.Settings.model_validate(section))
    except ValidationError as fault:
        first = fault.errors()[0]
        where = Location(".".join(["estimator", *map(str, first["loc"])]))
        raise ConfigError(f"{first['msg']}.", where=where, hint=f"See the settings of {name}.") from fault
    return built


def _steps(calibration: Calibration, setup: FilterSetup) -> Steps:
    """What the parameters can follow; nothing where no instrument reads a single pose."""
    poses = probing_poses(calibration.system.arms)
    conditions = {name: np.zeros(len(poses)) for arm in calibration.system.arms.values() for name in arm.conditions}
    commands = Dataset(poses.ids, {**poses.channels, **conditions, "payload": np.zeros(len(poses))})
    try:
        read, _ = calibration.predict(commands)
        return find_steps(setup.observer, setup.belief.origin, read, poses)
    except ArmcalError:
        return Steps((), (), {})


def _said(incoming: Incoming) -> str:
    """A hash of what a record says, where and when it arrived left out."""
    content = incoming.as_dict()
    said = [content["id"], content["channels"], content["labels"]]
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:12]


def _counted(state: State, what: str) -> State:
    return replace(state, counts={**state.counts, what: state.counts[what] + 1})
