"""Fields of the form of a new job, made from ``OPTIONS``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from trompe_shared.api import OPTIONS, PARTS, Option


@dataclass(frozen=True)
class Field:
    """An input of the form. ``name``: part and field of the option, as the API names a fault's place.

    ``choices`` are values of a select; without them ``attributes`` are those of an input.
    """

    name: str
    label: str
    attributes: Mapping[str, Any]
    choices: Sequence[str] = ()


def form_fields() -> dict[str, Field]:
    return {keyword: field_of(option) for keyword, option in OPTIONS.items() if option.in_form}


def field_of(option: Option) -> Field:
    """The field of an option: number, checkbox, select or text by its type."""
    schema = PARTS[option.part].model_json_schema()["properties"][option.field]
    kind = next(each for each in schema.get("anyOf", [schema]) if each.get("type") != "null")
    default = option.default[0] if isinstance(option.default, list) and option.default else option.default
    attributes: dict[str, Any] = {"type": "text", "maxlength": 200}
    if kind["type"] in {"number", "integer"}:
        attributes = {
            "type": "number",
            "min": kind.get("minimum", kind.get("exclusiveMinimum")),
            "max": kind.get("maximum", kind.get("exclusiveMaximum")),
            "step": 1 if kind["type"] == "integer" else "any",
        }
    elif kind["type"] == "boolean":
        attributes = {"type": "checkbox", "checked": "" if default else None}
    if kind["type"] != "boolean" and isinstance(default, str | int | float):
        attributes["value"] = default
    words = f"{option.keyword.replace('_', ' ')}: {option.help}"
    return Field(f"{option.part}.{option.field}", words, attributes, kind.get("enum", ()))
