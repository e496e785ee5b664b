"""The bending of an element between its three tangents, by the chords between them, and its derivatives.

Chords are 1 - cos of the angles from start to middle (ab), middle to end (bc) and start to end (ac), see `hermite`. The
derivatives are written out: by JAX they were 829 of the 5004 equations of a solve.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# Simpson's weights of the three points of an element.
SIMPSON = (1 / 6, 4 / 6, 1 / 6)
# t^2/4 = x + x^2/3 + 8 x^3/45 + 4 x^4/35 + 128 x^5/1575 + ... with x = sin(t/2)^2; the last one grows without bound.
SERIES = (1 / 3, 8 / 45, 4 / 35, 128 / 1575)


def bending_energies(
    density: Callable[[Array], Array], chords: Float[Array, "3 n"], h: Float[Array, "n"]
) -> Float[Array, "n"]:
    """Of elements of the length h, from the density of a squared curvature."""
    at_ends, middle = _squared_curvatures(chords)
    per_length = 1 / h
    return _by_simpson(density(at_ends * (per_length**2)[None]), density(middle * per_length**2), h)


def _squared_curvatures(chords: Float[Array, "3 n"]) -> tuple[Float[Array, "2 n"], Float[Array, "n"]]:
    """|dt/dx|^2, x = s/h, at both ends and in the middle of an element."""
    ab, bc, ac = chords
    x = chords[:2] / 2  # squared sines of half the angles
    above = _above(x)
    ratio, rest = 1 + x * above, 1 + above
    inverse = 1 / ratio
    squared = 4 * x * ratio  # |v_a|^2, |v_c|^2
    root = jnp.sqrt(ratio * (1 / (1 - x)))
    product = root[0] * root[1] * (ab + bc - ac - ab * bc)  # v_a . v_c
    # v changes by 3 v_a + v_c; across v_a that moves the tangent only by sin(t)/t as much.
    whole = 9 * squared + squared[::-1] + 6 * product[None]
    at_ends = whole - x * rest * inverse * squared[::-1] + rest / 4 * inverse**2 * (product**2)[None]
    return at_ends, squared[0] + squared[1] - 2 * product


def _by_simpson(ends: Float[Array, "2 n"], middle: Float[Array, "n"], h: Float[Array, "n"]) -> Float[Array, "n"]:
    return h * (SIMPSON[0] * (ends[0] + ends[1]) + SIMPSON[1] * middle)


def _above(x: Float[Array, "2 n"]) -> Float[Array, "2 n"]:
    """(t^2/(4 x) - 1)/x, see `SERIES`."""
    return SERIES[0] + x * SERIES[1] + x**2 * SERIES[2] + SERIES[3] * x**3 * (1 / (1 - x))


class _OfX(NamedTuple):
    """A function of x, its first and second derivative."""

    value: Float[Array, "2 n"]
    first: Float[Array, "2 n"]
    second: Float[Array, "2 n"]

    def by_chord(self) -> "_OfX":
        """With the derivatives by the chord 2 x in the place of those by x."""
        return _OfX(self.value, self.first / 2, self.second / 4)

    def over(self, other: "_OfX") -> "_OfX":
        inverse = 1 / other.value
        value = self.value * inverse
        first = (self.first - value * other.first) * inverse
        return _OfX(value, first, (self.second - 2 * first * other.first - value * other.second) * inverse)

    def times_x(self, x: Float[Array, "2 n"]) -> "_OfX":
        return _OfX(x * self.value, self.value + x * self.first, 2 * self.first + x * self.second)

    def over_rest(self, inverse: Array) -> "_OfX":
        """Over 1 - x, of which the inverse is given."""
        first = self.first + self.value * inverse
        return _OfX(self.value * inverse, first * inverse, (self.second + 2 * first * inverse) * inverse)

    def root(self) -> "_OfX":
        value = jnp.sqrt(self.value)
        inverse = 1 / value
        first = self.first / 2 * inverse
        return _OfX(value, first, (self.second / 2 - first**2) * inverse)


def by_chords(
    density: Callable[[Array], Array], chords: Float[Array, "3 n"], h: Float[Array, "n"]
) -> tuple[Float[Array, "n"], Float[Array, "3 n"], list[list[Float[Array, "n"]]]]:
    """`bending_energies`, their first and their second derivatives by the chords.

    Arrays (2, n) belong to the two ends, a with its chord ab and c with bc. With s = |v|^2 of an end's own chord, s' of
    the other and p = v_a . v_c, the squared curvature at an end is 9 s + s' + 6 p - g s' + q p^2, in the middle
    s + s' - 2 p; g and q are functions of the end's own chord.
    """
    x = chords[:2] / 2
    inverse = 1 / (1 - x)
    last = SERIES[3] * x * inverse
    above = _OfX(
        _above(x),
        SERIES[1] + 2 * SERIES[2] * x + last * x * (2 + inverse),
        2 * SERIES[2] + 2 * last * (1 + inverse + inverse**2),
    )
    ratio = _OfX(1 + x * above.value, *above.times_x(x)[1:])
    rest = _OfX(1 + above.value, above.first, above.second)
    squared = ratio.times_x(x)
    s, s1, s2 = 4 * squared.value, 2 * squared.first, squared.second
    g, g1, g2 = rest.times_x(x).over(ratio).by_chord()
    q, q1, q2 = rest.over(ratio).over(ratio).by_chord()
    q, q1, q2 = q / 4, q1 / 4, q2 / 4
    r, r1, r2 = ratio.over_rest(inverse).root().by_chord()

    # p = r r' d.
    ab, bc, ac = chords
    d, d1 = ab + bc - ac - ab * bc, 1 - chords[1::-1]
    other = r[::-1]
    rr = r[0] * r[1]
    p, p1, pz = rr * d, other * (r1 * d[None] + r * d1), -rr
    p11, p1z = other * (r2 * d[None] + 2 * r1 * d1), -r1 * other
    p12 = r1[0] * r1[1] * d + r1[0] * r[1] * d1[1] + r[0] * r1[1] * d1[0] - rr

    # Derivatives of the squared curvature at an end (k) by its own chord (1), by the other one (2) and by ac (z), and
    # of that in the middle (m) by each end's chord (1) and by ac.
    so, sf1, sf2 = s[::-1], s1[::-1], s2[::-1]
    po1 = p1[::-1]
    w = 6 + 2 * q * p[None]
    k1 = 9 * s1 - g1 * so + q1 * (p * p)[None] + w * p1
    k2 = (1 - g) * sf1 + w * po1
    kz = w * pz[None]
    k11 = 9 * s2 - g2 * so + q2 * (p * p)[None] + 4 * q1 * p[None] * p1 + w * p11 + 2 * q * p1**2
    k12 = -g1 * sf1 + 2 * (q1 * p[None] + q * p1) * po1 + w * p12[None]
    k22 = (1 - g) * sf2 + 2 * q * po1**2 + w * p11[::-1]
    k1z = 2 * (q1 * p[None] + q * p1) * pz[None] + w * p1z
    k2z = 2 * q * po1 * pz[None] + w * p1z[::-1]
    kzz = 2 * q * (pz * pz)[None]
    m1, mz = s1 - 2 * p1, -2 * pz

    k, m = _squared_curvatures(chords)
    per_length = 1 / h
    ends, e, ee = _derivatives(density, k * (per_length**2)[None])
    middle, f, ff = _derivatives(density, m * per_length**2)
    e, f = e * (SIMPSON[0] * per_length)[None], f * (SIMPSON[1] * per_length)
    ee, ff = ee * (SIMPSON[0] * per_length**3)[None], ff * (SIMPSON[1] * per_length**3)
    own1, own2, ownz = ee * k1, ee * k2, ee * kz

    def both(of_end: Float[Array, "2 n"]) -> Float[Array, "n"]:
        return of_end[0] + of_end[1]

    first = e * k1 + (e * k2)[::-1] + f[None] * m1
    firstz = both(e * kz) + f * mz
    of_own = e * k11 + own1 * k1 + (e * k22 + own2 * k2)[::-1] + f[None] * (s2 - 2 * p11) + ff[None] * m1**2
    of_both = both(e * k12 + own1 * k2) - 2 * f * p12 + ff * m1[0] * m1[1]
    with_ac = e * k1z + own1 * kz + (e * k2z + own2 * kz)[::-1] - 2 * f[None] * p1z + (ff * mz)[None] * m1
    of_ac = both(e * kzz + ownz * kz) + ff * mz**2
    gradient = jnp.concatenate([first, firstz[None]])
    hessian = [[of_own[0], of_both, with_ac[0]], [of_both, of_own[1], with_ac[1]], [with_ac[0], with_ac[1], of_ac]]
    return _by_simpson(ends, middle, h), gradient, hessian


def _derivatives(density: Callable[[Array], Array], at: Array) -> tuple[Array, Array, Array]:
    """A density and its derivatives by a squared curvature."""

    def rate(at: Array) -> Array:
        return jax.grad(lambda at: jnp.sum(density(at)))(at)

    first, second = jax.jvp(rate, (at,), (jnp.ones_like(at),))
    return density(at), first, second
