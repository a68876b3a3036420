"""What is remarkable about a servo calibration beside its numbers, in sentences."""

import math
from collections.abc import Iterator

import numpy as np
from armcal.arm.servo import PulseTable

from armcal_bench.servo.fit import FittedServo
from armcal_bench.servo.outcome import Outcome

_SENSIBLE_HZ = (23e6, 27e6)
_FAR_CHANGE = 0.1
_SAG_WORTH = math.radians(0.1)


def is_usable(servo: FittedServo) -> bool:
    try:
        PulseTable(servo.angles, servo.pulses)
    except ValueError:
        return False
    return True


def findings(outcome: Outcome) -> list[str]:
    """A sentence each, of servos, zeros, boards and springs."""
    texts = [f"{joint}: the table is left as it was: {why}." for joint, why in outcome.silent.items()]
    for servo in outcome.fit.servos.values():
        texts += list(_of_servo(servo, outcome))
    if outcome.zero == "kept":
        texts.append("zeros: each servo's pulse at 0 deg was kept; the angles were measured from one another.")
    for board, clock in outcome.fit.clocks.items():
        if not any(servo.known.board == board for servo in outcome.fit.servos.values()):
            continue
        if board not in outcome.fit.oscillator_sds:
            texts.append(
                f"{board}: the oscillator cannot be found from tables that are not known, so it is left at "
                f"{clock.oscillator_hz / 1e6:.3f} MHz and the tables count by it. Angles are right all the same. To "
                "know the oscillator, measure a pulse (bench.servo.measured_pulses) or trust a table "
                "(bench.servo.trusted)."
            )
        if not _SENSIBLE_HZ[0] <= clock.oscillator_hz <= _SENSIBLE_HZ[1]:
            texts.append(
                f"{board}: an oscillator of {clock.oscillator_hz / 1e6:.2f} MHz is outside "
                f"{_SENSIBLE_HZ[0] / 1e6:.0f} to {_SENSIBLE_HZ[1] / 1e6:.0f} MHz: check what it was measured by."
            )
    return texts + _of_springs(outcome)


def _of_servo(servo: FittedServo, outcome: Outcome) -> Iterator[str]:
    joint = servo.known.joint
    if not is_usable(servo):
        yield (
            f"{joint}: the pulses found neither rise nor fall with the angle: the table is left as it was. "
            "Look at its linkage."
        )
        return
    before, after = (np.sign(pulses[-1] - pulses[0]) for pulses in (servo.known.table.pulses, servo.pulses))
    if before != after:
        yield (
            f"{joint}: the servo turns the other way than its table said, or the tracker's frame is left-handed: "
            "look which way it turns."
        )
    for angle, is_determined in zip(servo.angles, servo.determined, strict=True):
        beyond = max(servo.reach[0] - angle, angle - servo.reach[1])
        if not is_determined:
            yield f"{joint}: no measurement determines the pulse at {math.degrees(angle):g} deg; it is the stated one."
        elif beyond > math.radians(15):
            yield (
                f"{joint}: the pulse at {math.degrees(angle):g} deg is extrapolated linearly from "
                "the measured range, "
                f"{math.degrees(servo.reach[0]):.0f} to {math.degrees(servo.reach[1]):.0f} deg."
            )
    if before == after and _gain_change(servo) > _FAR_CHANGE:
        yield (
            f"{joint}: its pulses a degree differ from the stated ones by {100 * _gain_change(servo):.0f} %: is it the "
            "servo that was meant, and does the tracker follow this arm's tool?"
        )
    if servo.lag is None:
        yield f"{joint}: it was approached from one side only, so its backlash is not known."
    elif servo.lag < -3 * servo.lag_sd and servo.lag < -math.radians(0.05):
        over = -math.degrees(servo.lag)
        yield f"{joint}: it overshoots by {over:.2f} deg rather than lags: does it stand before it is measured?"
    if servo.scale > 3:
        yield (
            f"{joint}: the spread of the angles is {math.degrees(servo.scatter):.2f} deg, {servo.scale:.0f} times the "
            "stated one; the deviations are enlarged by that."
        )
    for outlier in servo.outliers:
        angle = math.degrees(outlier.angle)
        yield f"{joint}: the angle at {outlier.counts} counts ({angle:.1f} deg) lies far off and was set aside."


def _gain_change(servo: FittedServo) -> float:
    angles = np.array(servo.angles)
    stated, fitted = np.diff(servo.known.pulses_at(angles)), np.diff(servo.pulses)
    return float(np.max(np.abs(fitted / stated - 1.0)))


def _of_springs(outcome: Outcome) -> list[str]:
    tracked = [joint for joint, sweeps in outcome.sweeps.items() if sweeps.by is not None]
    if not tracked:
        return []
    if not any(outcome.sag_span.values()):
        return [
            "springs: the model has no deflection of the arm under its weight; the tables contain it. Give the springs "
            "their compliances, or bench.servo.sag: fitted."
        ]
    worst = max(outcome.sag_span, key=lambda joint: outcome.sag_span[joint])
    if outcome.sag_span[worst] < _SAG_WORTH:
        return []
    how = "found with the tables" if outcome.compliances or outcome.fit.undetermined else "the model's"
    return [
        f"springs: over a sweep they turn the tool by up to {math.degrees(outcome.sag_span[worst]):.1f} deg ({worst}); "
        f"that is taken out by compliances that are {how}."
    ]
