"""Campaigns run in the twin, shared by all tests of a session: whoever asks for the same run gets the same object."""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from harness.campaign.campaign import Campaign
from harness.campaign.drivers import FVDMParameters, IDMParameters, Reaction, Surrogate
from harness.campaign.sections import EnvironmentSettings, Records, Testing
from harness.campaign.vehicle import AutomatedVehicle
from harness.loop.loop import Shard
from harness.resolved import resolve
from harness.sampling import prepare
from harness.sampling.protocol import Source
from harness.vocabulary import CRASH
from harness.worlds.twin import TwinWorld
from tests.chains import SEED

CELLS = 512
AVS = {
    "idm": AutomatedVehicle(),
    "never_brakes": AutomatedVehicle(parameters=IDMParameters(min_acceleration_mps2=-0.0)),
    "SM-II": AutomatedVehicle(model="fvdm", parameters=FVDMParameters(min_acceleration_mps2=-1.0)),
    "SM-III": AutomatedVehicle(model="fvdm", parameters=FVDMParameters(min_acceleration_mps2=-6.0)),
    "sees the onset": AutomatedVehicle(reaction=Reaction(perceives_lateral_m=0.0)),
    "blind": AutomatedVehicle(reaction=Reaction(perceives_lateral_m=10.0)),
    "holds": AutomatedVehicle(model="constant"),
}
DEFAULT_SURROGATES = Campaign(name="default").surrogates
SURROGATES = {
    "default": DEFAULT_SURROGATES,
    # Immediate tables take 17 s of a core for each:
    **{name: {name: DEFAULT_SURROGATES[name]} for name in ("SM-I", "SM-III")},
    "brakes with 2 g": {"hard": Surrogate(model="idm", parameters=IDMParameters(min_acceleration_mps2=-20.0))},
}


def campaign(
    method: str,
    challenge: str = "recursive",
    *,
    level: float = 1.0,
    hold_s: float = 1.0,
    lead_s: float | None = None,
    parameters: str = "ndd-overtaking-1",
    av: str = "idm",
    surrogates: str = "default",
    epsilon: float = 0.1,
    threshold: float = 0.0,
    moments: str = "none",
) -> Campaign:
    return Campaign(
        name="test",
        seed=SEED,
        environment=EnvironmentSettings(
            parameters=parameters, lane_change_level=level, acceleration_hold_s=hold_s, cut_in_lead_s=lead_s
        ),
        av=AVS[av],
        surrogates=SURROGATES[surrogates],
        testing=Testing(method=method, challenge=challenge, epsilon=epsilon, criticality_threshold=threshold),
        records=Records(moments=moments),
    )


@cache
def prepared(method: str, challenge: str = "recursive", **settings) -> Source:
    return prepare(resolve(campaign(method, challenge, **settings)))


@dataclass(frozen=True)
class Mean:
    """A sample mean and its standard error."""

    value: float
    std_error: float

    @classmethod
    def of(cls, sample) -> "Mean":
        return cls(float(np.mean(sample)), float(np.std(sample, ddof=1) / np.sqrt(len(sample))))

    def errors_from(self, other) -> float:
        """Distance in standard errors, of the difference if the other is a sample mean too."""
        if isinstance(other, Mean):
            return abs(self.value - other.value) / float(np.hypot(self.std_error, other.std_error))
        return abs(self.value - other) / self.std_error


@dataclass(frozen=True)
class Run:
    """Episodes 0 … n − 1 of a campaign, and what tests ask of them."""

    prepared: Source
    shard: Shard

    @cached_property
    def episode(self):
        return self.shard.episode

    @property
    def log_weight(self):
        return self.episode["log_weight"]

    @property
    def log_q(self):
        return self.shard.traffic.drawn.log_q

    @property
    def crash(self):
        return self.episode["outcome"] == CRASH

    @property
    def cut_in(self):
        return self.episode["event_step"] >= 0

    @cached_property
    def y(self):
        return np.where(self.crash, np.exp(self.log_weight), 0.0)

    @property
    def rate(self) -> Mean:
        return Mean.of(self.y)

    @property
    def alpha(self):
        return self.prepared.importance.alpha

    @cached_property
    def moments(self):
        """Control steps (m,) by episode and step, with q_j and V_j (m, J) of each."""
        results = self.shard.traffic.drawn
        used = slice(results.moment_count[0])
        order = np.lexsort((results.moment["step"][used], results.moment["row"][used]))
        return results.moment[used][order], results.moment_q[used][order], results.moment_v[used][order]

    moment = property(lambda self: self.moments[0])
    moment_q = property(lambda self: self.moments[1])
    moment_v = property(lambda self: self.moments[2])

    def summed(self, per_moment):
        """Per episode the sum over its control steps (m,) or (m, J)."""
        out = np.zeros((len(self.episode), *per_moment.shape[1:]))
        np.add.at(out, self.moment["row"], per_moment)
        return out


@cache
def run(method: str, challenge: str = "recursive", *, n: int, traces: str = "none", **settings) -> Run:
    """The first n episodes of a campaign; the keys of ``settings`` are those of `campaign`."""
    ready = prepared(method, challenge, **settings)
    loop = ready.loop(TwinWorld(CELLS), traces=traces)
    return Run(ready, loop.run(0, ready.tests(0, n)))
