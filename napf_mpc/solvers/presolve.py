"""What a program of soft rows can do without: rows that say nothing, and slacks that are expected at zero.

A *slack* here is a variable with a cost of its own, ``p s^2 / 2 + q s`` with ``q >= 0``, that is held at
``s >= 0`` by a row of its own and helps in all others: more of it never breaks a row. Two things follow.

- Without a linear price the row ``s >= 0`` says nothing: a negative slack would cost and help nobody. Such a
  row is left out whatever the numbers, with a multiplier of zero.
- With a linear price the penalty is exact. Leave the slack out, so that its rows are hard; if they can be
  kept at multipliers that in sum stay below the price, that is the optimum of the whole program, and what
  is left of the price is the multiplier of ``s >= 0``. If not, the whole program has to be solved.

A slack with a row on either side (``v + s >= low``, ``v - s <= high``) leaves one row ``low <= v <= high``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled
from napf_mpc.quadratic_program import Array, Index, Sparsity, Values

Mask = NDArray[np.bool_]

AT_ZERO = 1e-6
"""A slack of a guess up to this is expected at zero [unit of its rows]."""


@dataclass(frozen=True, eq=False)
class Part:
    """A program with columns and rows of a whole one left out."""

    sparsity: Sparsity
    """Of the part."""
    columns: Index
    """(n') its columns in the whole."""
    rows: Index
    """(m') its rows in the whole: where the lower bound comes from."""
    above: Index
    """(m') where the upper bound comes from; differs where two rows of the whole became one."""
    p_at: Index
    """Its numbers among those of the whole's P, upper triangle only: that is what OSQP takes."""
    a_at: Index
    """Its numbers among those of the whole's A."""

    @classmethod
    def of(cls, whole: Sparsity, columns: Mask, rows: Mask, above: Index) -> Part:
        """Part of the marked columns and rows; ``above`` (m) as in the part, for rows of the whole."""
        kept_columns, kept_rows = np.flatnonzero(columns), np.flatnonzero(rows)
        column, row = np.cumsum(columns) - 1, np.cumsum(rows) - 1
        upper = whole.p_rows <= whole.p_columns
        p_at = np.flatnonzero(upper & columns[whole.p_rows] & columns[whole.p_columns])
        a_at = np.flatnonzero(rows[whole.a_rows] & columns[whole.a_columns])
        sparsity = Sparsity(
            len(kept_columns), len(kept_rows),
            column[whole.p_rows[p_at]], column[whole.p_columns[p_at]],
            row[whole.a_rows[a_at]], column[whole.a_columns[a_at]],
        )  # fmt: skip
        return cls(sparsity, kept_columns, kept_rows, above[kept_rows], p_at, a_at)

    def guess(self, z: Array, y: Array) -> tuple[Array, Array]:
        """Guess of the part from one of the whole."""
        return _guess(z, y, self.columns, self.rows, self.above)


@dataclass(frozen=True, eq=False)
class Slacks:
    """Slacks of programs of one sparsity, and the parts of a program that do without them."""

    most: Part
    """All but the rows ``s >= 0`` that say nothing."""
    hard: Part | None
    """Without priced slacks and their rows; None without such slacks, or if nothing would be left."""
    priced: Mask
    """(n,) whether a variable is a slack with a linear price."""
    _whole: Sparsity
    _columns: Index
    """Of slacks, those with a price first."""
    _curvature: Index
    """Places of their curvatures in P."""
    _own: Index
    """Places in A of their entries in their rows ``s >= 0``."""
    _helping: Index
    """Places in A of their other entries."""
    _signs: Array
    """Signs of these."""
    _first: Index
    """Places in A of the entries of rows that take a second one in."""
    _second: Index
    """Places of the entries of those second ones."""

    @classmethod
    def of(cls, sparsity: Sparsity, values: Values, priced_before: Mask | None = None) -> Slacks:
        """Slacks of a program.

        Parameters
        ----------
        sparsity : Sparsity
            Places of its numbers.
        values : Values
            Its numbers.
        priced_before : array of bool, shape (n,), optional
            Variables that count as priced slacks even without a price, so that a price that comes and goes
            does not change the parts each time.
        """
        n, m, rows, columns = sparsity.variables, sparsity.constraints, sparsity.a_rows, sparsity.a_columns
        lower, upper = values.lower[rows], values.upper[rows]
        own = (np.bincount(rows, minlength=m)[rows] == 1) & (values.a > 0.0)
        own &= (lower == 0.0) & (upper == np.inf)
        helps = ((values.a > 0.0) & (upper == np.inf)) | ((values.a < 0.0) & (lower == -np.inf))
        on_diagonal = sparsity.p_rows == sparsity.p_columns
        curvature = np.full(n, -1)
        curvature[sparsity.p_rows[on_diagonal]] = np.flatnonzero(on_diagonal)
        slack = (np.bincount(columns[own], minlength=n) == 1) & (values.q >= 0.0) & (curvature >= 0)
        slack[slack] = values.p[curvature[slack]] > 0.0
        slack[columns[~helps]] = False
        slack[sparsity.p_rows[~on_diagonal]] = False
        priced = slack & (values.q > 0.0)
        if priced_before is not None:
            priced |= slack & priced_before
        place = np.full(n, -1)
        place[columns[own]] = np.flatnonzero(own)
        ordered = np.concatenate([np.flatnonzero(priced), np.flatnonzero(slack & ~priced)])
        kept, above = np.ones(m, dtype=bool), np.arange(m)
        kept[rows[place[slack & ~priced]]] = False
        most = Part.of(sparsity, np.ones(n, dtype=bool), kept, above)
        kept[rows[place[priced]]] = False
        first, second = _same_rows(sparsity, values.a, priced, own)
        above[rows[first]], kept[rows[second]] = rows[second], False
        use = priced.any() and not priced.all()
        hard = Part.of(sparsity, ~priced, kept, above) if use else None
        helping = np.flatnonzero(slack[columns] & ~own)
        return cls(
            most, hard, priced, sparsity, ordered, curvature[ordered], place[ordered], helping,
            np.sign(values.a[helping]), first, second,
        )  # fmt: skip

    def fit(self, values: Values) -> bool:
        """Whether they are slacks in these numbers too."""
        return bool(
            _fit(
                values.p, values.q, values.a, values.lower, values.upper, self._whole.a_rows, self.priced,
                self._columns, self._curvature, self._own, self._helping, self._signs,
            )
        )  # fmt: skip

    def expected_at_zero(self, values: Values, z: Array) -> bool:
        """Whether a guess has all priced slacks at zero, and the hard part may be asked."""
        if self.hard is None:
            return False
        return bool(
            _expected_at_zero(
                z, self.priced, values.a, values.lower, values.upper,
                self._whole.a_rows, self._first, self._second,
            )
        )  # fmt: skip

    def whole(self, part: Part, values: Values, z: Array, y: Array) -> tuple[Array, Array, bool]:
        """Point and multipliers of the whole program from those of a part.

        Returns
        -------
        z, y : array, shapes (n,) and (m,)
            With slacks that were left out at zero, and the multipliers that they must then have.
        paid : bool
            Whether no row pushes beyond the price of its slack: what optimal is for the part, then is so
            for the whole.
        """
        whole = self._whole
        all_z, all_y = np.zeros(whole.variables), np.zeros(whole.constraints)
        all_z[part.columns] = z
        paid = _completed(
            y, part.rows, part.above, values.q, values.a, whole.a_rows, whole.a_starts,
            self._columns, self._own, self.priced, part is self.hard, all_y,
        )  # fmt: skip
        return all_z, all_y, bool(paid)


def _same_rows(sparsity: Sparsity, a: Array, priced: Mask, own: Mask) -> tuple[Index, Index]:
    """Places in A of rows below and above that are the same without their common slack, entry by entry."""
    rows, columns = sparsity.a_rows, sparsity.a_columns
    by_row = np.lexsort((columns, rows))
    starts = np.searchsorted(rows[by_row], np.arange(sparsity.constraints + 1))
    slacks_in = np.bincount(rows[priced[columns]], minlength=sparsity.constraints)
    first, second = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for column in np.flatnonzero(priced):
        entries = np.arange(sparsity.a_starts[column], sparsity.a_starts[column + 1])
        entries = entries[~own[entries]]
        # A row with a second slack might be asked to become one with two others.
        alone = (slacks_in[rows[entries]] == 1).all()
        if not (alone and len(entries) == 2 and a[entries[0]] * a[entries[1]] < 0.0):
            continue
        below, beyond = rows[entries] if a[entries[0]] > 0.0 else rows[entries[::-1]]
        low, high = (by_row[starts[row] : starts[row + 1]] for row in (below, beyond))
        low, high = low[~priced[columns[low]]], high[~priced[columns[high]]]
        same = np.array_equal(columns[low], columns[high]) and np.array_equal(a[low], a[high])
        if len(low) and same:
            first.append(low)
            second.append(high)
    return np.concatenate(first), np.concatenate(second)


@compiled
def _guess(z: Array, y: Array, columns: Index, rows: Index, above: Index) -> tuple[Array, Array]:
    point, multipliers = np.empty(len(columns)), np.empty(len(rows))
    for j in range(len(columns)):
        point[j] = z[columns[j]]
    for i in range(len(rows)):
        multipliers[i] = y[rows[i]] if above[i] == rows[i] else y[rows[i]] + y[above[i]]
    return point, multipliers


@compiled
def _expected_at_zero(
    z: Array, priced: Mask, a: Array, lower: Array, upper: Array, a_rows: Index, first: Index, second: Index
) -> bool:
    for j in range(len(z)):
        if priced[j] and z[j] > AT_ZERO:
            return False
    for k in range(len(first)):
        # OSQP keeps its old bounds when it is given crossed ones.
        if a[first[k]] != a[second[k]] or lower[a_rows[first[k]]] > upper[a_rows[second[k]]]:
            return False
    return True


@compiled
def _fit(
    p: Array, q: Array, a: Array, lower: Array, upper: Array, a_rows: Index, priced: Mask,
    columns: Index, curvature: Index, own: Index, helping: Index, signs: Array,
) -> bool:  # fmt: skip
    for k in range(len(columns)):
        j, row = columns[k], a_rows[own[k]]
        if not (q[j] == 0.0 or (priced[j] and q[j] > 0.0)) or not p[curvature[k]] > 0.0:
            return False
        if not a[own[k]] > 0.0 or lower[row] != 0.0 or upper[row] != np.inf:
            return False
    for k in range(len(helping)):
        row = a_rows[helping[k]]
        if not a[helping[k]] * signs[k] > 0.0 or (upper[row] if signs[k] > 0.0 else -lower[row]) != np.inf:
            return False
    return True


@compiled
def _completed(
    part_y: Array, rows: Index, above: Index, q: Array, a: Array, a_rows: Index, a_starts: Index,
    columns: Index, own: Index, priced: Mask, hard: bool, y: Array,
) -> bool:  # fmt: skip
    """Write the multipliers y (m,) of the whole; return whether no price is exceeded."""
    for i in range(len(rows)):
        # Of two rows that became one, the lower bound pushes with negative multipliers.
        y[above[i] if part_y[i] > 0.0 else rows[i]] = part_y[i]
    paid = True
    for k in range(len(columns)):
        j = columns[k]
        if hard and priced[j]:
            left = q[j]
            for entry in range(a_starts[j], a_starts[j + 1]):
                if entry != own[k]:
                    left += a[entry] * y[a_rows[entry]]
            y[a_rows[own[k]]] = -left / a[own[k]]
            paid = paid and left >= 0.0
    return paid
