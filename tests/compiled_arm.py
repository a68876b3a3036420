"""Exported C code, compiled with every warning an error and called from here."""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path

import numpy as np
from armcal.calibration.exporter import Exported, ExportRequest
from armcal.functions.compiler import find_compiler
from armcal_export.c_code import CExporter, CExportSettings

FLAGS = ["-std=c99", "-O0", "-Wall", "-Wextra", "-Werror", "-pedantic"]
DONE, NOT_SETTLED, NOT_REACHED = 0, 1, 2
POSITION, POSE = 1, 2


class CompiledArm:
    """The functions of the code as methods; arrays of one pose."""

    def __init__(self, request: ExportRequest, folder: Path, **settings) -> None:
        self.exported: Exported = CExporter(CExportSettings(prefix="lrm", **settings)).export(request)
        self.expression = request.expression(settings.get("conditions", ()))
        write(self.exported, request.out, folder)
        library = folder / "arm.so"
        command = [str(find_compiler()), *FLAGS, "-fPIC", "-shared", "-o", str(library), request.out, "-lm"]
        subprocess.run(command, cwd=folder, check=True)
        self.library = ctypes.CDLL(str(library))
        self.n = len(self.expression.joints)
        self.states = max(1, self.expression.state.numel())
        self.lower, self.upper = (self._constants(f"lrm_{end}") for end in ("lower", "upper"))
        conditions = len(self.expression.channels) - 2 * self.n - 13
        self._record = ctypes.c_double * (2 * self.n + 13 + conditions)
        if self.expression.servos:
            self.library.lrm_counts.restype, self.library.lrm_set_angle.restype = ctypes.c_long, ctypes.c_double
            self.library.lrm_counts.argtypes = (ctypes.c_int, ctypes.c_double)
            self.library.lrm_set_angle.argtypes = (ctypes.c_int, ctypes.c_long)

    def defaults(self) -> np.ndarray:
        """The record that the code begins with."""
        return np.array(self._record.in_dll(self.library, "lrm_defaults"))

    def forward(self, record, state=None):
        """Status, base_T_tool (3 x 4), state."""
        pose, state = np.full(12, np.nan), self._state(state)
        status = self.library.lrm_forward(_at(_given(record)), _at(state), _at(pose))
        return status, pose.reshape(3, 4), state

    def jacobian(self, record):
        """Status, base_T_tool, Jacobian (6 x n)."""
        pose, state, found = np.full(12, np.nan), self._state(None), np.full(6 * self.n, np.nan)
        status = self.library.lrm_jacobian(_at(_given(record)), _at(state), _at(pose), _at(found))
        return status, pose.reshape(3, 4), found.reshape(6, self.n)

    def efforts(self, record):
        """Status, efforts of all joints of the chain."""
        found, state = np.full(len(self.expression.arm.joint_names), np.nan), self._state(None)
        status = self.library.lrm_efforts(_at(_given(record)), _at(state), _at(found))
        return status, found

    def compensate(self, record, target, kind=POSE, steps=50, tolerance=(1e-9, 1e-9)):
        """Status, commands, (distance, turn, steps)."""
        told, outcome, state = _given(record), _Outcome(), self._state(None)
        wanted = _Target(kind, (ctypes.c_double * 12)(*np.ravel(target)), *tolerance)
        status = self.library.lrm_compensate(_at(told), _at(state), ctypes.byref(wanted), steps, ctypes.byref(outcome))
        return status, told[: self.n], outcome

    def step(self, record, target, damping, kind=POSE):
        """Status, commands, outcome."""
        told, outcome, state = _given(record), _Outcome(), self._state(None)
        wanted = _Target(kind, (ctypes.c_double * 12)(*np.ravel(target)), 1e-9, 1e-9)
        call = self.library.lrm_step
        status = call(_at(told), _at(state), ctypes.byref(wanted), ctypes.c_double(damping), ctypes.byref(outcome))
        return status, told[: self.n], outcome

    def _state(self, state):
        return np.zeros(self.states) if state is None else np.array(state, dtype=float)

    def _constants(self, name):
        return np.array((ctypes.c_double * self.n).in_dll(self.library, name))


class _Target(ctypes.Structure):
    _fields_ = (
        ("kind", ctypes.c_int),
        ("base_T_tool", ctypes.c_double * 12),
        ("tolerance_m", ctypes.c_double),
        ("tolerance_rad", ctypes.c_double),
    )


class _Outcome(ctypes.Structure):
    _fields_ = (("distance_m", ctypes.c_double), ("turn_rad", ctypes.c_double), ("steps", ctypes.c_int))


def write(exported: Exported, out: str, folder: Path) -> None:
    """The files of an export."""
    for name, content in {out: exported.content, **exported.companions}.items():
        (folder / name).write_bytes(content)


def _given(record) -> np.ndarray:
    return np.array(record, dtype=float)


def _at(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
