from contextlib import closing

import numpy as np
import pytest

from harness.errors import CampaignError
from harness.vocabulary import AV, BV, CRASH, LV
from harness.worlds import sumo_driven
from harness.worlds.sumo_driven import SumoAvWorld, recyclable
from tests.worlds.running import bits, run, run_idm, run_in, sumo_av


def driven(av, ranges, *, cells=4, **options):
    return run_in(SumoAvWorld(cells, av.sumo, **options), av, ranges)


def fresh_bits(av, first, n):
    """Every episode in a new simulation."""
    return [bits(driven(av, [(first + i, 1)], cells=1)[0], 0) for i in range(n)]


@pytest.mark.parametrize("model", ["Krauss", "IDM", "ACC", "CACC"])
def test_recyclable_models_move_after_many_episodes_as_in_a_fresh_simulation(model):
    av = sumo_av(carFollowModel=model)
    assert recyclable(av.sumo)
    _, shard = driven(av, [(0, 40), (40, 12)])
    assert [bits(shard, row) for row in range(12)] == fresh_bits(av, 40, 12)


@pytest.mark.parametrize(
    "attributes",
    [{"carFollowModel": "Krauss", "sigma": 0.5}, {"carFollowModel": "EIDM"}, {"carFollowModel": "Wiedemann"}],
    ids=lambda attributes: "-".join(map(str, attributes.values())),
)
def test_other_models_do_not_and_get_a_seeded_simulation_per_episode(attributes):
    av = sumo_av(**attributes)
    assert not recyclable(av.sumo)
    _, recycled = driven(av, [(0, 40), (40, 8)])
    assert [bits(recycled, row) for row in range(8)] != fresh_bits(av, 40, 8)
    in_order, alone = run(av, 40, 8), run(av, 45, 2, cells=16)
    assert [bits(in_order, row) for row in (5, 6)] == [bits(alone, row) for row in (0, 1)]


def test_each_episode_has_a_seed_of_its_own_and_what_nobody_has_measured_is_not_recycled():
    assert len({sumo_driven.sumo_seed(seed, episode) for seed in (1, 2) for episode in range(50)}) == 100
    assert not any(map(recyclable, ({"sigma": 0.1}, {"speedDev": 0.1}, {"actionStepLength": 0.5}, {"startupDelay": 1})))


def test_lv_and_bv_move_as_with_any_other_av_and_the_av_holds_its_speed_until_the_step_after_the_cut_in():
    av = sumo_av(carFollowModel="ACC")
    shard, idm = run(av, 0, 24), run_idm(0, 24)
    responded = 0
    for row in range(24):
        mine, theirs = shard.traces[row], idm.traces[row]
        n = min(len(mine), len(theirs))
        assert np.array_equal(mine[:n, [LV, BV], :2], theirs[:n, [LV, BV], :2])
        cut = shard.results.episode["cut_in_step"][row]
        assert np.array_equal(mine[: cut + 2, AV, :2], theirs[: cut + 2, AV, :2])
        assert (mine[: cut + 2, AV, 1] == mine[0, AV, 1]).all()
        x, v, a = mine[:, AV].T
        assert np.allclose(np.diff(x), 0.05 * (v[1:] + v[:-1]), atol=1e-9)
        assert np.allclose(np.diff(v), 0.1 * a[:-1], atol=1e-12)
        responded += mine[min(cut + 3, len(mine) - 1), AV, 1] != mine[0, AV, 1]
    assert responded > 12


def test_collision_flag_and_formula_agree_for_an_av_that_keeps_a_gap_but_hardly_brakes():
    # A difference between SUMO's flag and the bumper formula would raise WorldDisagreementError.
    shard = run(sumo_av(carFollowModel="Krauss", minGap=5.0, decel=0.4, emergencyDecel=0.5), 0, 60)
    assert (shard.results.episode["outcome"] == CRASH).sum() >= 5


def test_neither_the_shim_nor_the_speed_mode_of_a_released_av_matters(monkeypatch):
    """Nothing is commanded then."""
    av = sumo_av(carFollowModel="CACC")
    (with_shim,), (without,) = (driven(av, [(0, 12)], shim=shim) for shim in (True, False))
    monkeypatch.setattr(sumo_driven, "SUMO_DECIDES", sumo_driven.OBEY)
    (obeying,) = driven(av, [(0, 12)])
    for row in range(12):
        assert bits(with_shim, row) == bits(without, row) == bits(obeying, row)


@pytest.mark.parametrize(
    ("attributes", "where", "words"),
    [
        ({"tao": 1.0}, "av.sumo.tao", "Did you mean 'tau'"),
        ({"tau": "short"}, "av.sumo.tau", "Cannot be parsed"),
        ({"sigma": 2.0, "carFollowModel": "Krauss"}, "av.sumo.sigma", "Only values between"),
        ({"length": 4.0}, "av.sumo.length", "Delete"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_wrong_attributes_are_named_with_what_sumo_says(attributes, where, words, capfd):
    with pytest.raises(CampaignError) as caught:
        run(sumo_av(**attributes), 0, 1)
    assert caught.value.where == where
    assert caught.value.exit_code == 2
    assert words in str(caught.value)
    assert "Error" not in capfd.readouterr().err
    SumoAvWorld(1, {}).close()  # as if SUMO had not been asked


@pytest.mark.parametrize(("overtakes", "speed_mps"), [(1.0, 40.0), (0.0, 26.0)])
def test_by_default_the_av_looks_at_its_own_lane_alone(overtakes, speed_mps):
    with closing(SumoAvWorld(1, {"lcOvertakeRight": overtakes})) as world:
        speeds = np.array([[20.0, 30.0, 30.0]])
        world.place(np.array([0]), np.array([[700.0, 640.0, 100.0]]), speeds)
        for cut_in in [1, *[0] * 300]:
            world.step(speeds, np.array([cut_in], np.int8))
        assert world.v[0, AV] == pytest.approx(speed_mps, abs=1.0)  # LV, at 20 m/s, is 24 m or 106 m ahead on the left
