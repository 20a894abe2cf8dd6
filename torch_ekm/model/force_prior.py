"""What is known of contact forces before a measurement, put into the force problem."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..contact.contact_kinematics import ContactKinematics
from ..contact.forces.balance import BalanceEquations
from ..contact.forces.options import ForceOptions
from ..exceptions import ShapeError
from ..typing import Array
from .expected_forces import ExpectedForces, start_covariance


class ForcePrior:
    """``N(x^, Sigma)`` of the stacked contact forces, read in the contact frames of the present state.

    Contacts that were not expected begin at 0, with ``start_std`` across the normal and any force along it.

    Args:
        kin: the contacts.
        expected: forces predicted from the state before, of one state or of as many as ``kin`` has.
        options: standard deviations.

    Raises:
        ShapeError: ``expected`` has another batch.
    """

    def __init__(
        self, kin: ContactKinematics, expected: ExpectedForces | None, options: ForceOptions
    ) -> None:
        contacts = kin.contacts
        batch, n_c = contacts.batch_shape, contacts.n_c
        mean = contacts.point.new_zeros(*batch, n_c, 4)
        covariance = start_covariance(contacts.normal, options)
        if expected is not None:
            if expected.force.shape[:-2] not in (batch, ()):
                raise ShapeError("expected.force", f"{(*batch, n_c, 3)}", expected.force.shape)
            both = [name for name in contacts.finger if name in expected.finger]
            now, then = ([names.index(f) for f in both] for names in (contacts.finger, expected.finger))
            mean[..., now, :3] = expected.force[..., then, :]
            mean[..., now, 3] = expected.spin_moment[..., then]
            row, column = _stacked(now), _stacked(then)
            covariance[..., row[:, None], row] = expected.covariance[..., column[:, None], column]
        self._rows = np.array(kin.rows)
        m = 4 * n_c
        self._mean, self._covariance, self._frame = (
            x.detach().reshape(-1, *shape).double().cpu().numpy()
            for x, shape in ((mean, (m,)), (covariance, (m, m)), (kin.frame, (n_c, 3, 3)))
        )

    def into(self, eq: BalanceEquations, k: int) -> BalanceEquations:
        """The balance of state k with its expected forces."""
        T = self._selection(k)
        return dataclasses.replace(
            eq,
            expected=T @ self._mean[k],
            expected_covariance=T @ self._covariance[k] @ T.T,
        )

    def stacked(self, covariance: Array, k: int) -> Array:
        """A covariance of ``mu`` as one of the stack."""
        T = self._selection(k)
        return T.T @ covariance @ T

    def _selection(self, k: int) -> Array:
        """T with ``mu = T x``, orthonormal rows."""
        contact, component = np.divmod(self._rows, 6)
        T = np.zeros((len(contact), self._frame.shape[1], 4))
        force = component < 3
        T[force, contact[force], :3] = self._frame[k, contact[force], :, component[force]]
        T[~force, contact[~force], 3] = 1.0
        return T.reshape(len(contact), -1)


def _stacked(contacts: list[int]) -> np.ndarray:
    return (4 * np.array(contacts, dtype=int)[:, None] + np.arange(4)).ravel()
