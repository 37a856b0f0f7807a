"""The study of `dr` on a chain, whose truth is exact: its gain is there, and a β of each number of steps is biased."""

from functools import partial

from harness.campaign.campaign import Campaign
from studies.chains.chain import DECISIVE
from studies.replication.doubly_robust import CHUNK, SIZES, by_strata, line, rows_of
from studies.replication.judgement import Subject
from studies.replication.populations import Known
from studies.replication.weighted import WeightedCampaign, chain_episodes


def test_rows_of_the_tables():
    chain = DECISIVE[1]
    subject = Subject(chain.name, Known.exactly(chain.crash_rate))
    source = partial(chain_episodes, chain, "step_mixture", 1)
    repeated = WeightedCampaign(Campaign(name="chain"), source, ("nade", "dr"))
    rows = rows_of(repeated, CHUNK)
    assert [(n, len(each)) for n, each in rows.items()] == [(n, 2 * CHUNK // n) for n in SIZES]
    *_, covered, gain = line("a setting", subject, 500, rows[500]).strip("| ").split(" | ")
    assert 0.7 < float(covered) <= 1.0
    assert float(gain) > 1.2
    blocks = [source(k * CHUNK, CHUNK) for k in range(2)]
    _, _, one, by_steps, _ = by_strata("a setting", subject, blocks).strip("| ").split(" | ")
    assert float(one) > 1.2
    assert float(by_steps) > 0.0
