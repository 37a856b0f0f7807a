"""Assemble a campaign's importance functions from its settings and the challenge tables."""

from __future__ import annotations

import numpy as np

from harness.campaign.campaign import Campaign
from harness.importance.challenge import level_steps
from harness.importance.functions import Importance
from harness.importance.tables import Tables
from harness.vehicles.kinematics import CONTACT_M
from harness.vocabulary import (
    EPISODE_MIXTURE,
    FORCED,
    METHODS,
    SAMPLING,
    STEP_MIXTURE,
    BoolArray,
    Float32Array,
    read_only,
)

_ROUNDING_M = 1e-9
"""More than interpolation between gaps of up to a kilometre can lose."""


def needs_tables(campaign: Campaign) -> bool:
    """Whether the campaign's method looks at surrogates at all."""
    return SAMPLING[campaign.testing.method].mixes


def importance_names(campaign: Campaign) -> tuple[str, ...]:
    """Names of the importance functions, in the order of ``log_q``."""
    defensive = ("forced",) if SAMPLING[campaign.testing.method].forces else ()
    return defensive + (tuple(campaign.surrogates) if needs_tables(campaign) else ())


def mixture_weights(campaign: Campaign) -> tuple[float, ...]:
    """Weights α of the importance functions, in the order of `importance_names`."""
    method = METHODS.index(campaign.testing.method)
    if method == FORCED:
        return (1.0,)
    if method == STEP_MIXTURE:
        return campaign.alpha()
    if method == EPISODE_MIXTURE:
        share = campaign.testing.defensive_share
        return (share, *((1.0 - share) * weight for weight in campaign.alpha()))
    return ()


def build_importance(campaign: Campaign, tables: Tables | None) -> Importance:
    """Importance functions of a campaign; ``nde`` and ``forced`` need no challenge tables."""
    method = campaign.testing.method
    recursive = campaign.testing.challenge == "recursive"
    none = _none(5), _none(5), _none(5), np.zeros((0, 1, 1, 1), np.bool_)
    return Importance(
        METHODS.index(method),
        recursive,
        len(campaign.surrogates) if needs_tables(campaign) else 0,
        1 if SAMPLING[method].forces else 0,
        level_steps(round(campaign.environment.acceleration_hold_s * 10)),
        campaign.testing.epsilon,
        campaign.testing.criticality_threshold,
        np.array(mixture_weights(campaign), dtype=np.float64),
        *(none if tables is None else (*tables, harmless_cells(tables.maneuvers, recursive=recursive))),
    )


def harmless_cells(maneuvers: Float32Array, *, recursive: bool) -> BoolArray:
    """Grid cells in which every acceleration has challenge 0, wherever in the cell it is interpolated.

    ``maneuvers`` (J, v, R2, R2dot, 31) are probabilities (recursive) or smallest gaps in metres (immediate); the result
    has shape (J, v - 1, R2 - 1, R2dot - 1).
    """
    cells: BoolArray = maneuvers.max(-1) == 0.0 if recursive else maneuvers.min(-1) > CONTACT_M + _ROUNDING_M
    for axis in (1, 2, 3):
        n = cells.shape[axis]
        cells = cells.take(range(n - 1), axis) & cells.take(range(1, n), axis)
    return cells


def _none(dimensions: int) -> Float32Array:
    """No table; read-only like those that are mapped, for kernels to be compiled once."""
    return read_only(np.zeros((0,) + (1,) * (dimensions - 1), np.float32))
