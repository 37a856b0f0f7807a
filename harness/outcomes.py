"""How an episode can end, which vehicles take part, and how critical moments can be sampled: names and codes."""

from __future__ import annotations

from harness.methods import METHODS

OUTCOMES = ("crash", "passed", "timeout", "bv_lv_contact", "failed")
CRASH, PASSED, TIMEOUT, BV_LV_CONTACT, FAILED = range(len(OUTCOMES))
RUNNING = -1

VEHICLES = ("LV", "BV", "AV")
LV, BV, AV = range(len(VEHICLES))

NDE, FORCED, STEP_MIXTURE, EPISODE_MIXTURE, PRESCRIBED = range(len(METHODS))
"""Methods as kernels know them; PRESCRIBED is shells, and any method where shadow runs prescribe the traffic."""
