"""Where a chain to convert comes from, and whether what it was converted to is the same arm."""

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armcal.arm.assembly import MassiveModel
from armcal.arm.model import ArmModel, Chain
from armcal.base.arrays import Array
from armcal.calibration.calibration import Calibration
from armcal.calibration.rigid_chain import largest_difference, numeric_chain, random_commands, rigid_chain, tool_poses
from armcal.config.system import build_component
from armcal.config.yaml_source import ConfigSource, load_config
from armcal.errors import ConfigError, Location
from armcal.plugins import PluginRegistry

POSES = 10_000
_SEED = 1
_SAME_MOUNT = 1e-9


@dataclass(frozen=True)
class ConvertSource:
    """What is converted.

    Attributes:
        arm: the arm's instance name.
        chain: of constants: nominal ones of a configuration, calibrated ones of a calibration.
        left: what of the file belongs to the arm and is not in the chain, in words.
    """

    arm: str
    chain: Chain
    left: tuple[str, ...]


@dataclass(frozen=True)
class Difference:
    """Between two chains: the largest distance (m) and angle (rad) over random poses, and how many these were.

    ``same_mount`` says whether their mounts are the same too.
    """

    position_m: float
    angle_rad: float
    poses: int
    same_mount: bool


def load_source(path: str | Path, arm: str | None, registry: PluginRegistry) -> ConvertSource:
    """The chain of an arm of a configuration or a calibration.

    Raises:
        ConfigError: it is refused, has no such arm, or several and none was named.
        PluginError: its model is not known.
    """
    source = load_config(path)
    name = _named(source, arm)
    if "armcal_calibration" in source.data:
        loaded = Calibration.load(path, registry)
        source_arm = loaded.system.arms[name]
        scope, values = f"{name}.{source_arm.model_name}.", loaded.parameters.nominal()
        blocks = [block for block in loaded.parameters.blocks if block.name.startswith(scope)]
        own = {b.name.removeprefix(scope): values[loaded.parameters.entries_of(b.name)] for b in blocks}
        return ConvertSource(name, *_described(source, name, source_arm.model, own))
    model = build_component(source, registry, "model", ("arms", name, "model"))[0]
    return ConvertSource(name, *_described(source, name, model, nominal_values(model)))


def nominal_values(model: ArmModel) -> dict[str, Array]:
    return {block.name: np.array(block.nominal) for block in model.parameters()}


def reload(text: str, registry: PluginRegistry) -> Chain:
    """The nominal chain of a section ``model:``, read like that of any configuration.

    Raises:
        ConfigError: it is refused.
        PluginError: no plugin offers its type.
    """
    content = ("arms:\n  arm:\n" + textwrap.indent(text, "    ")).encode()
    source = load_config("converted.yaml", content=content)
    model = build_component(source, registry, "model", ("arms", "arm", "model"))[0]
    return numeric_chain(model, nominal_values(model))


def difference(one: Chain, two: Chain) -> Difference:
    known = rigid_chain(one)
    commands = random_commands(known, POSES, _SEED)
    same_mount = bool(np.abs(known.base_T_mount - rigid_chain(two).base_T_mount).max() < _SAME_MOUNT)
    return Difference(*largest_difference(tool_poses(one, commands), tool_poses(two, commands)), POSES, same_mount)


def _named(source: ConfigSource, arm: str | None) -> str:
    arms = source.data.get("arms")
    if not isinstance(arms, dict) or not arms:
        raise ConfigError(
            "found no arms.", where=Location(str(source.path)), hint="Give a configuration or a calibration.yaml."
        )
    if arm is None and len(arms) > 1:
        raise ConfigError(
            f"found the arms {', '.join(arms)}.", where=source.where(("arms",)), hint="Choose one with --arm NAME."
        )
    name = str(next(iter(arms))) if arm is None else arm
    if name not in arms:
        raise ConfigError(
            f"no arm is called {name!r}.", where=source.where(("arms",)), hint=f"The arms are {', '.join(arms)}."
        )
    if not isinstance(arms[name], dict) or "model" not in arms[name]:
        source.refuse(("arms", name), f"the arm {name!r} has no model.", "Write model: {type: NAME, ...}.")
    return name


def _described(
    source: ConfigSource, name: str, model: ArmModel, values: Mapping[str, Array]
) -> tuple[Chain, tuple[str, ...]]:
    chain = numeric_chain(model, values)
    arm = source.data["arms"][name]
    parts = {key: arm[key] for key in ("effects", "links") if isinstance(arm.get(key), dict) and arm[key]}
    left = [f"{key} ({', '.join(map(str, part))})" for key, part in parts.items()]
    if isinstance(model, MassiveModel) and model.masses():
        left.append(f"masses ({', '.join(mass.name for mass in model.masses())})")
    left += [key for key in arm if str(key).startswith(("placement", "joint_noise", "residual", "couplings"))]
    used = [link.get("frame") for link in parts.get("links", {}).values() if isinstance(link, dict)]
    named = [frame for frame in chain.frames if frame in used]
    left += [f"frames ({', '.join(named)})"] if named else []
    stated = source.data.get("parameters")
    left += ["free parameters, priors and bounds"] if isinstance(stated, dict) else []
    return chain, tuple(left)
