"""Checks on pose residuals: what they learn, and what they say of poses that they did not see."""

import casadi as ca
import numpy as np

from armcal.arm.pose_residual import OF_TOOL, SURROUNDINGS, ModelErrors, PoseResidual, Postures
from armcal.base.arrays import Array
from armcal.testing.expressions import expect_only, expect_repeated
from armcal.testing.results import Recorder, expect
from armcal.testing.settings_checks import Subject

JOINTS = ("q1", "q2", "q3")
_SIZE = len(OF_TOOL) + len(JOINTS)
_COUNT = 240
_NOISE_M = 1e-4


def check_residual(record: Recorder, subject: Subject) -> None:
    """Everything that a run asks of a pose residual, on joints q1, q2 and q3."""
    with record.needed(f"it builds for the joints {', '.join(JOINTS)}"):
        residual: PoseResidual = subject.build(JOINTS)
    with record.needed("it derives from armcal.PoseResidual"):
        expect(isinstance(residual, PoseResidual), f"found {type(residual).__name__}, expected a PoseResidual")
    with record.check("it has learned nothing before it was shown records"):
        expect(not residual.is_learned, "found that it corrects something")
    with record.check("it learns nothing from a few records"):
        expect(residual.learned(_errors(2)) is None, "found that it learned from 2 records")
    with record.needed("it learns an error of a joint"):
        learned = residual.learned(_errors(_COUNT))
        expect(learned is not None and learned.is_learned, f"found that it learned nothing from {_COUNT} records")
    assert learned is not None
    unseen = _errors(2 * _COUNT).postures.subset(slice(_COUNT, None))
    with record.needed("it gives a correction of the tool and of each joint"):
        shape = learned.corrections(unseen).shape
        expect(shape == (_SIZE, _COUNT), f"found {shape}, expected {_SIZE} x {_COUNT}")
    with record.check("what it learned makes unseen errors smaller"):
        before, after = _left(unseen, None), _left(unseen, learned)
        expect(after < 0.7 * before, f"found {after:.3g} m, without it {before:.3g} m")
    with record.check("its expression depends on commands, approaches and surroundings alone"):
        given = [ca.SX.sym(name, len(JOINTS)) for name in ("commands", "approaches")]
        around = {name: ca.SX.sym(name) for name in SURROUNDINGS}
        expect_only(learned.correction(given[0], given[1], around), [*given, *around.values()])
    with record.check("its deviations are finite, and larger away from what it learned"):
        near, far = (learned.deviations(own) for own in (unseen, _away(unseen)))
        expect(bool(np.isfinite(near).all() and np.isfinite(far).all()), "found deviations that are not finite")
        expect(bool((near >= 0).all()), "found deviations below zero")
        expect(float(np.linalg.norm(far)) > float(np.linalg.norm(near)), "found that they do not grow")
    with record.check("it corrects nothing beyond the commands that it learned from"):
        turned = Postures(unseen.commands + 2 * np.pi, unseen.approaches)
        expect(not learned.corrections(turned).any(), "found corrections there")
    with record.check("what it learned is kept in its settings"):
        again = type(learned)(type(learned.settings).model_validate(learned.settings.to_config()), JOINTS)
        expect_repeated(lambda made: made.corrections(unseen), learned, again)
        expect_repeated(lambda made: made.deviations(unseen), learned, again)
    with record.check("it learns the same each time"):
        other = residual.learned(_errors(_COUNT))
        expect(other is not None, "found that it learned nothing the second time")
        assert other is not None
        same = np.array_equal(other.corrections(unseen), learned.corrections(unseen))
        expect(same, "found other corrections the second time")


def _truth(commands: Array) -> Array:
    """The error of joint q2 (rad), of which the tool sees 0.3 m."""
    return np.asarray(2e-3 * np.sin(2 * commands[1]))


def _errors(count: int) -> ModelErrors:
    random = np.random.default_rng(5)
    commands = random.uniform(-2, 2, (len(JOINTS), count))
    slopes = np.zeros((count, 3, _SIZE))
    slopes[:, :, :3] = -np.eye(3)
    slopes[:, :, len(OF_TOOL) :] = -_levers(commands)
    left = _levers(commands)[:, :, 1] * _truth(commands)[:, None] + random.normal(0, _NOISE_M, (count, 3))
    postures = Postures(commands, np.zeros_like(commands))
    return ModelErrors(postures, ("angle",) * len(JOINTS), left / _NOISE_M, slopes / _NOISE_M, 3)


def _levers(commands: Array) -> Array:
    """How a tool moves with each joint (N x 3 x joints; m/rad)."""
    levers = np.zeros((commands.shape[1], 3, len(JOINTS)))
    for joint, command in enumerate(commands):
        levers[:, joint] = 0.3 * np.eye(3)[(joint + 1) % 3]
        levers[:, joint, joint] = 0.1 * np.cos(command)
    return levers


def _away(postures: Postures) -> Postures:
    return Postures(postures.commands + np.pi, postures.approaches)


def _left(postures: Postures, learned: PoseResidual | None) -> float:
    levers = _levers(postures.commands)
    left = levers[:, :, 1] * _truth(postures.commands)[:, None]
    if learned is not None:
        corrections = learned.corrections(postures)
        left = left - corrections[:3].T - np.einsum("nij,jn->ni", levers, corrections[len(OF_TOOL) :])
    return float(np.sqrt(np.mean(left**2)))
