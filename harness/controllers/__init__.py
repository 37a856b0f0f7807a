"""Bring your own AV: what a controller sees, what it answers, and what happens when it misbehaves."""

from harness.controllers.protocol import (
    BatchController,
    BatchObservation,
    EpisodeStart,
    Neighbour,
    Observation,
    VehicleController,
)

__all__ = ["BatchController", "BatchObservation", "EpisodeStart", "Neighbour", "Observation", "VehicleController"]
