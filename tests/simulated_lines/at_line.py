"""A plugin's file: benches at real lines, for tests that need bytes."""

import sys
from pathlib import Path

from armcal.hooks import Register, hookimpl

if (_root := str(Path(__file__).resolve().parents[2])) not in sys.path:
    sys.path.append(_root)


@hookimpl
def armcal_register_benches(register: Register) -> None:
    register("servo_bench_at_line", "tests.simulated_lines.servo_bench:ServoBenchAtLine", "a servo board at a pty")
    register("bus_bench_at_line", "tests.simulated_lines.bus_bench:BusBenchAtLine", "smart servos on a bus at a pty")
