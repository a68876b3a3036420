"""Records of many points, evaluated as records of one point each: the expressions of a point are compiled once."""

from dataclasses import dataclass

import numpy as np

from armcal.base.domains import Array


@dataclass(frozen=True)
class PointRecords:
    """Between records of P points and as many records of one point, those of a record side by side.

    Attributes:
        shared: how many channels all points of a record have in common; they come first.
        points: what distinguishes the points (P x k).
    """

    shared: int
    points: Array

    @property
    def count(self) -> int:
        """How many points a record has."""
        return len(self.points)

    def split(self, record: Array) -> Array:
        """Channels (shared + P c x N) as those of one point each (shared + c + k x N P)."""
        number, per_point = record.shape[1], (len(record) - self.shared) // self.count
        own = record[self.shared :].reshape(self.count, per_point, number)
        return np.concatenate(
            [
                np.repeat(record[: self.shared], self.count, axis=1),
                own.transpose(1, 2, 0).reshape(per_point, -1 if per_point else number * self.count),
                np.tile(self.points.T, number),
            ]
        )

    def repeated(self, state: Array) -> Array:
        """What is one for a record (n x N), for each of its points (n x N P)."""
        return np.repeat(state, self.count, axis=1)

    def joined(self, rows: Array) -> Array:
        """Rows of points (r x N P) as those of records, point by point (P r x N)."""
        parts = rows.reshape(len(rows), -1, self.count)
        return np.ascontiguousarray(parts.transpose(2, 0, 1).reshape(-1, parts.shape[1]))
