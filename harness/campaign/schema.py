"""JSON schema of a campaign, for editors that complete and check it, and for error messages that know the limits."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

from pydantic import BaseModel

from harness.campaign.campaign import Campaign
from harness.campaign.vehicle import AV_SOURCES, PARAMETERS

Schema = dict[str, Any]


def campaign_schema() -> Schema:
    """JSON schema (draft 2020-12) of a campaign file, generated from the models."""
    about = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "harness campaign"}
    return {**about, **schema_of(Campaign)}


@cache
def schema_of(model: type[BaseModel]) -> Schema:
    """JSON schema of a file: a campaign, a panel of vehicles, or parameters of an environment."""
    schema = model.model_json_schema()
    av = schema.get("$defs", {}).get("AutomatedVehicle")
    if av is not None:
        for parameters in PARAMETERS.values():
            schema["$defs"].setdefault(parameters.__name__, parameters.model_json_schema())
    _tidy(schema)
    if av is not None:
        _tell_sources_apart(av)
    return schema


def _tell_sources_apart(av: Schema) -> None:
    """An AV has at most one source, and its parameters follow it: JSON schema's way to say what the models check."""
    for name in AV_SOURCES:
        node = av["properties"][name]
        (source,) = (option for option in node["anyOf"] if option.get("type") != "null")
        about = {"description": node["description"]}
        # Null says "not this one"; in a file of its own leaving the key out says it better.
        av["properties"][name] = {**source, **about, **{k: node[k] for k in ("examples",) if k in node}}
    named = [{"required": [name]} for name in AV_SOURCES]
    about = {"description": av["properties"]["parameters"]["description"]}
    av["properties"]["parameters"] = {"type": "object", **about}
    av |= {"oneOf": [*named, {"not": {"anyOf": named}}], **_by_source(about)}


def _by_source(about: Schema) -> Schema:
    """What ``parameters`` are, as a chain of if, then and else: of a model, of a controller, none, else the IDM's."""
    elsewhere = {"anyOf": [{"required": [name]} for name in ("sumo", "traci", "fmu")]}
    cases: list[tuple[Schema, Schema]] = [
        *(
            ({"required": ["model"], "properties": {"model": {"const": model}}}, _parameters_of(model))
            for model in PARAMETERS
            if model != "idm"
        ),
        ({"required": ["controller"]}, {"type": "object"}),
        (elsewhere, {"type": "object", "maxProperties": 0}),
    ]
    chain: Schema = {"properties": {"parameters": {**_parameters_of("idm"), **about}}}
    for test, parameters in reversed(cases):
        chain = {"if": test, "then": {"properties": {"parameters": {**parameters, **about}}}, "else": chain}
    return chain


def _parameters_of(model: str) -> Schema:
    return {"$ref": f"#/$defs/{PARAMETERS[model].__name__}"}


def schema_text() -> str:
    """Give the schema as it is committed beside the scenarios and printed by ``harness schema``."""
    return json.dumps(campaign_schema(), indent=2, ensure_ascii=False) + "\n"


def _tidy(node: Any) -> None:
    """Close mappings of patterned names, and drop generated titles, which only repeat the keys."""
    if isinstance(node, list):
        for item in node:
            _tidy(item)
    if not isinstance(node, dict):
        return
    if "patternProperties" in node:
        node.setdefault("additionalProperties", False)
    if isinstance(node.get("title"), str):
        del node["title"]
    for value in node.values():
        _tidy(value)


class SchemaView:
    """Finds what a JSON schema says about one place of a document.

    Understands what pydantic writes: references, optional values, unions told apart by a key, ``if``/``then``.
    """

    def __init__(self, root: Schema) -> None:
        self._root = root

    def at(self, path: Sequence[str | int], data: Any) -> Schema:
        """Look up the schema of the value at ``path`` of ``data``; empty when nothing is known about it."""
        node = self._resolve(self._root, data)
        for part in path:
            data = _step(data, part)
            node = self._resolve(self._child(node, part), data)
        return node

    def paths_of_key(self, key: str) -> Iterator[str]:
        """Dotted paths of every place that knows ``key``, names of one's own choice written as ``NAME``."""
        yield from self._search(self._root, key, "")

    def _search(self, node: Schema, key: str, prefix: str) -> Iterator[str]:
        node = self._deref(node)
        for option in (*node.get("oneOf", ()), *node.get("anyOf", ())):
            yield from self._search(option, key, prefix)
        for name, child in node.get("properties", {}).items():
            if name == key:
                yield prefix + name
            yield from self._search(child, key, f"{prefix}{name}.")
        for child in node.get("patternProperties", {}).values():
            yield from self._search(child, key, f"{prefix}NAME.")
        for branch in (node[name] for name in ("then", "else") if name in node):
            yield from self._search(branch, key, prefix)

    def _deref(self, node: Schema) -> Schema:
        if "$ref" in node:
            target = self._root["$defs"][node["$ref"].rpartition("/")[2]]
            node = {**target, **{key: value for key, value in node.items() if key != "$ref"}}
        return node

    def _resolve(self, node: Schema, value: Any) -> Schema:
        node = self._deref(node)
        if "discriminator" in node:
            tag = _step(value, node["discriminator"]["propertyName"])
            target = node["discriminator"]["mapping"].get(tag) if isinstance(tag, str) else None
            return self._deref({"$ref": target}) if target else node
        options = [option for option in node.get("anyOf", ()) if option.get("type") != "null"]
        if len(options) == 1:
            rest = {key: item for key, item in node.items() if key != "anyOf"}
            node = {**self._deref(options[0]), **rest, "nullable": len(node["anyOf"]) > 1}
        while "if" in node:
            branch = node["then" if _holds(node["if"], value) else "else"]
            rest = {key: item for key, item in node.items() if key not in ("if", "then", "else")}
            properties = {**node.get("properties", {}), **branch.get("properties", {})}
            node = {**rest, **branch, "properties": properties}
        return node

    def _child(self, node: Schema, part: str | int) -> Schema:
        child = node.get("properties", {}).get(part)
        if child is None:
            others = list(node.get("patternProperties", {}).values())
            extra = node.get("additionalProperties")
            items = node.get("items")
            child = next((other for other in (*others, extra, items) if isinstance(other, dict)), {})
        return dict(child)


def _holds(test: Schema, value: Any) -> bool:
    """Whether ``value`` passes a test of the kind that this module writes; a null counts as left out."""
    if any(_step(value, key) is None for key in test.get("required", ())):
        return False
    if any(_step(value, key) != wanted["const"] for key, wanted in test.get("properties", {}).items()):
        return False
    return "anyOf" not in test or any(_holds(option, value) for option in test["anyOf"])


def _step(data: Any, part: str | int) -> Any:
    """Value one step into ``data``, None where there is none."""
    if isinstance(data, dict):
        return data.get(part)
    if isinstance(data, list) and isinstance(part, int) and part < len(data):
        return data[part]
    return None
