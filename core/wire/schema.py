"""JSON schemas of the messages, as recordings carry them and viewers read them."""

from typing import Any, Final

import msgspec

from socast.core.wire.messages import KINDS, Wire

_KEPT: Final[tuple[str, ...]] = ("title", "description", "type", "required")


def make_schema(kind: str) -> dict[str, Any]:
    """Return the JSON schema of a kind of message, with plain types: no references and no `anyOf`.

    Returns
    -------
    dict
        Every field has its meaning and unit as `description`, and `null` among its types where the wire allows it.

    Notes
    -----
    Viewers of MCAP files plot what they find as `properties` of an `object`, and follow neither `$ref` nor `anyOf`.

    Examples
    --------
    >>> make_schema("telemetry")["properties"]["soc_pct"]
    {'type': ['number', 'null'], 'description': 'State of charge as displayed. [%]'}
    """
    return describe_struct(KINDS[kind])


def describe_struct(struct: type[Wire]) -> dict[str, Any]:
    """Return the JSON schema of a struct, see `make_schema`."""
    _, components = msgspec.json.schema_components([struct], ref_template="{name}")
    return _simplify(components[struct.__name__], components)


def _simplify(node: dict[str, Any], components: dict[str, Any]) -> dict[str, Any]:
    """Return a node of a schema without references, unions, defaults and limits."""
    if "$ref" in node:
        return _simplify(components[node["$ref"]], components) | {k: node[k] for k in _KEPT if k in node}
    if "enum" in node:
        return {k: node[k] for k in _KEPT if k in node} | {"type": "string"}
    if "anyOf" in node:
        (option,) = (option for option in node["anyOf"] if option.get("type") != "null")
        plain = _simplify(option, components) | {k: node[k] for k in _KEPT if k in node}
        return plain | {"type": [plain["type"], "null"]}
    out = {k: node[k] for k in _KEPT if k in node}
    if "items" in node:
        out["items"] = _simplify(node["items"], components)
    if "properties" in node:
        out["properties"] = {name: _simplify(child, components) for name, child in node["properties"].items()}
    return out
