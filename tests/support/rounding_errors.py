"""A check that a policy's passes round like the authors' own passes."""

from __future__ import annotations

import numpy as np

_AS_LARGE = 1.25  # errors of small networks vary by about a tenth between draws


def check_rounding(ours: np.ndarray, theirs: np.ndarray, exact: np.ndarray) -> None:
    """Check that the rounding error of this package's actions is not larger than the error of the
    authors' passes.

    Args:
        ours: Actions of this package in a coarse type.
        theirs: Actions of the authors' passes in the same type.
        exact: Actions of the authors' passes in float32, with the same weights.
    """
    our_error, their_error = (
        float(np.linalg.norm(actions - exact) / np.linalg.norm(exact)) for actions in (ours, theirs)
    )
    print(
        f"expected a relative error near that of the authors' passes, {their_error:.5f}, got {our_error:.5f}"
    )
    assert 0 < our_error <= _AS_LARGE * their_error
