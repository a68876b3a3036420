"""The arms, measurements and statics that a configuration (or a calibration) describes, built from plugins."""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pkgutil import resolve_name
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field
from typing_extensions import get_protocol_members, is_protocol

from armcal.arm.assembly import PLACEMENT, Arm, MassiveModel, prefixed
from armcal.arm.joints import require_couplings
from armcal.arm.servo import SteppedEffect
from armcal.arm.statics import STATICS, Environment, MassSpec, frame_names, gravity_tilt
from armcal.base.parameters import FIT_NAME, ParameterBlock, Parameters, declared
from armcal.base.poses import PoseSettings
from armcal.base.settings import Acceleration3, Angle, Force3, Length3, Mass, Settings, Torque3
from armcal.base.units import DIMENSIONS
from armcal.config.validate import validate
from armcal.config.yaml_source import ConfigSource
from armcal.errors import ArmcalError, BrokenPluginError, ConfigError, Location, PluginError
from armcal.hooks import COMPONENTS
from armcal.measure.groups import Groups, group_blocks
from armcal.measure.measurement import Borrowing, Carried, Measurement
from armcal.measure.reader import surroundings
from armcal.plugins import Component, PluginRegistry, expecting, plugin_files, refuse, spoken

T = TypeVar("T")
Path = tuple[str | int, ...]


class LinkSettings(Settings):
    """A mass: where its centre is, in a named frame of the model, ``mount`` or ``tool``.

    ``loads_up_to_joint`` overrides the physical loading where a source counted a link on a joint that does not
    carry it (from 1; 0 for the mount alone).
    """

    mass: Annotated[Mass, Field(ge=0)]
    com: Length3
    frame: str
    loads_up_to_joint: int | None = None


class ArmSettings(Settings):
    """One arm: its model, its joint effects and its masses, each by name.

    ``placement`` is the pose of the model's base in the common base frame, for arms that stand side by side.
    ``joint_noise`` is the standard deviation of what a turning joint reads against where it stands: of contacts, whose
    only readings are the joints', it is most of the noise. ``residual`` learns what all that leaves of the tool's pose.
    ``couplings: {q3: {q2: 1}}`` says that the angle of q3 is its command plus that of q2, as on a Fanuc's pendant.
    """

    model: dict[str, Any]
    joint_noise: Angle = 0.0
    placement: PoseSettings | None = None
    effects: dict[str, dict[str, Any]] = Field(default_factory=dict)
    links: dict[str, LinkSettings] = Field(default_factory=dict)
    residual: dict[str, Any] | None = None
    couplings: dict[str, dict[str, float]] = Field(default_factory=dict)


class StaticsSettings(Settings):
    """Gravity and load in the arm's base frame, where a record does not say otherwise.

    Without ``gravity`` it is assumed to pull along -z as on the earth; what bends under it then warns of that.
    ``payload`` is what hangs on the tool beyond the links (0 g has to be said); ``body`` lets gravity be checked.
    """

    gravity: Acceleration3 | None = None
    body: Literal["earth", "moon", "mars"] | None = None
    payload: Annotated[Mass, Field(ge=0)] | None = None
    payload_com: Length3 = (0.0, 0.0, 0.0)
    force: Force3 = (0.0, 0.0, 0.0)
    torque: Torque3 = (0.0, 0.0, 0.0)


class SystemSettings(Settings):
    """The part of a configuration that says what the arm is and how it is measured."""

    arms: dict[str, dict[str, Any]]
    measurements: dict[str, dict[str, Any]]
    statics: StaticsSettings = Field(default_factory=StaticsSettings)


# A centre of mass is no farther from its frame: in lengths of the arm from joint to joint, and beyond (m).
_FARTHEST_LENGTHS, _FARTHEST_M = 1.5, 0.5
ASSUMED_GRAVITY = (0.0, 0.0, -9.80665)  # m/s^2, on the earth with z up, where it is not stated. [Williams2024]


@dataclass(frozen=True)
class System:
    arms: Mapping[str, Arm]  # by instance name
    measurements: Mapping[str, Measurement]  # by instance name
    statics: StaticsSettings  # as stated
    description: Mapping[str, Any]  # of all three as a configuration in SI units, complete and self-contained

    @property
    def environment(self) -> Environment:
        """What acts where a record does not say."""
        s = self.statics
        return Environment(s.gravity or ASSUMED_GRAVITY, s.payload or 0.0, s.payload_com, s.force, s.torque)

    def parameters(self, groups: Groups | None = None) -> Parameters:
        """Every block, fixed but for what is not known of groups of records."""
        blocks: list[ParameterBlock] = [block for arm in self.arms.values() for block in arm.parameters()]
        for name, measurement in self.measurements.items():
            blocks += prefixed(f"{name}.", declared(measurement))
        return Parameters((*blocks, *gravity_tilt(), *group_blocks(self.measurements, groups or {})))


def build_system(source: ConfigSource, registry: PluginRegistry) -> System:
    parts = replace(source, data={k: source.data[k] for k in SystemSettings.model_fields if k in source.data})
    settings = validate(SystemSettings, parts)
    names = [*settings.arms, *settings.measurements]
    for name in names:  # they head parameter names and columns: no two are the same, and none holds a dot or a glob
        section: Path = ("arms" if name in settings.arms else "measurements", name)
        if names.count(name) > 1 or name == STATICS:
            source.refuse(section, f"{name!r} names two things.", "Rename one.")
        if not name.isidentifier():
            hint = "Use letters, digits and underscores, beginning with a letter."
            source.refuse(section, f"{name!r} is no instance name.", hint)
    arms, described_arms = {}, {}
    for name in settings.arms:
        arms[name], described_arms[name] = _arm(source, registry, name)
    _refusable(source, ("arms",), lambda: surroundings(arms))
    measurements, described = {}, {}
    for name in settings.measurements:
        at: Path = ("measurements", name)
        measurements[name], described[name] = build_component(source, registry, "measurement", at, tuple(arms))
        carried = measurements[name]
        channels = carried.channels()
        with expecting(carried.channels, channels, "a sequence of Channel(name, dimension)"):
            for channel in channels:
                if channel.dimension not in DIMENSIONS:
                    expected = f"Channel(name, dimension), of {', '.join(DIMENSIONS)}"
                    refuse(carried.channels, f"{channel!r}", expected)
        if isinstance(carried, Carried):
            carrier = arms[measurements[name].arms[0]]
            moved = [frame for frame, joint in frame_names(carrier.nominal_chain).items() if joint]
            for setting, frame in carried.carriers.items():
                if frame not in moved:
                    text = f"no frame that a joint of {carrier.name} moves is called {frame!r}."
                    source.refuse((*at, setting), text, f"Such frames are {', '.join(moved)}.")
    for name, measurement in measurements.items():
        if isinstance(measurement, Borrowing) and measurement.lender is not None:
            place, lender = ("measurements", name), measurements.get(measurement.lender)
            if lender is None or measurement.lender == name:
                text = f"found {measurement.lender!r}, whose parameters are to be used, expected another measurement."
                others = ", ".join(other for other in measurements if other != name)
                source.refuse(place, text, f"The others are {others or 'none'}.")
            if isinstance(lender, Borrowing) and lender.lender is not None:
                text = f"{measurement.lender} has the parameters of {lender.lender} itself."
                source.refuse(place, text, f"Name {lender.lender}.")
            _refusable(source, place, partial(measurement.check_lender, lender))
    description = {"arms": described_arms, "measurements": described, "statics": settings.statics.to_config()}
    return System(arms, measurements, settings.statics, description)


def build_component(
    source: ConfigSource, registry: PluginRegistry, kind: str, at: Path, *context: Any
) -> tuple[Any, dict[str, Any]]:
    """The component named by ``type`` in the section at a path, and the section in SI units."""
    section: Any = source.data
    for step in at:
        section = section[step]
    if not isinstance(section, dict) or not isinstance(section.get("type"), str):
        source.refuse(at, f"found no type of {spoken(kind)}.", "Write type: NAME; see armcal plugins list.")
    name = str(section["type"])
    try:
        registered = registry.find(kind, name)
    except PluginError as fault:
        raise PluginError(fault.message, where=source.where((*at, "type")), hint=fault.hint) from fault
    component = registered.load()
    settings_class = getattr(component, "Settings", None)
    if not (isinstance(settings_class, type) and issubclass(settings_class, Settings)):
        raise _broken(registered, "it has no class attribute Settings derived from armcal.Settings")
    settings = validate(settings_class, source, at, beside=("type",))
    try:
        built = _refusable(source, at, lambda: component(settings, *context))
    except ArmcalError:
        raise
    except Exception as fault:  # a plugin may fail in any way; the error names it and the reason
        raise _broken(registered, f"building it raised {type(fault).__name__}: {fault}") from fault
    contract = resolve_name(COMPONENTS[kind].protocol)
    if not is_protocol(contract) and not isinstance(built, contract):
        raise _broken(registered, f"it does not derive from armcal.{contract.__name__}")
    members = sorted(get_protocol_members(contract)) if is_protocol(contract) else []
    if lacking := [name for name in members if not (hasattr(type(built), name) or hasattr(built, name))]:
        raise _broken(registered, f"it has no {', '.join(lacking)}; its contract stands in docs/hooks.md")
    return built, {"type": name, **settings.to_config()}


def _broken(component: Component, fault: str) -> PluginError:
    file = plugin_files().get(component.plugin)
    text = f"the {component.kind} {component.name!r} of the plugin {component.plugin!r} is broken: {fault}."
    hint = f"See armcal plugins check {component.plugin}."
    return BrokenPluginError(text, where=Location(str(file)) if file else None, hint=hint)


def _arm(source: ConfigSource, registry: PluginRegistry, name: str) -> tuple[Arm, dict[str, Any]]:
    at: Path = ("arms", name)
    settings = validate(ArmSettings, source, at)
    model, described_model = build_component(source, registry, "model", (*at, "model"))
    effects, described_effects = {}, {}
    for effect in settings.effects:
        place: Path = (*at, "effects", effect)
        built, described_effects[effect] = build_component(source, registry, "effect", place, model.joint_names)
        effects[effect] = built
    masses = tuple(MassSpec(n, s.mass, s.com, s.frame, s.loads_up_to_joint) for n, s in settings.links.items())
    if isinstance(model, MassiveModel):
        masses = (*(mass for mass in model.masses() if mass.name not in settings.links), *masses)
    placement = settings.placement.blocks(PLACEMENT) if settings.placement else ()
    residual, described_residual = None, None
    if settings.residual is not None:
        place = (*at, "residual")
        residual, described_residual = build_component(source, registry, "residual", place, model.joint_names)
    parts = (model, effects, masses, placement, settings.joint_noise, residual, settings.couplings)
    _part_names(source, (*at, "model"), "joint", model.joint_names)
    _part_names(source, (*at, "effects"), "effect", effects, (described_model["type"], "links"))
    _part_names(source, (*at, "links"), "link", [mass.name for mass in masses])
    arm = _refusable(source, at, lambda: Arm(name, described_model["type"], *parts))
    _refusable(source, (*at, "couplings"), lambda: require_couplings(arm.commanded, arm.couplings))
    _refusable(source, (*at, "effects"), lambda: surroundings({name: arm}))
    _refusable(source, at, lambda: arm.nominal_chain)
    _check_masses(source, (*at, "links"), settings.links, arm)
    links = {link: stated.to_config() for link, stated in settings.links.items()}
    for stepped in (effect for effect in effects.values() if isinstance(effect, SteppedEffect)):
        for index in (i for i in stepped.servos() if model.joint_names[i] in settings.couplings):
            text = f"{model.joint_names[index]} is coupled, and a pulse table counts its servo's angle alone."
            source.refuse((*at, "couplings"), text, "Leave the pulse table out, or the coupling.")
    described: dict[str, Any] = {"model": described_model, "effects": described_effects, "links": links}
    if settings.joint_noise:
        described["joint_noise_rad"] = settings.joint_noise
    if described_residual is not None:
        described["residual"] = described_residual
    if settings.couplings:
        described["couplings"] = settings.couplings
    if settings.placement:
        described["placement"] = settings.placement.to_config()
    return arm, described


def _check_masses(source: ConfigSource, at: Path, links: Mapping[str, LinkSettings], arm: Arm) -> None:
    """Refuse links that cannot be, and centres of mass farther out than any of such an arm."""
    known, joints = frame_names(arm.nominal_chain), len(arm.joint_names)
    for name, link in links.items():
        place = (*at, name)
        if link.frame not in known:
            text = f"no frame is called {link.frame!r}."
            source.refuse((*place, "frame"), text, f"The frames are {', '.join(known)}.")
        if link.loads_up_to_joint is not None and not 0 <= link.loads_up_to_joint <= joints:
            text = f"found joint {link.loads_up_to_joint}, expected 0 to {joints}."
            source.refuse((*place, "loads_up_to_joint"), text, "Joints count from 1; 0 is the mount.")
    for mass in arm.masses:
        away, farthest = math.hypot(*mass.com), _FARTHEST_LENGTHS * arm.length + _FARTHEST_M
        if away > farthest:
            text = f"the centre of mass of {mass.name} is {away:.3g} m from the origin of {mass.frame}"
            text += f", expected at most {farthest:.3g} m of an arm of {arm.length:.3g} m from joint to joint."
            place = (*at, mass.name) if mass.name in links else (*at[:-1], "model")
            source.refuse(place, text, "Are these millimetres? Write com_mm, or correct the URDF's inertial.")


def _part_names(source: ConfigSource, at: Path, kind: str, names: Collection[str], taken: Collection[str] = ()) -> None:
    """Names below an arm are parts of parameter names, which patterns match; dots and brackets have a meaning there."""
    for name in names:
        if not FIT_NAME.fullmatch(name) or not name.isprintable():
            text = f"found the {kind} name {name!r}, expected letters, digits, underscores and dashes."
            source.refuse((*at, name), text, "It becomes a part of parameters' names; patterns address them.")
        if name in taken or list(names).count(name) > 1:
            source.refuse((*at, name), f"found the {kind} name {name!r}, which is taken.", "Rename one.")


def _refusable(source: ConfigSource, at: Path, build: Callable[[], T]) -> T:
    """A component's own refusal, placed where its section was written."""
    try:
        return build()
    except ValueError as fault:
        raise ConfigError(f"{fault}.", where=source.where(at)) from fault
