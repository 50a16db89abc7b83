"""The OpenAPI document, and whether a value is what one of its schemas says."""

import json
from pathlib import Path

from jsonschema import Draft202012Validator
from referencing import Registry, Resource
from referencing.jsonschema import DRAFT202012

ROOT = Path(__file__).resolve().parents[2]
DOCUMENT = json.loads((ROOT / "api/openapi.json").read_text())
REGISTRY = Registry().with_resource("urn:contract", Resource.from_contents(DOCUMENT, default_specification=DRAFT202012))


class Mismatch(AssertionError):
    """A value is not what its schema says."""


def check(value, pointer, what):
    """Holds a value against the schema at a JSON pointer into the document."""
    validator = Draft202012Validator({"$ref": f"urn:contract#{pointer}"}, registry=REGISTRY)
    errors = sorted(validator.iter_errors(value), key=lambda e: list(map(str, e.absolute_path)))
    if errors:
        lines = [f"  /{'/'.join(map(str, e.absolute_path))}: {e.message[:300]}" for e in errors[:5]]
        raise Mismatch(f"{what} is not as {pointer} says:\n" + "\n".join(lines))


def check_named(value, name, what):
    """Holds a value against a schema by its name."""
    check(value, f"/components/schemas/{name}", what)


def check_events(text, what):
    """Holds each event of a stream against its schema; returns their names."""
    names = []
    for block in filter(str.strip, text.split("\n\n")):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith(":"))
        if fields:
            event = {"event": fields["event"], "data": json.loads(fields["data"])}
            check_named(event, "JobEvent", f"{what}: {fields['event']}")
            names.append(fields["event"])
    return names
