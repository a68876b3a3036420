"""A calibration's file made ready to answer: read, checked, built and warmed up, before anybody waits for it."""

import gc
import json
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import lost_calibration
from armcal.calibration.compensation.request import Options
from armcal.calibration.recorded_range import PAYLOAD, RecordedRange
from armcal.errors import ConfigError, InputError, Location

from armcal_serve.answering import Answerer
from armcal_serve.order import Order
from armcal_serve.protocol import CalibrationTag
from armcal_serve.served_arm import TEMPERATURE, TEMPERATURE_KEY, ServedArm

_TRIES = 20
_LONGEST_S = 1.0
"""Requests of each kind before the first real one, and how long they may take (s): caches are filled by them."""
_ORDINARY_C = 20.0


def loaded(order: Order, data: bytes) -> Answerer:
    """The answerer of a calibration's bytes.

    Raises:
        ArmcalError: they are no calibration, one of another arm, or one that cannot be used.
    """
    calibration = Calibration.load(order.shown, accept=order.accept or order.sequence > 1, content=data)
    calibration_file = calibration.record
    identity = calibration_file.identity.get("arm", "")
    if order.arm and identity != order.arm:
        raise ConfigError(
            f"it is of another arm ({identity[:12]}, expected {order.arm[:12]}).",
            where=Location(order.shown),
            hint="Put a calibration of the same arm there, or start a server of its own for this one.",
        )
    sequence = (calibration_file.recalibrated or {}).get("sequence")
    tag: CalibrationTag = {
        "sequence": order.sequence,
        "created": calibration_file.created,
        "sha256": order.sha256,
        "arm": identity,
        "recalibrated": sequence if isinstance(sequence, int) else None,
        "level": calibration_file.level,
    }
    answerer = Answerer({name: _arm(calibration, name, order) for name in calibration.system.arms}, tag)
    for arm in answerer.arms.values():
        _warm_up(answerer, arm, {})
        if arm.heated is not None:
            with suppress(InputError):  # what is ordinary elsewhere may be too hot for this arm
                _warm_up(answerer, arm, {TEMPERATURE_KEY: _ORDINARY_C})
    gc.collect()
    gc.freeze()
    lost = calibration_file.level == "lost" and not order.accept
    return replace(answerer, fault=lost_calibration(calibration_file, order.shown)) if lost else answerer


def _arm(calibration: Calibration, name: str, order: Order) -> ServedArm:
    arm, statics = calibration.system.arms[name], calibration.system.statics
    joints = tuple(arm.commanded)
    unserved = [
        f"{condition.name} (effect {name}.{effect})"
        for effect, condition in arm.declared
        if condition.name != TEMPERATURE
    ]
    if unserved:
        raise ConfigError(
            f"the arm {name} changes with {', '.join(unserved)}, which a request cannot state.",
            where=Location(order.shown),
            hint="Use armcal predict or armcal compensate, which read it from a column.",
        )
    limits: Mapping[str, tuple[float, float]] = {}
    allowed = None
    if order.within:
        from armcal.plugins import discover  # late: not needed without limits
        from armcal.run.plan_poses import workspace_of

        space = workspace_of(Path(order.within), joints, discover())
        limits, allowed = space.limits, space.allowed
    options = Options(limits=limits, redundancy=order.redundancy)
    try:
        # A request never waits for a compiler, so the compiler is waited for here.
        parts: dict[str, Any] = {"allowed": allowed, "choice": order.evaluator, "point": order.point}
        compensator, heated = calibration.compensator(name, options, **parts), None
        if TEMPERATURE in arm.conditions:
            heated = calibration.compensator(name, options, (TEMPERATURE,), **parts)
    except ValueError as fault:
        hint = "Correct the limits in the plan."
        raise ConfigError(f"{fault}.", where=Location(order.within or order.shown), hint=hint) from fault
    needs_payload = arm.depends_on_payload and statics.payload is None
    kept, recorded = calibration.record.prediction, None
    if kept is not None and kept.ranges:
        is_known = needs_payload or statics.payload is not None
        ranges = {channel: ends for channel, ends in kept.ranges.items() if channel != PAYLOAD or is_known}
        recorded = RecordedRange.of(ranges, [*(f"{name}.{joint}" for joint in joints), PAYLOAD], {name: arm})
    return ServedArm(name, dict(arm.commanded), compensator, needs_payload, heated, order.point, recorded)


def _warm_up(answerer: Answerer, arm: ServedArm, acting: Mapping[str, float]) -> None:
    """Answer requests of every kind, several times.

    Raises:
        InputError: the arm cannot even be predicted.
    """
    began = time.monotonic()
    for i in range(_TRIES):
        posture = {"joints": arm.written([0.05 * (k + 1) + 0.01 * i for k in range(len(arm.joints))], "rad")}
        answer = _answer(answerer, arm, {"do": "forward", **posture, **acting})
        if not answer["ok"]:
            raise InputError(f"the arm {arm.name} cannot be predicted: {answer['error']}", hint=answer["hint"])
        tool = answer["tools"][0]
        for target in (tool, {"position_mm": tool["position_mm"]}):
            for path in (False, True):
                _answer(answerer, arm, {"do": "compensate", "targets": target, "path": path, **acting})
        _answer(answerer, arm, {"do": "compensate", "targets": tool, "start_joints": posture["joints"], **acting})
        if time.monotonic() - began > _LONGEST_S:
            break


def _answer(answerer: Answerer, arm: ServedArm, request: Mapping[str, Any]) -> dict[str, Any]:
    line = json.dumps({**request, "arm": arm.name, "payload_g": 0})
    return dict(json.loads(answerer.answer(line.encode(), 0.0)))
