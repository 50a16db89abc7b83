"""Holds the licences and sources of all dependencies to deny.toml, where `cargo deny` is not installed: licences.py."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]


def allowed(expression, known):
    """Whether an SPDX expression holds with the licences of a list; AND binds more tightly than OR, a slash is an OR of older manifests."""
    words = re.findall(r"[()]|[^\s()/]+|/", expression)
    at = 0

    def one():
        nonlocal at
        if words[at] == "(":
            at += 1
            value = either()
            at += 1
            return value
        name = words[at]
        at += 1
        if at < len(words) and words[at] == "WITH":
            name = f"{name} WITH {words[at + 1]}"
            at += 2
        return name in known

    def both():
        nonlocal at
        value = one()
        while at < len(words) and words[at] == "AND":
            at += 1
            value = one() and value
        return value

    def either():
        nonlocal at
        value = both()
        while at < len(words) and words[at] in ("OR", "/"):
            at += 1
            value = both() or value
        return value

    return either()


def main():
    known = set(tomllib.loads((ROOT / "deny.toml").read_text())["licenses"]["allow"])
    assert allowed("MIT OR (GPL-3.0 AND Zlib)", known) and not allowed("GPL-3.0 AND MIT", known) and allowed("MIT/Foo", known)
    told = subprocess.run(["cargo", "metadata", "--locked", "--all-features", "--format-version", "1"], cwd=ROOT, check=True, stdout=subprocess.PIPE)
    packages = json.loads(told.stdout)["packages"]
    wrong = []
    for package in packages:
        name = f"{package['name']} {package['version']}"
        if not package["license"] or not allowed(package["license"], known):
            wrong.append(f"{name}: the licence {package['license']} is not one of deny.toml")
        if package["source"] and not package["source"].startswith("registry+"):
            wrong.append(f"{name}: comes from {package['source']}")
    if wrong:
        sys.exit("\n".join(wrong))
    print(f"{len(packages)} packages: licences and sources as deny.toml wants them")


if __name__ == "__main__":
    main()
