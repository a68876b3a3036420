"""The test program that goes with the C code."""

from __future__ import annotations

from collections.abc import Mapping

from armcal.base.domains import Array
from armcal.calibration.tool_expression import ToolExpression

from armcal_export.c_template import filled
from armcal_export.c_writer import c_number
from armcal_export.reference import Reference

TOLERANCE = 1e-12
"""m, and entries of rotation matrices."""


def test_source(e: ToolExpression, reference: Reference, prefix: str, places: Mapping[str, str]) -> str:
    """The program with armcal's own answers in it."""
    cases = zip(reference.records, reference.base_T_tool, reference.efforts, strict=True)
    rows = [
        f"  {{{input_row(e, list(record))},\n   {_listed(pose.ravel())},\n   {_listed(efforts)}}}"
        for record, pose, efforts in cases
    ]
    filling = {"cases": str(len(rows)), "case_rows": ",\n".join(rows), "tolerance": repr(TOLERANCE)}
    return filled("arm_test.c.in", prefix, **{**places, **filling})


def input_row(e: ToolExpression, record: list[float]) -> str:
    """A record as the initial value of an arm_input."""
    n, sizes = len(e.joints), (3, 1, 3, 3, 3)
    rows, start = [_listed(record[:n]), _listed(record[n : 2 * n])], 2 * n
    for size in sizes:
        part = record[start : start + size]
        rows.append(_listed(part) if size > 1 else c_number(part[0]))
        start += size
    if len(record) > start:
        rows.append(_listed(record[start:]))
    return "{" + ", ".join(rows) + "}"


def _listed(numbers: Array | list[float]) -> str:
    return "{" + ", ".join(c_number(number) for number in numbers) + "}"
