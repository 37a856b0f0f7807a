"""The vocabulary in code: array types, outcomes, vehicles, methods of drawing, estimators."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
Float32Array: TypeAlias = NDArray[np.float32]
IntArray: TypeAlias = NDArray[np.int64]
UInt64Array: TypeAlias = NDArray[np.uint64]
Int8Array: TypeAlias = NDArray[np.int8]
BoolArray: TypeAlias = NDArray[np.bool_]
RecordArray: TypeAlias = NDArray[Any]
"""A structured array; its fields are described where its dtype is."""
Record: TypeAlias = Any
"""One element of a structured array, as kernels see it: fields are attributes."""


_Scalar = TypeVar("_Scalar", bound=np.generic)


def read_only(array: NDArray[_Scalar]) -> NDArray[_Scalar]:
    """The array itself, from now on closed to writing; views that are made of it later are closed, too."""
    array.setflags(write=False)
    return array


Method = Literal["nde", "forced", "step_mixture", "episode_mixture", "shells"]
EstimatorName = Literal["nde", "nade", "mixture_cv", "dr", "scv", "shells"]
StoppedBy = Literal["rhw", "below_reference", "accept", "episodes", "pool", "pool_error", "sum"]
"""In this order: the asked precision; a rate far enough below a reference driver's; a decision about the limit; the
budget; the last event that the pool holds of a shell that needs more; the pool's own error, if it alone is wider than
the asked precision; for one of several scenarios, that their sum had ended."""

METHODS: tuple[Method, ...] = get_args(Method)
ESTIMATORS: tuple[EstimatorName, ...] = get_args(EstimatorName)


@dataclass(frozen=True)
class Sampling:
    """One method of drawing tests.

    ``estimators`` are those that its records allow; the first is the method's own, the headline. `scv` also needs
    recorded control steps, `dr` 1,000 tests.
    """

    estimators: tuple[EstimatorName, ...]
    mixes_steps: bool = False  # importance functions of the surrogates, in every critical step
    mixes_episodes: bool = False  # or one per episode
    forces: bool = False  # forced cut-ins are among what it draws from
    holds_speed: bool = False  # the AV must, until the event: what is drawn before the episode depends on it
    baseline_runs: bool = False  # an AV that does not is driven along each path without an event first
    bounded: bool = True  # weights are, whatever testing.epsilon is; else no precision can be promised
    strata: bool = False  # tests are events of the pool, counted within strata of known probability
    controlled: bool = True  # something is drawn otherwise than the environment would; else every test weighs 1

    @property
    def headline(self) -> EstimatorName:
        """The method's own estimator."""
        return self.estimators[0]

    @property
    def mixes(self) -> bool:
        """Whether it needs challenge tables of surrogates."""
        return self.mixes_steps or self.mixes_episodes


SAMPLING: dict[Method, Sampling] = {
    "nde": Sampling(("nde", "nade"), controlled=False),
    "forced": Sampling(("nade",), forces=True, baseline_runs=True),
    "step_mixture": Sampling(("nade", "dr", "scv"), mixes_steps=True, bounded=False),
    "episode_mixture": Sampling(("mixture_cv", "nade", "dr"), mixes_episodes=True, forces=True, holds_speed=True),
    "shells": Sampling(("shells",), baseline_runs=True, strata=True),
}

MOST_ASKED = 100_000
"""Most workers, tests of a check, or replicates: more is a slip of the hand, for which there is no memory."""
COMPARISON, FAMILIES = "compare.json", "families.json"
"""Files that mark the folder of a comparison, or of several scenarios, as no folder of a run."""

OUTCOMES = ("crash", "passed", "timeout", "bv_lv_contact", "failed")
CRASH, PASSED, TIMEOUT, CONTACT, FAILED = range(len(OUTCOMES))
RUNNING = -1

VEHICLES = ("LV", "BV", "AV")
LV, BV, AV = range(len(VEHICLES))
