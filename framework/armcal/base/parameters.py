"""Parameter blocks: every number a calibration may find, by name."""

from __future__ import annotations

import difflib
import fnmatch
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from armcal.base.arrays import Array, Indices
from armcal.base.domains import Domain, Interval, Pose, Rotation, ScrewAxis
from armcal.base.units import SI_UNITS, UNITS, si_unit
from armcal.errors import ConfigError
from armcal.plugins import expecting, refuse

FIT_NAME = re.compile(r"""[^\s.*?\[\]<>"'\\@]+""")
"""What a part of a parameter's name may be: dots join parts, brackets name entries, the others make patterns."""


@dataclass(frozen=True)
class Drift:
    """How a parameter may move over a recording: standard deviation (in its unit) of a stationary process.

    Its correlation falls by e over the distance ``over``, in units of the channel (``sequence``: records, ``time``: s).
    """

    sd: float
    over: float
    channel: str = "sequence"


@dataclass(frozen=True)
class ParameterBlock:
    """One named parameter.

    ``scale`` is the size of a correction one would call ordinary; it conditions the solver and the rank decision, never
    the answer.
    """

    name: str  # instance, component and local name: ``arm.mdh.theta3``
    unit: str  # SI unit of its increments, its prior and its scale (``m``, ``rad``, ``rad_per_Nm``, ``kg``, ``1``)
    nominal: tuple[float, ...]  # canonical entries
    domain: Domain = field(default_factory=Interval)
    scale: float = 1.0
    free: bool = False  # whether the fit may move it
    prior_sd: float | None = None  # of a Gaussian prior about the nominal value, per coordinate; None for no prior
    drift: Drift | None = None  # how it moves over a recording; None if it does not
    nuisance: bool = False  # whether it belongs to one group of records (a socket, a clamp), and is of no use after

    @property
    def entry_names(self) -> tuple[str, ...]:
        """The name of each canonical entry."""
        return tuple(f"{self.name}[{suffix}]" if suffix else self.name for suffix in self.domain.entries)

    @property
    def entry_units(self) -> tuple[str, ...]:
        """The SI unit of each canonical entry; directions and quaternions have none."""
        lengths = {Pose: "xyz", ScrewAxis: ("vx", "vy", "vz"), Rotation: ()}.get(type(self.domain))
        if lengths is None:
            return (self.unit,) * self.size
        return tuple("m" if suffix in lengths else "1" for suffix in self.domain.entries)

    @property
    def size(self) -> int:
        """How many canonical entries it has."""
        return len(self.domain.entries)


def scalar(name: str, unit: str, nominal: float, scale: float, domain: Interval | None = None) -> ParameterBlock:
    """A block of one number."""
    return ParameterBlock(name, unit, (float(nominal),), domain or Interval(), scale)


class DeclaresParameters(Protocol):
    def parameters(self) -> Sequence[ParameterBlock]:
        """Its blocks, under local names."""


def declared(component: DeclaresParameters) -> tuple[ParameterBlock, ...]:
    """The blocks that a component declares, under local names; a PluginError if they make no sense."""
    blocks, method = component.parameters(), component.parameters
    with expecting(method, blocks, "a sequence of ParameterBlock, as scalar() makes them"):
        blocks = tuple(blocks)
        _check_blocks(method, blocks)
    return blocks


def _check_blocks(method: Callable[..., Any], blocks: Sequence[ParameterBlock]) -> None:
    names = set[str]()
    for block in blocks:
        if not FIT_NAME.fullmatch(block.name):
            refuse(method, f"the name {block.name!r}", "one without spaces, dots, quotes and * ? [ ] < > @ \\")
        if block.name in names:
            refuse(method, f"two parameters called {block.name!r}", "names that differ")
        names.add(block.name)
        known = UNITS.get(block.unit)
        if known is None or known != (si := si_unit(known.dimension)):
            expected = f"one of {', '.join(SI_UNITS)}" if known is None else f"{si.name}: parameters are held in SI"
            refuse(method, f"the unit {block.unit!r} of {block.name!r}", expected)
        if not (all(map(math.isfinite, block.nominal)) and 0 < block.scale < math.inf):
            numbers = f"nominal {', '.join(map(str, block.nominal))} and scale {block.scale} of {block.name!r}"
            refuse(method, numbers, "numbers, and a scale above zero: the size of an ordinary correction")


@dataclass(frozen=True)
class _Layout:
    """Where the numbers of free blocks stand: in a value vector, among the free entries, and among the increments."""

    places: Indices  # of blocks that are numbers
    entries: Indices
    increments: Indices
    others: tuple[tuple[ParameterBlock, slice, slice, slice], ...]  # each other free block, with the same three
    shape: tuple[int, int]  # how many free entries and increments there are


@dataclass(frozen=True)
class Parameters:
    """All blocks of a problem in a fixed order; value vectors hold the canonical entries of all, free and fixed."""

    blocks: tuple[ParameterBlock, ...]

    def __post_init__(self) -> None:
        for block in self.blocks:
            if len(block.nominal) != block.size:
                raise ConfigError(f"{block.name} has {len(block.nominal)} entries, its domain has {block.size}.")
        names = [block.name for block in self.blocks]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ConfigError(f"parameter names stand twice: {', '.join(twice)}.", hint="Rename one of the instances.")

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(block.name for block in self.blocks)

    @cached_property
    def entry_names(self) -> tuple[str, ...]:
        return tuple(name for block in self.blocks for name in block.entry_names)

    @cached_property
    def _index(self) -> Mapping[str, tuple[ParameterBlock, slice]]:
        index, start = {}, 0
        for block in self.blocks:
            index[block.name] = (block, slice(start, start + block.size))
            start += block.size
        return index

    def __getitem__(self, name: str) -> ParameterBlock:
        return self._index[name][0]

    def entries_of(self, name: str) -> slice:
        """Where a block's canonical entries stand in a value vector."""
        return self._index[name][1]

    def nominal(self) -> Array:
        """The nominal value vector."""
        return np.array([number for block in self.blocks for number in block.nominal])

    def select(self, patterns: Iterable[str]) -> tuple[str, ...]:
        """The names that match any of the globs (``arm.spring.k?``), in the order of the blocks.

        Raises:
            ConfigError: a pattern matches nothing; the nearest names are given.
        """
        chosen: set[str] = set()
        for pattern in patterns:
            matching = fnmatch.filter(self.names, pattern)
            if not matching:
                near = difflib.get_close_matches(pattern, self.names, n=3, cutoff=0.5) or list(self.names[:3])
                raise ConfigError(
                    f"no parameter is called {pattern!r}.",
                    hint=f"Nearest: {', '.join(near)}. `armcal check -v` lists all {len(self.names)} names.",
                )
            chosen.update(matching)
        return tuple(name for name in self.names if name in chosen)

    def with_free(self, names: Iterable[str]) -> Parameters:
        """Exactly these blocks free, all others fixed."""
        freed = set(names)
        if unknown := sorted(freed - set(self.names)):
            raise ConfigError(f"no parameter is called {unknown[0]!r}.", hint="Take names from `Parameters.select`.")
        return self.replaced({block.name: replace(block, free=block.name in freed) for block in self.blocks})

    def with_nominal(self, values: Array) -> Parameters:
        """The same blocks about other nominal values."""
        return self.replaced(
            {n: replace(b, nominal=tuple(float(v) for v in values[s])) for n, (b, s) in self._index.items()}
        )

    def without_bounds(self) -> Parameters:
        """Every interval opened to the whole line."""
        return self.replaced(
            {b.name: replace(b, domain=Interval()) for b in self.blocks if isinstance(b.domain, Interval)}
        )

    def replaced(self, blocks: Mapping[str, ParameterBlock]) -> Parameters:
        """The same blocks, some exchanged by name."""
        return Parameters(tuple(blocks.get(block.name, block) for block in self.blocks))

    @cached_property
    def free(self) -> tuple[ParameterBlock, ...]:
        return tuple(block for block in self.blocks if block.free)

    @cached_property
    def nuisances(self) -> tuple[ParameterBlock, ...]:
        """The blocks that belong to one group of records each."""
        return tuple(block for block in self.blocks if block.nuisance)

    @cached_property
    def free_entries(self) -> tuple[int, ...]:
        """Positions in a value vector of the free blocks' canonical entries."""
        return tuple(i for block in self.free for i in range(*self.entries_of(block.name).indices(1 << 30)))

    @cached_property
    def coordinate_blocks(self) -> tuple[ParameterBlock, ...]:
        """The free block of each coordinate."""
        return tuple(block for block in self.free for _ in range(block.domain.dof))

    @cached_property
    def coordinates_of(self) -> Mapping[str, slice]:
        """Where each free block's coordinates stand among all."""
        ends = np.cumsum([block.domain.dof for block in self.free]).tolist()
        return {b.name: slice(end - b.domain.dof, end) for b, end in zip(self.free, ends, strict=True)}

    @cached_property
    def coordinate_names(self) -> tuple[str, ...]:
        """A name for each number of an increment: the entry's, where coordinates are entries."""
        names: list[str] = []
        for block in self.free:
            by_entry = block.domain.dof == block.size
            names += block.entry_names if by_entry else [f"{block.name}<{i}>" for i in block.domain.increments]
        return tuple(names)

    @cached_property
    def _layout(self) -> _Layout:
        """Numbers, whose increments are added, all at once; the other free blocks one by one."""
        numbers: list[tuple[int, int, int]] = []
        others: list[tuple[ParameterBlock, slice, slice, slice]] = []
        entry = increment = 0
        for block in self.free:
            place, ends = self.entries_of(block.name), (entry + block.size, increment + block.domain.dof)
            if isinstance(block.domain, Interval):
                numbers.append((place.start, entry, increment))
            else:
                others.append((block, place, slice(entry, ends[0]), slice(increment, ends[1])))
            entry, increment = ends
        places, entries, increments = np.array(numbers, dtype=np.intp).reshape(-1, 3).T
        return _Layout(places, entries, increments, tuple(others), (entry, increment))

    def scales(self) -> Array:
        """The typical scale of each coordinate."""
        return np.array([block.scale for block in self.coordinate_blocks])

    def increment_scales(self) -> Array:
        """The typical scale of each increment."""
        return np.array([block.domain.increment_scale(block.scale) for block in self.coordinate_blocks])

    def prior_information(self) -> Array:
        """1/sd^2 of each coordinate's prior, 0 where there is none."""
        return np.array([0.0 if b.prior_sd is None else b.prior_sd**-2 for b in self.coordinate_blocks])

    def increment_bounds(self) -> tuple[Array, Array]:
        """Lower and upper bound of each increment from the nominal values; infinite for all but intervals."""
        lower = [getattr(block.domain, "lower", -math.inf) - block.nominal[0] for block in self.coordinate_blocks]
        upper = [getattr(block.domain, "upper", math.inf) - block.nominal[0] for block in self.coordinate_blocks]
        return np.array(lower), np.array(upper)

    def retract(self, delta: Array) -> Array:
        """The value vector that an increment of the free blocks leads to from the nominal values."""
        moved, layout = self.nominal(), self._layout
        moved[layout.places] += delta[layout.increments]
        for block, place, _, own in layout.others:
            moved[place] = block.domain.retract(moved[place], delta[own])
        return moved

    def local(self, values: Array) -> Array:
        """The increment of the free blocks that leads from the nominal values to ``values``."""
        layout, nominal = self._layout, self.nominal()
        delta = np.zeros(layout.shape[1])
        delta[layout.increments] = values[layout.places] - nominal[layout.places]
        for block, place, _, own in layout.others:
            delta[own] = block.domain.local(nominal[place], values[place])
        return delta

    def retract_jacobian(self, delta: Array) -> Array:
        """d free canonical entries / d increment, at an increment from the nominal values."""
        return self._diagonal(delta, lambda domain, base, part: domain.retract_jacobian(base, part))

    def coordinates(self, delta: Array) -> Array:
        """Where an increment leads, in the coordinates of priors and covariances."""
        coordinates = np.array(delta, dtype=float)
        for block, _, _, own in self._layout.others:
            coordinates[own] = block.domain.coordinates(np.array(block.nominal), delta[own])
        return coordinates

    def from_coordinates(self, coordinates: Array) -> Array:
        """The increment that leads there, or to the nearest value of each domain."""
        delta = np.array(coordinates, dtype=float)
        for block, _, _, own in self._layout.others:
            delta[own] = block.domain.from_coordinates(np.array(block.nominal), coordinates[own])
        return delta

    def coordinates_jacobian(self, delta: Array) -> Array:
        """d coordinates / d increment."""
        return self._diagonal(delta, lambda domain, base, part: domain.coordinates_jacobian(base, part), True)

    def entries_jacobian(self, values: Array) -> Array:
        """d free canonical entries / d coordinates, at a value vector."""
        delta = self.local(values)
        return self._diagonal(delta, lambda domain, base, part: domain.entries_jacobian(base, part))

    def curvature(self, gradient: Array, convex: bool = True) -> Array:
        """What the retraction's curvature adds to a Hessian by increments; ``gradient`` is by free entries."""
        layout = self._layout
        total = np.zeros((layout.shape[1], layout.shape[1]))
        for block, _, entries, own in layout.others:
            part = block.domain.curvature(gradient[entries], convex)
            if part is not None:
                total[own, own] = part
        return total

    def _diagonal(
        self, delta: Array, of: Callable[[Domain, Array, Array], Array], by_coordinates: bool = False
    ) -> Array:
        """A matrix of each free block's own (rows by entries or ``by_coordinates``, columns by increments)."""
        layout = self._layout
        whole = np.zeros((layout.shape[int(by_coordinates)], layout.shape[1]))
        whole[layout.increments if by_coordinates else layout.entries, layout.increments] = 1.0
        for block, _, entries, own in layout.others:
            whole[own if by_coordinates else entries, own] = of(block.domain, np.array(block.nominal), delta[own])
        return whole

    def check(self, values: Array, names: Sequence[str] | None = None) -> None:
        """Raise ConfigError for the first block whose value lies outside its domain."""
        for name in self.names if names is None else names:
            block, place = self._index[name]
            fault = block.domain.check(values[place])
            if fault:
                raise ConfigError(f"{name}: {fault}.", hint="Mend the value or the bounds.")
