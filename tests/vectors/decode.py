#!/usr/bin/env python3
"""Reads the golden vectors with a decoder that was written from docs/wire.md, in a language that shares no code with the
core.

For each vector: its bytes decode to its value, the value encodes to its bytes, and every change of a single byte is
accepted or refused, and read, exactly as the core does it. The examples in docs/wire.md must be vectors. Of the secured
conversation each message of the handshakes is made again, and everything sealed is opened; codes of discovery are made and
checked. Exits with 1 and a line for each difference.
"""

import json
import re
import struct
import sys
import time
import zlib
from pathlib import Path

sys.dont_write_bytecode = True

import cara_secure as secure  # noqa: E402
import cara_wire as wire  # noqa: E402

HERE = Path(__file__).resolve().parent
PAYLOADS = {"hello": "hello", "session": "session_body"}
DOCUMENT = HERE.parent.parent / "docs" / "wire.md"


def decode(kind, context, data):
    """The value of bytes, None where they are refused. Any other exception is a defect of the decoder."""
    try:
        if kind == "stream":
            return stream(context, data)
        if kind == "datagram":
            return wire.decode_datagram(data, context["fleet"])
        if kind == "block":
            return wire.decode_block(data, variables(context))
        return getattr(wire, "decode_" + kind)(data)
    except wire.Malformed:
        return None


def encode(kind, context, value):
    if kind == "datagram":
        return wire.encode_datagram(value, context["fleet"])
    if kind == "block":
        return wire.encode_block(value, variables(context))
    return getattr(wire, "encode_" + kind)(value)


def variables(context):
    if "variables" not in context:
        context["variables"] = wire.decode_signature(bytes.fromhex(context["signature"]))[context["part"]]
    return context["variables"]


def stream(context, data):
    link = wire.Link(context["chunk_limit"], context["message_limit"])
    seen = []
    try:
        for incoming in link.receive(data):
            seen.append(incoming)
        if link.buffer:
            seen.append({"incomplete": len(link.buffer)})
    except wire.Oversize:
        seen.append({"violation": "oversize"})
    except wire.Malformed:
        seen.append({"violation": "protocol"})
    return seen


def frames_of(data):
    """The frames of a stream, each with its length in front."""
    frames = []
    while data:
        end = 2 + struct.unpack_from("<H", data)[0]
        frames.append(data[:end])
        data = data[end:]
    return frames


def frames_again(context, seen):
    """The frames that carry what was seen; emergencies may have stood between the chunks of others."""
    frames = []
    for incoming in seen:
        if isinstance(incoming, str):
            frames.append(wire.encode_frame(incoming))
        elif "message" in incoming:
            message = wire.encode_message(incoming["message"])
            frames += wire.encode_chunks(incoming["priority"], message, context["chunk_limit"])
        else:
            (name, value), = incoming.items()
            payload = bytes([value]) if isinstance(value, int) else getattr(wire, "encode_" + PAYLOADS[name])(value)
            frames.append(wire.encode_frame(name, payload))
    return frames


CANONICAL = json.JSONEncoder(sort_keys=True, separators=(",", ":"), ensure_ascii=False)


def canonical(value):
    return CANONICAL.encode(value).encode()


def mutations(kind, context, data, bits_only):
    """(runs of how many values each byte may take, checksum of the values that all of them lead to)."""
    runs, checksum, count = [], 0, 0
    mutated = bytearray(data)
    for place, original in enumerate(data):
        accepted = 0
        values = [original ^ 1 << bit for bit in range(8)] if bits_only else range(256)
        for byte in values:
            mutated[place] = byte
            value = decode(kind, context, bytes(mutated))
            count += 1
            if value is not None:
                accepted += 1
                checksum = zlib.crc32(canonical(value), checksum)
        mutated[place] = original
        if runs and runs[-1][0] == accepted:
            runs[-1][1] += 1
        else:
            runs.append([accepted, 1])
    return " ".join("%dx%d" % (accepted, length) for accepted, length in runs), checksum, count


def differences_again(kind, context, value, data):
    """What differs when a value is encoded again."""
    if kind == "stream":
        same = sorted(frames_again(context, value)) == sorted(frames_of(data))
        return [] if same else ["is encoded as other frames"]
    encoded = encode(kind, context, value)
    return [] if encoded == data else ["is encoded as %s" % encoded.hex()]


def check(vector):
    """The differences of one vector, and how many mutations it had."""
    kind, context, data = vector["kind"], dict(vector.get("context", {})), bytes.fromhex(vector["hex"])
    value = decode(kind, context, data)
    if canonical(value) != canonical(vector["value"]):
        return ["decodes to %s instead of %s" % (value, vector["value"])], 0
    wrong = []
    if value is not None and not vector.get("lossy"):
        wrong += differences_again(kind, context, value, data)
    expected = vector["mutations"]
    accepted, checksum, count = mutations(kind, context, data, expected["bits_only"])
    if accepted != expected["accepted"]:
        wrong.append("mutated: accepts %s instead of %s" % (accepted, expected["accepted"]))
    elif checksum != expected["crc32"]:
        wrong.append("mutated: some accepted bytes have other values")
    return wrong, count


def check_answer(answer):
    """The differences of what a unit answers: it is read, and encoded again, like a stream."""
    wide = {"chunk_limit": 4096, "message_limit": 32800}
    data = bytes.fromhex(answer["answer"])
    value = decode("stream", wide, data)
    if canonical(value) != canonical(answer["value"]):
        return ["is answered with %s instead of %s" % (value, answer["value"])]
    for given in answer["given"]:
        decode("stream", wide, bytes.fromhex(given))
    return differences_again("stream", wide, value, data)


def check_document(vectors):
    """Every example of the document is a vector."""
    wrong = []
    blocks = re.findall(r"^```hex (\w+)\n(.*?)^```", DOCUMENT.read_text(encoding="utf-8"), re.M | re.S)
    for name, text in blocks:
        shown = "".join(text.split())
        if shown != vectors.get(name, {}).get("hex"):
            wrong.append("docs/wire.md: the example %s is not the vector" % name)
    if not blocks:
        wrong.append("docs/wire.md has no examples")
    return wrong, len(blocks)


# What the ends drew for the first handshake and for the second one: 32 times the same byte.
DRAWN = {"vehicle": (0x81, 0xC1), "manager": (0x01, 0x41)}
HANDSHAKE = ["proof 1", "proof 2", "turn", "turn", "acknowledgement"]


def conversation():
    """(the pair's key, [(who, how, bytes)]) of secured.txt."""
    lines = (HERE / "secured.txt").read_text(encoding="utf-8").splitlines()
    words = [line.split() for line in lines if not line.startswith("#")]
    (_, key), carried = words[0], words[1:]
    return bytes.fromhex(key), [(end, how, bytes.fromhex(data)) for end, how, data in carried]


def opened(key, carried):
    """What was said, and the link behind it."""
    link = secure.Conversation(key, {end: [bytes([byte]) * 32 for byte in bytes_] for end, bytes_ in DRAWN.items()})
    return [getattr(link, how)(end, data) for end, how, data in carried], link


def check_secured():
    """The differences of the secured conversation, and how many frames and datagrams it has."""
    key, carried = conversation()
    try:
        said, link = opened(key, carried)
    except (secure.Refused, wire.Malformed) as error:
        return ["secured.txt: %s" % (error or "it cannot be read")], len(carried)
    wrong = [] if link.renewals == 1 else ["secured.txt: the keys are made anew %d times" % link.renewals]
    if [what for what in said if what in HANDSHAKE] != HANDSHAKE[:2] + HANDSHAKE:
        wrong.append("secured.txt: the keys are made anew in another order")
    for end, how, data in carried:
        if how == "datagram":
            try:
                link.datagram(end, data)
                wrong.append("secured.txt: a datagram is opened twice")
            except secure.Refused:
                pass
    for at in range(2, len(carried)):
        end, how, data = carried[at]
        changed = data[:-1] + bytes([data[-1] ^ 1])
        try:
            opened(key, carried[:at] + [(end, how, changed)])
            wrong.append("secured.txt: number %d opens although it was changed" % at)
        except secure.Refused:
            pass
    return wrong, len(carried)


class Ring:
    """Keys for discovery: those in use, and those beside."""

    @staticmethod
    def discovery_keys():
        return [bytes([1]) * 32, bytes([2]) * 32]

    @staticmethod
    def pair_keys(_):
        return [bytes([3]) * 32, bytes([4]) * 32]


class Beside(Ring):
    """A unit that goes over to the other keys."""

    @staticmethod
    def discovery_keys():
        return Ring.discovery_keys()[::-1]

    @staticmethod
    def pair_keys(_):
        return Ring.pair_keys(_)[::-1]


def check_discovery(vectors):
    """With the codes of secured mode who-has and announce are read, made with either keys, and no byte of them can be changed."""
    who_has, answer = vectors["who_has_s_unit"]["value"], vectors["announce"]["value"]
    broadcast = {"announce": {**answer["announce"], "nonce": 0}}
    wrong = []
    for datagram, to, codes in ((who_has, None, 1), (broadcast, None, 1), (answer, "the asking one", 2)):
        for ring in (Ring, Beside):
            data = secure.encode_discovery(datagram, 7, ring, to)
            if data[7] != codes or secure.decode_discovery(data, 7, Ring) != datagram:
                wrong.append("secured discovery: %s is read otherwise" % datagram)
            if len(data) < 128 and to is None or len(data) > 128 and to is not None:
                wrong.append("secured discovery: %s has %d bytes" % (datagram, len(data)))
        for at, byte in enumerate(data):
            try:
                secure.decode_discovery(data[:at] + bytes([byte ^ 1]) + data[at + 1 :], 7, Ring)
                wrong.append("secured discovery: %s is read although byte %d was changed" % (datagram, at))
            except wire.Malformed:
                pass
    # The fleet's code alone, which every unit of the fleet can make, makes no answer.
    bare = secure.encode_discovery(answer, 7, Ring)
    foreign = secure.encode_discovery(answer, 7, Ring, "the asking one")[:-32] + bytes(16)
    foreign += secure.code(Ring.discovery_keys()[0], b"fmac", foreign)
    for data in (bare, foreign, secure.encode_discovery(broadcast, 7, Ring, "all")):
        try:
            secure.decode_discovery(data, 7, Ring)
            wrong.append("secured discovery: an announce counts with other codes than it must have")
        except wire.Malformed:
            pass
    return wrong


def check_lines():
    """Reads what is on standard input, a vector without a name a line; prints a line for each that the core has read otherwise."""
    count, wrong = 0, 0
    for line in sys.stdin:
        vector = json.loads(line)
        try:
            value = canonical(decode(vector["kind"], vector["context"], bytes.fromhex(vector["hex"]))).decode()
        except Exception as error:  # pylint: disable=broad-except
            value = repr(error)
        count += 1
        if value != canonical(vector["value"]).decode():
            wrong += 1
            print("%s %s: %s instead of %s" % (vector["kind"], vector["hex"], value, canonical(vector["value"]).decode()))
    print("%d read, %d otherwise" % (count, wrong))
    return 1 if wrong or not count else 0


def main():
    begin = time.monotonic()
    document = json.loads((HERE / "vectors.json").read_text(encoding="utf-8"))
    wrong = [] if document["version"] == wire.VERSION else ["vectors.json is of version %d" % document["version"]]
    vectors = {vector["name"]: vector for vector in document["vectors"]}
    total = 0
    for name, vector in vectors.items():
        differences, count = check(vector)
        wrong += ["%s %s" % (name, difference) for difference in differences]
        total += count
    for answer in document["answers"]:
        wrong += ["%s %s" % (answer["name"], difference) for difference in check_answer(answer)]
    differences, examples = check_document(vectors)
    wrong += differences
    differences, secured = check_secured()
    wrong += differences
    wrong += check_discovery(vectors)
    for line in wrong:
        print(line, file=sys.stderr)
    seconds = time.monotonic() - begin
    counts = (len(vectors), total, len(document["answers"]), examples, secured, len(wrong), seconds)
    form = "%d vectors, %d mutations, %d answers, %d examples, %d secured, %d differences, %.1f s"
    print(form % counts)
    return 1 if wrong or 0 in counts[:5] else 0


if __name__ == "__main__":
    sys.exit(check_lines() if sys.argv[1:] == ["--lines"] else main())
