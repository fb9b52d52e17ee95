"""What units of both roles share, in Python, standard library only, written from docs/wire.md: one link, in plain or in
secured mode, opened from either end; publishing, requests and leases in both directions; keep-alives; new keys.

It leaves out priorities among calls, a minimum interval, limits of the peer's that its small calls do not reach, access
tables, more than one leased function of its own, and new keys after 2^32 frames. It writes to the stream and waits until that
is taken.
"""

import argparse
import contextlib
import os
import secrets
import select
import socket
import struct
import sys
import time

import cara_keys as keys
import cara_secure as secure
import cara_wire as wire

KEEP_ALIVE = 1.0
MESSAGE_SIZE = 4096
CHUNK_SIZE = 1024
OPENING = 2.0
REPLY_WITHIN = 2.0
WITHOUT_DATAGRAMS = 3.0
PROBE = 4.0
STREAM_DEAD = 8.0
KEYS_LIVE, SHORTEST_HANDSHAKE_LIFE, RENEWAL_WITHIN = 12 * 3600.0, 0.5, 60.0
REFUSED_VERSION, REFUSED_FLEET, REFUSED_MANAGER, REFUSED_DUPLICATE, REFUSED_ROLE = 1, 2, 3, 5, 6
REFUSED_MALFORMED, REFUSED_MODE, REFUSED_SUITE, REFUSED_FENCED = 8, 9, 11, 12


def say(*words):
    print(*words, flush=True)


def clock():
    """This unit's clock in microseconds."""
    return time.monotonic_ns() // 1000


def chance(most):
    """A random part of a time."""
    return secrets.randbelow(1001) / 1000 * most


def options_of(description, name, number):
    """The options that both roles have."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--name", default=name)
    parser.add_argument("--id", type=int, default=number)
    parser.add_argument("--fleet", type=int, default=0)
    parser.add_argument("--term", type=int, default=0, help="of a manager's own claim, or of one that a vehicle says it has obeyed")
    parser.add_argument("--claim", help="that one whole, as TERM:CLAIMANT:TAG")
    parser.add_argument("--address", default="127.0.0.1", help="own address; loopback unless set")
    parser.add_argument("--broadcast", default="127.255.255.255", help="where who-has is sent")
    parser.add_argument("--port", type=int, help="UDP port of broadcasts")
    parser.add_argument("--keys", default=os.environ.get("CARA_KEYS"), help="key file, or its folder; CARA_KEYS unless set")
    parser.add_argument("--insecure", action="store_true", help="plain mode, without keys")
    return parser


class Refused(Exception):
    """A request is not run, with this error."""


class Ended(Exception):
    """The link is over; the words say why."""

    def __init__(self, why, by_peer=False):
        super().__init__(why)
        self.by_peer = by_peer


class Function:
    """A function that this unit offers: what it does takes the arguments' values and returns those of the results."""

    def __init__(self, signature, run, **attributes):
        self.signature, self.run, self.attributes = signature, run, attributes
        self.lease = attributes.get("lease", 0) * 1000


class Unit:
    wanted = None

    def __init__(self, options, role, functions):
        self.options, self.functions = options, functions
        self.identity = {"id": options.id, "name": options.name, "role": role}
        self.epoch, self.sequence = secrets.randbits(64), 0
        if options.insecure:
            self.ring, self.magic, self.suites = None, wire.MAGIC, 0
        else:
            if options.keys is None:
                sys.exit("either --keys or --insecure must be given")
            self.ring = keys.Ring(options.keys, options.fleet, self.identity)
            self.magic, self.suites = secure.MAGIC, secure.SUITES
        self.claim, self.obeyed = self.claims(options)
        self.port = options.port or (wire.PORT if self.ring is None else secure.PORT)
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self.udp.bind((options.address, 0))
        self.next_id = 1

    def claims(self, options):
        """A manager's own claim, and the highest one that a vehicle has obeyed: that one's tag is not genuine unless given."""
        claim = {"term": options.term, "claimant": secrets.randbits(64), "tag": bytes(16).hex(), "since": 2**32 - 1}
        if options.claim:
            term, claimant, tag = options.claim.split(":")
            claim.update(term=int(term), claimant=int(claimant), tag=tag)
        if self.identity["role"] == "s_unit":
            return None, claim if claim["term"] else None
        claim["term"] = claim["term"] or 1
        if self.ring is not None:
            text = b"claim" + struct.pack("<QQ", claim["term"], claim["claimant"])
            claim["tag"] = secure.code(self.ring.pair_keys(self.identity)[0], b"pmac", text).hex()
        return claim, None

    # --- discovery (sections 3 and 17)

    def discovery(self, kind, to=None, **fields):
        """A who-has, or an announce to a unit."""
        self.sequence += 1
        value = {"identity": self.identity, "epoch": self.epoch, "claim": self.claim, "sequence": self.sequence, **fields}
        if self.ring is None:
            return wire.encode_datagram({kind: value}, self.options.fleet)
        return secure.encode_discovery({kind: value}, self.options.fleet, self.ring, to)

    def heard_discovery(self, data, kind):
        """What a datagram of this kind says; None for others."""
        try:
            if self.ring is None:
                return wire.decode_datagram(data, self.options.fleet).get(kind)
            return secure.decode_discovery(data, self.options.fleet, self.ring).get(kind)
        except wire.Malformed:
            return None

    # --- opening a link (sections 7, 8 and 17)

    def open_link(self, tcp, dialed):
        self.tcp, self.dialed, self.peer, self.end = tcp, dialed, None, None
        self.sent = self.received = 0
        tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.opened = time.monotonic()
        longest = MESSAGE_SIZE + wire.LONGEST_HEADER
        self.link = wire.Link(CHUNK_SIZE, longest) if self.ring is None else secure.Stream(longest)
        own = self.hello()
        with self.reading():
            if dialed:
                self.send_frame("hello", own)
            peer = self.expect("hello")
            if "other_versions" in peer and not dialed:
                self.send_frame("hello", own)
            if "identity" not in peer:
                self.refuse(self.unreadable(peer))
            if self.ring is not None:
                if not dialed:
                    self.send_frame("hello", own)
                self.prove(peer["identity"], *((own, self.link.hello) if dialed else (self.link.hello, own)))
            refused = self.refusal(peer)
            if refused is not None:
                self.refuse(refused)
            if self.ring is None and not dialed:
                self.send_frame("hello", own)
            elif not dialed:
                self.send_frame("confirm", self.end.confirmation())
        self.tcp.settimeout(None)
        self.peer = peer
        self.live()

    def hello(self):
        self.nonce = secrets.randbits(64)
        hello = {
            "fleet": self.options.fleet, "identity": self.identity, "wanted": self.wanted, "epoch": self.epoch,
            "claim": self.claim, "obeyed": self.obeyed,
            "nonce": self.nonce, "versions": wire.VERSIONS, "capabilities": 0, "message_size": MESSAGE_SIZE,
            "chunk_size": CHUNK_SIZE, "calls": 8, "minimum_interval": 0, "link": 0, "udp_port": self.udp.getsockname()[1],
            "stamp": clock(), "keep_alive": int(KEEP_ALIVE * 1000),
        }
        return wire.encode_hello(hello, self.magic, self.suites)

    def expect(self, kind):
        """The next frame, which must be of this kind; what comes behind it stays in the link's buffer."""
        data = b""
        while True:
            for incoming in self.link.receive(data):
                if kind in incoming:
                    return incoming[kind]
                if "refuse" in incoming or "close" in incoming:
                    raise Ended("not taken: %s" % incoming, by_peer=True)
                raise wire.Malformed("something else than a %s" % kind)
            left = self.opened + OPENING - time.monotonic()
            if left <= 0:
                self.close(7, "no %s in time" % kind)
            self.tcp.settimeout(left)
            try:
                data = self.read()
            except socket.timeout:
                data = b""

    def unreadable(self, hello):
        """The code with which a hello is refused of which no items were read."""
        if "other_versions" in hello:
            return REFUSED_VERSION
        data = self.link.hello
        if len(data) < 20 or data[:4] not in (wire.MAGIC, secure.MAGIC):
            return REFUSED_MALFORMED
        if data[:4] != self.magic:
            return REFUSED_MODE
        return REFUSED_SUITE if self.suites and not data[6] & self.suites else REFUSED_MALFORMED

    def prove(self, peer, *hellos):
        pair_keys = self.ring.pair_keys(peer)
        if not pair_keys:
            self.close(12, "no key for %s" % peer)
        self.link.end = self.end = end = secure.End(self.dialed, pair_keys)
        end.begin(*hellos)
        if end.begins:
            self.send_frame("proof", end.propose())
            end.finish(self.expect("proof"))
        else:
            self.send_frame("proof", end.answer(self.expect("proof")))
        end.turn()
        if self.dialed:
            self.send_frame("confirm", end.confirmation())
        end.confirmed(self.expect("confirm"))
        self.link.chunk_limit = CHUNK_SIZE

    def refusal(self, peer):
        """The code with which the peer is refused, None if it is taken."""
        if peer["fleet"] != self.options.fleet:
            return REFUSED_FLEET
        if peer["identity"] == self.identity:
            return REFUSED_DUPLICATE
        if peer["identity"]["role"] == self.identity["role"] == "s_unit":
            return REFUSED_ROLE
        if not self.belongs(peer):
            return REFUSED_MANAGER
        if self.identity["role"] == "s_unit":
            if wire.rank(peer["claim"]) < wire.rank(self.obeyed):
                return REFUSED_FENCED
            # As long as it runs: one that moves stores the claim.
            self.obeyed = peer["claim"] and {**peer["claim"], "since": 0}
        elif wire.rank(peer["obeyed"]) > wire.rank(self.claim):
            return REFUSED_FENCED
        return None

    # --- the stream

    def read(self):
        try:
            data = self.tcp.recv(65536)
        except ConnectionError as error:
            raise Ended(error) from None
        if not data:
            raise Ended("the connection was closed without a close frame")
        self.received += len(data)
        return data

    def write(self, frames):
        for frame in frames:
            sealed = self.end is not None and self.end.sending is not None
            # A peer that has gone may have said why: the reader hears it.
            with contextlib.suppress(ConnectionError):
                data = self.end.seal_frame(frame) if sealed else frame
                self.sent += len(data)
                self.tcp.sendall(data)

    def send_frame(self, name, payload=b""):
        self.write([wire.encode_frame(name, payload)])

    def send(self, priority, message):
        room = self.peer["chunk_size"] - (0 if self.end is None else secure.TAG_BYTES)
        self.write(wire.encode_chunks(priority, wire.encode_message(message), room))

    def tell(self, name, value):
        """A control message of one item."""
        self.send("high", {"control": [{name: value}]})

    def refuse(self, code):
        self.send_frame("refuse", bytes([code]))
        raise Ended("refused with %d" % code)

    def close(self, code, why):
        self.send_frame("close", bytes([code]))
        raise Ended("%s, closed with %d" % (why, code))

    @contextlib.contextmanager
    def reading(self):
        """What cannot be read ends the link."""
        try:
            yield
        except secure.Refused as error:
            proven = self.peer is not None and not isinstance(error, secure.NotProven)
            self.close(5 if proven else 12, error)
        except wire.Oversize:
            self.close(6, "more than this unit takes")
        except wire.Malformed as error:
            self.close(5, "the peer broke the protocol %s" % error)

    # --- a live link

    def live(self):
        self.stamp = None
        self.hear_stamp(self.peer["stamp"])
        self.windows = {priority: wire.Window() for priority in wire.PRIORITIES}
        self.lease, self.renewals, self.newest_order = None, 0, 0
        self.theirs, self.not_kept = {}, 0
        self.waiting, self.held = {}, {}
        self.hears, self.is_heard, self.missed, self.no_datagram, self.next_question = False, False, 0, 0, 0
        self.heard = self.heard_datagram = self.next_keep_alive = self.next_probe = time.monotonic()
        self.sent_before, self.arrived, self.stuck_since, self.stale = 0, 0, None, 0
        self.rest()
        self.readers = {self.tcp: lambda: self.stream(self.read()), self.udp: self.datagram}
        say("joined", self.peer["identity"]["name"], "in plain mode" if self.end is None else "secured")
        for slot, function in enumerate(self.functions):
            self.tell("publish", {
                "slot": slot, "generation": 0, "attributes": wire.encode_attributes(function.attributes).hex(),
                "signature": wire.encode_signature(function.signature).hex(),
            })
        self.tell("list_end", {"serial": 1})

    def run(self):
        """Until the link ends."""
        self.stream(b"")
        while True:
            self.look()
            busy = self.lease or self.held or self.waiting
            due = min(self.next_keep_alive - time.monotonic(), 0.01 if busy else self.pause() / 4)
            ready, _, _ = select.select(list(self.readers), [], [], max(due, 0))
            for each in ready:
                self.readers[each]()

    def look(self):
        """Does what is due."""
        now = time.monotonic()
        if now >= self.next_keep_alive:
            self.keep_alive()
            self.next_keep_alive = now + KEEP_ALIVE
        if self.lease is not None and clock() >= self.lease["end"]:
            self.end_lease("expired")
        for number, held in list(self.held.items()):
            if now >= held["next"] and now >= held["answered"] + held["lease"]:
                say("lease of", held["name"], "ended: unanswered")
                self.release(number)
            elif now >= held["next"]:
                held["next"] = now + held["every"]
                self.renew_held(number, held)
        for number in [number for number, (_, _, until) in self.waiting.items() if now >= until]:
            name, _, _ = self.waiting.pop(number)
            self.failed(number, name, "no reply")
        if self.end is not None and self.dialed and now >= self.new_keys_at:
            self.new_keys_at, self.new_keys_until = float("inf"), now + RENEWAL_WITHIN
            self.send_frame("proof", self.end.propose())
        if now >= self.new_keys_until:
            self.close(7, "no new keys")
        self.look_at_silence(now)

    def pause(self):
        return min(max(self.peer["keep_alive"], 1), 60_000) / 1000

    def look_at_silence(self, now):
        pause, before = self.pause(), self.missed
        # One more at a time, so that a process that was held up does not end the link by itself.
        self.missed = max(0, min(before + 1, int((now - self.heard) / pause - 0.5)))
        if self.missed >= 3 and (self.hears or self.missed * pause >= WITHOUT_DATAGRAMS):
            self.close(3, "silence")
        none_before = self.no_datagram
        self.no_datagram = max(0, min(none_before + 1, int((now - self.heard_datagram) / pause - 0.5)))
        if self.hears and self.no_datagram >= 3:
            say("datagrams do not pass")
            self.hears, self.next_keep_alive = False, now
        if self.hears and self.no_datagram > 0 and now >= self.next_question:
            self.send_datagram({"ping": {}})
            self.next_question = now + pause / 4
        silent = self.missed > before or self.hears and self.no_datagram > none_before
        if now >= self.next_probe:
            silent, self.sent_before = silent or self.sent == self.sent_before, self.sent
            self.next_probe = now + PROBE
        if silent:
            self.send_frame("ping")

    def report(self):
        return {"received": self.received & 0xFFFFFFFF, "hears": self.hears, "holds": False, "misses": self.missed > 0}

    def reported(self, report):
        """What the peer tells of the stream and the datagrams of this unit."""
        now, stands = time.monotonic(), report["received"] == self.arrived
        self.is_heard, self.arrived = report["hears"], report["received"]
        missing = (self.sent - report["received"]) & 0xFFFFFFFF
        if not stands or report["holds"] or missing == 0 or self.stuck_since is None:
            self.stuck_since, self.stale = now if missing else None, 0
            return
        self.stale += 1
        if self.stale >= 3 and now >= self.stuck_since + STREAM_DEAD:
            code = 14 if missing > 536 else 13
            self.send_datagram({"close": {"code": code}})
            self.close(code, "the stream is dead")

    def keep_alive(self):
        body = {"keep_alive": {"stamp": clock(), **self.report()}}
        self.send_datagram(body)
        if not self.hears or not self.is_heard:
            self.send_frame("session", wire.encode_session_body(body))

    def stream(self, data):
        with self.reading():
            for incoming in self.link.receive(data):
                self.dispatch(incoming)

    def dispatch(self, incoming):
        if self.end is not None and self.end.unconfirmed and "confirm" not in incoming:
            raise wire.Malformed("no confirm frame under new keys")
        if incoming == "skipped":
            return
        self.heard = time.monotonic()
        if incoming == "ping":
            self.send_frame("pong")
        elif incoming == "pong":
            pass
        elif "close" in incoming or "refuse" in incoming:
            raise Ended("%s %d" % incoming.popitem(), by_peer=True)
        elif "session" in incoming:
            if "unreadable" not in incoming["session"]:
                self.session_body(incoming["session"], self.send_in_stream)
        elif "message" in incoming:
            self.message(incoming["priority"], incoming["message"])
        elif "proof" in incoming:
            self.proof(incoming["proof"])
        elif "confirm" in incoming:
            self.confirm(incoming["confirm"])
        else:
            raise wire.Malformed("a second hello")

    # --- session datagrams (sections 3 and 17)

    def send_datagram(self, body):
        if self.peer["udp_port"]:
            header = wire.session_header(self.peer["link"], self.peer["nonce"], self.options.fleet, self.magic)
            body = wire.encode_session_body(body)
            data = header + body if self.end is None else self.end.seal_datagram(header, body)
            self.udp.sendto(data, (self.tcp.getpeername()[0], self.peer["udp_port"]))

    def datagram(self):
        data, source = self.udp.recvfrom(2048)
        # Under a seal the session's nonce tells whose it is: a host may have several addresses.
        if self.end is None and source[0] != self.tcp.getpeername()[0]:
            return
        try:
            body = self.session_of(data)
        except wire.Malformed:
            return
        if not self.hears:
            say("datagrams pass")
            self.next_keep_alive = 0
        self.hears, self.heard = True, time.monotonic()
        self.heard_datagram = self.heard
        self.session_body(body, self.send_datagram)

    def session_of(self, data):
        if self.end is not None:
            header = wire.session_header(0, self.nonce, self.options.fleet, self.magic)
            return wire.decode_session_body(self.end.open_datagram(header, data))
        session = wire.decode_datagram(data, self.options.fleet).get("session")
        if session is None or session["link"] != 0 or session["nonce"] != self.nonce:
            raise wire.Malformed("not of this link")
        return session["body"]

    def session_body(self, body, answer):
        """`answer` sends on the way that it came."""
        (kind, value), = body.items()
        if kind == "keep_alive":
            self.hear_stamp(value["stamp"])
            self.reported(value)
        elif kind == "ping":
            self.send_datagram({"pong": self.report()})
        elif kind == "pong":
            self.reported(value)
        elif kind == "close" and answer == self.send_datagram and value["code"] in (13, 14):
            raise Ended("close %d" % value["code"], by_peer=True)
        elif kind == "renew":
            self.renewed(value)
            answer({"renewed": {"call": value["call"]}})
        elif kind == "renewed":
            if value["call"] in self.held:
                self.held[value["call"]]["answered"] = time.monotonic()
        elif kind == "release":
            self.windows[value["class"]].note(value["call"])
            if self.lease is not None and value["call"] == self.lease["call"]:
                self.released()
        elif kind == "release_all":
            if self.lease is not None and value["slot"] == self.lease["slot"] and self.lease["call"] <= value["call"]:
                self.released()
        elif kind == "message" and "request" in value["message"]:
            self.request(value["priority"], value["message"]["request"])

    def hear_stamp(self, stamp):
        if self.stamp is None or stamp >= self.stamp:
            self.stamp, self.heard_at = stamp, clock()

    # --- new keys (section 17)

    def rest(self):
        """The keys are as new as now."""
        self.proven, self.new_keys_until = time.monotonic(), float("inf")
        life = getattr(self.options, "renew", KEYS_LIVE)
        self.new_keys_at = self.proven + life - chance(life / 8)

    def proof(self, message):
        if not message:
            self.end.turn_receiving()
        elif self.dialed:
            self.end.finish(message)
        else:
            secure.require(time.monotonic() - self.proven >= SHORTEST_HANDSHAKE_LIFE, "new keys too soon")
            self.send_frame("proof", self.end.answer(message))
            self.new_keys_until = time.monotonic() + RENEWAL_WITHIN
            self.turn()

    def turn(self):
        self.send_frame("proof")
        self.end.turn_sending()
        self.send_frame("confirm", self.end.confirmation())

    def confirm(self, told):
        if told:
            self.end.confirmed(told)
        if told and self.dialed:
            self.turn()
            return
        secure.require(self.dialed or told, "an acknowledgement of nothing")
        self.end.adopt()
        if not self.dialed:
            self.send_frame("confirm")
        self.rest()
        say("new keys")

    # --- messages (sections 9 and 11)

    def message(self, priority, message):
        (kind, value), = message.items()
        if kind == "request":
            self.request(priority, value)
        elif kind in ("reply", "failure"):
            self.answered(value)
        else:
            items = [item for each in value for item in each.items()]
            if any(name in wire.LAST_ITEMS for name, _ in items[:-1]):
                raise wire.Malformed("something behind an item that is the last")
            for name, told in items:
                self.control(name, told)

    def control(self, name, told):
        if name in ("publish", "withdraw"):
            self.theirs = {known: what for known, what in self.theirs.items() if what["slot"] != told["slot"]}
        if name == "publish":
            attributes = wire.decode_attributes(bytes.fromhex(told["attributes"]))
            try:
                signature = wire.decode_signature(bytes.fromhex(told["signature"]))
                self.theirs[signature["name"]] = {**told, "attributes": attributes, "signature": signature}
            except wire.Malformed:
                self.not_kept += 1
        elif name == "list_end":
            self.tell("list_ack", {"serial": told["serial"], "skipped": self.not_kept})
            self.list_ended()
        elif name == "list_ack":
            say("published")
        elif name == "limits":
            self.peer.update(told)
        elif name == "lease_ended" and told["call"] in self.held:
            say("lease of", self.held.pop(told["call"])["name"], "ended:", told["why"])

    # --- calls of the peer's functions (sections 12 and 13)

    def call(self, name, values):
        """Calls a function; its answer comes later. What has a lease is held until it is released."""
        theirs, number, now = self.theirs[name], self.next_id, time.monotonic()
        priority, lease = theirs["attributes"]["priority"], theirs["attributes"]["lease"]
        self.next_id += 1
        self.waiting[number] = name, theirs["signature"], now + REPLY_WITHIN
        if lease is not None:
            every = max(lease / 4000, 0.005)
            self.held[number] = {
                "name": name, "class": priority, "every": every, "next": now + every, "lease": lease / 1000, "answered": now,
            }
        request = {"request": {
            "id": number, "slot": theirs["slot"], "generation": theirs["generation"], "wants_reply": True, "unknown": 0,
            "remaining": int(REPLY_WITHIN * 1e6), "stamp": self.stamp, "since": clock() - self.heard_at, "number": number,
            "block": wire.encode_block(values, theirs["signature"]["arguments"]).hex(),
        }}
        if priority == "emergency":
            self.send_datagram({"message": {"priority": priority, "message": request}})
        self.send(priority, request)

    def answered(self, reply):
        name, signature, _ = self.waiting.pop(reply["id"], (None, None, None))
        if name is None:
            return
        if "error" in reply:
            self.failed(reply["id"], name, reply["error"])
            return
        try:
            say(name, wire.decode_block(bytes.fromhex(reply["block"]), signature["results"]))
        except wire.Malformed:
            self.failed(reply["id"], name, "result_lost")

    def failed(self, number, name, why):
        say(name, "failed:", why)
        if number in self.held:
            self.release(number)

    def in_both(self, body):
        """As a datagram and in the stream."""
        self.send_datagram(body)
        self.send_in_stream(body)

    def send_in_stream(self, body):
        self.send_frame("session", wire.encode_session_body(body))

    def renew_held(self, number, held):
        since = clock() - self.heard_at
        self.in_both({"renew": {
            "class": held["class"], "call": number, "stamp": self.stamp, "since": since, "age": 0,
        }})

    def release(self, number):
        self.in_both({"release": {"class": self.held.pop(number)["class"], "call": number}})

    # --- calls of this unit's functions (sections 12 and 13)

    def request(self, priority, request):
        window, number = self.windows[priority], request["id"]
        if number in window.seen:
            return
        error = "stale" if window.is_behind(number) else self.error_of(request)
        window.note(number)
        if error is None:
            try:
                results = self.serve(request)
                self.answer(priority, request, {"block": results.hex()})
                return
            except wire.Malformed:
                error = "malformed"
            except Refused as refused:
                (error,) = refused.args
        self.answer(priority, request, {"error": error})

    def error_of(self, request):
        """Why a request is not run, by its header alone."""
        if request["unknown"]:
            return "unsupported"
        if request["stamp"] > clock():
            return "malformed"
        if made(request) + request["remaining"] <= clock():
            return "expired"
        if request["slot"] >= len(self.functions):
            return "unknown_function"
        if request["generation"] != 0:
            return "stale_function"
        lease = self.functions[request["slot"]].lease
        return "expired" if lease and made(request) + lease <= clock() else None

    def serve(self, request):
        function = self.functions[request["slot"]]
        signature = function.signature
        arguments = wire.decode_block(bytes.fromhex(request["block"]), signature["arguments"])
        # It was overtaken on its way.
        if function.lease and request["number"] < self.newest_order:
            raise Refused("replaced")
        if function.lease and self.lease is not None:
            # An operator and the program of the peer hold for themselves.
            operator = self.lease["operator"]
            if operator != request["operator"] and not request["takes_over"]:
                raise Refused({"held": {"by": self.peer["identity"]["id"], "operator": operator}})
            self.end_lease("replaced")
        say("run", signature["name"], arguments)
        if function.lease:
            end = made(request) + function.lease
            self.newest_order = max(self.newest_order, request["number"])
            self.lease = {
                "slot": request["slot"], "call": request["id"], "end": end, "length": function.lease,
                "operator": request["operator"],
            }
        return wire.encode_block(function.run(arguments), signature["results"])

    def answer(self, priority, request, outcome):
        if request["wants_reply"]:
            self.send(priority, {"reply": {"id": request["id"], **outcome}})
        elif "error" in outcome:
            self.send(priority, {"failure": {"id": request["id"], **outcome}})

    def renewed(self, value):
        if self.lease is None or value["call"] != self.lease["call"]:
            window = self.windows[value["class"]]
            if value["call"] in window.seen or window.is_behind(value["call"]):
                self.tell("lease_ended", {"call": value["call"], "why": "expired"})
        elif value["stamp"] <= clock():
            self.renewals += 1
            self.lease["end"] = max(self.lease["end"], made(value) - value["age"] + self.lease["length"])

    def end_lease(self, why):
        say("stopped after", self.renewals, "renewals:", why)
        self.tell("lease_ended", {"call": self.lease["call"], "why": why})
        self.lease = None

    def released(self):
        say("released")
        self.lease = None

    # --- what the roles do otherwise

    def belongs(self, peer):
        """Whether the peer's hello is that of a unit that this one has a link with."""
        raise NotImplementedError

    def list_ended(self):
        """The peer has published what it has to."""


def made(told):
    """When a request or renewal was made, on this unit's clock."""
    return min(told["stamp"] + told["since"], clock())
