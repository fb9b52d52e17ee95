#!/usr/bin/env python3
"""An s_unit in Python, standard library only, written from docs/wire.md: it finds its manager by broadcast, joins it,
publishes `pos_info` and `go_to`, serves them, and calls `call_mechanic` once the manager has published it. Each thing
that happens is a line on standard output. It ends when the manager does.

It leaves out what an s_unit may leave out: hearing broadcasts of others, priorities among calls, a minimum interval.
"""

import argparse
import secrets
import select
import socket
import sys
import time

sys.dont_write_bytecode = True

import cara_wire as wire  # noqa: E402

KEEP_ALIVE = 1.0
MESSAGE_SIZE = 4096
CHUNK_SIZE = 1024
POS_INFO = {
    "name": "pos_info", "arguments": [],
    "results": [{"name": "position", "type": "int", "size": 2}],
}
GO_TO = {"name": "go_to", "arguments": [{"name": "position", "type": "int", "size": 2}], "results": []}
LEASE_MILLIS = 400
FUNCTIONS = [
    (POS_INFO, {}),
    (GO_TO, {"lease": LEASE_MILLIS}),
]


def say(*words):
    print(*words, flush=True)


def clock():
    """This unit's clock in microseconds."""
    return time.monotonic_ns() // 1000


class SUnit:
    def __init__(self, options):
        self.options = options
        manager, number = options.manager.rsplit("/", 1)
        self.wanted = {"name": manager, "id": int(number)}
        self.identity = {"id": options.id, "name": options.name, "role": "s_unit"}
        self.epoch, self.nonce = secrets.randbits(64), secrets.randbits(64)
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self.udp.bind((options.address, 0))
        self.position = [3, -4]
        self.lease_end = None
        self.leased_call = 0
        self.renewals = 0
        self.theirs, self.not_kept = {}, 0
        self.windows = {priority: (0, set()) for priority in wire.PRIORITIES}
        self.next_id = 1
        self.waiting = {}
        self.datagrams_pass = False

    # --- finding the manager (section 4)

    def find(self):
        """The address at which the manager can be dialled."""
        pause, sequence = 0.25, 0
        while True:
            sequence += 1
            nonce = secrets.randbits(63) + 1
            search = {
                "identity": self.identity, "epoch": self.epoch, "sequence": sequence, "nonce": nonce,
                "wanted": self.wanted, "tcp_port": 0, "expected": 1, "known": [],
            }
            data = wire.encode_datagram({"who_has": search}, self.options.fleet)
            self.udp.sendto(data, (self.options.broadcast, self.options.port))
            found = self.await_announce(nonce, time.monotonic() + pause + secrets.randbelow(1000) / 1000 * pause)
            if found:
                return found
            pause = min(2 * pause, 8)

    def await_announce(self, nonce, until):
        while time.monotonic() < until:
            self.udp.settimeout(max(until - time.monotonic(), 0.001))
            try:
                data, source = self.udp.recvfrom(2048)
                announce = wire.decode_datagram(data, self.options.fleet)["announce"]
            except (socket.timeout, wire.Malformed, KeyError):
                continue
            who = announce["identity"]
            if who == {**self.wanted, "role": "m_unit"} and announce["nonce"] == nonce and announce["tcp_port"]:
                return source[0], announce["tcp_port"]
        return None

    # --- the link (sections 7 and 8)

    def join(self, address):
        self.tcp = socket.create_connection(address, timeout=2)
        self.tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        hello = {
            "fleet": self.options.fleet, "identity": self.identity, "wanted": self.wanted, "epoch": self.epoch,
            "nonce": self.nonce, "versions": wire.VERSIONS, "capabilities": 0, "message_size": MESSAGE_SIZE, "chunk_size": CHUNK_SIZE,
            "calls": 8, "minimum_interval": 0, "link": 0, "udp_port": self.udp.getsockname()[1], "stamp": clock(),
            "keep_alive": int(KEEP_ALIVE * 1000),
        }
        self.write(wire.encode_frame("hello", wire.encode_hello(hello)))
        self.link = wire.Link(CHUNK_SIZE, MESSAGE_SIZE + wire.LONGEST_HEADER)
        self.peer = None
        while self.peer is None:
            for incoming in self.link.receive(self.read()):
                self.first(incoming)
        say("joined", self.peer["identity"]["name"])
        self.publish()

    def first(self, incoming):
        if isinstance(incoming, dict) and "epoch" in incoming.get("hello", {}) and self.peer is None:
            self.peer = incoming["hello"]
            self.hear_stamp(self.peer["stamp"])
        elif self.peer is not None:
            self.dispatch(incoming)
        elif isinstance(incoming, dict) and "other_versions" in incoming.get("hello", {}):
            self.write(wire.encode_frame("refuse", b"\1"))
            sys.exit("not taken: it speaks %s, this unit %s" % (incoming["hello"]["other_versions"], wire.VERSIONS))
        else:
            sys.exit("not taken: %s" % incoming)

    def read(self):
        data = self.tcp.recv(65536)
        if not data:
            sys.exit("the connection was closed without a close frame")
        return data

    def write(self, data):
        self.tcp.sendall(data)

    def send(self, priority, message):
        self.write(b"".join(wire.encode_chunks(priority, wire.encode_message(message), self.peer_chunk())))

    def tell(self, name, value):
        """A control message of one item."""
        self.send("high", {"control": [{name: value}]})

    def peer_chunk(self):
        return self.peer["chunk_size"]

    def publish(self):
        for slot, (signature, attributes) in enumerate(FUNCTIONS):
            self.tell("publish", {
                "slot": slot, "generation": 0, "attributes": wire.encode_attributes(attributes).hex(),
                "signature": wire.encode_signature(signature).hex(),
            })
        self.tell("list_end", {"serial": 1})

    # --- the loop

    def run(self):
        """Serves until the manager closes the link."""
        self.tcp.settimeout(None)
        next_keep_alive = self.heard = time.monotonic()
        pause = self.peer["keep_alive"] / 1000
        next_question, missed = 0, 0
        while True:
            now = time.monotonic()
            if now >= next_keep_alive:
                self.keep_alive()
                next_keep_alive = now + KEEP_ALIVE
            if self.lease_end is not None and clock() >= self.lease_end:
                self.end_lease(expired=True)
            if now - self.heard > 3.5 * pause:
                self.close(3, "silence")
            before, missed = missed, int((now - self.heard) / pause + 0.5) - 1
            if self.datagrams_pass and missed > 0 and now >= next_question:
                self.send_datagram(wire.encode_session_body({"ping": {}}))
                next_question = now + pause / 4
            if self.datagrams_pass and missed > max(before, 0):
                self.write(wire.encode_frame("ping"))
            due = min(next_keep_alive - now, 0.01 if self.lease_end is not None else pause / 4)
            ready, _, _ = select.select([self.tcp, self.udp], [], [], max(due, 0))
            if self.udp in ready:
                self.datagram()
            if self.tcp in ready:
                self.stream()

    def stream(self):
        try:
            for incoming in self.link.receive(self.read()):
                self.dispatch(incoming)
        except wire.Oversize:
            self.close(6, "more than this unit takes")
        except wire.Malformed:
            self.close(5, "the manager broke the protocol")

    def close(self, code, why):
        self.write(wire.encode_frame("close", bytes([code])))
        sys.exit(why)

    def keep_alive(self):
        body = wire.encode_session_body({"keep_alive": {"stamp": clock()}})
        self.send_datagram(body)
        if not self.datagrams_pass:
            self.write(wire.encode_frame("session", body) + wire.encode_frame("ping"))

    def send_datagram(self, body):
        session = {"link": self.peer["link"], "nonce": self.peer["nonce"], "body": wire.decode_session_body(body)}
        data = wire.encode_datagram({"session": session}, self.options.fleet)
        self.udp.sendto(data, (self.tcp.getpeername()[0], self.peer["udp_port"]))

    def datagram(self):
        data, source = self.udp.recvfrom(2048)
        try:
            session = wire.decode_datagram(data, self.options.fleet).get("session")
        except wire.Malformed:
            return
        mine = session and session["link"] == 0 and session["nonce"] == self.nonce
        if mine and source[0] == self.tcp.getpeername()[0]:
            if not self.datagrams_pass:
                say("datagrams pass")
            self.datagrams_pass, self.heard = True, time.monotonic()
            self.session_body(session["body"])

    def dispatch(self, incoming):
        if incoming == "skipped":
            return
        self.heard = time.monotonic()
        if incoming == "ping":
            self.write(wire.encode_frame("pong"))
        elif incoming == "pong":
            pass
        elif "close" in incoming or "refuse" in incoming:
            say("ended", *incoming.popitem())
            sys.exit(0)
        elif "session" in incoming:
            if "unreadable" not in incoming["session"]:
                self.session_body(incoming["session"])
        elif "message" in incoming:
            self.message(incoming["priority"], incoming["message"])
        else:
            self.close(5, "a second hello")

    # --- session bodies and leases (sections 13 and 14)

    def hear_stamp(self, stamp):
        if not hasattr(self, "stamp") or stamp >= self.stamp:
            self.stamp, self.heard_at = stamp, clock()

    def session_body(self, body):
        (kind, value), = body.items()
        if kind == "keep_alive":
            self.hear_stamp(value["stamp"])
        elif kind == "renew":
            self.renew(value)
        elif kind == "release":
            self.note(value["class"], value["call"])
            if self.lease_end is not None and value["call"] == self.leased_call:
                self.released()
        elif kind == "release_all":
            if self.lease_end is not None and value["slot"] == 1 and self.leased_call <= value["call"]:
                self.released()
        elif kind == "message" and "request" in value["message"]:
            self.request(value["priority"], value["message"]["request"])

    def released(self):
        say("released")
        self.lease_end = None

    def renew(self, value):
        if self.lease_end is None or value["call"] != self.leased_call:
            newest, seen = self.windows[value["class"]]
            if value["call"] in seen or value["call"] + 64 <= newest:
                self.tell("lease_ended", {"call": value["call"], "why": "expired"})
        elif value["stamp"] <= clock():
            self.renewals += 1
            made = min(value["stamp"] + value["since"], clock())
            self.lease_end = max(self.lease_end, made + LEASE_MILLIS * 1000)

    def end_lease(self, expired):
        say("stopped after", self.renewals, "renewals")
        self.lease_end = None
        self.tell("lease_ended", {"call": self.leased_call, "why": "expired" if expired else "finished"})

    # --- messages (sections 9, 11 and 12)

    def message(self, priority, message):
        (kind, value), = message.items()
        if kind == "request":
            self.request(priority, value)
        elif kind in ("reply", "failure"):
            self.answered(value)
        else:
            items = [item for each in value for item in each.items()]
            if any(name in wire.LAST_ITEMS for name, _ in items[:-1]):
                self.close(5, "something behind an item that is the last")
            for name, told in items:
                self.control(name, told)

    def control(self, name, told):
        if name in ("publish", "withdraw"):
            self.theirs = {known: what for known, what in self.theirs.items() if what[0] != told["slot"]}
        if name == "publish":
            wire.decode_attributes(bytes.fromhex(told["attributes"]))
            try:
                signature = wire.decode_signature(bytes.fromhex(told["signature"]))
                self.theirs[signature["name"]] = (told["slot"], told["generation"], signature)
            except wire.Malformed:
                self.not_kept += 1
        elif name == "list_end":
            self.tell("list_ack", {"serial": told["serial"], "skipped": self.not_kept})
            self.call_mechanic()
        elif name == "list_ack":
            say("published")
        elif name == "limits":
            self.peer.update(told)

    def call_mechanic(self):
        """Calls the manager's function, once; every argument at its smallest."""
        if "call_mechanic" not in self.theirs or self.next_id > 1:
            return
        slot, generation, signature = self.theirs["call_mechanic"]
        empty = {"int": lambda size: [7] * size, "string": lambda size: "flat tyre"[:size]}
        values = {each["name"]: empty[each["type"]](each["size"]) for each in signature["arguments"]}
        self.waiting[self.next_id] = signature
        self.send("normal", {"request": {
            "id": self.next_id, "slot": slot, "generation": generation, "wants_reply": True, "unknown": 0,
            "remaining": 2_000_000, "stamp": self.stamp, "since": clock() - self.heard_at,
            "block": wire.encode_block(values, signature["arguments"]).hex(),
        }})
        self.next_id += 1

    def answered(self, reply):
        signature = self.waiting.pop(reply["id"], None)
        if signature is None:
            return
        if "error" in reply:
            say("call_mechanic failed", reply["error"])
        else:
            say("call_mechanic", wire.decode_block(bytes.fromhex(reply["block"]), signature["results"]))

    def request(self, priority, request):
        number = request["id"]
        newest, seen = self.windows[priority]
        if number in seen:
            return
        error = "stale" if number + 64 <= newest else self.refusal(request)
        self.note(priority, number)
        if error is None:
            try:
                results = self.serve(request)
                self.answer(priority, request, {"block": results.hex()})
                return
            except wire.Malformed:
                error = "malformed"
        self.answer(priority, request, {"error": error})

    def note(self, priority, number):
        newest, seen = self.windows[priority]
        newest = max(newest, number)
        self.windows[priority] = (newest, {each for each in seen | {number} if each + 64 > newest})

    def refusal(self, request):
        """Why a request is not run, by its header alone."""
        if request["unknown"]:
            return "unsupported"
        if request["stamp"] > clock():
            return "malformed"
        made = min(request["stamp"] + request["since"], clock())
        if made + request["remaining"] <= clock():
            return "expired"
        if request["slot"] >= len(FUNCTIONS):
            return "unknown_function"
        return None if request["generation"] == 0 else "stale_function"

    def serve(self, request):
        signature, _ = FUNCTIONS[request["slot"]]
        arguments = wire.decode_block(bytes.fromhex(request["block"]), signature["arguments"])
        say("run", signature["name"], arguments)
        if signature is GO_TO:
            self.position = arguments["position"]
            if self.lease_end is not None:
                self.tell("lease_ended", {"call": self.leased_call, "why": "replaced"})
            self.leased_call = request["id"]
            self.lease_end = clock() + LEASE_MILLIS * 1000
            return b""
        return wire.encode_block({"position": self.position}, signature["results"])

    def answer(self, priority, request, outcome):
        if request["wants_reply"]:
            self.send(priority, {"reply": {"id": request["id"], **outcome}})
        elif "error" in outcome:
            self.send(priority, {"failure": {"id": request["id"], **outcome}})


def main():
    parser = argparse.ArgumentParser(description="An s_unit that offers pos_info and go_to.")
    parser.add_argument("--name", default="agv_in_python")
    parser.add_argument("--id", type=int, default=77)
    parser.add_argument("--manager", default="AGV_manager/1", help="NAME/ID")
    parser.add_argument("--fleet", type=int, default=0)
    parser.add_argument("--address", default="127.0.0.1", help="own address; loopback unless set")
    parser.add_argument("--broadcast", default="127.255.255.255", help="where who-has is sent")
    parser.add_argument("--port", type=int, default=wire.PORT, help="UDP port of broadcasts")
    unit = SUnit(parser.parse_args())
    unit.join(unit.find())
    unit.run()


if __name__ == "__main__":
    main()
