#!/usr/bin/env python3
"""Drills of the service: what must hold when processes are killed at random under load.

    tests/drill.py [--program PROGRAM] [--kills N] [--seed N] [--folder DIR]

Two processes share one data folder. Jobs of two sizes are submitted all the time, some are cancelled, and one of the processes is
killed with SIGKILL at random, N times in all (200; the gate runs a few). Then everything must be final: no accepted job is lost or has
failed, every artifact is there, equal jobs have equal results, and no file is left that no job owns. One line of JSON tells what
happened; the exit code is 1 where something does not hold.
"""

import argparse
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path

BOUNDARY = "a-boundary-that-no-file-holds-51c2"
FINAL = {"succeeded", "failed", "canceled", "expired"}


class Service:
    """One process of the service on a data folder, which can be killed and started again."""

    def __init__(self, program, data, log):
        self.command = [program, "serve", "--listen", "127.0.0.1:0", "--data-dir", str(data), "--jobs", "2", "--lease", "5s"]
        self.command += ["--list-jobs", "--log-level", "warn"]
        self.log = log
        self.start()

    def start(self):
        self.process = subprocess.Popen(self.command, stdout=subprocess.PIPE, stderr=self.log, text=True)
        line = self.process.stdout.readline().strip()
        if not line.startswith("listening on "):
            sys.exit(f"the service does not start: {line!r}")
        self.base = line.removeprefix("listening on ")

    def kill(self):
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def call(self, method, path, body=None, headers=None):
        """Status and body; None where there is no answer."""
        request = urllib.request.Request(self.base + path, data=body, headers=headers or {}, method=method)
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                return answer.status, answer.read()
        except urllib.error.HTTPError as error:
            return error.code, error.read()
        except (urllib.error.URLError, OSError):
            return None


def form(model, recipe):
    head = f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="model"; filename="m.glb"\r\n\r\n'
    tail = f'\r\n--{BOUNDARY}\r\nContent-Disposition: form-data; name="options"\r\n\r\n{{"recipe": "{recipe}"}}\r\n--{BOUNDARY}--\r\n'
    return head.encode() + model + tail.encode()


def sample(program, name, folder):
    path = folder / f"{name}.glb"
    subprocess.run([program, "sample", name, "-o", str(path)], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return path.read_bytes()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", default="target/release/intarsia")
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", help="where the data folder is made")
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory(prefix="intarsia-drill-", dir=arguments.folder) as root:
        sys.exit(drill(arguments.program, Path(root), arguments.kills, chance))


def drill(program, root, kills, chance):
    data, log = root / "data", open(root / "log", "w+")
    forms = {"small": form(sample(program, "textured", root), "pack"), "large": form(sample(program, "scan_2000", root), "scan")}
    services = [Service(program, data, log), Service(program, data, log)]
    accepted, wanted, killed, unanswered = {}, set(), 0, 0
    next_kill = time.monotonic() + 1
    while killed < kills:
        service = chance.choice(services)
        counts = service.call("GET", "/v1/jobs?state=queued&limit=200")
        waiting = len(json.loads(counts[1])["jobs"]) if counts and counts[0] == 200 else 99
        if waiting < 12:
            size = "large" if chance.random() < 0.25 else "small"
            headers = {"Content-Type": f"multipart/form-data; boundary={BOUNDARY}"}
            answer = service.call("POST", "/v1/jobs", forms[size], headers)
            if answer and answer[0] == 202:
                accepted[json.loads(answer[1])["id"]] = size
            elif answer is None:
                unanswered += 1
        if accepted and chance.random() < 0.1:
            job = chance.choice(sorted(accepted)[-20:])
            if (service.call("POST", f"/v1/jobs/{job}/cancel", b"") or [0])[0] == 202:
                wanted.add(job)
        time.sleep(chance.random() * 0.1)
        if time.monotonic() >= next_kill:
            victim = chance.choice(services)
            victim.kill()
            killed += 1
            victim.start()
            next_kill = time.monotonic() + 0.2 + chance.random() * 1.5
    service = services[0]
    jobs, deadline = {}, time.monotonic() + 1800
    while len(jobs) < len(accepted) and time.monotonic() < deadline:
        for job in [j for j in accepted if j not in jobs]:
            answer = service.call("GET", f"/v1/jobs/{job}")
            found = json.loads(answer[1]) if answer else {"state": "unanswered"}
            if answer and (answer[0] != 200 or found["state"] in FINAL):
                jobs[job] = found if answer[0] == 200 else {"state": f"lost ({answer[0]})", "artifacts": []}
        time.sleep(0.2)
    states = {}
    for job in jobs.values():
        states[job["state"]] = states.get(job["state"], 0) + 1
    problems = [f"{n} jobs are {state}" for state, n in states.items() if state not in {"succeeded", "canceled"}]
    problems += [f"{len(accepted) - len(jobs)} jobs do not end"] * (len(jobs) < len(accepted))
    problems += [f"{job} was cancelled by nobody" for job, found in jobs.items() if found["state"] == "canceled" and job not in wanted]
    problems += [f"{job} was cancelled and is {jobs[job]['state']}" for job in wanted if job in jobs and jobs[job]["state"] == "failed"]
    models = {}
    for job, found in jobs.items():
        for artifact in found["artifacts"]:
            answer = service.call("GET", artifact["href"])
            if not answer or answer[0] != 200 or hashlib.sha256(answer[1]).hexdigest() != artifact["sha256"]:
                problems.append(f"{job}: {artifact['name']} is not what was published")
            if artifact["name"] == "model.glb":
                models.setdefault(accepted[job], set()).add(artifact["sha256"])
    problems += [f"{size} jobs have {len(found)} different models" for size, found in models.items() if len(found) > 1]
    # Submissions whose answer was lost may have made jobs too: what they own is no orphan.
    owned, cursor = set(), ""
    while True:
        page = json.loads(service.call("GET", f"/v1/jobs?limit=200{cursor}")[1])
        owned |= {artifact["sha256"] for job in page["jobs"] for artifact in job["artifacts"]}
        if page["next"] is None:
            break
        cursor = f"&cursor={page['next']}"
    for other in services[1:]:
        other.kill()
    # Maintenance removes what dead processes have left: at the start of the next one, and uploads of no job after a minute.
    service.kill()
    service.start()
    orphans, deadline = ["?"], time.monotonic() + 150
    while orphans and time.monotonic() < deadline:
        time.sleep(1)
        files = [p for part in ("objects", "uploads", "incoming") for p in (data / part).rglob("*") if p.is_file()]
        orphans = [p for p in files if p.parts[-3] != "objects" or p.name not in owned]
    problems += [f"{p.relative_to(data)} belongs to no job" for p in orphans]
    service.kill()
    most = max((job.get("attempt", 0) for job in jobs.values()), default=0)
    told = {"kills": killed, "jobs": len(accepted), "unanswered": unanswered, "states": states, "most_attempts": most, "problems": problems}
    print(json.dumps(told))
    if problems:
        log.seek(0)
        sys.stderr.write(log.read()[-20000:])
    return 1 if problems else 0


if __name__ == "__main__":
    main()
