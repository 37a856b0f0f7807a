"""The YAML reader: what looks like a number is one, and nothing wrong passes silently."""

import pytest

from harness.campaign.files import SHIPPED_PARAMETERS
from harness.campaign.problems import InvalidFileError, read_model
from harness.campaign.yaml_text import parse_value, read_yaml
from harness.errors import CampaignError
from harness.traffic.parameters import EnvironmentParameters


@pytest.fixture
def read(tmp_path):
    def read_text(text):
        file = tmp_path / "some.yaml"
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_yaml(file)

    return read_text


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-5", 1e-5),
        ("1E5", 1e5),
        ("-.5e-3", -0.5e-3),
        ("1.", 1.0),
        ("+1", 1),
        ("010", 10),
        ("0o17", 15),
        ("0x1F", 31),
        ("100_000", 100_000),
        ("12:30", "12:30"),
        ("no", "no"),
        ("on", "on"),
        ("true", True),
        ("~", None),
        ("", None),
        ("2024-01-01", "2024-01-01"),
        ("=", "="),
        ("'1'", "1"),
        ("1e", "1e"),
        ("[1, {b: 2}]", [1, {"b": 2}]),
    ],
)
def test_values_are_what_they_look_like(read, text, value):
    data, _ = read(f"a: {text}\n")
    assert data == {"a": value}
    assert type(data["a"]) is type(value)


def test_anchors_and_merges(read):
    data, lines = read("a: &x {b: 1, c: 2}\nd:\n  <<: *x\n  c: 3\ne: *x\n")
    assert data == {"a": {"b": 1, "c": 2}, "d": {"b": 1, "c": 3}, "e": {"b": 1, "c": 2}}
    assert lines.line_of(["d", "c"]) == 4
    assert lines.line_of(["d", "b"]) == 1


def test_repeated_anchors_are_shared(read):
    levels = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    levels += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 4)]
    data, _ = read("\n".join(levels))
    assert data["a3"][0] is data["a3"][9]


def test_lines_fall_back_to_the_nearest_ancestor(read):
    _, lines = read("a: 1\nb:\n  c:\n    - 1\n    - {d: 2}\n")
    assert lines.line_of([]) == 1
    assert lines.line_of(["b", "c", 1, "d"]) == 5
    assert lines.line_of(["b", "missing", "deeper"]) == 2
    assert lines.place(["b", "c"]).startswith("b.c (")
    assert lines.place(["b", "c"]).endswith("some.yaml:3)")


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("a: 1\nb:\n  c: 1\n  c: 2\n", "4:3", "b.c"),
        ("a: {b: 1,\n b: 1}", 2, "again"),
        ("- 1\n", 1, "list"),
        ("\n5\n", 2, "single value"),
        ("a: 1\n\tb: 2", "2:1", "character '\\t'"),
        ("a: 1\n---\nb: 2", "2:1", "a single document"),
        ("a: 1\nb: [1,\n", "3:1", "<stream end>"),
        ("a: 'x\n", "2:1", "a quoted scalar (line 1)"),
        ("a: 1\n b: 2", "2:3", "mapping values are not allowed"),
        ("a:\n  b: 1\n c: 2", "3:2", "a block mapping (line 1)"),
        ("a: {b: 1\nc: 2", "2:2", "a flow mapping (line 1)"),
        ("- 1\na: 2", "2:1", "a block collection (line 1)"),
        ("a: 1\n- b", "2:1", "a block mapping (line 1)"),
        ("a: - 1", "1:4", "sequence entries are not allowed"),
        ("a: 'x' y", "1:8", "a block mapping (line 1)"),
        ("a: @x", "1:4", "cannot start any token"),
        ("a: 1\nb\nc: 2", "3:1", "a simple key (line 2)"),
        ("%YAML 1.1\n---\na: no", "3:1", "%YAML"),
        ("a: 1\nb: x\0y", "2:5", "U+0000"),
        ('a: 1\nb: "\\ud800"', "2:4", "surrogate"),
        ("a: 1\nb: !!python/name:os.system x", "2:4", "tag"),
        ("a: !!set {x}", "1:4", "tag"),
        ("a: !!int x", "1:4", "'x' is no int"),
        ("a: " + "9" * 5000, 1, "999"),
        ("a: &x [*x]", 1, "itself"),
        ("a: *nope", 1, "nope"),
        ("b: 1\n1: a", 2, "not text"),
        ("? [1]\n: 2", 1, "not text"),
        ("<<: 5", "1:5", "for merging"),
        ("a: " + "[" * 5000, 1, "nested"),
    ],
)
def test_errors_name_the_line(read, text, line, words):
    with pytest.raises(CampaignError) as caught:
        read(text)
    assert f"some.yaml:{line}" in caught.value.where
    assert words in str(caught.value)


@pytest.mark.parametrize(("text", "words"), [("", "empty"), ("# only a comment\n", "empty"), (b"a: \xff", "UTF-8")])
def test_files_without_yaml(read, text, words):
    with pytest.raises(CampaignError, match=words):
        read(text)


def test_byte_order_mark_is_no_content(read):
    assert read(b"\xef\xbb\xbfa: 1")[0] == {"a": 1}


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(CampaignError, match="no such file"):
        read_yaml(tmp_path / "none.yaml")
    with pytest.raises(CampaignError, match="a folder"):
        read_yaml(tmp_path)
    with pytest.raises(CampaignError, match="cannot be read"):
        read_yaml("a\0b")


def test_models_are_read_with_the_place_of_every_problem(tmp_path):
    shipped = SHIPPED_PARAMETERS / "ndd-overtaking-1.yaml"
    read_model(shipped, EnvironmentParameters)
    text = shipped.read_text().replace("r2_min_m: {value: 20.0,", "r2_min_m: {value: '20',")
    text = text.replace("r2_max_m: {value: 100.0, source: paper}", "r2_max_m: {value: 100.0, sourse: paper}")
    (tmp_path / "mine.yaml").write_text(text)
    line = 1 + next(i for i, row in enumerate(text.splitlines()) if "r2_min_m" in row)
    with pytest.raises(InvalidFileError) as caught:
        read_model(tmp_path / "mine.yaml", EnvironmentParameters)
    where = {problem.where for problem in caught.value.problems}
    assert where == {
        f"initial_state.r2_min_m.value ({tmp_path}/mine.yaml:{line})",
        f"initial_state.r2_max_m.source ({tmp_path}/mine.yaml:{line + 1})",
        f"initial_state.r2_max_m.sourse ({tmp_path}/mine.yaml:{line + 1})",
    }
    assert "Did you mean 'source'?" in str(caught.value)


def test_single_values():
    assert parse_value("1e-5", "here") == 1e-5
    assert parse_value("{a: no}", "here") == {"a": "no"}
    for text in ("", "[1"):
        with pytest.raises(CampaignError) as caught:
            parse_value(text, "here")
        assert caught.value.where == "here"


def multiplied(item, levels):
    """Each level names the one below nine times."""
    keys = [f"k{i}: " if item[0] == "{" else "" for i in range(9)]
    above = [f"a{i}: &a{i} {item[0]}{', '.join(f'{key}*a{i - 1}' for key in keys)}{item[-1]}" for i in range(1, levels)]
    return "\n".join([f"a0: &a0 {item}", *above])


@pytest.mark.parametrize("text", [multiplied("[1]", 9), multiplied("{x: 1}", 9), multiplied("[1]", 30)])
def test_aliases_that_multiply_are_refused_at_once(text, tmp_path):
    path = tmp_path / "laughs.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CampaignError, match=r"laughs\.yaml:\d+:\d+\): found [\d,]+ values, aliases \(\*\) written out"):
        read_yaml(path)


def test_aliases_that_multiply_are_refused_in_an_override():
    text = "{a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1], b: &b [*a, *a, *a, *a, *a, *a, *a, *a, *a, *a], "
    for inner, outer in ("bc", "cd", "de", "ef"):
        text += f"{outer}: &{outer} [" + ", ".join([f"*{inner}"] * 10) + "], "
    with pytest.raises(CampaignError, match="aliases"):
        parse_value(text + "}", "--set av.parameters")


def test_aliases_that_nest_without_end_are_refused(tmp_path):
    path = tmp_path / "deep.yaml"
    path.write_text("a0: &a0 [1]\n" + "\n".join(f"a{i}: &a{i} [*a{i - 1}]" for i in range(1, 2000)), encoding="utf-8")
    with pytest.raises(CampaignError, match="nested too deeply"):
        read_yaml(path)


def test_a_file_without_an_end_is_refused():
    with pytest.raises(CampaignError, match="more than 1,000,000 bytes"):
        read_yaml("/dev/zero")


def test_an_anchor_given_twice_is_an_error_and_no_warning(tmp_path):
    path = tmp_path / "anchors.yaml"
    path.write_text("a: &x [1]\nb: *x\nc: &x [2]\n", encoding="utf-8")
    with pytest.raises(CampaignError, match=r"anchors\.yaml:3:4\): found duplicate anchor 'x'.* \(line 1\)"):
        read_yaml(path)
