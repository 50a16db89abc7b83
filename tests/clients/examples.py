"""Every example is valid: those of the OpenAPI document, the files of api/examples, the options in README.md.

With --write SERVER SAMPLE: makes the answers in api/examples/answers anew, from a service with the defaults.
"""

import json
import re
import sys
import time

import httpx
import yaml

from contract import DOCUMENT, ROOT, check, check_events, check_named

ANSWERS = ROOT / "api/examples/answers"
JOB = "8c2f6d0b5e9a4c17b3d8f1a26e7c9054"


def escape(key):
    return key.replace("~", "~0").replace("/", "~1")


def walk(value, pointer):
    """Every object with an example or examples and a schema beside it: media types, parameters, headers."""
    if isinstance(value, dict):
        if "schema" in value:
            named = {name: e["value"] for name, e in value.get("examples", {}).items()}
            for name, example in {**named, **({"": value["example"]} if "example" in value else {})}.items():
                yield example, f"{pointer}/schema", f"the example {name} of {pointer}"
        for key, child in value.items():
            if key not in ("example", "examples"):
                yield from walk(child, f"{pointer}/{escape(key)}")
    elif isinstance(value, list):
        for index, child in enumerate(value):
            yield from walk(child, f"{pointer}/{index}")


def in_document():
    count = 0
    for example, pointer, what in walk(DOCUMENT["paths"], "/paths"):
        check(example, pointer, what)
        if pointer.endswith("text~1event-stream/schema"):
            check_events(example, what)
        count += 1
    return count


def missing():
    """Calls without an example of what is answered, or of what is asked where that is JSON or a form."""
    for path, item in DOCUMENT["paths"].items():
        for method, call in item.items():
            body = call.get("requestBody", {}).get("content", {}).get("multipart/form-data")
            if body is not None and not body.get("examples"):
                yield f"{method} {path}: the form"
            for status, answer in call["responses"].items():
                for media_type, content in answer.get("content", {}).items():
                    if content["schema"].get("format") != "binary" and "example" not in content:
                        yield f"{method} {path}: {status} {media_type}"


def options():
    """Options as users read them, each with the place where it stands."""
    for file in sorted((ROOT / "api/examples").glob("*.json")):
        yield json.loads(file.read_text()), file.name
    for file in [ROOT / "README.md", *sorted((ROOT / "api/examples").glob("*.sh"))]:
        for text in re.findall(r"options=(\{.*?\})'", file.read_text()):
            yield json.loads(text), f"{file.name}: {text}"
    gate = yaml.safe_load((ROOT / "api/examples/gate.yml").read_text())
    for step in (s for job in gate["jobs"].values() for s in job["steps"]):
        if "OPTIONS" in step.get("env", {}):
            yield json.loads(step["env"]["OPTIONS"]), "gate.yml"
    # The table of options: JSON in its last column is a value of the option in its first.
    for path, default, meaning in re.findall(r"^\| `([a-z_.]+)` \| (.*?) \| (.*) \|$", (ROOT / "README.md").read_text(), re.M):
        values = [json.loads(text) for text in re.findall(r"`(\{.*?\}+)`", meaning)]
        default = default.strip("`")
        values.append(json.loads(default) if re.match(r"[\d{\[]|null$|true$|false$", default) else default)
        for value in values:
            whole = value
            for key in reversed(path.split(".")):
                whole = {key: whole}
            yield whole, f"README.md: {path} = {value}"


def write(base, sample):
    """The answers of a service: one job of the sample, before it runs and when it is done."""
    service = httpx.Client(base_url=base, timeout=120)
    parts = {"model": ("textured.glb", open(sample, "rb"))}
    gate = json.loads((ROOT / "api/examples/pack-gate.json").read_text())
    queued = service.post("/v1/jobs", files=parts, data={"options": json.dumps(gate)}).json()
    done = service.get(f"/v1/jobs/{queued['id']}", headers={"Prefer": "wait=60"}).json()
    report = service.get(f"/v1/jobs/{queued['id']}/artifacts/report.json").json()
    recipes = service.get("/v1/recipes").json()
    # The schemas stand in the document already.
    recipes["stages"] = [{**s, "parameters": {"type": "object"}} for s in recipes["stages"]]
    recipes["options"] = {"type": "object"}
    queued.update(state="queued", queue_position=1, attempt=0, started_at=None, timings=[])
    queued["progress"] = dict.fromkeys(queued["progress"], 0) | {"stage": "", "message": ""}
    answers = {"job": done, "queued": queued, "report": report, "recipes": recipes, "limits": service.get("/v1/limits").json()}
    for name, answer in answers.items():
        text = json.dumps(answer, indent=2, ensure_ascii=False).replace(queued["id"], JOB)
        (ANSWERS / f"{name}.json").write_text(text + "\n")


def main():
    if sys.argv[1:2] == ["--write"]:
        return write(*sys.argv[2:])
    started = time.time()
    bare = list(missing())
    assert not bare, "without an example: " + "; ".join(bare)
    count = in_document()
    given = list(options())
    assert len(given) > 25, "the options of README.md were not found"
    for value, what in given:
        check_named(value, "Options", what)
    print(f"{count} examples of the document and {len(given)} options are valid ({time.time() - started:.1f} s)")


main()
