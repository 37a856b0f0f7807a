"""The YAML reader: what looks like a number is one, and nothing wrong passes silently."""

from pathlib import Path

import pytest

from harness.campaign.models import Places
from harness.campaign.yaml_text import parse_value, read_yaml
from harness.errors import CampaignError


@pytest.fixture
def read(tmp_path):
    def read_text(text):
        file = tmp_path / "some.yaml"
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
        data, lines = read_yaml(file)
        return data, Places(str(file), lines)

    return read_text


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-5", 1e-5),
        ("010", 10),
        ("0x1F", 31),
        ("12:30", "12:30"),
        ("no", "no"),
        ("true", True),
        ("~", None),
        ("2024-01-01", "2024-01-01"),
        ("[1, {b: 2}]", [1, {"b": 2}]),
    ],
)
def test_values_are_what_they_look_like(read, text, value):
    data, _ = read(f"a: {text}\n")
    assert data == {"a": value}
    assert type(data["a"]) is type(value)
    assert parse_value(text or "~", "here") == value


def test_anchors_and_merges(read):
    data, lines = read("a: &x {b: 1, c: 2}\nd:\n  <<: *x\n  c: 3\ne: *x\n")
    assert data == {"a": {"b": 1, "c": 2}, "d": {"b": 1, "c": 3}, "e": {"b": 1, "c": 2}}
    assert [lines.line_of(path) for path in (["d", "c"], ["d", "b"], ["e", "c"])] == [4, 2, 1]


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("a: 1\nb:\n  c: 1\n  c: 2\n", "4:3", "b.c ("),
        ("- 1\n", 1, "list"),
        ("a: 1\n\tb: 2", "2:1", "character '\\t'"),
        ("a: 1\n---\nb: 2", "2:1", "a single document"),
        ("a: 1\nb: [1,\n", "3:1", "<stream end>"),
        ("a: 1\nb: x\0y", "2:5", "U+0000"),
        ("a: 1\nb: !!python/name:os.system x", "2:4", "tag"),
        ("a: &x [*x]", 1, "more than 100,000 values, or 50 levels"),
        ("a: *nope", 1, "nope"),
        ("a: &x [1]\nb: *x\nc: &x [2]", "3:4", "duplicate anchor 'x'"),
        ("b: 1\n1: a", 2, "not text"),
        ("<<: 5", "1:5", "for merging"),
        ("a: " + "[" * 60 + "]" * 60, 1, "50 levels"),
    ],
)
def test_errors_name_the_line(read, text, line, words):
    with pytest.raises(CampaignError) as caught:
        read(text)
    assert f"some.yaml:{line}" in caught.value.where
    assert words in str(caught.value)
    with pytest.raises(CampaignError) as caught:
        parse_value(text if words not in ("list", "single value") else "[1", "here")
    assert caught.value.where == "here"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("# only a comment\n", "empty"),
        (b"a: \xff", "UTF-8"),
        ("a: " + "9" * 5000, "limit"),
        ('a: "\\UFFFFFFFF"', "too large"),
        ("a: " + "[" * 5000, "nested too deeply"),
        ("".join(f"key_{i}: 1\n" for i in range(60_000)), "more than 100,000 bytes"),
        (Path("none.yaml"), "no such file"),
        (Path(), "a folder"),
        (Path("/dev/zero"), "more"),
    ],
)
def test_files_that_are_refused_as_a_whole(read, tmp_path, content, words):
    with pytest.raises(CampaignError, match=words):
        read_yaml(tmp_path / content) if isinstance(content, Path) else read(content)


def test_byte_order_mark_is_no_content(read):
    assert read(b"\xef\xbb\xbfa: 1")[0] == {"a": 1}


@pytest.mark.parametrize(("first", "more"), [("[1]", "[{}]"), ("{x: 1}", "{{{}}}")])
@pytest.mark.parametrize("levels", [9, 2000])
def test_aliases_that_multiply_are_refused_at_once(read, first, more, levels):
    """Each level names the one below nine times, so that a few lines stand for billions of values."""
    times = 9 if levels < 10 else 1
    names = [", ".join(f"{f'k{j}: ' if first[0] == '{' else ''}*a{i - 1}" for j in range(times)) for i in range(levels)]
    lines = [f"a{i}: &a{i} {more.format(name)}" for i, name in enumerate(names) if i]
    with pytest.raises(CampaignError, match=r"some\.yaml:\d+:\d+: found more than 100,000 values, or 50 levels"):
        read("\n".join([f"a0: &a0 {first}", *lines]))
