"""The panel of vehicles: valid as shipped, laid under --set, and every mistake named."""

import pytest

from harness.campaign.files import SHIPPED_PANEL, load_campaign, load_panel, panel_av
from harness.campaign.vehicle import IDM, AutomatedVehicle, IDMParameters
from harness.cli import main
from harness.errors import CampaignError
from harness.vehicles.drivers import av_records
from harness.worlds.av_type import recyclable

HEAD = "format: av-panel\nversion: 1\navs:\n"


@pytest.fixture
def panel(tmp_path):
    def write(entries):
        file = tmp_path / "mine.yaml"
        file.write_text(HEAD + entries)
        return file

    return write


@pytest.fixture
def campaign_file(tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text("name: c\nav:\n  model: fvdm\n  parameters: {kappa_per_s: 0.5}\nsurrogates: {S: {model: idm}}\n")
    return file


def test_the_shipped_panel_has_what_the_design_asks_for():
    avs = load_panel().avs
    table_1 = [av.parameters.acceleration_mps2 for name, av in avs.items() if name.startswith("alpha-")]
    assert table_1 == [0.5 * k for k in range(1, 13)]
    assert avs["idm"] == AutomatedVehicle()
    limits = {name: avs[name].parameters.min_acceleration_mps2 for name in ("brakes-3", "brakes-5", "SM-II", "SM-III")}
    assert limits == {"brakes-3": -3.0, "brakes-5": -5.0, "SM-II": -1.0, "SM-III": -6.0}
    reactions = {name: av.reaction for name, av in avs.items()}
    delays = [reactions[name].delay_s for name in ("late-300ms", "late-600ms", "late-1000ms")]
    jerks = [reactions[name].max_jerk_mps3 for name in ("jerk-5", "jerk-10")]
    assert (delays, jerks) == ([0.3, 0.6, 1.0], [5.0, 10.0])
    assert (reactions["inattentive"].inattention_probability, reactions["inattentive"].inattention_delay_s) == (
        0.05,
        1.5,
    )


def test_no_two_vehicles_are_the_same_but_those_that_say_so():
    content = {}
    for name, av in load_panel().avs.items():
        content.setdefault(av.model_dump_json(), []).append(name)
    assert [names for names in content.values() if len(names) > 1] == [["idm", "alpha-2.0"]]


def test_what_sumo_drives_is_reproducible_in_recycled_cells():
    driven = [av.sumo for av in load_panel().avs.values() if av.sumo is not None]
    assert [sumo["carFollowModel"] for sumo in driven] == ["ACC", "Krauss"]
    assert all(recyclable(sumo) for sumo in driven)


def test_all_others_are_drivers_that_kernels_read():
    assert all(av_records(av).size == 1 for av in load_panel().avs.values() if av.sumo is None)


def test_every_number_of_the_shipped_panel_carries_a_tag():
    lines = SHIPPED_PANEL.read_text().partition("\navs:\n")[2].splitlines()
    numbers = [line for line in lines if any(c.isdigit() for c in line.partition("{")[2]) and "{" in line]
    assert len(numbers) >= 25
    tags = ("[paper]", "[cutin]", "[assumed]", "[SUMO]")
    assert [
        line for line in numbers if not line.lstrip().startswith("#") and not any(tag in line for tag in tags)
    ] == []


def test_a_vehicle_replaces_the_campaigns_and_overrides_are_laid_over_it(campaign_file, panel):
    file = panel("  mine: {model: idm, parameters: {time_headway_s: 2}, reaction: {delay_s: 0.2}}\n")
    by_name = load_campaign(campaign_file, av="brakes-3")
    assert by_name.av == panel_av("brakes-3")
    assert by_name.surrogates == {"S": IDM(model="idm")}
    mine = load_campaign(campaign_file, ["av.parameters.min_acceleration_mps2=-7"], av=f"{file}:mine").av
    assert mine.parameters == IDMParameters(time_headway_s=2.0, min_acceleration_mps2=-7.0)
    assert mine.reaction.delay_s == 0.2


def test_an_fmu_lies_beside_the_panel(campaign_file, panel, tmp_path):
    (tmp_path / "av.fmu").write_bytes(b"x")
    file = panel("  box: {fmu: {file: av.fmu, inputs: {speed_mps: v}, output: a}}\n")
    (tmp_path / "elsewhere").mkdir()
    elsewhere = campaign_file.rename(tmp_path / "elsewhere" / "c.yaml")
    assert load_campaign(elsewhere, av=f"{file}:box").av.fmu.file == str(tmp_path / "av.fmu")


@pytest.mark.parametrize(
    ("entries", "where", "words"),
    [
        ("  a: {model: idm, parameters: {min_acceleration: -3}}", "avs.a.parameters.min_acceleration", "Did you mean"),
        ("  a: {model: idm}\n  b: {model: fvdm, reaction: {delay_s: 0.25}}", "avs.b.reaction.delay_s", "0.1 s step"),
        ("  a: {model: idm, controller: 'm:C'}", "avs.a", "one driver"),
        ("  a: {model: constant, parameters: {acceleration_mps2: x}}", "avs.a.parameters.acceleration_mps2", "text"),
        ("  a: {sumo: {carFollowModel: ACC}, reaction: {delay_s: 0.1}}", "avs.a.reaction", "leave av.reaction out"),
        ("  'a b': {model: idm}", "avs.a b", "another name"),
        ("  {}", "avs", ""),
    ],
)
def test_a_mistake_in_a_panel_names_its_place(panel, entries, where, words):
    file = panel(entries)
    with pytest.raises(CampaignError) as caught:
        load_panel(file)
    assert where in caught.value.where
    assert f"{file}:" in caught.value.where
    assert words in str(caught.value)


def test_an_unknown_vehicle_or_panel_is_an_error(campaign_file, panel):
    with pytest.raises(CampaignError, match=r"--av late-60ms: found no vehicle .* Did you mean 'late-600ms'"):
        load_campaign(campaign_file, av="late-60ms")
    with pytest.raises(CampaignError, match=r"expected one of a; or PANEL"):
        load_campaign(campaign_file, av=f"{panel('  a: {model: idm}')}:idm")
    with pytest.raises(CampaignError, match=r"gone\.yaml: found no such file"):
        load_campaign(campaign_file, av="gone.yaml:idm")


def test_a_rule_between_panel_and_campaign_names_the_option(campaign_file):
    with pytest.raises(CampaignError) as caught:
        load_campaign(campaign_file, ["world.engine=twin"], av="sumo-acc")
    assert caught.value.where == "--set world.engine=twin"
    with pytest.raises(CampaignError) as caught:
        load_campaign(campaign_file, ["av.reaction.delay_s=0.1"], av="sumo-acc")
    assert caught.value.where == "--set av.reaction.delay_s=0.1" or "--av sumo-acc" in caught.value.where


def test_the_commands_take_a_vehicle(campaign_file, capsys, monkeypatch, tmp_path):
    assert main(["check", str(campaign_file), "--av", "late-300ms"]) == 0
    assert "delay_s: 0.3" in capsys.readouterr().out
    seen = []
    monkeypatch.setattr("harness.runner.run_campaign", lambda campaign, *_, **__: seen.append(campaign) or 1 / 0)
    monkeypatch.setattr("harness.runner.compare_campaigns", lambda a, b, *_, **__: seen.extend([a, b]) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main(["run", str(campaign_file), "--out", str(tmp_path / "r"), "--av", "jerk-5", "--quiet"])
    vehicles = ["--av", "idm", "--against-av", "SM-II"]
    with pytest.raises(ZeroDivisionError):
        main(["compare", str(campaign_file), "--out", str(tmp_path / "c"), *vehicles, "--quiet"])
    assert [campaign.av for campaign in seen] == [panel_av(name) for name in ("jerk-5", "idm", "SM-II")]
    assert main(["run", str(campaign_file), "--out", str(tmp_path / "r"), "--av", "nobody"]) == 2
    assert capsys.readouterr().err.startswith("error: --av nobody\n")
