"""What authors of plugins do wrong: each ends in one sentence that names file, method, what was found and expected."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from importlib.util import find_spec, module_from_spec
from pathlib import Path

import pytest
from armcal import plugins, use_plugins
from armcal.cli.main import cli
from armcal.errors import PluginError
from armcal.plugins import blaming

IMPORTS = """import math

import casadi as ca
from armcal import Channel, Instrument, InstrumentSettings, JointEffect, Length, Spring, hookimpl, scalar

"""
EFFECT = (
    IMPORTS
    + """
class E(JointEffect):
    def parameters(self):
        return [scalar(f"s{joint}", "rad", 0.0, 0.01) for joint in self.joints]

    def displacement(self, command, values):
        s = values["s2"]
        return s * ca.sin(command.commanded) if command.joint == 2 else 0

    def springs(self, values):
        return ()


@hookimpl
def armcal_register_effects(register):
    register("mine", E, "")
"""
)
GAUGE = (
    IMPORTS
    + """
class G(Instrument):
    def channels(self):
        return [Channel("r", "length")]

    def outputs(self, arms, values):
        return {"r": ca.norm_2(self.base_T_tool(arms).translation)}

    def noise(self):
        return (1e-4,)


@hookimpl
def armcal_register_measurements(register):
    register("mine", G, "")
"""
)
MOVED, NO_SPRINGS, DECLARED = "s * ca.sin(command.commanded)", "return ()", 'scalar(f"s{joint}", "rad", 0.0, 0.01)'
LAW = "lambda load, command: values['s2'] * load"

EFFECTS = {  # what stands in the place of what, and what the sentence says
    "another name": (MOVED, "s * command.angle", "E.displacement raised AttributeError: .* has no attribute 'angle'"),
    "unknown parameter": ('"s2"', '"k2"', "E.displacement .*found no parameter 'k2', expected one of s1, s2"),
    "a list": (MOVED, "[s]", r"E.displacement returned \[SX\(values\)\], expected one number or expression"),
    "a vector": (MOVED, "ca.vertcat(s, s)", "E.displacement returned 2 x 1 numbers, expected one number"),
    "no return": ("return s *", "s *", "E.displacement returned None, expected one number"),
    "not a number": (MOVED, "s * ca.sqrt(-9 - command.commanded ** 2)", "E.displacement returned nan for q2 comm.* 1"),
    "of math": (MOVED, "s * math.sin(command.commanded)", "E.displacement returned nan for q2 commanded to"),
    "no slope": (MOVED, "ca.sqrt(s)", "derivative of the residuals by arm.mine.s2 is no number"),
    "if": (MOVED, "s if command.commanded > 0 else -s", "E.displacement raised RuntimeError: .*Choose by casadi.if_el"),
    "an exit": (MOVED, "exit('bye')", "E.displacement raised SystemExit: bye. To check it by itself"),
    "arguments": ("command, values", "command", r"E.displacement\(\) takes 2 positional arguments but 3 were given"),
    "degrees": ('"rad"', '"deg"', "E.parameters returned the unit 'deg' of 's1', expected rad: parameters are held"),
    "no unit": ('"rad"', '"radians"', "E.parameters returned the unit 'radians' of 's1', expected one of m, rad, kg"),
    "no scale": ("0.01", "0", "E.parameters returned nominal 0.0 and scale 0 of 's1', expected numbers, and a scale"),
    "nominal NaN": ("0.0,", "math.nan,", "E.parameters returned nominal nan and scale 0.01 of 's1', expected numbers"),
    "one name": ('f"s{joint}"', '"s2"', "E.parameters returned two parameters called 's2', expected names that differ"),
    "a dot": ('f"s{joint}"', 'f"s.{joint}"', "E.parameters returned the name 's.1', expected one without spaces, dots"),
    "a text": (DECLARED, "'s2'", "E.parameters returned .'s2', .*, expected a sequence of ParameterBl"),
    "none": ("return [", "[", "E.parameters returned None, expected a sequence of ParameterBlock"),
    "no springs": (NO_SPRINGS, "pass", "E.springs returned None, expected a sequence of Spring"),
    "no such site": (NO_SPRINGS, f"return [Spring(9, (), {LAW})]", "E.springs returned a spring at the site 9, expec"),
    "a direction": (NO_SPRINGS, f"return [Spring(2, (1, 0, 0), {LAW})]", "E.springs returned the direction 1, expecte"),
    "no law": (NO_SPRINGS, "return [Spring(2, (), values['s2'])]", "returned a law of type SX, expected a function"),
    "a law of one": (NO_SPRINGS, f"return [Spring(2, (), {LAW.replace(', command', '')})]", "takes 1 positional"),
    "a long law": (NO_SPRINGS, f"return [Spring(2, (), {LAW} * ca.SX([1, 2]))]", "<lambda> returned 2 x 1 numbers"),
}  # fmt: skip
GAUGES = {
    "another channel": ('"r": ca', '"d": ca', "G.outputs returned the channels d, expected .* of each channel .* r"),
    "no channel": ('{"r": ', '{"r": 0} and {} and {"r": ', "G.outputs returned only none, expected every channel: r"),
    "no mapping": ('{"r": ', "{", "G.outputs returned set .*, expected the expression of each channel"),
    "a whole vector": ("ca.norm_2", "", "G.outputs returned 3 x 1 numbers, expected one number as 'r'"),
    "a text": ('Channel("r", "length")', '"r"', "G.channels returned .'r'., expected a sequence of Channel.name, d"),
    "no dimension": ('"length"', '"mm"', "G.channels returned Channel.name='r', dimension='mm'., expected Chan"),
    "bare noise": ("(1e-4,)", "1e-4", "G.noise returned 0.0001, expected a sequence of standard deviations above zero"),
    "no noise": ("(1e-4,)", "(0.0,)", r"G.noise returned \(0.0,\), expected a sequence of standard deviations above z"),
    "not a number": ("ca.norm_2", "ca.sqrt(-1) * ca.norm_2", "the measurement m predicts no number .* the record 1 at"),
    "no parameter": ('{"r"', 'values["x"] or {"r"', "G.outputs .*found no parameter .x., expected one of none"),
}  # fmt: skip

READER = (
    IMPORTS
    + """
import numpy as np
from armcal.base.dataset import Dataset
from armcal.base.settings import InputPath, Settings


class S(Settings):
    path: InputPath


class R:
    Settings = S

    def __init__(self, settings):
        pass

    def read(self, request):
        angles = np.radians([[10.0, 20.0, -30.0], [5.0, -40.0, 60.0], [0.0, 30.0, 20.0]])
        values = {f"arm.q{i}": numbers for i, numbers in enumerate(angles, start=1)}
        values |= {f"m.{axis}": np.array([0.5, 0.1, 0.2])[: len(angles)] for axis in "xyz"}
        return Dataset(("a", "b", "c"), values)


@hookimpl
def armcal_register_readers(register):
    register("mine", R, "")
"""
)
TIP, MINE = "{type: tip_position, noise_mm: 0.1}", "{mine: {type: mine}}"
MDH = "mdh, convention: standard, rows: [{a_mm: 300, alpha_deg: 90}, {a_mm: 200}, {a_mm: 150}]"
WHOLE = 'Dataset(("a", "b", "c"), values)'


def _beside(parts: str) -> str:
    return WHOLE[:-1] + f", {parts})"


READERS = {
    "none": ("return Dataset", "Dataset", "R.read returned None, expected a Dataset"),
    "a mapping": (WHOLE, "values", "R.read returned dict .*no attribute 'channels'., expected a Da"),
    "lists": (": numbers for", ": list(numbers) for", "R.read returned Dataset .*no attribute 'shape'., exp"),
    "few": ("[: len(angles)]", "[:2]", r"R.read returned the channel 'm.x' of the shape \(2,\), of float64, expect"),
    "NaN": ("0.5, 0.1, 0.2]", "math.nan] * 3", "no usable record: all 3 were set aside, the first because m.x is emp"),
    "a file": ("angles =", "open('no')\n        angles =", "R.read raised FileNotFoundError: .* 'no'. To che"),
    "ids twice": ('"c")', '"a")', "row 3: the id 'a' was given to another record before, at row 1, with other values"),
    "no joint": ("start=1)}", "start=1) if i < 3}", "R.read returned no channel 'arm.q3' among arm.q1, arm.q2, m.x, "),
    "no z": ('in "xyz"', 'in "xy"', "R.read returned no channel 'm.z' among .*, expected every channel of the request"),
    "degrees": ("np.radians", "np.array", "arm.q1: found -1718.87.* deg more than two turns. If the unit is wrong"),
    "time": (WHOLE, "Dataset(tuple('abc'), {**values, 'time': np.array([1.0, 3, 2])})", "row 3, time: .* out of order"),
    "channels": (WHOLE, "Dataset(tuple('abc'), list(values))", "R.read returned Dataset .'list' .*, expected a Datase"),
    "few rows": (WHOLE, _beside("rows=(1,)"), "R.read returned 1 rows, expected 3 of them, or none"),
    "a column": (WHOLE, _beside("extra={'t': ('x',)}"), "R.read returned 1 texts as 't', expected 3, one a record"),
}  # fmt: skip
MODEL = (
    IMPORTS
    + """
from armcal import Settings
from armcal.arm.model import Attachment, Chain, Joint
from armcal.base import se3


class M:
    Settings = Settings
    joint_names = ("q1", "q2", "q3")

    def __init__(self, settings):
        pass

    def parameters(self):
        return [scalar("a2", "m", 0.3, 0.01)]

    def chain(self, values):
        link, at = se3.translation_along("x", values["a2"]), se3.identity()
        joints = tuple(Joint(name, link, angular=(0, 0, 1)) for name in ("q1", "q2", "q3"))
        return Chain(at, joints, Attachment(3, link))


@hookimpl
def armcal_register_models(register):
    register("mine", M, "")
"""
)
MODELS = {
    "none": ("return Chain", "Chain", "M.chain returned None, expected a Chain of the joints q1, q2, q3"),
    "other joints": (
        'in ("q1"',
        'in ("p1"',
        "M.chain returned the joints p1, q2, q3, expected a sequence of the joint",
    ),
    "no names": ("    joint_names", "    names", "the plugin 'mine' is broken: it has no joint_names; its contract"),
    "an axis": (
        "(0, 0, 1)",
        "(0, 0, 2)",
        r"the joint q1 about \(0, 0, 2\), along .*, expected one of them of length 1",
    ),
    "no transform": (
        "Attachment(3, link)",
        "Attachment(3, values['a2'])",
        "M.chain returned Chain .'SX' object has no attribute 'rotation'., expected a",
    ),
    "no joint": ("Attachment(3", "Attachment(4", "M.chain returned the frame 'tool' on the joint 4, expected 0 to 3"),
    "an offset": (
        "(0, 0, 1)",
        "(0, 0, 1), offset='a2'",
        "M.chain returned Chain .*, expected a Chain",
    ),
    "no mount": (
        "Chain(at",
        "Chain(0",
        "M.chain returned Chain .'int' object has no attribute 'rotation'., expected a",
    ),
}
REGISTRATIONS = {
    "another hook": (
        "armcal_register_effects",
        "armcal_register_effect",
        "'armcal_register_effect': did you mean armcal_",
    ),
    "no mark": ("@hookimpl\n", "", "armcal_register_effects is not marked: put @hookimpl before it"),
    "another kind": ("armcal_register_effects", "armcal_register_models", "'mine'. It is registered as a model."),
    "another name": ('register("mine"', 'register("yours"', "'mine'. .* A plugin's file is loaded by --plugin FILE."),
    "in a hook": ("    register(", "    1 / 0\n    register(", r"mine.py:\d+: ZeroDivisionError: division by zero"),
}


@pytest.fixture(autouse=True)
def _forgotten(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    for variable in (plugins.CHOSEN, plugins.DISABLED):
        monkeypatch.setenv(variable, "")
    yield


def ended(
    folder: Path,
    plugin: str,
    effects: str = "{}",
    measurement: str = TIP,
    free: str = "arm.mdh.a2",
    reader: str = "csv",
    model: str = MDH,
) -> int:
    """How ``armcal run`` ends on a planar arm with a plugin file."""
    (folder / "mine.py").write_text(plugin, encoding="utf-8")
    rows = "\n".join(f"{i},{10 * i - 20},{7 * i % 50},{5 * i},{500 + i},{i * i},3,600" for i in range(1, 9))
    (folder / "data.csv").write_text(f"pose_id,q1_deg,q2_deg,q3_deg,x_mm,y_mm,z_mm,r_mm\n{rows}\n", encoding="utf-8")
    (folder / "run.yaml").write_text(
        f"""
arms:
  arm:
    model: {{type: {model}}}
    effects: {effects}
statics: {{gravity_m_s2: [0, 0, -9.81], payload_g: 100}}
measurements: {{m: {measurement}}}
data: {{type: {reader}, path: data.csv}}
parameters: {{free: [{free}]}}
""",
        encoding="utf-8",
    )
    os.chdir(folder)
    done = cli.main(["run", "run.yaml", "--plugin", "mine.py", "--accept"], "armcal", standalone_mode=False)
    assert isinstance(done, int)
    return done


KINDS: dict[str, tuple[str, dict[str, tuple[str, str, str]], dict[str, str]]] = {  # its plugin, mistakes, and the run
    "effect": (EFFECT, EFFECTS, {"effects": MINE, "free": "arm.mine.s2"}),
    "measurement": (GAUGE, GAUGES, {"measurement": "{type: mine}"}),
    "reader": (READER, READERS, {"reader": "mine"}),
    "model": (MODEL, MODELS, {"model": "mine", "free": "arm.mine.a2"}),
    "registration": (EFFECT, REGISTRATIONS, {"effects": MINE, "free": "arm.mine.s2"}),
}
OF_NO_LINE = ("derivative", "the measurement", "row", "no usable", "arm.q1", "'mine'")
"""Sentences about numbers, records or a name that no single line of a plugin gave."""
RAISED = re.compile(r"raised|found no parameter|takes|ZeroDivision")
"""Sentences about what the plugin's own code raised, which stand below its traceback."""


@pytest.mark.parametrize(("kind", "mistake"), [(kind, name) for kind, (_, table, _) in KINDS.items() for name in table])
def test_a_mistake(kind: str, mistake: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plugin, mistakes, options = KINDS[kind]
    right, wrong, sentence = mistakes[mistake]
    assert right in plugin
    assert ended(tmp_path, plugin.replace(right, wrong, 1), **options) == 2
    shown = capsys.readouterr().err
    last = [line for line in shown.splitlines() if line.startswith("armcal: ")]
    assert len(last) == 1 and ("Traceback" in shown) == bool(RAISED.search(sentence))
    assert re.search(sentence, last[0]) and (sentence.startswith(OF_NO_LINE) or "mine.py" in last[0]), last[0]


def _work(task: int) -> int:
    from armcal.plugins import discover

    effect = discover().find("effect", "mine").load()({}, ["q1", "q2"])
    return int(effect.displacement(task, {"s2": 1}))


def test_a_fault_is_placed_in_any_process(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(EFFECT, encoding="utf-8")
    use_plugins(tmp_path / "mine.py")
    with pytest.raises(PluginError, match=r"mine.py:\d+: E.displacement raised AttributeError: 'int' object"):
        blaming(_work)(1)


def test_another_thread_meets_no_plugin_without_its_digest(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(EFFECT, encoding="utf-8")
    use_plugins(tmp_path / "mine.py")
    spec = find_spec("armcal.plugins.mine")
    assert spec is not None and module_from_spec(spec).armcal_digest.startswith("sha256 ")  # before its code has run


def test_armcals_own_faults_keep_their_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armcal.run.pipeline.mislabelled", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        ended(tmp_path, EFFECT, effects=MINE, free="arm.mine.s2")
