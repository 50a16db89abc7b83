#!/usr/bin/env python3
"""Compares two builds of Intarsia on real models: same bytes, and what the runs cost.

    tests/compare_builds.py record PROGRAM -o FILE [--data DIR] [--recipe NAME]... [--only TEXT]
    tests/compare_builds.py compare FILE FILE
    tests/compare_builds.py pair OLD NEW [--data DIR] [--recipe NAME]... [--only TEXT]

`record` refines every model under DIR (or INTARSIA_DATA) with each recipe and notes the SHA-256 of every file that comes
out, the exit code, user seconds and peak memory; a run that FILE holds already is not repeated. `compare` holds two such files against each other.
`pair` runs both programs in turn, model by model, so that the ratio of their costs holds on a machine whose speed drifts.
Models and pictures must be equal; reports are counted apart, as they may gain fields. Exit code 1 where bytes differ.
"""

import argparse
import hashlib
import json
import math
import os
import shutil
import sys
import tempfile
from pathlib import Path

RECIPES = {
    "pack": ["--recipe", "pack"],
    "box_cutter": ["--recipe", "box_cutter", "--set", "box_cutter.max_boundary_length=1.3"],
    "scan": ["--recipe", "scan"],
    "scan_tight": ["--recipe", "scan_tight"],
}


def models(data, only):
    found = sorted(p for p in data.rglob("*") if p.suffix.lower() in {".glb", ".gltf", ".obj"})
    return [p for p in found if only in str(p)]


def run(program, model, recipe):
    """One refinement: exit code, hashes by file, user seconds, peak kilobytes."""
    folder = Path(tempfile.mkdtemp(prefix="intarsia-compare-"))
    try:
        command = [program, "refine", str(model), "-o", str(folder / "out.glb"), *RECIPES[recipe]]
        command += ["--report", str(folder / "report.json"), "--pictures", str(folder / "pictures")]
        pid = os.fork()
        if pid == 0:
            null = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2):
                os.dup2(null, stream)
            try:
                os.execv(program, command)
            finally:
                os._exit(127)
        _, status, usage = os.wait4(pid, 0)
        files = {
            str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
            for p in sorted(folder.rglob("*"))
            if p.is_file()
        }
        return {
            "exit": os.waitstatus_to_exitcode(status),
            "files": files,
            "user_s": usage.ru_utime,
            "peak_kb": usage.ru_maxrss,
        }
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def keys(arguments):
    data = Path(arguments.data or os.environ.get("INTARSIA_DATA", ""))
    if not str(data) or not data.is_dir():
        sys.exit("no models: name a folder with --data or INTARSIA_DATA")
    for recipe in arguments.recipe or RECIPES:
        for model in models(data, arguments.only):
            yield recipe, model, f"{recipe} {model.relative_to(data)}"


def load(path):
    runs = {}
    if Path(path).exists():
        for line in Path(path).read_text().splitlines():
            one = json.loads(line)
            runs[one.pop("key")] = one
    return runs


def record(arguments):
    done = load(arguments.output)
    with open(arguments.output, "a") as out:
        for recipe, model, key in keys(arguments):
            if key in done:
                continue
            out.write(json.dumps({"key": key, **run(arguments.program, model, recipe)}) + "\n")
            out.flush()
            print(key, flush=True)


class Tally:
    def __init__(self):
        self.same = self.reports = 0
        self.different = []
        self.ratios = []

    def add(self, key, old, new):
        def kept(r):
            return {"exit": r["exit"], **{n: h for n, h in r["files"].items() if n != "report.json"}}

        if kept(old) != kept(new):
            names = sorted(n for n in kept(old).keys() | kept(new).keys() if kept(old).get(n) != kept(new).get(n))
            self.different.append(f"{key}: {', '.join(names)}")
            print("DIFFERENT", self.different[-1], flush=True)
        else:
            self.same += 1
        self.reports += old["files"].get("report.json") != new["files"].get("report.json")
        # Below some hundredths of a second the clock decides.
        if old["user_s"] >= 0.05:
            self.ratios.append((new["user_s"] / old["user_s"], new["peak_kb"] / old["peak_kb"], key))

    def close(self):
        print(f"{self.same} runs with equal models and pictures, {len(self.different)} different, {self.reports} other reports")
        if self.ratios:
            mean = lambda k: math.exp(sum(math.log(r[k]) for r in self.ratios) / len(self.ratios))
            print(f"new / old, geometric mean of {len(self.ratios)} runs: user time {mean(0):.3f}, peak memory {mean(1):.3f}")
            for name, k in (("time", 0), ("memory", 1)):
                worst = sorted(self.ratios, key=lambda r: -r[k])[:5]
                print(f"most {name}:", "; ".join(f"{r[k]:.2f} {r[2]}" for r in worst))
        return 1 if self.different else 0


def compare(arguments):
    old, new = load(arguments.old), load(arguments.new)
    tally = Tally()
    for key in old:
        if key in new:
            tally.add(key, old[key], new[key])
    print(f"{len(old.keys() ^ new.keys())} runs in one of the files only")
    return tally.close()


def pair(arguments):
    tally = Tally()
    for recipe, model, key in keys(arguments):
        tally.add(key, run(arguments.old, model, recipe), run(arguments.new, model, recipe))
    return tally.close()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    for name, what, names in (("record", record, ["program"]), ("compare", compare, ["old", "new"]), ("pair", pair, ["old", "new"])):
        command = commands.add_parser(name)
        command.set_defaults(what=what)
        for n in names:
            command.add_argument(n)
        if what is record:
            command.add_argument("-o", "--output", required=True)
        if what is not compare:
            command.add_argument("--data")
            command.add_argument("--recipe", action="append", choices=RECIPES)
            command.add_argument("--only", default="")
    arguments = parser.parse_args()
    sys.exit(arguments.what(arguments) or 0)


if __name__ == "__main__":
    main()
