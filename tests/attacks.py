#!/usr/bin/env python3
"""Attacks on a service of its own: what is tried, what is answered, and whether that is as it should be.

    tests/attacks.py [PROGRAM]

Starts PROGRAM (target/debug/intarsia) on a free port of this machine with an empty data folder and tries one attack after the other: on the
parser of requests, on routes, forms, options, archives, images and models. Each line tells the attack, the answer, and the answers that are
right. The exit code is 1 where an answer is another, is a 5xx that was not asked for, where a job fails for the service's sake, or where the
service died, grew beyond a bound, or left files of what it refused.
"""

import base64
import io
import json
import os
import random
import socket
import struct
import subprocess
import sys
import tempfile
import time
import warnings
import zipfile
import zlib
from pathlib import Path

BOUNDARY = "a-boundary-that-no-file-holds-90ab"
MULTIPART = f"multipart/form-data; boundary={BOUNDARY}"
# Bytes of memory that the service may have held at its peak: jobs on small models, and bodies that are streamed.
MOST_MEMORY = 512 << 20
MAX_UPLOAD = 32 << 20
FINAL = {"succeeded", "failed", "canceled", "expired"}
# What a request may be answered with that is broken, what a model may end with that is.
REFUSED = {400, "closed"}
BROKEN = {400, 413, 422, "invalid_model"}
BAD_IMAGE = BROKEN | {"invalid_image", "too_large", "warned"}


class Service:
    """The service under attack."""

    def __init__(self, program, data, log):
        command = [program, "serve", "--listen", "127.0.0.1:0", "--data-dir", str(data), "--list-jobs", "--log-level", "error"]
        command += ["--upload-idle", "2s", "--max-uploads", "16", "--max-upload", str(MAX_UPLOAD), "--jobs", "2", "--min-free", "1MiB"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True)
        line = self.process.stdout.readline().strip()
        if not line.startswith("listening on http://"):
            sys.exit(f"the service does not start: {line!r}")
        self.host = line.removeprefix("listening on http://")
        address, port = self.host.rsplit(":", 1)
        self.address = (address, int(port))

    def connect(self, timeout=15):
        return socket.create_connection(self.address, timeout=timeout)

    def raw(self, data, timeout=15, finish=False):
        """All that is answered to these bytes until the connection ends or nothing more comes."""
        answer = b""
        with self.connect(timeout) as peer:
            try:
                peer.sendall(data)
                if finish:
                    peer.shutdown(socket.SHUT_WR)
                while len(answer) < 1 << 20 and (part := peer.recv(1 << 16)):
                    answer += part
            except OSError:
                pass
        return answer

    def request(self, method, path, body=b"", headers=None):
        """Status, headers in small letters, and body."""
        head = {"Host": self.host, "Connection": "close", **(headers or {})}
        if body or method == "POST":
            head.setdefault("Content-Length", str(len(body)))
        lines = "".join(f"{name}: {value}\r\n" for name, value in head.items())
        answer = self.raw(f"{method} {path} HTTP/1.1\r\n{lines}\r\n".encode("utf-8", "surrogateescape") + body)
        return parsed(answer)

    def submit(self, body, media_type=MULTIPART, query="", headers=None):
        return self.request("POST", f"/v1/jobs{query}", body, {"Content-Type": media_type, **(headers or {})})

    def memory(self):
        try:
            status = Path(f"/proc/{self.process.pid}/status").read_text()
            return int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:"))) * 1024
        except (OSError, StopIteration):
            return 0


def parsed(answer):
    head, _, body = answer.partition(b"\r\n\r\n")
    first, *lines = head.split(b"\r\n")
    words = first.split(b" ")
    if len(words) < 2 or not words[0].startswith(b"HTTP/"):
        return "closed", {}, b""
    headers = {name.decode().lower(): value.strip().decode("latin-1") for name, _, value in (line.partition(b":") for line in lines)}
    return int(words[1]), headers, body


def form(*parts):
    """A form of (name, file name or none, contents)."""
    body = b""
    for name, file, contents in parts:
        contents = contents.encode() if isinstance(contents, str) else contents
        file = f'; filename="{file}"' if file is not None else ""
        body += f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="{name}"{file}\r\n\r\n'.encode() + contents + b"\r\n"
    return body + f"--{BOUNDARY}--\r\n".encode()


def glb(document, chunk=b"", length=None, json_length=None):
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunk += b"\0" * (-len(chunk) % 4)
    bin_chunk = struct.pack("<II", len(chunk), 0x004E4942) + chunk if chunk else b""
    whole = 20 + len(text) + len(bin_chunk)
    head = struct.pack("<4sIIII", b"glTF", 2, whole if length is None else length, len(text) if json_length is None else json_length, 0x4E4F534A)
    return head + text + bin_chunk


def chunk(name, data):
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png(width, height, data=None):
    data = zlib.compress((b"\0" + bytes(range(256)) * 12)[: width * 3 + 1].ljust(width * 3 + 1, b"\7") * height) if data is None else data
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def jpeg(width, height):
    return b"\xff\xd8\xff\xc0\0\x11\x08" + struct.pack(">HH", height, width) + b"\x03\x01\x22\0\x02\x11\x01\x03\x11\x01\xff\xda\0\x0c\x03\x01\0\x02\x11\x03\x11\0\x3f\0\xff\xd9"


def ktx2(width, height, **changed):
    fields = {"format": 0, "size": 1, "width": width, "height": height, "depth": 0, "layers": 0, "faces": 1, "levels": 1, "scheme": 1}
    fields.update(changed)
    index = struct.pack("<IIIIQQ", 104, 44, 148, 0, 0, 0)
    level = struct.pack("<QQQ", 200, changed.get("bytes", 1000), changed.get("whole", 1000))
    names = list(fields)[:9]
    return b"\xabKTX 20\xbb\r\n\x1a\n" + struct.pack("<9I", *(fields[n] for n in names)) + index + level + b"\x9d" * 500


def webp(width, height):
    head = b"\x2f" + struct.pack("<I", (width - 1) & 0x3FFF | ((height - 1) & 0x3FFF) << 14) + b"\xff" * 30
    return b"RIFF" + struct.pack("<I", len(head) + 12) + b"WEBPVP8L" + struct.pack("<I", len(head)) + head


def triangle(image=None, **changes):
    """A document of one textured triangle, and its buffer, with what is changed in it."""
    blob = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + struct.pack("<6f", 0.1, 0.1, 0.9, 0.1, 0.1, 0.9) + struct.pack("<3H2x", 0, 1, 2)
    image = png(16, 16) if image is None else image
    places = [(0, 36), (36, 24), (60, 6), (68, len(image))]
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": at, "byteLength": length} for at, length in places],
        "buffers": [{"byteLength": 68 + len(image)}],
    }
    for path, value in changes.items():
        *way, last = [int(word) if word.isdigit() else word for word in path.split("__")]
        place = document
        for step in way:
            place = place[step]
        place[last] = value
    return glb(document, blob + image)


def archive(*files):
    out = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as made:
        # Two entries of one name are meant.
        warnings.simplefilter("ignore")
        for name, contents in files:
            made.writestr(name, contents)
    return out.getvalue()


def http(service):
    """Attacks on the parser of requests, and on what stands before the routes."""
    host = f"Host: {service.host}\r\n"
    smuggled = f"GET /smuggled HTTP/1.1\r\n{host}\r\n"

    def raw(text, finish=False):
        answer = service.raw(text if isinstance(text, bytes) else text.encode("latin-1"), timeout=4, finish=finish)
        codes = [int(line[9:12]) for line in answer.split(b"\r\n") if line.startswith(b"HTTP/1.") and line[9:12].isdigit()]
        return codes[0] if len(codes) == 1 else "closed" if not codes else f"{len(codes)} answers: {codes}"

    def post(head, body=""):
        return raw(f"POST /v1/jobs HTTP/1.1\r\n{host}Content-Type: model/gltf-binary\r\n{head}\r\n{body}", finish=True)

    # None of these may be answered twice: the second answer would be to a request that a proxy has not seen.
    yield "length and chunked, a request behind", post("Content-Length: 5\r\nTransfer-Encoding: chunked\r\n", f"0\r\n\r\n{smuggled}"), REFUSED
    yield "two lengths, a request behind", post("Content-Length: 0\r\nContent-Length: 60\r\n", smuggled), REFUSED
    yield "a list of lengths", post("Content-Length: 4, 5\r\n", "glTFx"), REFUSED
    yield "a length with a sign", post("Content-Length: +4\r\n", "glTF"), REFUSED
    yield "a negative length", post("Content-Length: -1\r\n", "glTF"), REFUSED
    yield "a length beyond 64 bits", post("Content-Length: 99999999999999999999999\r\n", "glTF"), REFUSED
    yield "a length beyond the limit", post("Content-Length: 99999999999999\r\n", "glTF"), {413}
    yield "an unknown coding, a request behind", post("Transfer-Encoding: xchunked\r\n", f"0\r\n\r\n{smuggled}"), REFUSED
    yield "chunked not last", post("Transfer-Encoding: chunked, identity\r\n", f"0\r\n\r\n{smuggled}"), REFUSED
    yield "a blank before the colon", post("Transfer-Encoding : chunked\r\n", f"0\r\n\r\n{smuggled}"), REFUSED
    yield "a folded header", post("X-A: 1\r\n Transfer-Encoding: chunked\r\n"), REFUSED
    yield "a chunk length beyond 64 bits", post("Transfer-Encoding: chunked\r\n", "fffffffffffffffff\r\nglTF"), REFUSED
    yield "a chunk length that is none", post("Transfer-Encoding: chunked\r\n", "zz\r\nglTF\r\n0\r\n\r\n"), REFUSED
    yield "a chunk extension without end", post("Transfer-Encoding: chunked\r\n", "4;" + "a" * 100_000 + "\r\nglTF\r\n0\r\n\r\n"), REFUSED
    yield "a body that ends early", post("Content-Length: 1000\r\n", "glTF"), REFUSED
    yield "no length at all", post("", "glTF"), REFUSED
    yield "a zero byte in a header", raw(f"GET /healthz HTTP/1.1\r\n{host}X-A: a\0b\r\n\r\n"), REFUSED
    yield "a zero byte in the target", raw(f"GET /healthz\0 HTTP/1.1\r\n{host}\r\n"), REFUSED
    yield "a lone line feed in a header", raw(f"GET /healthz HTTP/1.1\r\n{host}X-A: a\rX-B: b\r\n\r\n"), REFUSED
    yield "a header of 1 MB", raw(f"GET /healthz HTTP/1.1\r\n{host}X-A: {'a' * 1_000_000}\r\n\r\n"), {400, 431, "closed"}
    yield "10,000 headers", raw(f"GET /healthz HTTP/1.1\r\n{host}" + "X-A: a\r\n" * 10_000 + "\r\n"), {400, 431, "closed"}
    yield "a path of 1 MB", raw(f"GET /{'a' * 1_000_000} HTTP/1.1\r\n{host}\r\n"), {400, 414, 431, "closed"}
    yield "a query of 60 KB", service.request("GET", f"/v1/jobs?state={'a' * 60_000}")[0], {400, 414}
    yield "no HTTP", raw(b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(range(200)), finish=True), REFUSED
    yield "HTTP/0.9", raw("GET /healthz\r\n\r\n", finish=True), REFUSED
    yield "HTTP/9.9", raw(f"GET /healthz HTTP/9.9\r\n{host}\r\n"), REFUSED | {505}
    yield "the preface of HTTP/2, and nothing", raw(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + b"\0" * 9, finish=True), REFUSED
    for method in ["TRACE", "CONNECT", "PUT", "PATCH", "PROPFIND", "get", "A" * 5000]:
        path = service.host if method == "CONNECT" else "/v1/jobs"
        yield f"the method {method[:12]}", service.request(method, path)[0], {400, 404, 405, 421, "closed"}
    answer = service.request("GET", "/v1/jobs/none", headers={"X-HTTP-Method-Override": "DELETE", "X-Forwarded-Host": "evil.example"})
    yield "a method in a header", answer[0], {404}
    yield "a strange Host", service.request("GET", "/v1/limits", headers={"Host": "evil.example"})[0], {421}
    yield "an empty Host", service.request("GET", "/v1/limits", headers={"Host": ""})[0], {400, 421}
    yield "two Hosts", raw(f"GET /v1/limits HTTP/1.1\r\n{host}Host: evil.example\r\nConnection: close\r\n\r\n"), {400}
    yield "a strange Host in the target", raw(f"GET http://evil.example/v1/limits HTTP/1.1\r\n{host}Connection: close\r\n\r\n"), {421}
    for origin in ["https://evil.example", "null", f"http://{service.host}.evil.example", f"http://{service.host}@evil.example", "file://"]:
        yield f"the Origin {origin.replace(service.host, 'HOST')}", service.submit(form(), headers={"Origin": origin})[0], {403}


def slow(service):
    """Attacks by taking one's time."""

    def others():
        started = time.monotonic()
        status = service.request("GET", "/healthz")[0]
        return status if time.monotonic() - started < 2 else f"{status} after {time.monotonic() - started:.1f} s"

    head = f"POST /v1/jobs HTTP/1.1\r\nHost: {service.host}\r\nContent-Type: {MULTIPART}\r\nContent-Length: 1000000\r\n"
    heads = [service.connect() for _ in range(200)]
    for peer in heads:
        peer.sendall(head[:50].encode())
    yield "200 heads that do not end: others", others(), {200}
    bodies = [service.connect(5) for _ in range(40)]
    for peer in bodies:
        peer.sendall(f"{head}\r\n--{BOUNDARY}".encode())
    yield "40 bodies that do not end: others", others(), {200}
    started = time.monotonic()
    answers = set()
    for peer in bodies:
        try:
            answers.add(parsed(peer.recv(1 << 16))[0])
        except (TimeoutError, ConnectionError):
            answers.add("closed")
    # Over half of the slots of one client are told to come back, the others that they are too slow.
    yield "40 bodies that do not end", ", ".join(map(str, sorted(answers, key=str))), {"408, 503", "408"}
    yield "how long they were waited for", "in time" if time.monotonic() - started < 8 else "too long", {"in time"}
    waiting = [service.connect() for _ in range(40)]
    for peer in waiting:
        peer.sendall(f"{head}Expect: 100-continue\r\n\r\n".encode())
    yield "40 that wait to be asked for more: others", others(), {200}
    for peer in heads + bodies + waiting:
        peer.close()
    # The slots of those that are gone are free as soon as that is noticed.
    for _ in range(50):
        accepted = service.submit(form(("model", "m.glb", triangle())))[0]
        if accepted != 503:
            break
        time.sleep(0.1)
    yield "a submission after all that", accepted, {202}


def routes(service):
    """Attacks on names, numbers and headers of requests."""
    status, headers, body = service.submit(form(("model", "m.glb", triangle())))
    job = json.loads(body)["id"]
    ended(service, job)
    get = lambda path, headers=None: service.request("GET", path, headers=headers)[0]
    for name in ["..%2F..%2Fqueue.sqlite", "%2e%2e/%2e%2e/queue.sqlite", "..\\..\\queue.sqlite", "%00", "model.glb%00.png", "%ff%fe", "/etc/passwd", "a" * 20_000]:
        yield f"the artifact {name[:30]}", get(f"/v1/jobs/{job}/artifacts/{name}"), {400, 404, 414}
    for name in ["..%2F..%2Fidentity", "%00", "' OR '1'='1", "%27%20OR%201=1--", "%F0%28%8C%28", "0" * 20_000, f"{job}%20", job.upper()]:
        yield f"the job {name[:30]}", get(f"/v1/jobs/{name}"), {400, 404, 414}
    yield "deleting a job by a path", service.request("DELETE", "/v1/jobs/..%2F..")[0], {404}
    for query in ["limit=-1", "limit=99999999999999999999", "limit=NaN", "cursor=%00", "cursor=garbage", f"cursor={'9' * 400}", "state=none", "state=queued&state=failed", "x=1"]:
        yield f"the list with {query[:30]}", get(f"/v1/jobs?{query}"), {200, 400}
    model = f"/v1/jobs/{job}/artifacts/model.glb"
    ranges = ["bytes=18446744073709551615-", "bytes=-99999999999999999999", "bytes=5-2", "bytes=0-99999999999999999999", "bytes=--1", "lines=0-1", "bytes=0-0," * 5000 + "0-0"]
    for given in ranges:
        yield f"the range {given[:30]}", get(model, {"Range": given}), {200, 206, 400, 416, 431}
    whole = len(service.request("GET", model)[2])
    many = service.request("GET", model, headers={"Range": "bytes=" + ",".join(["0-"] * 1000)})
    yield "1,000 ranges of the whole", "no more than it" if len(many[2]) <= whole + 1000 else f"{len(many[2])} bytes", {"no more than it"}
    for last in ["9" * 400, "-1.-1.-1", "1.2.3.4", "../../etc", "\x7f\xff", "4294967296.0.0"]:
        status, headers, body = service.request("GET", f"/v1/jobs/{job}/events", headers={"Last-Event-ID": last})
        yield f"the last event {last[:20]!r}", status, {200, 400}
    for key in ["k" * 10_000, "\xff\xfe", " ", "'; DROP TABLE jobs; --"]:
        yield f"the idempotency key {key[:24]!r}", service.submit(form(("model", "m.glb", triangle())), headers={"Idempotency-Key": key})[0], {202, 400}
    yield "waiting for ever", get(f"/v1/jobs/{job}", {"Prefer": "wait=99999999999999999999"}), {200}
    yield "a million tags", get(model, {"If-None-Match": ",".join(['"a"'] * 10_000)}), {200, 400}
    yield "a strange Accept-Encoding", get("/v1/recipes", {"Accept-Encoding": "gzip;q=9e999, *;q=-1, \xff"}), {200, 400}


def forms(service):
    """Attacks on the form of a submission."""
    model = ("model", "m.glb", triangle())
    submit = lambda body, media_type=MULTIPART, headers=None: service.submit(body, media_type, headers=headers)[0]
    yield "a form that breaks off", submit(form(model)[:-200]), {400}
    yield "a form without its end", submit(form(model)[: -len(BOUNDARY) - 6]), {400}
    yield "no boundary", submit(form(model), "multipart/form-data"), {400}
    yield "a boundary of 60 KB", submit(form(model), f"multipart/form-data; boundary={'b' * 60_000}"), {400, 431, "closed"}
    yield "another boundary", submit(form(model), "multipart/form-data; boundary=other"), {400}
    yield "a part whose head is 1 MB", submit(f"--{BOUNDARY}\r\nX: {'a' * 1_000_000}\r\n\r\n".encode() + form(model)), {400}
    yield "5,000 parts", submit(form(model, *[("files", f"{n}.png", b"") for n in range(5000)])), {400, 413}
    yield "options in 5,000 parts", submit(form(model, *[("options", None, "{}")] * 5000)), {400}
    yield "options of 5 MB", submit(form(model, ("options", None, json.dumps({"a": "b" * 5_000_000})))), {400, 413, 422}
    for name in ["../../etc/passwd", "/etc/passwd", "..\\..\\boot.ini", "C:\\boot.ini", "a/../../b", "\0", "a\0.png", "con:", "a" * 5000, "%2e%2e/a", ".", ""]:
        yield f"a file called {name[:24]!r}", submit(form(model, ("files", name, b"x"))), {202, 400}
    yield "a file twice", submit(form(model, ("files", "a.png", b"x"), ("files", "A.png", b"y"), ("files", "a.png", b"z"))), {400}
    yield "an unknown field", submit(form(model, ("constructor", None, "x"))), {400}
    yield "a model in no form", submit(b"\0" * 1000, "application/x-www-form-urlencoded"), {415}
    yield "a packed body", submit(zlib.compress(form(model)), headers={"Content-Encoding": "deflate"}), {400, 415}
    yield "a body beyond the limit", submit(form(("model", "m.glb", b"\0" * (MAX_UPLOAD + (1 << 20))))), {413}
    yield "an encoded media type", submit(triangle(), "model/gltf-binary; charset=\xff"), {202, 400, 415}


def options(service):
    """Attacks on the options."""
    model = ("model", "m.glb", triangle())
    for name, text in [
        ("nested 100,000 deep", "[" * 100_000 + "]" * 100_000),
        ("objects nested 100,000 deep", '{"a":' * 100_000 + "1" + "}" * 100_000),
        ("a key twice", '{"seed": 1, "seed": 2}'),
        ("a key twice within", '{"pack": {"grid": 4, "gr\\u0069d": 5}}'),
        ("NaN", '{"pack": {"gutter": NaN}}'),
        ("Infinity", '{"time_limit_s": Infinity}'),
        ("1e999", '{"time_limit_s": 1e999}'),
        ("a negative time", '{"time_limit_s": -1}'),
        ("a number of 100,000 digits", '{"seed": ' + "9" * 100_000 + "}"),
        ("a negative seed", '{"seed": -1}'),
        ("a huge size", '{"texture": {"max_size": 1e300}}'),
        ("a list of a million", '{"recipe": [' + "1," * 1_000_000 + "1]}"),
        ("a recipe of 10,000 stages", json.dumps({"recipe": ["pack"] * 10_000})),
        ("50,000 unknown keys", json.dumps({f"k{n}": n for n in range(50_000)})),
        ("half a surrogate", '{"recipe": "\\ud800"}'),
        ("no UTF-8", b'{"recipe": "\xff\xfe"}'),
        ("a zero byte", '{"recipe": "pack\\u0000"}'),
        ("a comment", '{/* */"seed": 1}'),
        ("two values", "{} {}"),
        ("a prototype", '{"__proto__": {"recipe": "scan"}}'),
        ("a path as a model", '{"model": "../../etc/passwd"}'),
        ("a path as importance", '{"importance": {"texture": "/etc/passwd"}}'),
        ("a requirement of no number", '{"require": {"atlas.charts": {"max": "1"}}}'),
        ("an unknown requirement", '{"require": {"../../": {"max": 1}}}'),
    ]:
        yield name, service.submit(form(model, ("options", None, text))), {400, 413, 422, "missing_file", "invalid_options", "requirement_not_met"}


def archives(service):
    """Attacks by archives."""
    model = triangle()
    submit = lambda contents: service.submit(form(("model", "m.zip", contents)))
    yield "entries above the archive", submit(archive(("../m.glb", model), ("../../etc/cron.d/x", b"x"))), {400, 413, "invalid_model", "missing_file"}
    yield "an entry with an absolute name", submit(archive(("/tmp/intarsia-attack.glb", model))), {202, 400, "succeeded", "invalid_model"}
    yield "an entry with backslashes", submit(archive(("..\\..\\m.glb", model))), {400, "succeeded", "invalid_model"}
    link = zipfile.ZipInfo("m.glb")
    link.external_attr = 0o120777 << 16
    yield "a link to /etc/passwd", submit(archive((link, b"/etc/passwd"))), {400, "invalid_model"}
    yield "an entry twice", submit(archive(("m.glb", model), ("m.glb", b"other"))), {400, "succeeded", "invalid_model", "invalid_request"}
    yield "40 MB of zeros in 40 KB", submit(archive(("m.glb", model), ("zeros", bytes(40 << 20)))), {413}
    yield "an archive in an archive", submit(archive(("m.zip", archive(("m.glb", model))))), {400}
    yield "12,000 entries", submit(archive(("m.glb", model), *[(str(n), b"") for n in range(12_000)])), {413}
    good = archive(("m.glb", model), ("a.txt", b"a" * 1000))
    yield "without its directory", submit(good[:-60]), {400}
    # An end that declares a directory of 65,535 entries at the end of the world.
    end = good.rindex(b"PK\5\6")
    lying = good[:end] + struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 65535, 65535, 0xFFFFFFF0, 0xFFFFFFF0, 0)
    yield "a directory that lies", submit(lying), {400}
    sized = good.replace(struct.pack("<I", 1000), struct.pack("<I", 0x7FFFFFFF))
    yield "an entry that lies about its size", submit(sized), {400, 413, "succeeded", "invalid_model", "too_large"}
    # Entries that share their bytes, as in the bombs that a directory alone makes.
    one = archive(("m.glb", model), ("z", bytes(4 << 20)))
    at, end = one.index(b"PK\1\2", one.index(b"PK\1\2") + 4), one.rindex(b"PK\5\6")
    entry = one[at:end]
    names = [entry[:46] + bytes([97 + n % 26]) + entry[47:] for n in range(26)]
    head = one[:at] + b"".join(names)
    start = one.index(b"PK\1\2")
    shared = head + struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 27, 27, len(head) - start, start, 0)
    yield "entries that share their bytes", submit(shared), {400, 413}
    coded = bytearray(good)
    for mark, flag in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
        place = coded.index(mark)
        coded[place + flag] |= 1
    yield "an encrypted entry", submit(bytes(coded)), {400, "invalid_model"}
    yield "a method of the future", submit(good.replace(b"PK\3\4\x14\0\0\0\x08\0", b"PK\3\4\x14\0\0\0\x63\0").replace(b"\x14\0\0\0\x08\0", b"\x14\0\0\0\x63\0")), {400, "invalid_model"}
    chance = random.Random(7)
    for n in range(5):
        broken = bytearray(good)
        for _ in range(20):
            broken[chance.randrange(len(broken))] = chance.randrange(256)
        yield f"20 bytes changed, {n}", submit(bytes(broken)), {400, 413, 415, "succeeded", "invalid_model", "invalid_image", "missing_file", "unsupported_extension"}


def images(service):
    """Attacks by images."""
    submit = lambda image: service.submit(form(("model", "m.glb", triangle(image))))
    whole = png(64, 64)
    yield "a PNG of 65,535 x 65,535 texels", submit(png(65535, 65535, b"x")), {413}
    yield "a PNG of 2^31 x 2^31 texels", submit(png(0x7FFFFFFF, 0x7FFFFFFF, b"x")), BAD_IMAGE
    yield "a PNG without texels", submit(png(0, 0)), BAD_IMAGE
    yield "a PNG of 8,000 x 8,000 texels without data", submit(png(8000, 8000, zlib.compress(b""))), BAD_IMAGE
    yield "a PNG that breaks off", submit(whole[:100]), BAD_IMAGE
    yield "a PNG whose chunk lies", submit(whole[:33] + struct.pack(">I", 0x7FFFFFF0) + whole[37:]), BAD_IMAGE
    yield "a PNG of zeros without end", submit(png(16, 16, zlib.compress(bytes(20 << 20)))), BAD_IMAGE | {"succeeded"}
    yield "a JPEG of 65,535 x 65,535 texels", submit(jpeg(65535, 65535)), {413}
    yield "a JPEG that breaks off", submit(jpeg(64, 64)[:40]), BAD_IMAGE
    yield "a JPEG of garbage", submit(jpeg(64, 64)), BAD_IMAGE | {"succeeded"}
    yield "a JPEG of 600 scans", submit(jpeg(64, 64)[:-2] + jpeg(64, 64)[21:-2] * 600 + b"\xff\xd9"), BAD_IMAGE
    yield "a KTX2 of 65,535 x 65,535 texels", submit(ktx2(65535, 65535)), {413}
    yield "a KTX2 of garbage", submit(ktx2(64, 64)), BAD_IMAGE
    yield "a KTX2 whose level lies", submit(ktx2(64, 64, bytes=2**63, whole=2**64 - 1)), BAD_IMAGE
    yield "a KTX2 of a billion levels", submit(ktx2(64, 64, levels=10**9)), BAD_IMAGE
    yield "a WebP of 16,384 x 2,000 texels of garbage", submit(webp(16384, 2000)), BAD_IMAGE
    yield "a WebP that breaks off", submit(webp(64, 64)[:22]), BAD_IMAGE
    yield "an SVG", submit(b'<svg xmlns="http://www.w3.org/2000/svg"/>'), BAD_IMAGE
    yield "no image", submit(b""), BAD_IMAGE | {"missing_file"}


def models(service):
    """Attacks by models."""
    submit = lambda contents, name="m.glb", *files: service.submit(form(("model", name, contents), *files))
    garbage = random.Random(3).randbytes(400)
    yield "a GLB longer than it is", submit(glb({"asset": {"version": "2.0"}}, length=1 << 31)), {400}
    yield "a GLB shorter than its JSON", submit(glb({"asset": {"version": "2.0"}}, length=21)), BROKEN
    yield "a GLB whose JSON lies", submit(glb({"asset": {"version": "2.0"}}, json_length=0xFFFFFFF0)), {400}
    yield "a GLB without JSON", submit(struct.pack("<4sII", b"glTF", 2, 12)), {400}
    yield "JSON nested 100,000 deep", submit(glb(b'{"asset":' + b"[" * 100_000 + b"]" * 100_000 + b"}")), {400}
    yield "100,000 nodes", submit(glb({"asset": {"version": "2.0"}, "nodes": [{}] * 100_000})), {400, 413, "warned"}
    for name, changes in [
        ("a negative count", {"accessors__0__count": -3}),
        ("a count of 2^64", {"accessors__0__count": 2**64}),
        ("a count of 4 billion", {"accessors__0__count": 2**32 - 1}),
        ("a count that is no whole number", {"accessors__0__count": 2.5}),
        ("a count of texts", {"accessors__0__count": "3"}),
        ("a count without a view", {"accessors__0__bufferView": None, "accessors__0__count": 10**9}),
        ("a negative offset", {"accessors__0__byteOffset": -12}),
        ("an offset near 2^64", {"accessors__0__byteOffset": 2**64 - 8}),
        ("a view beyond its buffer", {"bufferViews__0__byteLength": 2**40}),
        ("a view near 2^64", {"bufferViews__0__byteOffset": 2**64 - 1}),
        ("a stride of nothing", {"bufferViews__0__byteStride": 0}),
        ("a stride of 2^40", {"bufferViews__0__byteStride": 2**40}),
        ("a buffer of a terabyte", {"buffers__0__byteLength": 2**40}),
        ("a buffer of a file", {"buffers__0__uri": "file:///etc/passwd"}),
        ("a buffer of the web", {"buffers__0__uri": "http://127.0.0.1:1/x.bin"}),
        ("a buffer above", {"buffers__0__uri": "../../../../etc/passwd"}),
        ("a buffer of broken base64", {"buffers__0__uri": "data:application/octet-stream;base64,%%%"}),
        ("an index beyond the vertices", {"accessors__2__bufferView": 3}),
        ("a type of the future", {"accessors__0__type": "MAT99"}),
        ("a component of the future", {"accessors__0__componentType": 99}),
        ("a mode of the future", {"meshes__0__primitives__0__mode": 99}),
        ("an attribute that is not there", {"meshes__0__primitives__0__attributes": {"POSITION": 99, "TEXCOORD_0": 1}}),
        ("a material that is not there", {"meshes__0__primitives__0__material": 2**40}),
        ("a node that is its own child", {"nodes__0__children": [0]}),
        ("nodes in a ring", {"nodes": [{"mesh": 0, "children": [1]}, {"children": [2]}, {"children": [0]}]}),
        ("a chain of 20,000 nodes", {"nodes": [{"mesh": 0}] + [{"children": [n]} for n in range(20_000)], "scenes__0__nodes": [20_000]}),
        ("a node with two parents", {"nodes": [{"mesh": 0}, {"children": [0]}, {"children": [0, 1]}]}),
        ("a child that is not there", {"nodes__0__children": [7, -1]}),
        ("a matrix of no numbers", {"nodes__0__matrix": ["NaN"] * 16}),
        ("a scale of 1e308", {"nodes__0__scale": [1e308, 1e308, 1e308]}),
        ("a sparse accessor that lies", {"accessors__0__sparse": {"count": 2**31, "indices": {"bufferView": 0, "componentType": 5125}, "values": {"bufferView": 0}}}),
        ("an image that is not there", {"images__0__bufferView": 99}),
        ("an image of a file", {"images": [{"uri": "file:///etc/passwd"}]}),
        ("an image above", {"images": [{"uri": "../../../etc/passwd"}]}),
        ("a texture of itself", {"textures__0__source": -1}),
        ("a TEXCOORD of 2^31", {"materials__0__pbrMetallicRoughness__baseColorTexture__texCoord": 2**31}),
        ("an extension that must be known", {"extensionsRequired": ["EVIL_code"], "extensionsUsed": ["EVIL_code"]}),
        ("an extension of no shape", {"extensions": [[[]]]}),
        ("a transform of 1e308", {"materials__0__pbrMetallicRoughness__baseColorTexture__extensions": {"KHR_texture_transform": {"scale": [1e308, -1e308], "rotation": 1e308}}}),
        ("meshes that are no list", {"meshes": {"0": {}}}),
        ("200 copies of a primitive", {"meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}] * 200}]}),
        ("Draco of garbage", {"extensionsUsed": ["KHR_draco_mesh_compression"], "extensionsRequired": ["KHR_draco_mesh_compression"], "meshes__0__primitives__0__extensions": {"KHR_draco_mesh_compression": {"bufferView": 3, "attributes": {"POSITION": 0, "TEXCOORD_0": 1}}}}),
        ("meshopt of garbage", {"extensionsUsed": ["EXT_meshopt_compression"], "extensionsRequired": ["EXT_meshopt_compression"], "bufferViews__0__extensions": {"EXT_meshopt_compression": {"buffer": 0, "byteOffset": 68, "byteLength": 40, "byteStride": 12, "count": 3, "mode": "ATTRIBUTES"}}}),
        ("meshopt of a billion vertices", {"extensionsUsed": ["EXT_meshopt_compression"], "extensionsRequired": ["EXT_meshopt_compression"], "bufferViews__0__byteLength": 12 * 10**9, "bufferViews__0__extensions": {"EXT_meshopt_compression": {"buffer": 0, "byteLength": 36, "byteStride": 12, "count": 10**9, "mode": "ATTRIBUTES"}}}),
    ]:
        outcomes = BAD_IMAGE | {"succeeded", "missing_file", "unsupported_extension"}
        yield name, submit(triangle(**changes)), outcomes
    draco = b"DRACO\x02\x02\x01\x01\x00\x00" + b"\xff" * 300
    changes = {"meshes__0__primitives__0__extensions": {"KHR_draco_mesh_compression": {"bufferView": 3, "attributes": {"POSITION": 0}}}}
    yield "Draco that declares what is not there", submit(triangle(draco, **changes)), BAD_IMAGE
    numbers = struct.pack("<9f", *[float("nan"), float("inf"), -float("inf")] * 3)
    whole = triangle()
    place = whole.index(struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0))
    yield "positions that are no numbers", submit(whole[:place] + numbers + whole[place + 36 :]), {"warned"}
    yield "UVs that are no numbers", submit(whole[: place + 36] + numbers[:24] + whole[place + 60 :]), {"warned"}
    yield "UVs of 1e38", submit(whole[: place + 36] + struct.pack("<6f", *[1e38, -1e38] * 3) + whole[place + 60 :]), BAD_IMAGE | {"succeeded"}
    for name, text in [
        ("an OBJ of an index beyond all", "v 0 0 0\nf 99999999999999999999 1 1\n"),
        ("an OBJ of a negative index", "v 0 0 0\nf -9 -1 -1\n"),
        ("an OBJ of no numbers", "v NaN inf 1e999\nv 1 0 0\nv 0 1 0\nvt nan nan\nf 1/1 2/1 3/1\n"),
        ("an OBJ of one line", "f" + " 1" * 1_000_000),
        ("an OBJ whose line does not end", "v 0 0 0\n" + "\\\n" * 500_000),
        ("an OBJ that names files", "mtllib ../../../etc/passwd\nmtllib /etc/passwd\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 1/1 1/1\n"),
        ("an OBJ of zeros", "\0" * 100_000),
        ("an OBJ of garbage", garbage),
    ]:
        yield name, submit(text if isinstance(text, bytes) else text.encode(), "m.obj"), BAD_IMAGE | {"succeeded", "missing_file"}
    secret = "mtllib m.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    yield "an MTL that names files", submit(secret.encode(), "m.obj", ("files", "m.mtl", "newmtl a\nmap_Kd ../../../etc/passwd\n")), BAD_IMAGE | {"missing_file", "succeeded"}
    for uri in ["data:image/png;base64," + base64.b64encode(png(65535, 65535, b"x")).decode(), "data:,", "data:image/png;base64,AAAA"]:
        yield f"an image {uri[:24]}", submit(triangle(images=[{"uri": uri}])), BAD_IMAGE
    chance = random.Random(5)
    for n in range(12):
        broken = bytearray(whole)
        for _ in range(6):
            broken[chance.randrange(20, len(broken))] = chance.randrange(256)
        yield f"6 bytes changed, {n}", submit(bytes(broken)), BAD_IMAGE | {"succeeded", "missing_file", "unsupported_extension"}


def ended(service, job):
    """How a job ends: its state, the code of its failure, or `warned`."""
    limit = time.monotonic() + 30
    while time.monotonic() < limit:
        status, _, body = service.request("GET", f"/v1/jobs/{job}")
        found = json.loads(body) if status == 200 else {"state": status}
        if found["state"] in FINAL or status != 200:
            # What is passed over is told.
            done = "warned" if found["state"] == "succeeded" and found["warnings"] else found["state"]
            return found["error"]["code"] if found["state"] == "failed" else done
        time.sleep(0.02)
    return "does not end"


def outcome(service, answer):
    """What is answered: a word, a status, or how the job ends that was accepted."""
    if not isinstance(answer, tuple):
        return answer, ""
    status, _, body = answer
    try:
        told = json.loads(body)
    except ValueError:
        told = {}
    if status != 202:
        return status, told.get("detail", "")
    service.accepted.append(told["id"])
    return ended(service, told["id"]), "as a job"


def printable(text):
    return "".join(c if c.isprintable() else "?" for c in text[:70])


def main():
    program = sys.argv[1] if len(sys.argv) > 1 else "target/debug/intarsia"
    wrong, tried = [], 0
    with tempfile.TemporaryDirectory(prefix="intarsia-attacks-") as root:
        log = open(Path(root) / "log", "w+")
        data = Path(root) / "data"
        service = Service(program, data, log)
        service.accepted = []
        for group in [http, slow, routes, forms, options, archives, images, models]:
            print(f"\n{group.__doc__.strip()}")
            started = time.monotonic()
            before = started
            for name, answer, expected in group(service):
                tried += 1
                got, detail = outcome(service, answer)
                before, took = time.monotonic(), time.monotonic() - before
                is_right = got in expected and got not in {"internal", "does not end"}
                right = "" if is_right else f"   WRONG, expected {', '.join(sorted(map(str, expected)))}"
                print(f"  {printable(name):<48} {str(got):<22} {took:>5.1f} s  {printable(detail)}{right}", flush=True)
                wrong += [] if is_right else [f"{group.__name__}: {name}: {got}"]
                if service.process.poll() is not None:
                    sys.exit(f"the service died of {name!r}")
            most = service.memory()
            print(f"  ({time.monotonic() - started:.1f} s, {most >> 20} MiB at most)")
        for job in {job for job in service.accepted}:
            service.request("DELETE", f"/v1/jobs/{job}")
        if service.request("GET", "/readyz")[0] != 200:
            wrong.append("the service is not ready any more")
        if most > MOST_MEMORY:
            wrong.append(f"the service has held {most >> 20} MiB, and {MOST_MEMORY >> 20} MiB are allowed")
        if Path("/tmp/intarsia-attack.glb").exists():
            wrong.append("an entry of an archive was written outside")
        listed = json.loads(service.request("GET", "/v1/jobs?limit=200")[2])["jobs"]
        known = {job["id"] for job in listed}
        left = [p.name for p in (data / "uploads").iterdir() if p.name not in known]
        if left:
            wrong.append(f"uploads of nobody are left: {left}")
        service.process.terminate()
        if service.process.wait(20) != 0:
            wrong.append("the service does not end cleanly")
        log.seek(0)
        said = log.read()
        if "panicked" in said:
            wrong.append("something panicked")
        if wrong:
            print(said[-5000:], file=sys.stderr)
    print(f"\n{tried} attacks, {len(wrong)} answered wrongly")
    for line in wrong:
        print(f"  {line}")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
