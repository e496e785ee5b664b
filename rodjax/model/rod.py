"""The rod: reference length, stiffnesses, mass and the shape without stress."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import (
    DEFAULT_D2,
    Numbers,
    instance,
    is_known,
    leaf,
    namespace,
    not_negative,
    number_array,
    number_list,
    positive,
    shown,
    whole_number,
)
from rodjax.model.along import Along, Pair, Smooth, Steps, Value, scaled
from rodjax.model.rest import RestShape, RestStrain, SpaceCurve, ends
from rodjax.model.summaries import rod_text
from rodjax.units import Units

# Of St-Venant's series, which falls like k^-5: 13 digits.
TORSION_TERMS = 200
# By the length: so far may the arclengths of what varies along a rod end from those of its ends.
ARCLENGTH_TOLERANCE = 1e-6


class Law(eqx.Module):
    """A user-defined density of elastic energy: subclass it, with numbers as fields, and pass it to `Rod`.

    `__call__(curvature, twist, axial_strain, s)` [J/m] for one cross section, a smooth function of the strains relative
    to the stress-free shape: `curvature` (2,) along d1 and d2 [1/m], `twist` [rad/m], `axial_strain`; `s` [m]. It needs
    no derivatives of its own.
    """

    def __call__(
        self, curvature: Float[Array, "2"], twist: Float[Array, ""], axial_strain: Float[Array, ""], s: Float[Array, ""]
    ) -> Float[Array, ""]:
        raise NotImplementedError


class ScaledLaw(Law):
    """A law in the units in which a scene is solved."""

    law: Law
    length: Float[Array, ""]
    energy: Float[Array, ""]

    def __call__(self, curvature, twist, axial_strain, s):
        of_law = self.law(curvature / self.length, twist / self.length, axial_strain, s * self.length)
        return of_law * self.length / self.energy


class Rod(eqx.Module):
    """An extensible Kirchhoff rod; with `GA` the rod of Simo and Reissner, whose sections shear too.

    **Arguments:**

    - `length`: reference length L [m].
    - `EI`: bending stiffness [N m^2]; or a pair (EI1, EI2) for the components of t x t' along d1 and d2.
    - `GJ`: torsional stiffness [N m^2].
    - `EA`: stretching stiffness [N].
    - `mass_per_length` [kg/m]: gives the weight in a scene with gravity.
    - `radius` [m]: for pictures and clearances only; `None` where unknown.
    - `rest_curvature`: a pair (k1, k2) [1/m], components of t x t' along d1 and d2 in the shape without stress; `None`
        for a straight one. Not a first guess.
    - `rest_twist` [rad/m] in the shape without stress; `None` for none.
    - `law`: a user-defined energy density, in place of the quadratic one. The stiffnesses above then only set its
        scale.
    - `GA`: shear stiffness [N], shear factor included; or a pair (GA1, GA2) for the components of phi' along d1 and d2,
        whose energy GA1/2 gamma1^2 + GA2/2 gamma2^2 is added to any law. The frames (d1, d2, d3) are then those of the
        sections, as is what clamps and tangents of supports hold: the centerline leaves d3 by the shear. `None`:
        sections do not shear.
    - `rest_strain`: the axial strain |phi'| - 1 without stress, above -1: of a heated part its expansion times the rise
        of temperature, of a shrunk part negative; `None` for none. Rest curvature and twist stay per length s.

    Stiffnesses, mass, radius and components of the rest shape may be `Along`: `rodjax.Steps` or `rodjax.Smooth`. A rod
    with one EI, nothing but its radius that varies, no rest shape or strain, no shear and no law of its own needs no
    angle about its tangent, and is solved faster.

    Raises `ValueError` or `TypeError` where a stiffness or the length is not a positive finite number.
    """

    length: Float[Array, ""]
    EI: Value | Pair
    GJ: Value
    EA: Value
    mass_per_length: Value
    radius: Value | None
    rest_curvature: Pair | None
    rest_twist: Value | None
    rest_centerline: SpaceCurve | None
    law: Law | None
    GA: Value | Pair | None
    rest_strain: Value | None

    def __init__(
        self,
        length: Any,
        EI: Any,
        GJ: Any,
        EA: Any,
        mass_per_length: Any = 0.0,
        radius: Any = None,
        rest_curvature: Any = None,
        rest_twist: Any = None,
        *,
        law: Law | None = None,
        GA: Any = None,
        rest_strain: Any = None,
    ):
        self.length = leaf(positive(length, "length"))
        self.EI = _pair(EI, "EI", positive) if _is_pair(EI) else _value(EI, "EI", positive)
        self.GJ = _value(GJ, "GJ", positive)
        self.EA = _value(EA, "EA", positive)
        self.mass_per_length = _value(mass_per_length, "mass_per_length", not_negative)
        self.radius = None if radius is None else _value(radius, "radius", positive)
        if rest_curvature is not None and not _is_pair(rest_curvature):
            raise ValueError(f"rest_curvature must be a pair (k1, k2), got {rest_curvature!r}")
        self.rest_curvature = None if rest_curvature is None else _pair(rest_curvature, "rest_curvature", number_array)
        self.rest_twist = None if rest_twist is None else _value(rest_twist, "rest_twist", number_array)
        self.rest_centerline = None
        self.law = None if law is None else _law(law)
        self.GA = None if GA is None else _pair(GA, "GA", positive) if _is_pair(GA) else _value(GA, "GA", positive)
        self.rest_strain = None if rest_strain is None else _value(rest_strain, "rest_strain", _above_minus_one)
        _check_arclengths(self)

    def __str__(self) -> str:
        return rod_text(self)

    @property
    def is_plain(self) -> bool:
        """Whether the rod is isotropic, straight and the same all along, so that the twist is one number."""
        # Asked at every solve: no loops, and an array is told by its dtype, as a question for `Along` takes longer.
        return (
            hasattr(self.EI, "dtype")
            and hasattr(self.GJ, "dtype")
            and hasattr(self.EA, "dtype")
            and hasattr(self.mass_per_length, "dtype")
            and self.rest_curvature is None
            and self.rest_twist is None
            and self.rest_centerline is None
            and self.law is None
            and self.GA is None
            and self.rest_strain is None
        )

    @property
    def bending_pair(self) -> tuple[Value, Value]:
        return self.EI if isinstance(self.EI, tuple) else (self.EI, self.EI)

    @property
    def stiffnesses(self) -> tuple[Value, Value, Value, Value]:
        """Against bending about d1 and d2, torsion and stretching."""
        return (*self.bending_pair, self.GJ, self.EA)

    @property
    def shear_pair(self) -> tuple[Value, Value] | None:
        """Against shear along d1 and d2; `None` where sections do not shear."""
        return self.GA if self.GA is None or isinstance(self.GA, tuple) else (self.GA, self.GA)

    @property
    def rest_shape(self) -> RestShape | None:
        if self.rest_centerline is not None:
            return self.rest_centerline
        if self.rest_curvature is None and self.rest_twist is None:
            return None
        return RestStrain(self.rest_curvature, self.rest_twist, self.rest_strain)

    @property
    def stress_free(self) -> RestShape:
        """The rest shape, or the straight rod where there is none."""
        shape = self.rest_shape
        return RestStrain(None, None, self.rest_strain) if shape is None else shape

    @property
    def bending_scale(self) -> Float[Array, ""]:
        """The bending stiffness in whose units a scene is solved: the geometric mean of two, means along the rod."""
        if isinstance(self.EI, tuple):
            return jnp.sqrt(self.mean(self.EI[0]) * self.mean(self.EI[1]))
        return self.mean(self.EI)

    @property
    def mean_mass_per_length(self) -> Float[Array, ""]:
        return self.mean(self.mass_per_length)

    def mean(self, value: Value) -> Float[Array, ""]:
        """Along the rod."""
        return value.mean(jnp.zeros_like(self.length), self.length) if isinstance(value, Along) else value

    def in_units(self, units: Units) -> "Rod":
        """The same rod with L = 1, EI = 1 and mass per length 1: see `rodjax.model.scene.nondimensional`."""
        one = jnp.ones_like(self.length)
        radius = None if self.radius is None else scaled(self.radius, units.length, units.length)
        if self.is_plain:
            return Rod(one, one, self.GJ / self.EI, self.EA / units.force, one, radius)
        L, bending = units.length, units.energy * units.length
        EI = tuple(scaled(value, L, bending) for value in self.bending_pair)
        mass = self.mass_per_length
        rest = self.rest_shape
        strain = rest.scaled(L) if isinstance(rest, RestStrain) else RestStrain(None, None, None)
        scaled_rod = Rod(
            one,
            EI,
            scaled(self.GJ, L, bending),
            scaled(self.EA, L, units.force),
            scaled(mass, L, self.mean_mass_per_length) if isinstance(mass, Along) else one,
            radius,
            strain.curvature,
            strain.twist,
            law=None if self.law is None else ScaledLaw(self.law, L, units.energy),
            GA=None if self.shear_pair is None else tuple(scaled(value, L, units.force) for value in self.shear_pair),
            rest_strain=None if self.rest_strain is None else scaled(self.rest_strain, L, one),
        )
        return _shaped(scaled_rod, rest.scaled(L)) if isinstance(rest, SpaceCurve) else scaled_rod

    @staticmethod
    def from_centerline(
        points: Any,
        EI: Any,
        GJ: Any,
        EA: Any,
        mass_per_length: Any = 0.0,
        radius: Any = None,
        *,
        d2: Any = DEFAULT_D2,
        frames: Any = None,
        law: Law | None = None,
        GA: Any = None,
    ) -> "Rod":
        """A rod that has the shape of a curve when it is free of stress; its length is that of the curve.

        - `points`: (m, 3) [m], m >= 4, along the curve: a cubic spline goes through them.
        - `d2`: (3,): of the first frame, as for `rodjax.frame`; from there on the frame goes without twist.
        - `frames`: (m, 3, 3) instead, columns d1, d2, t, the frames at the points.
        - the others: as for `Rod`.

        `Rod.rest_ends` gives position and frame of its ends, for the supports that leave it free of stress.
        """
        curve, length = SpaceCurve.through(points, d2, frames)
        return _shaped(Rod(length, EI, GJ, EA, mass_per_length, radius, law=law, GA=GA), curve)

    def rest_ends(
        self, position: Any = None, frame: Any = None
    ) -> tuple[tuple[Float[Array, "3"], Float[Array, "3 3"]], tuple[Float[Array, "3"], Float[Array, "3 3"]]]:
        """Position (3,) [m] and frame (3, 3) of the start and of the end in the shape without stress.

        `position`, `frame`: of the start; `None` for where `from_centerline` was given the points, else for the origin
        and the global axes.
        """
        return ends(self.stress_free, self.length, position, frame)

    @staticmethod
    def circular(
        length: Any,
        radius: Any,
        youngs_modulus: Any,
        shear_modulus: Any = None,
        poisson_ratio: Any = None,
        density: Any = 0.0,
        shear: bool = False,
    ) -> "Rod":
        """A rod of solid circular section: EI = E pi R^4/4, GJ = G pi R^4/2, EA = E pi R^2.

        `length` and `radius` [m], `youngs_modulus` [Pa], `density` [kg/m^3], and exactly one of `shear_modulus` [Pa]
        and `poisson_ratio`. `shear`: whether sections shear, GA = k G pi R^2 with the factor k = 6 (1 + nu)/(7 + 6 nu),
        nu = E/(2 G) - 1, of Cowper, J. Appl. Mech. 33 (1966) 335.
        """
        radius = positive(radius, "radius")
        section = radius, 0.0 * radius, youngs_modulus, shear_modulus, poisson_ratio, density
        return _round_section(length, *section, shear=shear)

    @staticmethod
    def tube(
        length: Any,
        outer_radius: Any,
        inner_radius: Any,
        youngs_modulus: Any,
        shear_modulus: Any = None,
        poisson_ratio: Any = None,
        density: Any = 0.0,
        shear: bool = False,
    ) -> "Rod":
        """A rod of annular section, a hose or pipe; arguments as for `Rod.circular`, radii [m], shear factor likewise:

        k = 6 (1 + nu) (1 + m^2)^2 / ((7 + 6 nu) (1 + m^2)^2 + (20 + 12 nu) m^2), m = inner_radius/outer_radius.
        """
        outer = positive(outer_radius, "outer_radius")
        inner = positive(inner_radius, "inner_radius")
        section = outer, inner, youngs_modulus, shear_modulus, poisson_ratio, density
        return _round_section(length, *section, shear=shear)

    @staticmethod
    def layered(
        length: Any,
        radii: Any,
        youngs_moduli: Any,
        shear_moduli: Any = None,
        poisson_ratios: Any = None,
        densities: Any = None,
    ) -> "Rod":
        """A rod of concentric bonded layers, such as a hose with its reinforcement: the sums of their stiffnesses.

        - `radii`: (k + 1,) [m], increasing: from the inner radius of the first layer, 0 for a solid core, to the outer
          one of the last.
        - `youngs_moduli` [Pa], `densities` [kg/m^3], and one of `shear_moduli` [Pa] and `poisson_ratios`: (k,), one a
          layer.
        """
        radii, moduli = number_list(radii, "radii"), number_list(youngs_moduli, "youngs_moduli")
        k = len(radii) - 1
        if k < 1 or len(moduli) != k:
            raise ValueError(
                f"radii must be one more than youngs_moduli, got {len(radii)} radii and {len(moduli)} moduli"
            )
        if is_known(radii) and not np.all(np.diff(radii, prepend=0.0)[1:] > 0):
            raise ValueError(f"radii must increase, got {radii.tolist()}")
        others = {"shear_moduli": shear_moduli, "poisson_ratios": poisson_ratios, "densities": densities}
        lists = {name: None if value is None else number_list(value, name) for name, value in others.items()}
        for name, value in lists.items():
            if value is not None and len(value) != k:
                raise ValueError(f"{name} must be one a layer, {k}, got {len(value)}")
        layers = []
        for i in range(k):
            shear, ratio, density = (None if x is None else x[i] for x in lists.values())
            density = 0.0 if density is None else density
            layers.append(_ring(radii[i + 1], radii[i], moduli[i], shear, ratio, density))
        EI, GJ, EA, mass = (sum(column[1:], column[0]) for column in zip(*layers, strict=True))
        return Rod(length, EI, GJ, EA, mass, radius=radii[-1])

    @staticmethod
    def rectangular(
        length: Any,
        width: Any,
        height: Any,
        youngs_modulus: Any,
        shear_modulus: Any = None,
        poisson_ratio: Any = None,
        density: Any = 0.0,
        rest_curvature: Any = None,
        rest_twist: Any = None,
        shear: bool = False,
    ) -> "Rod":
        """A ribbon or strip: `width` [m] along d1, `height` [m] along d2; other arguments as for `Rod.circular`.

        EI1 = E width height^3/12 resists the bending that turns the section about d1. GJ by the series of St-Venant.
        Cowper's factor of the shear is 10 (1 + nu)/(12 + 11 nu), along d1 and d2 alike.
        """
        instance(shear, "shear", bool)
        width, height = positive(width, "width"), positive(height, "height")
        E = positive(youngs_modulus, "youngs_modulus")
        G = _shear_modulus(E, shear_modulus, poisson_ratio)
        density = not_negative(density, "density")
        area = width * height
        EI = (E * area * height**2 / 12, E * area * width**2 / 12)
        return Rod(
            length,
            EI,
            G * torsion_constant(width, height),
            E * area,
            density * area,
            rest_curvature=rest_curvature,
            rest_twist=rest_twist,
            GA=10 * E / (2 * G + 11 * E) * G * area if shear else None,
        )

    @staticmethod
    def bundle(
        length: Any,
        wires: int,
        wire_radius: Any,
        youngs_modulus: Any,
        shear_modulus: Any = None,
        poisson_ratio: Any = None,
        density: Any = 0.0,
        *,
        stick: Any,
    ) -> "Rod":
        """A first estimate of a bundle of parallel round wires in the closest packing; the centerline is its centroid.

        - `wires`: how many, `wire_radius` [m] each; other arguments as for `Rod.circular`, of one wire.
        - `stick`: 0, where every wire slips along its neighbours: EI and GJ are the sums over the wires, the lower
          bound; 1, where all stick together as one section, the upper bound: of seven wires its EI is 7.9 times the
          lower one. In between in proportion.

        The wires lie about the first of them, the nearest places first and those of one distance side by side, and d1
        along the longest direction of the section. Of two wires, of four, and of others whose section is not the same
        all around, EI is a pair: EI1 of two wires, which lie along d1, is the same whether they stick or slip.
        `radius` is that of the circle about the centroid around all wires.
        """
        wires = whole_number(wires, "wires", 1, 10_000)
        radius = positive(wire_radius, "wire_radius")
        stick = number_array(stick, "stick")
        if is_known(stick) and not 0 <= float(stick) <= 1:
            raise ValueError(f"stick must lie in 0 (all slip) to 1 (all stick), got {float(stick):g}")
        bending, torsion, EA, mass = _ring(radius, 0.0 * radius, youngs_modulus, shear_modulus, poisson_ratio, density)
        offsets = _packed(wires)
        along_d1, along_d2 = np.sum(offsets**2, axis=0).tolist()
        # Sections away from the centroid bend by stretch and twist by shear: E A d^2 and G A d^2, G A = 2 GJ/radius^2.
        stuck = stick * radius**2
        EI1, EI2 = (wires * bending + EA * stuck * squares for squares in (along_d2, along_d1))
        GJ = wires * torsion + 2 * torsion / radius**2 * stuck * (along_d1 + along_d2)
        is_round = math.isclose(along_d1, along_d2, rel_tol=1e-9, abs_tol=1e-9)
        around = radius * (1 + float(np.max(np.linalg.norm(offsets, axis=1))))
        return Rod(length, EI1 if is_round else (EI1, EI2), GJ, wires * EA, wires * mass, radius=around)


def _round_section(
    length: Any,
    outer: Float[Numbers, ""],
    inner: Float[Numbers, ""],
    youngs_modulus: Any,
    shear_modulus: Any,
    poisson_ratio: Any,
    density: Any,
    *,
    shear: bool,
) -> Rod:
    instance(shear, "shear", bool)
    EI, GJ, EA, mass = _ring(outer, inner, youngs_modulus, shear_modulus, poisson_ratio, density)
    GA = None
    if shear:
        # Cowper's factor with 1 + nu = E/(2 G), times G A = G EA/E.
        E = positive(youngs_modulus, "youngs_modulus")
        G, m = _shear_modulus(E, shear_modulus, poisson_ratio), (inner / outer) ** 2
        ring = (1 + m) ** 2
        GA = 3 * G * EA * ring / ((G + 3 * E) * ring + (8 * G + 6 * E) * m)
    return Rod(length, EI, GJ, EA, mass_per_length=mass, radius=outer, GA=GA)


def _ring(
    outer: Float[Numbers, ""],
    inner: Float[Numbers, ""],
    youngs_modulus: Any,
    shear_modulus: Any,
    poisson_ratio: Any,
    density: Any,
) -> tuple[Numbers, Numbers, Numbers, Numbers]:
    """EI, GJ, EA and mass per length of an annular section."""
    E = positive(youngs_modulus, "youngs_modulus")
    G = _shear_modulus(E, shear_modulus, poisson_ratio)
    density = not_negative(density, "density")
    # The differences of powers are factored so that a thin wall keeps its digits.
    wall = positive(outer - inner, "outer_radius - inner_radius")
    with np.errstate(over="ignore", invalid="ignore"):  # of what is too large, Rod says so
        area = math.pi * wall * (outer + inner)
        second_moment = area * (outer**2 + inner**2) / 4
        return E * second_moment, 2 * G * second_moment, E * area, density * area


def torsion_constant(width: Float[Numbers, ""], height: Float[Numbers, ""]) -> Float[Numbers, ""]:
    """St-Venant's torsion constant J of a rectangle [m^4]: Timoshenko & Goodier, "Theory of Elasticity", sec. 109."""
    xp = namespace(width, height)
    long, short = xp.maximum(width, height), xp.minimum(width, height)
    terms = [xp.tanh(k * math.pi * long / (2 * short)) / k**5 for k in range(1, 2 * TORSION_TERMS, 2)]
    return long * short**3 * (1 / 3 - 64 / math.pi**5 * short / long * sum(terms[1:], terms[0]))


def _packed(wires: int) -> Float[np.ndarray, "wires 2"]:
    """Places of the wires from their centroid along the principal axes of the section, the longer one first, in radii
    of a wire.
    """
    reach = math.ceil(wires**0.5) + 1
    i, j = (index.ravel() for index in np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1)))
    positions = np.stack([2.0 * i + j, math.sqrt(3.0) * j], axis=1)
    angles = np.round(np.arctan2(positions[:, 1], positions[:, 0]) % (2 * math.pi), 9)
    # Squared distances are whole numbers, so that those of one ring are told from rounding.
    positions = positions[np.lexsort((angles, i * i + i * j + j * j))][:wires]
    positions = positions - np.mean(positions, axis=0)
    _, axes = np.linalg.eigh(positions.T @ positions)
    return positions @ axes[:, ::-1]


def _shear_modulus(E: Float[Numbers, ""], shear_modulus: Any, poisson_ratio: Any) -> Float[Numbers, ""]:
    if (shear_modulus is None) == (poisson_ratio is None):
        raise ValueError(
            f"exactly one of shear_modulus and poisson_ratio must be given, got {shear_modulus!r} and {poisson_ratio!r}"
        )
    if shear_modulus is not None:
        return positive(shear_modulus, "shear_modulus")
    ratio = number_array(poisson_ratio, "poisson_ratio")
    if is_known(ratio) and not -1 < float(ratio) <= 0.5:
        raise ValueError(f"poisson_ratio must be above -1 and at most 0.5, got {float(ratio):g}")
    return E / (2 * (1 + ratio))


def _shaped(rod: Rod, curve: SpaceCurve) -> Rod:
    return eqx.tree_at(lambda rod: rod.rest_centerline, rod, curve, is_leaf=lambda value: value is None)


def _above_minus_one(value: Any, name: str) -> Float[Numbers, ""]:
    number = number_array(value, name)
    if is_known(number) and not float(number) > -1:
        raise ValueError(f"{name} must be above -1, where nothing of the rod is left, got {float(number):g}")
    return number


def _law(law: Any) -> Law:
    """A law with arrays for its numbers, which gives a number."""
    instance(law, "law", Law)
    for value in jax.tree.leaves(law):
        if not isinstance(value, int | float | np.number | np.ndarray | Array) or isinstance(value, bool):
            raise TypeError(
                f"law must have numbers in its fields, got {shown(value)}; mark what is none by eqx.field(static=True)"
            )
    law = jax.tree.map(lambda value: leaf(number_array(value, "law", np.shape(value))), law)
    # Scenes bring all numbers to one precision.
    dtype = max((value.dtype for value in jax.tree.leaves(law)), key=lambda dtype: dtype.itemsize, default=float)
    number = jax.ShapeDtypeStruct((), jax.dtypes.canonicalize_dtype(dtype))
    as_one = jax.tree.map(lambda value: jax.ShapeDtypeStruct(value.shape, number.dtype), law)
    pair = jax.ShapeDtypeStruct((2,), number.dtype)
    given = jax.eval_shape(lambda law, *strains: law(*strains), as_one, pair, number, number, number)
    if getattr(given, "shape", None) != () or not jnp.issubdtype(given.dtype, jnp.floating):
        raise ValueError(f"law must give one floating-point number, got {given}")
    return law


def _is_pair(value: Any) -> bool:
    """Whether there are two values, not one."""
    return isinstance(value, tuple | list) or getattr(value, "shape", ()) == (2,)


def _pair(value: Any, name: str, check: Callable[[Any, str], Numbers]) -> tuple[Value, Value]:
    if len(value) != 2:
        raise ValueError(f"{name} must be one or a pair, got {len(value)} values")
    return _value(value[0], f"{name}[0]", check), _value(value[1], f"{name}[1]", check)


def _value(value: Any, name: str, check: Callable[[Any, str], Numbers]) -> Value:
    if not isinstance(value, Along):
        return leaf(check(value, name))
    if is_known(value):
        samples = np.asarray(value.samples)
        check(samples[np.argmin(samples)], name)
    return value


def _check_arclengths(rod: Rod) -> None:
    """That what varies along the rod does so along this one."""
    if not is_known(rod):
        return
    length = float(rod.length)
    for field in ("EI", "GJ", "EA", "GA", "mass_per_length", "radius", "rest_curvature", "rest_twist", "rest_strain"):
        values = getattr(rod, field)
        named = {field: values}
        if isinstance(values, tuple):
            named = {f"{field}[{k}]": value for k, value in enumerate(values)}
        for name, value in named.items():
            if isinstance(value, Steps) and not 0 < value.jumps[0] <= value.jumps[-1] < length:
                raise ValueError(f"{name}.jumps must lie inside 0 to {length:g} m, got {value.jumps.tolist()}")
            if isinstance(value, Smooth):
                reached = np.array([value.s[0], value.s[-1]])
                if not np.allclose(reached, [0, length], rtol=0, atol=ARCLENGTH_TOLERANCE * length):
                    raise ValueError(f"{name}.s must run from 0 to {length:g} m, got {reached[0]:g} to {reached[1]:g}")
