"""The manifests in docker/ fit the program: manifests.py SERVER PROGRAM. Each parses; their flags, variables, paths and metrics exist."""

import json
import re
import subprocess
import sys

import httpx
import yaml

from contract import DOCUMENT, ROOT

base, program = sys.argv[1:]
DOCKER = ROOT / "docker"
HELP = subprocess.run([program, "serve", "--help"], capture_output=True, text=True, check=True).stdout
FLAGS = set(re.findall(r"--[a-z-]+", HELP))
VARIABLES = set(re.findall(r"INTARSIA_[A-Z_]+", HELP))
METRICS = set(re.findall(r"^# TYPE (\S+)", httpx.get(f"{base}/metrics").text, re.M))
SECRET = re.compile(r"PASSWORD|SECRET|ACCESS_KEY_ID|QUEUE")


def objects(value):
    """Every object in a document."""
    if isinstance(value, dict):
        yield value
        for child in value.values():
            yield from objects(child)
    elif isinstance(value, list):
        for child in value:
            yield from objects(child)


def check_container(container, what):
    """A container that runs the program."""
    assert container["securityContext"]["readOnlyRootFilesystem"] is True, what
    assert {"requests", "limits"} <= container["resources"].keys(), what
    for argument in container["args"]:
        assert not argument.startswith("--") or argument in FLAGS, f"{what}: {argument}"
    for variable in container["env"]:
        name = variable["name"]
        assert name in VARIABLES or name.startswith("AWS_"), f"{what}: {name}"
        assert not SECRET.search(name) or "secretKeyRef" in variable["valueFrom"], f"{what}: {name} is no reference"
    for probe in ("startupProbe", "livenessProbe", "readinessProbe"):
        if probe in container:
            assert container[probe]["httpGet"]["path"] in DOCUMENT["paths"], f"{what}: {probe}"


def check_kubernetes(path):
    kinds = []
    for document in yaml.safe_load_all(path.read_text()):
        assert document["apiVersion"] and document["metadata"]["name"], path
        kinds.append(document["kind"])
        for pod in (o for o in objects(document) if "containers" in o):
            assert pod["securityContext"]["runAsNonRoot"] is True and pod["automountServiceAccountToken"] is False, path
            for container in pod["containers"]:
                check_container(container, f"{path.name}: {document['metadata']['name']}")
        if document["kind"] == "ConfigMap":
            for name in document["data"]:
                assert (name in VARIABLES or name.startswith("AWS_")) and not SECRET.search(name), f"{path.name}: {name}"
        if document["kind"] == "Deployment":
            assert document["spec"]["selector"]["matchLabels"] == document["spec"]["template"]["metadata"]["labels"]
    return kinds


def check_compose(path):
    services = yaml.safe_load(path.read_text())["services"]
    for name, service in services.items():
        image = service.get("image", "")
        if image != "intarsia":
            assert ":" in image, f"{path.name}: {name} has no version"
            continue
        for variable in service["environment"]:
            assert variable in VARIABLES or variable.startswith("AWS_"), f"{path.name}: {variable}"
        for argument in service.get("command", []):
            assert not argument.startswith("--") or argument in FLAGS, f"{path.name}: {argument}"
    return services


kinds = check_kubernetes(DOCKER / "kubernetes/intarsia.yaml")
assert kinds.count("Deployment") == 2 and kinds.count("PodDisruptionBudget") == 2, kinds
assert check_kubernetes(DOCKER / "kubernetes/keda.yaml") == ["ScaledJob"]
assert {"intarsia"} <= check_compose(DOCKER / "compose.yaml").keys()
assert {"api", "worker-1", "worker-2", "postgres", "s3"} <= check_compose(DOCKER / "compose.fleet.yaml").keys()
rules = yaml.safe_load((DOCKER / "monitoring/alerts.yaml").read_text())["groups"][0]["rules"]
for rule in rules:
    assert {"alert", "expr", "labels"} <= rule.keys() and {"summary", "description"} <= rule["annotations"].keys(), rule
dashboard = json.loads((DOCKER / "monitoring/dashboard.json").read_text())
ids = [panel["id"] for panel in dashboard["panels"]]
assert len(set(ids)) == len(ids) and all(panel["targets"] for panel in dashboard["panels"])
for file in sorted((DOCKER / "monitoring").iterdir()):
    if file.suffix == ".yaml":
        yaml.safe_load(file.read_text())
print(f"manifests: {len(kinds) + 1} objects, {len(rules)} alerts, {len(ids)} panels; the service tells {len(METRICS)} metrics")
