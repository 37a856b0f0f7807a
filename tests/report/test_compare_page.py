"""The page of a comparison: its numbers are those of compare.json, its pairs and motions those of the records."""

import json
import re
from dataclasses import replace

import numpy as np
import pyarrow.compute as pc
import pytest

import harness
from harness.errors import RunFolderError
from harness.numbers import interval, number, ratio
from harness.report.crashes import crashing_pairs
from harness.report.plots import WHO
from harness.report.several import deciding_words, pair_lines, ratio_words
from harness.report.summary import read_run_folder
from harness.runner.stored import write_report
from tests.families.test_same_bits import SMALL
from tests.in_process import controllers_here, one_process
from tests.report.page_text import Page
from tests.report.test_player import motion, scenes_in
from tests.stored_runs import answer_in, copy_of, stored_table


@pytest.fixture(scope="module")
def page(compared):
    write_report(compared)
    return Page(compared)


def content_of(folder):
    return json.loads((folder / "compare.json").read_text())


def test_the_numbers_are_those_of_the_comparison(compared, page):
    found, shown = content_of(compared), page.words.partition("Pairs of tests by shell")[0]
    for side in (found["a"], found["b"], {"crash_rate": found["difference"], **found}):
        assert number(side["crash_rate"]) in shown
        assert interval(side["ci_low"], side["ci_high"], beside=side["crash_rate"]) in shown
    for side in ("a", "b"):
        assert f"{found[side]['n_crashes']:,} in {found[side]['n_episodes']:,}" in shown
        assert number(found[f"only_{side}"]["value"]) in shown
        rows = {row["key"]: row for row in answer_in(compared / side)["rows"]}
        assert f"{rows['ratio']['value']} {rows['ratio']['interval']}" in shown
    assert f"A/B = {ratio(found['ratio'])} ({ratio(found['ratio_low'])} to {ratio(found['ratio_high'])})" in shown
    assert "B idm min_acceleration_mps2 −8 reaction.delay_s 0.5" in shown
    assert f"alone in pairs {found['n_only_a']:,} {found['n_only_b']:,}" in shown
    alike = {**found, "n_only_a": 0, "n_only_b": 0, "decision": {**found["decision"], "verdict": "open"}}
    assert deciding_words(alike) == "in no pair of tests did only one crash"
    assert deciding_words(found) is None or "to decide, repeat the command" in shown.lower()
    needed = {"pairs": 90_000, "settings": {}, "new_folder": True}
    left_open = {**found, "to_decide": needed, "ended": "rhw", "decision": {**alike["decision"], "margin": None}}
    assert (
        "--margin 0 and a new --out, and without --set stop.rhw, if you gave it: about 90,000 pairs"
        in deciding_words(left_open)
    )
    doubted = {**left_open, "difference": 1e-9, "decision": {**left_open["decision"], "n_milder": 7}}
    assert deciding_words(doubted).startswith("first mend what ! says: until then no number of pairs")
    assert deciding_words(doubted | {"difference": -1e-9}) == deciding_words(left_open | {"difference": -1e-9})
    assert not any(found[side]["details"]["within"]["n_crashes_outside"] for side in "ab")
    most = max(found[side]["details"]["within"]["upper_bound_outside"] for side in "ab")
    for apart, told in ((0.9 * most, True), (1.1 * most, False)):  # less than, or more than, what nobody saw may weigh
        words = f"had no crash, which leaves up to {number(most)} open"
        assert (words in deciding_words({**left_open, "difference": -apart})) == told
    assert len(page.ids) == len(set(page.ids))


def test_what_differs_is_never_cut_off_in_a_terminal(compared):
    found = content_of(compared)
    found["campaigns"] = {"a": {"label": "my_av-MyAV"}, "b": {"label": "my_av-MyAV, av.parameters.hardest_mps2=9"}}
    _, a, b, *_ = pair_lines(found, read_run_folder(compared / "a").campaign, compared)
    assert a.startswith("  A my_av-MyAV  ")
    assert b.startswith("  B hardest_mps2=9  ")


@pytest.mark.parametrize(("low", "high", "verdict", "said"), [
    (0.51, 0.88, "open", True), (0.51, 1.1, "open", False), (1.2, None, "open", True), (0.51, 0.88, "refuted", False),
])  # fmt: skip
def test_an_interval_that_excludes_1_beside_an_open_verdict_says_that_it_is_of_one_look(
    compared, low, high, verdict, said
):
    found = content_of(compared)
    found |= {"ratio": low, "ratio_low": low, "ratio_high": high, "to_decide": None}
    found["decision"] |= {"verdict": verdict, "margin": None}
    head, _, _, ratio_row, *_ = pair_lines(found, read_run_folder(compared / "a").campaign, compared)
    assert ratio_row.endswith("over all looks; interval: of one look") == said
    seems = f"Not proven: B seems to crash {'less' if low > 1.0 else 'more'} often · "
    assert head.startswith(seems if said else "Not told apart · " if verdict == "open" else "B crashes more often")


def test_the_map_holds_each_pair_with_a_crash(compared, page):
    found, runs = content_of(compared), [read_run_folder(compared / side) for side in "ab"]
    pairs = crashing_pairs(runs, found["shells"])
    counts = {who: sum(shell[f"n_{who.lower().replace(' ', '_')}"] for shell in found["shells"]) for who in WHO}
    assert pairs.counts == counts
    assert min(counts.values()) > 0
    for place, side in ((1, "only_a"), (2, "only_b")):
        assert pairs.weight[pairs.who == place].sum() == pytest.approx(found[side]["value"])
    impact = np.nanmax(np.where(pairs.who == [[2], [1]], np.nan, pairs.impact_mps), axis=0)
    harder = [replace(run, campaign=run.campaign.replaced(("crash", "counts_above_mps"), 5.0)) for run in runs]
    assert 0 < crashing_pairs(harder, found["shells"]).who.size == (impact > 5.0).sum() < impact.size
    early = np.where(np.arange(pairs.who.size) == 0, np.nan, pairs.values)  # it crashed before the event
    family = runs[0].family
    assert pairs._replace(values=early).plot(family).caption.startswith(pairs.plot(family).caption.partition(". A")[0])
    assert pairs._replace(values=0.0 * pairs.values).plot(family).markup
    assert pairs._replace(values=np.nan * pairs.values).plot(family) is None
    for who, n in counts.items():
        assert f"{who} on {n}" in page.words
        assert f">{who} ({n})</text>" in page.html


def test_a_scene_is_the_motion_of_both_tests(compared, page):
    """The hardest crashes of B alone first; the other's test, which was not traced, is run again."""
    scenes = scenes_in(page.html)
    assert [scene["title"][:6] for scene in scenes] == ["Only B"] * 2 + ["Only A"] * (len(scenes) - 2)
    impacts = [float(re.search(r"at ([\d.]+) m/s", scene["title"])[1]) for scene in scenes]
    assert impacts[:2] == sorted(impacts[:2], reverse=True)
    for scene in (scenes[0], scenes[-1]):
        tests = dict(zip("AB", map(int, re.findall(r"test (\d+) of", scene["title"])), strict=True))
        first, (_, bv, own), [ghost] = scene["first"], scene["tracks"], scene["ghosts"]
        crashed = stored_table(compared / own["label"].lower(), "traces")
        crashed = crashed.filter(pc.equal(crashed["episode"], tests[own["label"]]))
        other = harness.replay(compared / ghost["name"].lower(), tests[ghost["name"]])
        assert (other.outcome != "crash", {own["label"], ghost["name"]}) == (True, {"A", "B"})
        for ours, column in (("x", "x_m"), ("v", "v_mps")):
            assert own[ours] == motion(crashed, "AV", column)[first:]
            for track, vehicle in ((ghost, "AV"), (bv, "BV")):
                n = len(track[ours])
                assert track[ours] == motion(other.trace, vehicle, column)[first : first + n]
                assert n > len(own[ours])
        told = dict(scene["facts"])
        assert told[own["label"]].startswith("crashes")
        assert told[ghost["name"]].startswith("avoids it")
        assert "AV" not in " ".join((*told, *(name for _, name in scene["moments"])))


def test_runs_of_another_comparison_are_refused(compared, tmp_path):
    folder = copy_of(compared, tmp_path / "out")
    (folder / "b").rename(folder / "was")
    copy_of(folder / "a", folder / "b")
    with pytest.raises(RunFolderError, match="a run of campaign"):
        write_report(folder)


class Tailgates:
    """Speeds up to whom it follows, and crashes before the event."""

    def step(self, seen):
        return 1.5 if seen.gap_m > 3.0 else -0.5


def test_who_crashes_before_the_event_is_compared_and_shown(tmp_path):
    small = ("scenario=cut_out", "world.engine=twin", "stop.episodes=200", "stop.below_reference=null", *SMALL)
    a, b = (harness.load_campaign(av, small) for av in (f"{__name__}:Tailgates", "late-600ms"))
    with one_process(), controllers_here():
        found = harness.compare(a, b, tmp_path / "pair", workers=1)
    assert found.content["n_only_a"] > 10
    assert '"does not crash"' in found.report.read_text()
    with controllers_here():
        facts = harness.replay(tmp_path / "pair" / "a").scene["facts"]
    impact = harness.replay(tmp_path / "pair" / "a", stored=True).row["impact_speed_mps"]
    assert facts[0] == ("LV", "Nobody left the lane.")
    assert re.fullmatch(
        rf"crashes at [\d.]+ s, before anything happens: strikes LV .*: impact {impact:.1f} m/s", facts[1][1]
    )


def test_a_ratio_to_one_that_has_not_crashed_has_a_lower_end_alone():
    assert ratio_words({"ratio": None, "ratio_low": 3.2, "ratio_high": None}) == ("–", "≥ 3.20")
    assert ratio_words({"ratio": None, "ratio_low": 0.0, "ratio_high": None}) == ("–", "")
