"""Where to look for initial states: importance sampling in the five uniforms that an initial state is made from.

Each uniform gets a piecewise constant density of its own, fitted to a pilot run, as in Lepage's VEGAS (J. Comput.
Phys. 27, 1978, 192), mixed with a share of the naturalistic density that bounds every weight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.arrays import FloatArray

N_BINS = 16
NATURALISTIC_SHARE = 0.2
"""Weights are at most its inverse."""


@dataclass(frozen=True)
class Proposal:
    """Product density on the unit cube, mixed with the uniform one.

    Attributes
    ----------
    density : ndarray, shape (dimensions, N_BINS)
        Density within each bin; its mean over the bins is 1.
    """

    density: FloatArray

    def map(self, u: FloatArray, choice: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points drawn from the proposal, and their weights.

        Parameters
        ----------
        u : ndarray, shape (n, dimensions)
            Uniforms.
        choice : ndarray, shape (n,)
            Uniforms that decide which points stay naturalistic.

        Returns
        -------
        points : ndarray, shape (n, dimensions)
        weights : ndarray, shape (n,)
            Naturalistic density over the proposal's.
        """
        edges = np.linspace(0.0, 1.0, N_BINS + 1)
        aimed = choice >= NATURALISTIC_SHARE
        points = u.copy()
        density = np.ones(len(u))
        for d, levels in enumerate(self.density):
            cumulative = np.concatenate([[0.0], np.cumsum(levels) / N_BINS])
            cumulative[-1] = 1.0
            points[aimed, d] = np.interp(u[aimed, d], cumulative, edges)
            density *= levels[np.minimum((points[:, d] * N_BINS).astype(np.int64), N_BINS - 1)]
        weights: FloatArray = 1.0 / (NATURALISTIC_SHARE + (1.0 - NATURALISTIC_SHARE) * density)
        return points, weights


def fit_proposal(u: FloatArray, importance: FloatArray) -> Proposal:
    """Proposal from a naturalistic pilot run.

    Parameters
    ----------
    u : ndarray, shape (n, dimensions)
        Its uniforms.
    importance : ndarray, shape (n,)
        What a point contributes to what is to be known; the best density of one variable is the root of its mean
        square within each bin.
    """
    density = np.ones((u.shape[1], N_BINS))
    for d in range(u.shape[1]):
        bins = np.minimum((u[:, d] * N_BINS).astype(np.int64), N_BINS - 1)
        counts = np.bincount(bins, minlength=N_BINS)
        squares = np.bincount(bins, importance * importance, minlength=N_BINS) / np.maximum(counts, 1)
        root = np.sqrt(squares)
        smooth = np.convolve(np.concatenate([root[:1], root, root[-1:]]), [0.25, 0.5, 0.25], "valid")
        if smooth.sum() > 0.0:
            density[d] = smooth * (N_BINS / smooth.sum())
    return Proposal(density)
