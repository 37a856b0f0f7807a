"""What ended a campaign, and what to do when that was not the asked precision."""

from __future__ import annotations

from typing import Literal

StoppedBy = Literal["rhw", "episodes", "pool", "pool_error"]
"""The asked precision, the budget, the last cut-in that the pool holds of a shell that needs more, or the pool's own
error, which alone is wider than the asked precision."""

MENDS: dict[str, str] = {
    "episodes": "stop.episodes was spent; raise it and go on with --resume",
    "pool": "all cut-ins that the pool keeps of a shell were tested; raise pool.cut_ins_per_shell and use a new folder",
    "pool_error": "the pool's own error alone is wider; lower pool.relative_error and use a new folder",
}
"""Why a campaign ended before its precision, and the mend."""
