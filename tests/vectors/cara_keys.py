#!/usr/bin/env python3
"""Makes a node's key file from a fleet's root and its list of nodes, and reads such a file: written from docs/keys.md,
standard library only.

    cara_keys.py FOLDER FLEET ROLE ID NAME

prints what `cara keys` writes for that node, byte for byte.
"""

import hashlib
import struct
import sys
import zlib
from pathlib import Path
from urllib.parse import quote

ROLES = ["m_unit", "s_unit"]


def lines(path, word):
    """The lines of a file for programs, as word and rest; its checksum and its form are checked."""
    text = path.read_bytes()
    before, _, last = text[:-1].rpartition(b"\n")
    before += b"\n"
    if text[len(before):] != b"sum %08x\n" % zlib.crc32(before):
        sys.exit(f"{path} is damaged")
    kept = [line for line in before.decode().split("\n") if line and not line.startswith("#")]
    if kept[0] != word + " 2":
        sys.exit(f"{path}: `{word} 2` is expected")
    return [tuple(line.split(" ", 1)) for line in kept[1:]]


def identity(text):
    """`ROLE ID NAME` in the order that identities have: ID, name, role."""
    role, number, name = text.split(" ", 2)
    return int(number), name.encode(), ROLES.index(role)


def spelled(node):
    number, name, role = node
    return f"{ROLES[role]} {number} {name.decode()}"


def hashed(node):
    number, name, role = node
    return bytes([role, len(name)]) + name + struct.pack("<I", number)


def key(root, purpose, fleet, generation, *nodes):
    text = purpose + struct.pack("<II", fleet, generation) + b"".join(hashed(node) for node in sorted(nodes))
    return hashlib.blake2s(text, key=root).digest()


def members(path):
    """Generations, and for each node the first generation with keys for it and the m_units that it belongs to."""
    nodes, generations = {}, []
    for word, rest in lines(path, "cara-fleet"):
        if word == "generations":
            generations = [int(number) for number in rest.split(" ")]
        elif word == "node":
            since, rest = rest.split(" ", 1)
            node = identity(rest)
            nodes[node] = (int(since), set())
        elif word == "manager":
            nodes[node][1].add(identity(rest))
    return generations, nodes


def ring(root, fleet, generations, nodes, node):
    since, managers = nodes[node]

    def is_peer(other):
        # An m_unit has a key for itself as well.
        both_manage = node[2] == other[2] == 0
        return both_manage or other in managers or node in nodes[other][1]

    shown = f"{node[1].decode()}/{node[0]}" + ("@m_unit" if node[2] == 0 else "")
    out = [f"# The keys of {shown} in fleet {fleet}. A holder of this file can speak as it."]
    out += ["cara-ring 2", f"fleet {fleet}", f"node {spelled(node)}"]
    for generation in generations:
        out += [f"generation {generation}", f"discovery {key(root, b'disc', fleet, generation).hex()}"]
        for peer in sorted(filter(is_peer, nodes)):
            if max(since, nodes[peer][0]) <= generation:
                pair = key(root, b"pair", fleet, generation, node, peer)
                out.append(f"pair {pair.hex()} {spelled(peer)}")
    text = ("\n".join(out) + "\n").encode()
    return text + b"sum %08x\n" % zlib.crc32(text)


class Ring:
    """A node's keys, from its file, or its file in a folder; the generation in use first."""

    def __init__(self, path, fleet, node):
        path = Path(path)
        if path.is_dir():
            name = quote(node["name"], safe="").replace("~", "%7E")
            name = "%2E" + name[1:] if name.startswith(".") else name
            path /= f"{name}-{node['id']}-{node['role']}-{fleet}.keys"
        if path.stat().st_mode & 0o077:
            sys.exit(f"{path}: others could read or write it; `chmod 600` mends that")
        self.generations, told = [], []
        for word, rest in lines(path, "cara-ring"):
            if word == "discovery":
                self.generations.append((bytes.fromhex(rest), {}))
            elif word == "pair":
                pair, peer = rest.split(" ", 1)
                self.generations[-1][1][identity(peer)] = bytes.fromhex(pair)
            elif word != "generation":
                told.append((word, rest))
        if told != [("fleet", str(fleet)), ("node", spelled(place_of(node)))]:
            sys.exit(f"{path} is the file of another node or fleet: {told}")

    def discovery_keys(self):
        return [discovery for discovery, _ in self.generations]

    def pair_keys(self, peer):
        return [pairs[place_of(peer)] for _, pairs in self.generations if place_of(peer) in pairs]


def place_of(node):
    """The identity of a unit, as these files have it."""
    return node["id"], node["name"].encode(), ROLES.index(node["role"])


def main(folder, fleet, role, number, name):
    path = Path(folder) / f"fleet-{fleet}"
    root = dict(lines(path.with_suffix(".root"), "cara-root"))["root"]
    generations, nodes = members(path.with_suffix(".nodes"))
    node = identity(f"{role} {number} {name}")
    sys.stdout.buffer.write(ring(bytes.fromhex(root), int(fleet), generations, nodes, node))


if __name__ == "__main__":
    main(*sys.argv[1:])
