#!/usr/bin/env python3
"""Holds the memory estimate against what refinements really take.

    tests/memory.py [--program PROGRAM] [--made] [RECIPE=MODEL ...]

Each MODEL (.glb, .gltf, .obj, .zip, or a folder that is searched for them) is refined by RECIPE (`box_cutter` with a boundary of 1.3, `unwrap` fast), with
everything that the service makes of a job, and the peak of the process' resident memory is printed beside the estimate that
`inspect --memory` gives. `--made` adds models with textures of up to 16,000 x 16,000 texels, made here. The exit code is 1 where an estimate is
below the peak, or above one and a half times the peak (and 32 MB, where the peak is below 100 MB).
"""

import argparse
import json
import multiprocessing
import os
import random
import struct
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path

SETTINGS = {
    "box_cutter": ["--set", "box_cutter.max_boundary_length=1.3"],
    "unwrap": ["--set", "optcuts.quality=fast"],
}
MODELS = {".glb", ".gltf", ".obj", ".zip"}


def peak(command):
    """Exit code, and the most resident memory that a process had, in bytes."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    said = process.stderr.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, usage.ru_maxrss * 1024, said.decode(errors="replace")


def png(width, height, channels, depth, rows):
    """A PNG whose rows are what `rows` gives, taken in turn."""
    kind = {1: 0, 2: 4, 3: 2, 4: 6}[channels]

    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    squeeze = zlib.compressobj(1)
    data = b"".join(squeeze.compress(b"\0" + rows[y % len(rows)]) for y in range(height)) + squeeze.flush()
    head = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def grid(charts, side):
    """Positions, UVs and triangles of square charts of `side` x `side` quads that leave room between each other."""
    points, uvs, corners = [], [], []
    for chart in range(charts * charts):
        x, y = chart % charts, chart // charts
        first = len(points)
        for j in range(side + 1):
            for i in range(side + 1):
                points.append((x + 0.8 * i / side, y + 0.8 * j / side, 0.02 * ((i * 7 + j * 3) % 5)))
                uvs.append(((x + 0.1 + 0.7 * i / side) / charts, (y + 0.1 + 0.7 * j / side) / charts))
        for j in range(side):
            for i in range(side):
                a = first + j * (side + 1) + i
                corners += [a, a + 1, a + side + 2, a, a + side + 2, a + side + 1]
    return points, uvs, corners


def model(folder, name, images, charts=8, side=4):
    """A .gltf whose one material reads the images in all its slots."""
    points, uvs, corners = grid(charts, side)
    blob = b"".join(struct.pack("<3f", *p) for p in points)
    starts = [0, len(blob)]
    blob += b"".join(struct.pack("<2f", *p) for p in uvs)
    starts.append(len(blob))
    blob += struct.pack(f"<{len(corners)}I", *corners)
    ends = starts[1:] + [len(blob)]
    low, high = [[f(p[k] for p in points) for k in range(3)] for f in (min, max)]
    slots = ["baseColorTexture", "metallicRoughnessTexture", "normalTexture", "emissiveTexture"]
    material = {"pbrMetallicRoughness": {}}
    for index, slot in enumerate(slots[: len(images)]):
        (material["pbrMetallicRoughness"] if index < 2 else material)[slot] = {"index": index}
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [material],
        "textures": [{"source": i} for i in range(len(images))],
        "images": [{"uri": f"{name}-{i}.png"} for i in range(len(images))],
        "buffers": [{"uri": f"{name}.bin", "byteLength": len(blob)}],
        "bufferViews": [{"buffer": 0, "byteOffset": a, "byteLength": b - a} for a, b in zip(starts, ends)],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(points), "type": "VEC3", "min": low, "max": high},
            {"bufferView": 1, "componentType": 5126, "count": len(points), "type": "VEC2"},
            {"bufferView": 2, "componentType": 5125, "count": len(corners), "type": "SCALAR"},
        ],
    }
    for index, image in enumerate(images):
        (folder / f"{name}-{index}.png").write_bytes(image)
    (folder / f"{name}.bin").write_bytes(blob)
    path = folder / f"{name}.gltf"
    path.write_text(json.dumps(document))
    return path


def made(program, folder):
    """Recipe and model of everything that is made here: samples, and textures of many sizes, plain and of noise."""
    chance = random.Random(1)
    noise = lambda size: [chance.randbytes(size) for _ in range(64)]
    smooth = lambda width, channels: [bytes((x // 8 + y) & 255 for x in range(width) for _ in range(channels)) for y in range(8)]
    found = []
    for name in subprocess.run([program, "sample"], check=True, capture_output=True, text=True).stdout.split():
        path = folder / f"{name}.glb"
        subprocess.run([program, "sample", name, "-o", str(path)], check=True, stderr=subprocess.DEVNULL)
        found += [("pack", path)] + [("scan", path)] * name.startswith("scan")
        found += [("unwrap", path)] * (name in ("bare", "textured"))
    textures = {
        "plain_16000_x4": lambda: [png(16000, 16000, 3, 8, smooth(16000, 3))] * 4,
        "plain_16000_rgba": lambda: [png(16000, 16000, 4, 8, smooth(16000, 4))],
        "plain_8192_x4": lambda: [png(8192, 8192, 3, 8, smooth(8192, 3))] * 4,
        "noise_8192": lambda: [png(8192, 8192, 3, 8, noise(8192 * 3))],
        "noise_4096_x4": lambda: [png(4096, 4096, 3, 8, noise(4096 * 3)) for _ in range(4)],
        "noise_4096_deep": lambda: [png(4096, 4096, 4, 16, noise(4096 * 8))],
        "noise_4096_grey": lambda: [png(4096, 4096, 1, 8, noise(4096))],
        "noise_2048_x4": lambda: [png(2048, 2048, 4, 8, noise(2048 * 4)) for _ in range(4)],
    }
    for name, images in textures.items():
        found.append(("pack", model(folder, name, images())))
    found.append(("pack", model(folder, "many_charts", [png(1024, 1024, 3, 8, noise(3072))], charts=80)))
    found.append(("pack", model(folder, "many_triangles", [png(1024, 1024, 3, 8, noise(3072))], side=80)))
    found.append(("scan", model(folder, "many_triangles_scan", [png(1024, 1024, 3, 8, noise(3072))], side=60)))
    # Few charts, and textures that stay as they are or are drawn anew.
    textured = model(folder, "curved", [png(4096, 4096, 3, 8, smooth(4096, 3))], charts=2, side=50)
    found += [("unwrap", textured), ("polish", textured)]
    return found


def models(path):
    """The models that a path means."""
    if not path.is_dir():
        return [path]
    return sorted(p for p in path.rglob("*") if p.suffix.lower() in MODELS)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", default="target/release/intarsia")
    parser.add_argument("--made", action="store_true")
    parser.add_argument("jobs", nargs="*", metavar="RECIPE=MODEL")
    arguments = parser.parse_args()
    wrong = 0
    print(f"{'recipe':<11} {'model':<44} {'peak MB':>9} {'estimate':>9} {'ratio':>6}", flush=True)
    with tempfile.TemporaryDirectory(prefix="intarsia-memory-") as root:
        jobs = [(recipe, p) for recipe, path in (j.split("=", 1) for j in arguments.jobs) for p in models(Path(path))]
        if arguments.made:
            # In a process of its own: what is started here begins with the memory of this one.
            with multiprocessing.Pool(1) as maker:
                jobs += maker.apply(made, (arguments.program, Path(root)))
        for recipe, path in jobs:
            settings = ["--recipe", recipe, *SETTINGS.get(recipe, [])]
            output = ["-o", f"{root}/out.glb", "--pictures", f"{root}/pictures", "--quiet"]
            code, most, said = peak([arguments.program, "refine", str(path), *settings, *output])
            told = subprocess.run([arguments.program, "inspect", "--memory", str(path), *settings], capture_output=True, text=True)
            estimate = int(told.stdout or 0)
            ratio = estimate / most
            fits = code != 0 or (1 <= ratio and estimate <= 1.5 * most + (32e6 if most < 100e6 else 0))
            wrong += not fits
            name = f"{path.parent.name}/{path.name}"[-44:]
            verdict = said.strip().splitlines()[-1][:80] if code else "" if fits else "does not fit"
            print(f"{recipe:<11} {name:<44} {most / 1e6:>9.1f} {estimate / 1e6:>9.1f} {ratio:>6.2f} {verdict}", flush=True)
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
