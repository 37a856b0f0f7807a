"""Which estimator answers a campaign's question: each method of drawing has its own."""

from __future__ import annotations

from harness.campaign.models import EstimatorName, Method

_OWN: dict[Method, EstimatorName] = {
    "nde": "nde",
    "forced": "nade",
    "step_mixture": "nade",
    "episode_mixture": "mixture_cv",
    "shells": "shells",
}


def headline(method: Method) -> EstimatorName:
    """Estimator of a method's own: exact counts for nde, known-mean control variates for the episode mixture."""
    return _OWN[method]
