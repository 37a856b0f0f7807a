"""What ended a campaign, which condition decided when, and what to do when that was not the asked precision."""

from __future__ import annotations

from typing import Literal

StoppedBy = Literal["rhw", "accept", "contradicted", "two_phase", "episodes", "pool", "pool_error"]
"""The asked precision, a decision about the limit, a vehicle that does not do what the deciding statement assumes, the
number of tests planned for a precision, the budget, the last cut-in that the pool holds of a shell that needs more, or
the pool's own error, which alone is wider than that."""

MENDS: dict[str, str] = {
    "episodes": "stop.episodes was spent; raise it and go on with --resume",
    "pool": "all cut-ins that the pool keeps of a shell were tested; raise pool.cut_ins_per_shell and use a new folder",
    "contradicted": "the vehicle does not do what the statement assumes; ask for accept.statement: assumption_free and "
    "use a new folder",
    "pool_error": "the pool's own error alone is wider; lower pool.relative_error (or raise pool.shadow_paths, of a "
    "vehicle that acts before the cut-in) and use a new folder",
}
"""Why a campaign ended before its precision, and the mend."""


def ending(stopped_by: StoppedBy, n_episodes: int, unmet: tuple[str, ...], *, precision_asked: bool) -> str:
    """When a campaign ended and what decided it, in a sentence.

    ``unmet`` are the conditions that were not met when the stop rule last said no; without a ``precision_asked``
    there was only a budget.
    """
    after = f"Stopped after {n_episodes:,} tests"
    conditions = " and ".join(unmet)
    if stopped_by in ("rhw", "accept"):
        if not unmet:
            return f"{after}: every condition was met at the first look."
        return f"{after}: the last condition to be met was {conditions}."
    if stopped_by == "two_phase":
        return f"{after}: as many as the first phase had planned, which are reported without it."
    if precision_asked:
        return f"{after} without {conditions}: {MENDS[stopped_by]}."
    if stopped_by == "episodes":
        return f"{after}: stop.episodes was all that was asked for."
    return f"{after}: {MENDS[stopped_by]}."
