"""What of ``estimates.json`` the report reads, with its types; other keys are let through."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict


class _Stored(BaseModel):
    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)


class StoredEstimate(_Stored):
    """An estimate, or the reason why there is none."""

    crash_rate: float | None
    reason: str | None = None
    std_error: float | None = None
    ci_low: float | None = None
    ci_high: float | None = None
    upper_bound: float | None = None
    confidence: float | None = None
    rhw: float | None = None
    n_episodes: int | None = None
    n_crashes: int | None = None
    n_effective: float | None = None
    largest_weight_share: float | None = None
    weight_cap: float | None = None
    method: str | None = None
    warnings: list[str] = []
    details: dict[str, Any] = {}


class StoredEstimates(_Stored):
    """The content of ``estimates.json``."""

    campaign: str
    campaign_hash: str
    lane_change_level: float
    confidence: float
    headline: str
    estimates: dict[str, StoredEstimate]
    statement: str
    statements: dict[str, str] = {}
    conditional_statement: str | None = None
    scope: str | None = None
    n_episodes: int | None = None
    n_crashes: int | None = None
    distance_per_test_km: float | None = None
    crash_rate_per_1e6_km: dict[str, float | None] | None = None
    diagnostics: dict[str, Any] | None = None
    convergence: list[dict[str, float | None]] | None = None
