"""Challenges and surrogates of one's own: tables, hashed, refused, run if trusted; what a table's name depends on."""

import numpy as np
import pytest

import harness
from harness.campaign.drivers import IDMParameters
from harness.errors import CampaignError, RunFolderError
from harness.families.cut_in.nade.challenge import COLLIDED, LEVELS, LONG, transitions
from harness.families.cut_in.nade.grid import AFTER, GridPoints, points_of
from harness.families.cut_in.nade.own import own_challenge, own_surrogate, states_after
from harness.families.cut_in.nade.tables import tables_name
from harness.families.cut_in.vocabulary import ACCELERATIONS_MPS2
from harness.resolved import resolve
from harness.vehicles.drivers import driver_records
from tests.kernels import environment
from tests.stored_runs import edit

DRIVER = driver_records([IDMParameters(min_acceleration_mps2=-5.0)])
FORMULA = "np.clip((gap < 20 + a) * (rate < -5) * (1 - s / 24) * v / 45 + d.min_acceleration_mps2 / 100, 0, 1)"
SETTINGS = ["world.engine=twin", "testing.method=episode_mixture", "environment.parameters=ndd-overtaking-1"]
FEW = [*SETTINGS, "stop.rhw=null", "stop.episodes=20"]


def own(folder, formula=FORMULA, first="import numpy as np"):
    (folder / "my.py").write_text(f"{first}\ndef mine(d, v, gap, rate, a, s):\n    return {formula}\n")
    return f"{folder}/my.py:mine"


def campaign(name):
    return harness.load_campaign("idm", [*FEW, f"testing.challenge={name}"])


@pytest.mark.slow
def test_tables_hold_what_it_says(tmp_path):
    tables = own_challenge(own(tmp_path))(environment(), DRIVER, "")
    v, gap, rate = (points[at] for points, at in zip(points_of(AFTER), (3, 20, 40), strict=True))
    expected = [(1 - level / 24) * v / 45 - 0.05 for level in range(1, LEVELS + 1)]
    assert gap < 16.0
    assert rate < -5.0
    np.testing.assert_allclose(tables.value[1:, 3, 20, 40], expected, rtol=1e-6)
    assert not tables.value[0].any()
    harder = np.where(gap < 20.0 + ACCELERATIONS_MPS2, 0.5 * v / 45 - 0.05, 0.0)
    np.testing.assert_allclose(tables.maneuvers[3, 20, 40], harder, rtol=1e-6)
    assert tables.before.max() > 0.0


@pytest.mark.parametrize(
    ("formula", "said"), [("-gap", "from 0 to 1"), ("v[:3]", "challenges of shape (150, 121)"), ("x", "name 'x'")]
)
def test_what_is_no_challenge_is_refused(formula, said, tmp_path):
    with pytest.raises(CampaignError) as caught:
        own_challenge(own(tmp_path, formula))(environment(), DRIVER, "")
    assert caught.value.where == "testing.challenge"
    assert said in str(caught.value)


@pytest.mark.parametrize(("name", "said"), [("no.py:mine", "no file"), ("recursiv", "Did you mean 'recursive'?")])
def test_one_that_is_not_there_is_named(name, said):
    with pytest.raises(CampaignError, match=said) as caught:
        campaign(name)
    assert "testing.challenge" in str(caught.value)


def test_its_file_s_content_is_part_of_the_hash_and_its_place_is_not(tmp_path):
    folders = [tmp_path / each for each in "abc"]
    for folder in folders:
        folder.mkdir()
    names = own(folders[0]), own(folders[1]), own(folders[2], "1.0")
    first, same, other = (resolve(campaign(name)) for name in names)
    assert (first.content_hash, first.challenge) == (same.content_hash, same.challenge)
    assert first.content_hash != other.content_hash


class Model:
    """The intelligent driver model of `DRIVER`."""

    def step_batch(self, seen):
        speed, closing = seen.speed_mps, seen.speed_mps - seen.lead_speed_mps
        desired = 2.0 + np.maximum(0.0, speed + speed * closing / (2.0 * np.sqrt(6.0)))
        free = 1.0 - (speed / 40.0) ** 4
        return np.clip(2.0 * (free - (desired / np.maximum(seen.gap_m, 0.1)) ** 2), -5.0, 2.0)


def test_a_surrogate_of_ones_own_goes_where_the_built_in_model_goes():
    points = GridPoints(np.array([25.0]), np.linspace(0.5, 60.0, 25), np.linspace(-15.0, 10.0, 21))
    built_in = np.zeros((1, 25, 21, ACCELERATIONS_MPS2.size, 3), np.float32)
    transitions(DRIVER, 10, LONG, points, built_in)
    states = (each.ravel() for each in np.meshgrid(*points[1:], ACCELERATIONS_MPS2, indexing="ij"))
    own = states_after(Model(), 25.0, *states, 10).reshape(built_in.shape)
    crashed = built_in[..., 0] == COLLIDED
    assert 1000 < crashed.sum() < 10_000
    np.testing.assert_array_equal(own[..., 0] == COLLIDED, crashed)
    np.testing.assert_allclose(own[~crashed], built_in[~crashed], rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("def step(self, seen): return 0.0", "no step_batch"),
        ("def step_batch(self, seen): return seen.gap_m * np.nan", "an acceleration of nan"),
        ("def step_batch(self, seen): seen.gap_m[:] = 1.0", "read-only"),
        ("def step_batch(self, seen): return seen.gap_m[:5]", "broadcast"),
    ],
)
def test_what_is_no_surrogate_is_refused(body, said, tmp_path):
    (tmp_path / "model.py").write_text(f"import numpy as np\nclass Mine:\n    {body}\n")
    with pytest.raises(CampaignError, match=said) as caught:
        own_surrogate(f"{tmp_path}/model.py:Mine", "surrogates.A")(environment(), DRIVER, "")
    assert caught.value.where == "surrogates.A"


@pytest.mark.parametrize("in_file", ["model.py", "numbers_of.py"])
def test_a_surrogate_s_files_are_part_of_the_hash_and_their_place_is_not(in_file, tmp_path):
    resolved = []
    for i, braking in enumerate((-1.0, -1.0, -2.0)):
        (tmp_path / f"{i}").mkdir()
        body = "from numbers_of import BRAKING\nclass Mine:\n    def step_batch(self, seen): return BRAKING\n"
        (tmp_path / f"{i}/numbers_of.py").write_text("BRAKING = -1.0\n")
        (tmp_path / f"{i}/model.py").write_text(body)
        with (tmp_path / f"{i}" / in_file).open("a") as file:
            file.write(f"BRAKING = {braking}\n")
        one = harness.load_campaign("idm", [*FEW, f"surrogates={{A: '{tmp_path}/{i}/model.py:Mine'}}"])
        resolved.append(resolve(one))
    first, same, other = ((each.content_hash, each.challenge) for each in resolved)
    assert first == same
    assert first[0] != other[0]
    assert first[1] != other[1]


@pytest.mark.slow
@pytest.mark.parametrize("of", ["challenge", "surrogate"])
def test_a_folder_from_elsewhere_runs_it_only_if_trusted(of, tmp_path):
    asked = campaign(name := own(tmp_path))
    if of == "surrogate":
        (tmp_path / "my.py").write_text("class mine:\n    def step_batch(self, seen): return -4.0\n")
        asked = harness.load_campaign("idm", [*FEW, f"surrogates={{A: '{name}'}}"])
    harness.run(asked, tmp_path / "run", workers=1)
    assert harness.replay(tmp_path / "run", 3).bit_equal
    edit(tmp_path / "run", signature="of another user")
    with pytest.raises(RunFolderError, match=r"my\.py:mine, which would be run"):
        harness.replay(tmp_path / "run", 3)
    assert harness.replay(tmp_path / "run", 3, trust=True).bit_equal


DEFAULT = driver_records([IDMParameters()])
FIELDS = [name for name in DEFAULT.dtype.names if name != "max_jerk_mps3"]  # infinite


def test_what_the_hash_depends_on():
    reference = tables_name(environment(), DEFAULT, "recursive")
    assert tables_name(environment(level=350.0), DEFAULT, "recursive") == reference
    assert tables_name(environment(hold_s=0.1), DEFAULT, "recursive") != reference
    assert tables_name(environment(), DEFAULT, "immediate") != reference
    for name in FIELDS:
        changed = DEFAULT.copy()
        changed[name] += 1
        assert tables_name(environment(), changed, "recursive") != reference
    for name in ("free_driving__df", "cut_in__accept_ttc_s", "guard__margin_m", "initial_state__r1_log_mean"):
        numbers = environment().numbers.copy()
        numbers[name] += 0.1
        assert tables_name(environment()._replace(numbers=numbers), DEFAULT, "recursive") != reference
