"""For schemathesis: half of what it sends as bytes is a model, so that jobs come to be; the rest is noise."""

import json
import os

import schemathesis
from hypothesis import strategies

with open(os.environ["INTARSIA_SAMPLE"], "rb") as file:
    MODEL = file.read()


@schemathesis.serializer("model/gltf+json")
def as_json(context, value):
    """glTF as JSON is JSON."""
    return json.dumps(value).encode()


@schemathesis.serializer("application/offset+octet-stream")
def as_bytes(context, value):
    """A piece of an upload is bytes."""
    value = getattr(value, "data", value)
    return value if isinstance(value, bytes) else str(value).encode()


schemathesis.openapi.format("binary", strategies.just(MODEL) | strategies.binary(max_size=64))
