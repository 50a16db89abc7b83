"""The generated Python client at work: client.py SERVER SAMPLE. Posts, waits, fetches, and holds a figure against a bound."""

import io
import sys

from intarsia_client import Client
from intarsia_client.api.jobs import fetch, read, report, submit
from intarsia_client.models import Job, Options, Problem, Submission
from intarsia_client.types import File

from contract import check_events, check_named

base, sample = sys.argv[1:]
service = Client(base_url=base, timeout=120)
with open(sample, "rb") as file:
    model = file.read()


def file():
    return File(payload=io.BytesIO(model), file_name="sample.glb", mime_type="model/gltf-binary")


def submitted(options):
    """Posts the sample with options as one writes them."""
    return submit.sync(client=service, body=Submission(model=[file()], options=Options.from_dict(options)))


def finished(job):
    assert isinstance(job, Job), job
    while job.state in ("queued", "running"):
        job = read.sync(job.id, client=service, prefer="wait=30")
        assert isinstance(job, Job), job
    return job


# Post, wait, fetch.
gate = {"min": 0.4}
job = finished(submitted({"recipe": "scan", "pack": {"gutter": 8}, "work_budget": 1000, "require": {"atlas.packing_efficiency": gate}}))
assert job.state == "succeeded", job.error
glb = fetch.sync(job.id, "model.glb", client=service)
assert glb.payload.read(4) == b"glTF"

# Gate on a figure of the report.
figures = report.sync(job.id, client=service)
efficiency = figures.model.after.packing_efficiency
assert efficiency > 0.4, efficiency

# Gate by the service: the job fails, its artifacts are there.
missed = finished(submitted({"require": {"atlas.packing_efficiency": {"min": 1}}}))
assert missed.state == "failed" and missed.error.code == "requirement_not_met", missed.error
assert missed.error.failures[0].path == "atlas.packing_efficiency" and missed.artifacts

# A raw model, with its recipe in the query.
raw = submit.sync(client=service, body=file(), recipe="pack")
assert isinstance(raw, Job), raw

# What is wrong is told.
wrong = submitted({"pack": {"grid": 65}})
assert isinstance(wrong, Problem) and wrong.errors[0].pointer == "/pack/grid", wrong

# What the service says is what the document says: of each recipe, with merging, and of several models.
http = service.get_httpx_client()
recipes = http.get("/v1/recipes").json()
check_named(recipes, "Recipes", "/v1/recipes")
check_named(http.get("/v1/limits").json(), "LimitList", "/v1/limits")
names = [recipe["name"] for recipe in recipes["recipes"]]
for recipe in names:
    options = {"recipe": recipe, "atlas": {"merge": recipe == "pack"}, "work_budget": 1000}
    done = finished(submitted(options))
    check_named(http.get(f"/v1/jobs/{done.id}").json(), "Job", f"the job of {recipe}")
    check_named(http.get(f"/v1/jobs/{done.id}/artifacts/report.json").json(), "Report", f"the report of {recipe}")
    told = check_events(http.get(f"/v1/jobs/{done.id}/events").text, f"the events of {recipe}")
    assert told[0] == "snapshot" and told[-1] == "state", told
check_named(http.get("/v1/jobs").json(), "JobPage", "/v1/jobs")

# A large file in two pieces, which then stands for the models of a batch.
begun = http.post("/v1/uploads", headers={"Upload-Length": str(len(model))})
check_named(begun.json(), "Upload", "an upload that begins")
place, half = begun.headers["location"], len(model) // 2
for offset, piece in ((0, model[:half]), (half, model[half:])):
    headers = {"Upload-Offset": str(offset), "Content-Type": "application/offset+octet-stream"}
    sent = http.patch(place, content=piece, headers=headers)
    assert sent.status_code == 204, sent.text
upload = http.get(place).json()
check_named(upload, "Upload", "an upload that is complete")
answer = http.post("/v1/batches", json={"items": [{"model": upload["reference"]}] * 2})
assert answer.status_code == 202, answer.text
batch = answer.json()
while batch["state"] in ("queued", "running"):
    check_named(batch, "Batch", "a batch on its way")
    batch = http.get(f"/v1/batches/{batch['id']}", headers={"Prefer": "wait=30"}).json()
check_named(batch, "Batch", "a batch that has ended")
assert batch["counts"]["succeeded"] == 2, batch
check_named(http.get(f"{batch['jobs'][0]['href']}/deliveries").json(), "DeliveryPage", "deliveries of a job")

print(f"Python: packing efficiency {efficiency:.3f}; the answers for {len(names)} recipes are as documented")
