"""The operations of JAX's programs that NumPy has under no name of its own, for `numpy_code`.

Arrays come first, then what is fixed when the program is traced. The names and the meaning of the fixed arguments are
those of `jax.lax`.
"""

import contextlib
import itertools
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

Values = tuple[Any, ...]


class TookTooLongError(Exception):
    """Loops took more time than they were given."""


class _Limit(threading.local):
    """Until when loops of this thread may run, by its own processor time: other work on the machine does not count."""

    until = math.inf


_limit = _Limit()
# Of a scan every so many steps.
CLOCK_STEPS = 8


@contextlib.contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Loops raise `TookTooLongError` after so many seconds."""
    before, _limit.until = _limit.until, time.thread_time() + seconds
    try:
        yield
    finally:
        _limit.until = before


def _look_at_clock() -> None:
    if time.thread_time() > _limit.until:
        raise TookTooLongError


# --- loops and branches ----------------------------------------------------------------------------------------------


def loop(condition: Callable[..., Values], body: Callable[..., Values], carry: Values) -> Values:
    """`while_loop`; the condition of a batch of loops is an array, and those that are done keep what they have."""
    while True:
        _look_at_clock()
        (holds,) = condition(*carry)
        if not np.ndim(holds):
            if not holds:
                return carry
            carry = body(*carry)
            continue
        if not holds.any():
            return carry
        new = body(*carry)
        carry = tuple(
            np.where(np.reshape(holds, holds.shape + (1,) * (np.ndim(b) - holds.ndim)), b, a)
            for a, b in zip(carry, new, strict=True)
        )


def scan(
    body: Callable[..., Values],
    constants: Values,
    carry: Values,
    columns: Values,
    length: int,
    reverse: bool,
    kinds: Sequence[tuple[tuple[int, ...], np.dtype]],
) -> Values:
    """`kinds`: shape and type of what each step gives besides the carry."""
    rows = tuple(np.empty((length, *shape), dtype) for shape, dtype in kinds)
    count = len(carry)
    for k in range(length - 1, -1, -1) if reverse else range(length):
        if not k % CLOCK_STEPS:
            _look_at_clock()
        new = body(*constants, *carry, *[column[k] for column in columns])
        carry = new[:count]
        for row, value in zip(rows, new[count:], strict=True):
            row[k] = value
    return carry + rows


class Callback:
    """A function of Python's, as JAX calls it from programs. It is not kept on disk, nor is what calls it."""

    def __init__(self, function: Callable[..., Sequence[Any]]):
        self.function = function

    def __call__(self, *given: Any) -> Values:
        return tuple(map(np.asarray, self.function(*given)))


# --- shapes ----------------------------------------------------------------------------------------------------------


def filled(x: Any, shape: tuple[int, ...]) -> np.ndarray:
    """An array that broadcasts to a shape, of that shape."""
    result = np.empty(shape, x.dtype)
    result[...] = x
    return result


def stack(arrays: Values, axis: int) -> np.ndarray:
    first = arrays[0]
    shape = first.shape
    result = np.empty((*shape[:axis], len(arrays), *shape[axis:]), first.dtype)
    before = (slice(None),) * axis
    for k, array in enumerate(arrays):
        result[(*before, k)] = array
    return result


def unstack(x: np.ndarray, axis: int) -> Values:
    return tuple(x if not axis else np.moveaxis(x, axis, 0))


def split(x: np.ndarray, sizes: Sequence[int], axis: int) -> Values:
    return tuple(np.split(x, list(itertools.accumulate(sizes))[:-1], axis))


class Padding:
    """Low, high and interior padding of each axis of an array of a shape; edges that are negative are cut off."""

    def __init__(self, shape: Sequence[int], config: Sequence[tuple[int, int, int]]):
        spread = [max(0, n + (n - 1) * gap) if n else 0 for n, (_, _, gap) in zip(shape, config, strict=True)]
        self.sizes = tuple(n + low + high for n, (low, high, _) in zip(spread, config, strict=True))
        from_, to = [], []
        for n, size, (low, _, gap) in zip(shape, self.sizes, config, strict=True):
            step = gap + 1
            first = -(min(low, 0) // step)  # the first entry that is not cut off
            last = min(n, -(-(size - low) // step))
            from_.append(slice(first, max(first, last)))
            to.append(slice(low + first * step, low + max(last - 1, first - 1) * step + 1, step))
        self.places = (tuple(to), tuple(from_)) if all(part.stop > part.start for part in from_) else None

    def __call__(self, x: Any, value: Any) -> np.ndarray:
        result = np.empty(self.sizes, x.dtype)
        result.fill(value)
        if self.places is not None:
            to, from_ = self.places
            result[to] = x[from_]
        return result


def _starts(starts: Values, sizes: Sequence[int], shape: tuple[int, ...]) -> tuple[slice, ...]:
    firsts = [min(max(int(start), 0), n - size) for start, size, n in zip(starts, sizes, shape, strict=True)]
    return tuple(slice(first, first + size) for first, size in zip(firsts, sizes, strict=True))


def dynamic_slice(x: np.ndarray, starts: Values, sizes: Sequence[int]) -> np.ndarray:
    return x[_starts(starts, sizes, x.shape)]


def dynamic_update_slice(x: np.ndarray, update: np.ndarray, starts: Values) -> np.ndarray:
    result = np.array(x)
    result[_starts(starts, update.shape, x.shape)] = update
    return result


# --- places ----------------------------------------------------------------------------------------------------------


class Windows:
    """Where windows of an array of a shape lie that begin at given starts, as `gather` and `scatter` have them.

    `sizes`: of a window along each axis; `mapped`: the axes of the array that the numbers of a start speak of; `fixed`:
    those that windows lack; `batched`: those that go with the axes `batched_starts` of the starts; `moves`: whether
    windows beyond the array are moved into it, not left out.
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        sizes: Sequence[int],
        outer: tuple[int, ...],
        mapped: Sequence[int],
        fixed: Sequence[int],
        batched: Sequence[int],
        batched_starts: Sequence[int],
        moves: bool,
    ):
        inner = [axis for axis in range(len(shape)) if axis not in fixed and axis not in batched]
        count = len(outer) + len(inner)
        self.inner, self.sizes = inner, tuple(sizes)
        self.shape = (*outer, *(sizes[axis] for axis in inner))
        self.ones = (1,) * len(inner)
        self.moves = moves
        # Of each axis: which number of a start, the last place where a window fits, and places from there.
        self.axes: list[tuple[int | None, int, np.ndarray | int]] = []
        for axis, (n, size) in enumerate(zip(shape, sizes, strict=True)):
            places: np.ndarray | int = 0
            if axis in batched:
                places = _line(n, batched_starts[list(batched).index(axis)], count)
            elif axis in inner and size > 1:
                places = _line(size, len(outer) + inner.index(axis), count)
            self.axes.append((list(mapped).index(axis) if axis in mapped else None, n - size, places))

    def places(self, starts: np.ndarray) -> tuple[tuple[np.ndarray | int, ...], Any]:
        """Of each axis the places, over the axes of the starts and then those of a window; and which windows lie
        within the array, `True` where that does not matter.
        """
        is_within: Any = True
        index: list[np.ndarray | int] = []
        for number, last, places in self.axes:
            if number is not None:
                first = starts[..., number]
                if not self.moves:
                    is_within &= (first >= 0) & (first <= last)
                first = np.minimum(np.maximum(first, 0), last)
                places = first.reshape(first.shape + self.ones) + places
            index.append(places)
        return tuple(index), True if is_within is True or is_within.all() else is_within

    def region(self, starts: np.ndarray) -> "Region | None":
        """Where windows lie that begin where the program says; `None` for those beyond the array."""
        places, is_within = self.places(starts)
        if is_within is not True:
            return None
        if starts.ndim > 1:
            return Region(places)
        firsts = [int(np.ravel(place)[0]) for place in places]
        slices = [slice(first, first + size) for first, size in zip(firsts, self.sizes, strict=True)]
        return Region(tuple(slices[axis] if axis in self.inner else first for axis, first in enumerate(firsts)))


class Region:
    """Places of an array by which NumPy picks them; whether each is there once."""

    def __init__(self, places: tuple[Any, ...]):
        self.places = places
        self.is_unique = True
        if any(isinstance(place, np.ndarray) for place in places):
            together = np.stack([np.ravel(place) for place in np.broadcast_arrays(*places)])
            self.is_unique = np.unique(together, axis=1).shape == together.shape


def _line(n: int, axis: int, count: int) -> np.ndarray:
    """0 to n - 1 along one of so many axes."""
    return np.arange(n).reshape([-1 if k == axis else 1 for k in range(count)])


def gather(x: Any, starts: np.ndarray, windows: Windows, order: Sequence[int], missing: Any) -> np.ndarray:
    """`order`: of the axes in the result; `missing`: what stands for a window beyond the array."""
    places, is_within = windows.places(starts)
    result = np.asarray(x)[places]
    if result.shape != windows.shape:
        result = np.broadcast_to(result, windows.shape)
    if is_within is not True:
        result = np.where(is_within.reshape(is_within.shape + windows.ones), result, missing)
    return result.transpose(order)


def gather_at(x: Any, region: Region, shape: tuple[int, ...], order: Sequence[int]) -> np.ndarray:
    """The same where the places are known as the code is written."""
    result = np.asarray(x)[region.places]
    if result.shape != shape:
        result = np.broadcast_to(result, shape)
    return result.transpose(order)


def scatter(
    x: Any, starts: np.ndarray, updates: Any, combine: Any, windows: Windows, order: Sequence[int]
) -> np.ndarray:
    """`combine`: a ufunc, `None` to replace; `order`: of the axes of the updates, those of the starts first."""
    result, updates = np.array(x), np.asarray(updates).transpose(order)
    places, is_within = windows.places(starts)
    if is_within is not True:
        chosen = np.broadcast_to(is_within.reshape(is_within.shape + windows.ones), updates.shape)
        places = tuple(np.broadcast_to(place, updates.shape)[chosen] for place in places)
        updates = updates[chosen]
    if combine is None:
        _put(result, places, updates)
    else:
        combine.at(result, places, updates)
    return result


def scatter_at(x: Any, updates: Any, combine: Any, region: Region, order: Sequence[int]) -> np.ndarray:
    """The same where the places are known as the code is written."""
    result, updates = np.array(x), np.asarray(updates).transpose(order)
    if combine is None:
        _put(result, region.places, updates)
    elif region.is_unique:
        result[region.places] = combine(result[region.places], updates)
    else:
        combine.at(result, region.places, updates)
    return result


def _put(x: np.ndarray, places: tuple[Any, ...], updates: np.ndarray) -> None:
    x[places] = updates if np.ndim(x[places]) else updates.reshape(())  # NumPy puts no array at the place of a number


# --- sums, orders, products ------------------------------------------------------------------------------------------


def accumulate(x: np.ndarray, ufunc: np.ufunc, axis: int, reverse: bool) -> np.ndarray:
    if not reverse:
        return ufunc.accumulate(x, axis)
    return np.flip(ufunc.accumulate(np.flip(x, axis), axis), axis)


def sort(arrays: Values, axis: int, keys: int) -> Values:
    """By the first arrays, the others along with them; equal ones stay in their order."""
    order = np.argsort(arrays[0], axis, kind="stable")
    if keys > 1:
        order = np.lexsort(arrays[keys - 1 :: -1], axis)
    return tuple(np.take_along_axis(array, order, axis) for array in arrays)


def before_in_order(a: Any, b: Any, or_same: bool) -> Any:
    """a < b, with -0 before 0 and what is no number last."""
    if not np.issubdtype(a.dtype, np.floating):
        return a <= b if or_same else a < b
    # Numbers as integers in the same order: those below zero have their other bits reversed.
    whole = np.dtype(f"i{a.dtype.itemsize}")
    a, b = (np.asarray(x).view(whole) for x in (a, b))
    a, b = (np.where(x < 0, x ^ np.iinfo(whole).max, x) for x in (a, b))
    return a <= b if or_same else a < b


class Product:
    """A contraction of two arrays as a product of matrices, for arrays of given shapes."""

    def __init__(
        self,
        shapes: tuple[tuple[int, ...], tuple[int, ...]],
        contracted: tuple[Sequence[int], Sequence[int]],
        batched: tuple[Sequence[int], Sequence[int]],
    ):
        free = [
            [axis for axis in range(len(shape)) if axis not in over and axis not in along]
            for shape, over, along in zip(shapes, contracted, batched, strict=True)
        ]
        outer = [shapes[0][axis] for axis in batched[0]]
        n = math.prod(shapes[0][axis] for axis in contracted[0])
        self.orders = [*batched[0], *free[0], *contracted[0]], [*batched[1], *contracted[1], *free[1]]
        rows, columns = ([shape[axis] for axis in axes] for shape, axes in zip(shapes, free, strict=True))
        self.matrices = [*outer, math.prod(rows), n], [*outer, n, math.prod(columns)]
        self.shape = [*outer, *rows, *columns]
        # Most products are of matrices without any axis to be moved.
        self.is_plain = all(
            order == list(range(len(order))) and list(shape) == matrix
            for order, shape, matrix in zip(self.orders, shapes, self.matrices, strict=True)
        )

    def __call__(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        if self.is_plain:
            return np.matmul(a, b)
        left = a.transpose(self.orders[0]).reshape(self.matrices[0])
        right = b.transpose(self.orders[1]).reshape(self.matrices[1])
        return np.matmul(left, right).reshape(self.shape)


# --- linear algebra --------------------------------------------------------------------------------------------------


def _each_matrix(function: Callable[..., Values], *arrays: np.ndarray) -> Values:
    """A function of matrices for all of a batch."""
    outer = arrays[0].shape[:-2]
    if not outer:
        return function(*arrays)
    flat = [array.reshape(-1, *array.shape[len(outer) :]) for array in arrays]
    results = [function(*row) for row in zip(*flat, strict=True)]
    columns = [np.stack(column) for column in zip(*results, strict=True)]
    return tuple(column.reshape(outer + column.shape[1:]) for column in columns)


def _or_no_numbers(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """A function of square matrices, not a number for those of which NumPy has none, as in JAX."""
    try:
        return function(x)
    except np.linalg.LinAlgError:
        if x.ndim == 2:
            return np.full_like(x, np.nan)
    return _each_matrix(lambda matrix: (_or_no_numbers(function, matrix),), x)[0]


def cholesky(x: np.ndarray) -> np.ndarray:
    """Not a number where a matrix is not positive definite."""
    return _or_no_numbers(np.linalg.cholesky, x)


def lu(x: np.ndarray) -> Values:
    def one(matrix: np.ndarray) -> Values:
        if not np.isfinite(matrix).all():
            n = min(matrix.shape)
            return np.full_like(matrix, np.nan), np.arange(n, dtype=np.int32), np.arange(len(matrix), dtype=np.int32)
        factors, pivots, _ = _getrf(matrix)
        return factors, pivots, permutation(pivots, len(matrix))

    return _each_matrix(one, x)


def special(name: str) -> Callable[..., np.ndarray]:
    import scipy.special  # a tenth of a second, for few programs

    return getattr(scipy.special, name)


def _getrf(matrix: np.ndarray) -> Values:
    import scipy.linalg  # a tenth of a second, for few programs

    (getrf,) = scipy.linalg.get_lapack_funcs(("getrf",), (matrix,))
    factors, pivots, info = getrf(matrix)
    return factors, pivots.astype(np.int32), info


def permutation(pivots: np.ndarray, size: int) -> np.ndarray:
    """The order of rows after exchanges."""
    if pivots.ndim > 1:
        return np.stack([permutation(row, size) for row in pivots])
    order = np.arange(size, dtype=np.int32)
    for k, other in enumerate(pivots):
        order[[k, other]] = order[[other, k]]
    return order


def triangular_solve(
    a: np.ndarray, b: np.ndarray, left_side: bool, lower: bool, transpose_a: bool, unit_diagonal: bool
) -> np.ndarray:
    """x of op(a) x = b, or of x op(a) = b; not a number where there is none."""
    a = np.tril(a) if lower else np.triu(a)
    if unit_diagonal:
        places = np.arange(a.shape[-1])
        a[..., places, places] = 1
    if transpose_a == left_side:
        a = np.swapaxes(a, -1, -2)
    right = b if left_side else np.swapaxes(b, -1, -2)
    # Not LAPACK's own routine for triangles, which starts threads for the smallest matrix.
    try:
        x = np.linalg.solve(a, right)
    except np.linalg.LinAlgError:
        is_regular = (np.diagonal(a, axis1=-2, axis2=-1) != 0).all(-1)[..., None, None]
        x = np.where(is_regular, np.linalg.solve(np.where(is_regular, a, np.eye(a.shape[-1])), right), np.nan)
    return x if left_side else np.swapaxes(x, -1, -2)


def eigh(x: np.ndarray, lower: bool) -> Values:
    """Vectors, then values."""

    def one(matrix: np.ndarray) -> Values:
        if not np.isfinite(matrix).all():
            return np.full_like(matrix, np.nan), np.full_like(matrix[0], np.nan)
        values, vectors = np.linalg.eigh(matrix, "L" if lower else "U")
        return vectors, values

    return _each_matrix(one, x)


def inverse(x: np.ndarray) -> np.ndarray:
    """Not a number where a matrix is singular."""
    return _or_no_numbers(np.linalg.inv, x)


def substitution(couplings: np.ndarray, right: np.ndarray, backward: bool) -> np.ndarray:
    """As `linalg.substitution` has it."""
    x = np.array(right)
    count = couplings.shape[-3]
    for k in range(count - 1, -1, -1) if backward else range(count):
        here, beside = (k, k + 1) if backward else (k + 1, k)
        x[..., here, :, :] -= couplings[..., k, :, :] @ x[..., beside, :, :]
    return x


def negative_counts(x: np.ndarray) -> np.ndarray:
    """How many eigenvalues of each symmetric matrix are negative; none where it has no numbers."""
    is_known = np.isfinite(x).all((-2, -1), keepdims=True)
    return np.sum(np.linalg.eigvalsh(np.where(is_known, x, 0.0)) < 0, axis=-1)


def svd(x: np.ndarray) -> Values:
    """Singular values, then left and right vectors, as many as there are values."""

    def one(matrix: np.ndarray) -> Values:
        count = min(matrix.shape)
        if not np.isfinite(matrix).all():
            shapes = (count,), (matrix.shape[0], count), (count, matrix.shape[1])
            return tuple(np.full(shape, np.nan, matrix.dtype) for shape in shapes)
        left, values, right = np.linalg.svd(matrix, full_matrices=False)
        return values, left, right

    return _each_matrix(one, x)


def tridiagonal(x: np.ndarray) -> Values:
    """Tridiagonal matrices similar to these: their eigenvalues, with zeros beside them. The reflections that lead there
    are not made: not a number.
    """
    _, values = eigh(x, True)
    unknown = np.full_like(values[..., 1:], np.nan)
    return np.full_like(x, np.nan), values, np.zeros_like(unknown), unknown
