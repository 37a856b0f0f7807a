"""Random campaigns that the JSON schema allows, for property tests."""

import shlex
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from harness.campaign.schema import campaign_schema
from harness.campaign.sections import MOST_SUMO_CELLS
from harness.campaign.vehicle import AV_SOURCES, PARAMETERS

SCHEMA = campaign_schema()
BUILT_IN = {name: section.__name__ for name, section in PARAMETERS.items()}
_NAMES = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_-]{0,11}", fullmatch=True)
_PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(_NAMES, inner, max_size=3),
    max_leaves=4,
)


def values(node: dict[str, Any]) -> st.SearchStrategy[Any]:
    """Values that one node of the schema allows; mappings leave out any part that has a default."""
    if "$ref" in node:
        return values(SCHEMA["$defs"][node["$ref"].rpartition("/")[2]])
    if "if" in node:
        return st.sampled_from([None, *AV_SOURCES]).flatmap(lambda source: _av(node, source))
    for choice in ("anyOf", "oneOf"):
        if choice in node:
            return st.one_of([values(option) for option in node[choice]])
    if "properties" in node:
        required = {key: values(child) for key, child in node["properties"].items() if key in node.get("required", ())}
        optional = {key: values(child) for key, child in node["properties"].items() if key not in required}
        return st.fixed_dictionaries(required, optional=optional)
    named = [*node.get("patternProperties", {}).values(), node.get("additionalProperties")]
    if named[0]:  # True: whatever somebody else's options are
        return st.dictionaries(_NAMES, _PLAIN if named[0] is True else values(named[0]), min_size=1, max_size=3)
    return _scalars(node)


def _av(node: dict[str, Any], source: str | None) -> st.SearchStrategy[Any]:
    """A vehicle driven by one source, or by none in particular, with the parameters that belong to it."""
    if source == "model":
        return st.sampled_from(sorted(BUILT_IN)).flatmap(lambda model: _parts(node, {"model": st.just(model)}, model))
    if source is None:
        return _parts(node, {}, "idm")
    return _parts(node, {source: values(node["properties"][source])}, source)


def _in_steps(reaction: dict[str, Any]) -> dict[str, Any]:
    return {key: round(value, 1) if key.endswith("delay_s") else value for key, value in reaction.items()}


def _harder(parameters: dict[str, Any]) -> dict[str, Any]:
    """Hard braking is no softer than comfortable braking, 4 m/s² when left out; times are whole steps."""
    if "comfortable_braking_mps2" in parameters or "hard_braking_mps2" in parameters:
        comfortable = parameters.get("comfortable_braking_mps2", 4.0)
        parameters["hard_braking_mps2"] = max(parameters.get("hard_braking_mps2", 0.0), comfortable)
    if "risk_evaluation_s" in parameters:
        parameters["risk_evaluation_s"] = round(parameters["risk_evaluation_s"], 1)
    return parameters


def _parts(
    node: dict[str, Any], required: dict[str, st.SearchStrategy[Any]], driver: str
) -> st.SearchStrategy[dict[str, Any]]:
    optional = {name: values(node["properties"][name]) for name in ("before_cut_in", "limits")}
    if driver in BUILT_IN:
        optional["parameters"] = values({"$ref": f"#/$defs/{BUILT_IN[driver]}"}).map(_harder)
        optional["reaction"] = values({"$ref": "#/$defs/Reaction"}).map(_in_steps)
    if driver == "controller":
        optional["parameters"] = st.dictionaries(_NAMES, _PLAIN, max_size=3) | values(
            {"$ref": "#/$defs/IDMParameters"}  # names that a built-in model has, too
        )
    return st.fixed_dictionaries(required, optional=optional)


def _scalars(node: dict[str, Any]) -> st.SearchStrategy[Any]:
    low, high = node.get("minimum", node.get("exclusiveMinimum")), node.get("maximum", node.get("exclusiveMaximum"))
    if "const" in node or "enum" in node:
        return st.sampled_from(node.get("enum") or [node["const"]])
    if node["type"] == "integer":
        return st.integers(low, high - ("exclusiveMaximum" in node) if high is not None else None)
    if node["type"] == "number":
        bounds = {"exclude_min": "exclusiveMinimum" in node, "exclude_max": "exclusiveMaximum" in node}
        return st.floats(low, high, allow_nan=False, allow_infinity=False, **bounds)
    if node["type"] in ("null", "boolean"):
        return st.none() if node["type"] == "null" else st.booleans()
    if "pattern" in node:
        return st.from_regex(node["pattern"], fullmatch=True)
    return st.text(min_size=node.get("minLength", 0), max_size=40)


def campaigns() -> st.SearchStrategy[dict[str, Any]]:
    """Campaign data by which the rules between several values hold, too."""
    return values(SCHEMA).map(_obey_rules)


def _obey_rules(data: dict[str, Any]) -> dict[str, Any]:
    environment, testing, stop = data.get("environment", {}), data.get("testing", {}), data.get("stop", {})
    environment.pop("parameters", None)
    data.get("pool", {}).pop("library", None)
    fmu = (data.get("av") or {}).get("fmu")
    if fmu:
        fmu["file"] = str(Path(__file__).resolve())  # loading wants a file that exists, and makes its path absolute
    traci = (data.get("av") or {}).get("traci")
    if traci:
        traci["command"] = shlex.join(
            ["x", traci["command"].replace("{", "").replace("}", "")]
        )  # words, nothing to fill in
    for name in ("acceleration_hold_s", "cut_in_lead_s"):
        if environment.get(name) is not None:
            environment[name] = round(environment[name], 1)
    if testing.get("alpha") is not None:
        names = list(data.get("surrogates", ("SM-I", "SM-II", "SM-III")))
        testing["alpha"] = dict.fromkeys(names[:-1], 0.25) | {names[-1]: 1 - 0.25 * (len(names) - 1)}
    stop.pop("estimator", None)
    if testing.get("method") == "step_mixture":
        stop.pop("rhw", None)
    shells = testing.get("shells", {})
    if testing.get("method") != "shells" or shells.get("stopping") == "two_phase":
        data.pop("accept", None)
    if data.get("accept") and "statement" in shells:
        data["accept"].pop("statement", None)
    av = data.get("av", {})
    if testing.get("method", "episode_mixture") in ("forced", "episode_mixture", "shells"):
        av.pop("before_cut_in", None)
    if not any(av.get(source) for source in ("controller", "sumo", "traci", "fmu")):
        av.pop("before_cut_in", None)
    world = data.get("world", {})
    if "cells" in world:
        world["cells"] = min(world["cells"], MOST_SUMO_CELLS)
    if "sumo" in av or "traci" in av:
        data.get("world", {}).pop("engine", None)
    return data
