"""From composed YAML nodes to plain data, strictly: no tag, key or number is guessed at."""

from __future__ import annotations

from typing import Any, NoReturn

from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from harness.campaign.yaml_lines import MERGE_TAG, dotted, merged_nodes
from harness.errors import CampaignError

_TAG = "tag:yaml.org,2002:"
_TRUTH = {"true": True, "false": False}
_NULLS = ("", "~", "null", "Null", "NULL")
# Dates and the odd "=" have types of their own in YAML; here they are the text that was written.
_TEXT_TAGS = tuple(_TAG + kind for kind in ("str", "timestamp", "value"))

MOST_VALUES = 100_000
"""Values of a document with every alias written out; the largest file that comes with the harness has 300."""
DEEPEST = 50
"""Levels of nesting, aliases written out; a campaign needs five."""
TOO_DEEP = ("values nested too deeply", f"at most {DEEPEST} levels", "Close the brackets that were left open.")


def require_bounded(root: Node, name: str) -> None:
    """Refuse a document whose aliases multiply: a few lines can stand for more values than any memory holds.

    Raises
    ------
    CampaignError
        Written out, it has more than `MOST_VALUES` values or `DEEPEST` levels; the line is that where it first has.
    """
    known: dict[int, tuple[int, int]] = {}

    def measure(node: Node) -> tuple[int, int]:
        """Values and levels below a node; one that contains itself is left to `PlainData`."""
        if id(node) in known:
            return known[id(node)]
        known[id(node)] = (1, 1)
        inner = [measure(child) for child in _children(node)]
        values, levels = 1 + sum(n for n, _ in inner), 1 + max((depth for _, depth in inner), default=0)
        if values > MOST_VALUES or levels > DEEPEST:
            many = (f"{values:,} values, aliases (*) written out", f"at most {MOST_VALUES:,}", "Delete aliases.")
            found, expected, mend = many if values > MOST_VALUES else TOO_DEEP
            raise CampaignError(f"{name}:{node.start_mark.line + 1}", found=found, expected=expected, mend=mend)
        known[id(node)] = (values, levels)
        return values, levels

    measure(root)


def _children(node: Node) -> list[Node]:
    if isinstance(node, MappingNode):
        return [part for pair in node.value for part in pair]
    return list(node.value) if isinstance(node, SequenceNode) else []


class PlainData:
    """Turns composed nodes into plain data; shared anchors become shared objects, so nothing blows up.

    Parameters
    ----------
    name : str
        Name of the document, for messages.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._done: dict[int, Any] = {}
        self._open: set[int] = set()
        self._trail: list[str | int] = []

    def build(self, node: Node) -> Any:
        """Plain value of ``node``.

        Raises
        ------
        CampaignError
            A key is there twice or is not text, a number or tag is malformed, an anchor contains itself.
        """
        if id(node) in self._done:
            return self._done[id(node)]
        if id(node) in self._open:
            self._fail(node, "an anchor that contains itself", "a finite value", "Write the value out.")
        self._open.add(id(node))
        value = self._construct(node)
        self._done[id(node)] = value
        return value

    def _construct(self, node: Node) -> Any:
        if isinstance(node, MappingNode) and node.tag == _TAG + "map":
            return self._mapping(node)
        if isinstance(node, SequenceNode) and node.tag == _TAG + "seq":
            return [self._build_at(index, item) for index, item in enumerate(node.value)]
        if isinstance(node, ScalarNode):
            return self._scalar(node)
        return self._unknown_tag(node)

    def _mapping(self, node: MappingNode) -> dict[str, Any]:
        own: dict[str, Any] = {}
        merged: dict[str, Any] = {}
        lines: dict[str, int] = {}
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            if key_node.tag == MERGE_TAG:
                for source in merged_nodes(value_node):
                    merged = {**self._merge_source(source), **merged}
                continue
            key = self._key(key_node)
            if key in lines:
                self._trail.append(key)
                found = f"the key {key!r} again, first written on line {lines[key]}"
                self._fail(key_node, found, "each key once", "Delete one of the two.")
            lines[key] = line
            own[key] = self._build_at(key, value_node)
        return {**merged, **own}

    def _build_at(self, part: str | int, node: Node) -> Any:
        self._trail.append(part)
        value = self.build(node)
        self._trail.pop()
        return value

    def _merge_source(self, node: Node) -> dict[str, Any]:
        source = self.build(node)
        if not isinstance(source, dict):
            self._fail(node, "'<<' without keys and values", "'<<: *anchor' of a mapping", "Name another anchor.")
        return source

    def _key(self, node: Node) -> str:
        key = self._scalar(node) if isinstance(node, ScalarNode) else None
        if not isinstance(key, str):
            shown = str(node.value)[:40] if isinstance(node, ScalarNode) else "made of a list or mapping"
            self._fail(
                node, f"a key {shown}, which is not text", "a word as key", "Quote the key if it is meant as text."
            )
        return key

    def _scalar(self, node: ScalarNode) -> Any:
        text = str(node.value)
        try:
            if node.tag in _TEXT_TAGS:
                return _whole_characters(text)
            if node.tag == _TAG + "int":
                return _whole_number(text)
            if node.tag == _TAG + "float":
                return _real_number(text)
        except UnicodeDecodeError:
            self._fail(node, "half of a surrogate pair", "whole characters", "Write the character itself.")
        except ValueError:
            self._fail(node, f"{text[:40]!r}", "a number", "Correct the number, or quote it if it is text.")
        if node.tag == _TAG + "bool" and text.lower() in _TRUTH:
            return _TRUTH[text.lower()]
        if node.tag == _TAG + "null" and text in _NULLS:
            return None
        return self._unknown_tag(node)

    def _unknown_tag(self, node: Node) -> NoReturn:
        tag = str(node.tag).replace(_TAG, "!!")
        self._fail(node, f"the tag {tag}", "plain YAML values", "Delete the tag.")

    def _fail(self, node: Node, found: str, expected: str, mend: str) -> NoReturn:
        spot = f"{self._name}:{node.start_mark.line + 1}"
        where = f"{dotted(self._trail)} ({spot})" if self._trail else spot
        raise CampaignError(where, found=found, expected=expected, mend=mend)


def _whole_characters(text: str) -> str:
    """Join surrogate pairs, by which JSON escapes write some characters; half a pair raises `UnicodeDecodeError`."""
    return text.encode("utf-16", "surrogatepass").decode("utf-16")


def _whole_number(text: str) -> int:
    digits = text.replace("_", "").lower()
    for prefix, base in (("0x", 16), ("0o", 8), ("0b", 2)):
        if digits.lstrip("+-").startswith(prefix):
            return int(digits, base)
    return int(digits)


def _real_number(text: str) -> float:
    digits = text.replace("_", "").lower()
    return float(digits.replace(".inf", "inf").replace(".nan", "nan"))
