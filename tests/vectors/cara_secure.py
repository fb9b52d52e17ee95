"""CARA's secured mode in Python: written from docs/wire.md, section 17, standard library only.

X25519, ChaCha20-Poly1305 and Noise's NNpsk0; the codes of discovery; `End`, one end of a secured link; `Stream`, what such
an end reads; and `Conversation`, which plays both ends of a link with the numbers that they drew: all that they sent is made
again and compared, and opened. It takes no care against measuring how long it takes: for checking only.
"""

import hashlib
import hmac
import secrets
import struct
import time

import cara_wire as wire

MAGIC = b"CARs"
PORT = 21971
SUITE = b"Noise_NNpsk0_25519_ChaChaPoly_BLAKE2s"
SUITES = 1
TAG_BYTES = 16
FRAMES_PER_KEY = 1 << 20
HELLO, PROOF, CONFIRM = 1, 7, 8
CODE_BYTES = 16
SHORTEST_DISCOVERY = 176
DATAGRAM_HEADER = 24
# The longest frame body before the other end's confirm frame has opened.
LONGEST_BEFORE_CONFIRM = 317
# How long datagrams of the generation before are taken: after the first one of the new one, and after the confirm frame.
PREVIOUS_KEY_LIFE, PREVIOUS_KEY_LIFE_WITHOUT = 5, 60


class Refused(wire.Malformed):
    """Something that is not what it should be."""


class NotProven(Refused):
    """A handshake that the other end's key, or its prologue, does not fit."""


def require(condition, what):
    if not condition:
        raise Refused(what)


# --- X25519 (RFC 7748)

PRIME = 2**255 - 19


def x25519(scalar, point):
    k = int.from_bytes(scalar, "little") & ~7 & (1 << 255) - 1 | 1 << 254
    u = int.from_bytes(point, "little") & (1 << 255) - 1
    a, b, c, d, swapped = 1, 0, u, 1, 0
    for bit in reversed(range(255)):
        now = k >> bit & 1
        if now != swapped:
            a, b, c, d = c, d, a, b
        swapped = now
        plus, minus = (a + b) % PRIME, (a - b) % PRIME
        square_plus, square_minus = plus * plus % PRIME, minus * minus % PRIME
        cross, other = (c - d) * plus % PRIME, (c + d) * minus % PRIME
        c, d = (cross + other) ** 2 % PRIME, u * (cross - other) ** 2 % PRIME
        difference = square_plus - square_minus
        a, b = square_plus * square_minus % PRIME, difference * (square_plus + 121665 * difference) % PRIME
    if swapped:
        a, b = c, d
    return (a * pow(b, PRIME - 2, PRIME) % PRIME).to_bytes(32, "little")


def public_key(secret):
    return x25519(secret, (9).to_bytes(32, "little"))


# --- ChaCha20-Poly1305 (RFC 8439), with Noise's nonces

COLUMNS_AND_DIAGONALS = [
    (0, 4, 8, 12), (1, 5, 9, 13), (2, 6, 10, 14), (3, 7, 11, 15),
    (0, 5, 10, 15), (1, 6, 11, 12), (2, 7, 8, 13), (3, 4, 9, 14),
]  # fmt: skip
MASK = 0xFFFFFFFF


def block(key, counter, nonce):
    begin = list(struct.unpack("<16I", b"expand 32-byte k" + key + struct.pack("<I", counter) + nonce))
    x = list(begin)
    for _ in range(10):
        for a, b, c, d in COLUMNS_AND_DIAGONALS:
            for left, right in ((16, 12), (8, 7)):
                x[a] = x[a] + x[b] & MASK
                x[d] ^= x[a]
                x[d] = (x[d] << left | x[d] >> 32 - left) & MASK
                x[c] = x[c] + x[d] & MASK
                x[b] ^= x[c]
                x[b] = (x[b] << right | x[b] >> 32 - right) & MASK
    return struct.pack("<16I", *((one + other) & MASK for one, other in zip(begin, x)))


def chacha20(key, nonce, data):
    blocks = range((len(data) + 63) // 64)
    stream = b"".join(block(key, 1 + number, nonce) for number in blocks)
    return bytes(one ^ other for one, other in zip(data, stream))


def poly1305(key, data):
    r = int.from_bytes(key[:16], "little") & 0x0FFFFFFC0FFFFFFC0FFFFFFC0FFFFFFF
    total = 0
    for at in range(0, len(data), 16):
        total = (total + int.from_bytes(data[at : at + 16] + b"\1", "little")) * r % (2**130 - 5)
    return (total + int.from_bytes(key[16:], "little") & (1 << 128) - 1).to_bytes(16, "little")


def padded(data):
    return data + bytes(-len(data) % 16)


def tag_of(key, nonce, further, sealed):
    lengths = struct.pack("<QQ", len(further), len(sealed))
    return poly1305(block(key, 0, nonce)[:32], padded(further) + padded(sealed) + lengths)


def nonce_of(number):
    return bytes(4) + struct.pack("<Q", number)


def seal(key, number, further, body):
    sealed = chacha20(key, nonce_of(number), body)
    return sealed + tag_of(key, nonce_of(number), further, sealed)


def open_sealed(key, number, further, data):
    require(len(data) >= TAG_BYTES, "shorter than a tag")
    sealed, tag = data[:-TAG_BYTES], data[-TAG_BYTES:]
    require(tag_of(key, nonce_of(number), further, sealed) == tag, "it does not open")
    return chacha20(key, nonce_of(number), sealed)


# --- Noise


def blake2s(*parts, key=b""):
    return hashlib.blake2s(b"".join(parts), key=key).digest()


def hkdf(chaining, material, count):
    def mac(key, data):
        return hmac.new(key, data, hashlib.blake2s).digest()

    secret, out = mac(chaining, material), [b""]
    for number in range(1, count + 1):
        out.append(mac(secret, out[-1] + bytes([number])))
    return out[1:]


class Handshake:
    """One end of NNpsk0."""

    def __init__(self, prologue, psk, secret):
        self.secret = secret
        self.hash = self.chaining = blake2s(SUITE)
        self.mix_hash(prologue)
        self.chaining, mixed, self.key = hkdf(self.chaining, psk, 3)
        self.number = 0
        self.mix_hash(mixed)

    def mix_hash(self, data):
        self.hash = blake2s(self.hash, data)

    def mix_key(self, material):
        self.chaining, self.key = hkdf(self.chaining, material, 2)
        self.number = 0

    def public(self, key):
        self.mix_hash(key)
        self.mix_key(key)

    def empty(self, tag=None):
        """Seals the empty payload, or opens it."""
        sealed = seal(self.key, self.number, self.hash, b"") if tag is None else tag
        if tag is not None:
            open_sealed(self.key, self.number, self.hash, tag)
        self.number += 1
        self.mix_hash(sealed)
        return sealed

    def write_first(self):
        own = public_key(self.secret)
        self.public(own)
        return own + self.empty()

    def read_first(self, message):
        self.public(message[:32])
        self.empty(message[32:])
        self.theirs = message[:32]

    def write_second(self):
        own = public_key(self.secret)
        self.public(own)
        self.mix_key(x25519(self.secret, self.theirs))
        return own + self.empty()

    def read_second(self, message):
        self.public(message[:32])
        self.mix_key(x25519(self.secret, message[:32]))
        self.empty(message[32:])

    def split(self):
        """The keys of what the initiator sends, and of what the responder sends."""
        return hkdf(self.chaining, b"", 2)


class Direction:
    """The frames of one direction under one key, numbered from 0."""

    def __init__(self, key):
        self.key = key
        self.number = 0

    def step(self):
        """The number of the next frame."""
        if self.number and self.number % FRAMES_PER_KEY == 0:
            self.key = seal(self.key, 2**64 - 1, b"", bytes(32))[:32]
        self.number += 1
        return self.number - 1

    def seal(self, body):
        number = self.step()
        return seal(self.key, number, b"", body)

    def open(self, body):
        number = self.step()
        return open_sealed(self.key, number, b"", body)


# --- discovery


def code(key, use, data):
    return blake2s(use, data, key=key)[:CODE_BYTES]


def encode_discovery(datagram, fleet, ring, to=None):
    """A who-has or announce with its codes; an announce with a nonce is for the unit `to`."""
    if to is None:
        data = wire.encode_datagram(datagram, fleet, MAGIC, 1)
        missing = SHORTEST_DISCOVERY - CODE_BYTES - len(data)
        data += wire.item(0, bytes(missing - 4)) if missing > 0 else b""
    else:
        data = wire.encode_datagram(datagram, fleet, MAGIC, 2)
        data += code(ring.pair_keys(to)[0], b"pmac", data)
    return data + code(ring.discovery_keys()[0], b"fmac", data)


def decode_discovery(data, fleet, ring):
    require(len(data) >= 12 + CODE_BYTES and data[7] in (1, 2), "a datagram without codes")
    covered, fleets = data[:-CODE_BYTES], data[-CODE_BYTES:]
    require(any(code(key, b"fmac", covered) == fleets for key in ring.discovery_keys()), "not of this fleet")
    body = covered if data[7] == 1 else covered[:-CODE_BYTES]
    datagram = wire.decode_datagram(body, fleet, MAGIC, data[7])
    announce = datagram.get("announce", {"nonce": 0})
    require(data[7] == (2 if announce["nonce"] else 1), "another number of codes")
    if announce["nonce"]:
        keys, pairs = ring.pair_keys(announce["identity"]), covered[-CODE_BYTES:]
        require(any(code(key, b"pmac", body) == pairs for key in keys), "not of this pair")
    return datagram


# --- a link


class Opener:
    """The datagrams of one generation that come."""

    def __init__(self, key):
        self.key, self.window = key, wire.Window()

    def open(self, data):
        number, = struct.unpack("<Q", data[25:33])
        require(number != 2**64 - 1 and not self.window.is_behind(number), "an old number")
        require(number not in self.window.seen, "a number comes back")
        body = open_sealed(self.key, number, bound(data[:33]), data[33:])
        self.window.note(number)
        return body


def bound(head):
    """What a datagram's tag covers besides its body; `head` is what stands in front of that."""
    header, told = head[:DATAGRAM_HEADER], head[DATAGRAM_HEADER:]
    return (bytes([len(header)]) + told + header).ljust(58, b"\0")


class End:
    """One end of a secured link: it proves one of `keys`, the pair's, and has the ciphers of both directions."""

    def __init__(self, dialed, keys, draw=lambda: secrets.token_bytes(32)):
        self.dialed, self.keys, self.draw = dialed, keys, draw
        self.sending = self.receiving = self.handshake = None
        self.next_sending = self.next_receiving = None
        # Of this end's datagrams: generation and key, those that the other end is told, and the next number.
        self.own, self.told, self.number = None, None, 0
        self.openers, self.newest = {}, None
        self.forget = float("inf")
        # The next frame that comes must be the other end's confirm frame.
        self.unconfirmed = False

    def begin(self, *hellos):
        """The payloads of both hellos, that of the end that dialled first."""
        parts = [part for hello in hellos for part in (struct.pack("<Q", len(hello)), hello)]
        self.prologue = blake2s(b"CARA prologue 1", *parts)

    # Either end's two messages of a handshake.

    @property
    def begins(self):
        """The end that was dialled begins the first handshake, the dialler all others."""
        return self.dialed != (self.own is None)

    def propose(self):
        require(self.begins and self.handshake is None, "a proof within a proof")
        self.handshake = self.new_handshake(self.keys[0], self.draw())
        return self.handshake.write_first()

    def answer(self, message):
        require(not self.begins and self.handshake is None and len(message) == 48, "a proof that was not to come")
        fresh = self.draw()
        for key in self.keys:
            handshake = self.new_handshake(key, fresh)
            try:
                handshake.read_first(message)
            except Refused:
                continue
            second = handshake.write_second()
            self.agreed(handshake)
            return second
        raise NotProven("another key")

    def finish(self, message):
        require(self.begins and self.handshake is not None and len(message) == 48, "an answer to nothing")
        try:
            self.handshake.read_second(message)
        except Refused:
            raise NotProven("another key") from None
        self.agreed(self.handshake)

    def new_handshake(self, key, fresh):
        # Made of the prologue as well, so that two links differ even if what is drawn comes back.
        handshake = Handshake(self.prologue, key, blake2s(b"ephe", self.prologue, key=fresh))
        handshake.fresh = fresh
        return handshake

    def agreed(self, handshake):
        require(self.next_sending is None and self.next_receiving is None, "keys that were not taken into use")
        keys = [Direction(key) for key in handshake.split()]
        self.next_sending, self.next_receiving = keys if self.begins else reversed(keys)
        generation = 0 if self.own is None else self.own[0] + 1 & 255
        use = b"dgrI" if self.begins else b"dgrR"
        self.told = generation, blake2s(use, handshake.hash, key=handshake.fresh)
        self.prologue, self.handshake = blake2s(b"CARA renewal 1", handshake.hash), None

    # The new keys are taken into use: at once on a new link, later one direction at a time.

    def turn(self):
        self.turn_sending()
        self.turn_receiving()
        self.adopt()

    def turn_sending(self):
        require(self.next_sending is not None, "a turn without new keys")
        self.sending, self.next_sending = self.next_sending, None

    def turn_receiving(self):
        require(self.next_receiving is not None, "a turn without new keys")
        self.receiving, self.next_receiving = self.next_receiving, None
        self.unconfirmed = True

    def confirmation(self):
        generation, key = self.told or self.own
        return bytes([generation]) + key

    def confirmed(self, told):
        """The other end's confirmation, the first frame under its new key."""
        generation = 0 if self.newest is None else self.newest + 1 & 255
        require(len(told) == 33 and told[0] == generation and self.unconfirmed, "another confirmation")
        self.unconfirmed = False
        self.openers = {number: opener for number, opener in self.openers.items() if number == self.newest}
        self.openers[generation], self.newest = Opener(told[1:]), generation
        self.forget = time.monotonic() + PREVIOUS_KEY_LIFE_WITHOUT

    def adopt(self):
        """The other end has the key of this end's datagrams."""
        require(self.told is not None and self.next_sending is None, "an acknowledgement of nothing")
        self.own, self.told, self.number = self.told, None, 0

    # What travels.

    def seal_frame(self, frame):
        body = self.sending.seal(frame[2:])
        return struct.pack("<H", len(body)) + body

    def seal_datagram(self, header, body):
        generation, key = self.own
        head = header + struct.pack("<BQ", generation, self.number)
        self.number += 1
        return head + seal(key, self.number - 1, bound(head), body)

    def open_datagram(self, header, data):
        """The session body in a datagram, which must have this header."""
        require(len(data) > 33 and data[:DATAGRAM_HEADER] == header, "another header")
        if time.monotonic() >= self.forget:
            self.openers = {self.newest: self.openers[self.newest]}
        generation = data[DATAGRAM_HEADER]
        require(generation in self.openers, "a datagram of no known key")
        body = self.openers[generation].open(data)
        if generation == self.newest:
            self.forget = min(self.forget, time.monotonic() + PREVIOUS_KEY_LIFE)
        return body


class Stream(wire.Link):
    """One direction of a secured link's stream; in clear until `end` has keys."""

    magic, suites = MAGIC, SUITES

    def __init__(self, message_limit):
        super().__init__(LONGEST_BEFORE_CONFIRM, message_limit)
        self.end = None

    def frame(self, body):
        if self.end is not None and self.end.receiving is not None:
            body = self.end.receiving.open(body)
        if body[:1] == bytes([PROOF]):
            return {"proof": body[1:]}
        if body[:1] == bytes([CONFIRM]):
            return {"confirm": body[1:]}
        return super().frame(body)


class Conversation:
    """Both ends of a link: what they sent, in its order. `vehicle` has dialled; `drawn` has, for each end, the 32 bytes of
    each of its proofs."""

    ENDS = {"vehicle": "manager", "manager": "vehicle"}

    def __init__(self, psk, drawn):
        draws = {name: iter(numbers) for name, numbers in drawn.items()}
        self.ends = {name: End(name == "vehicle", [psk], lambda name=name: next(draws[name])) for name in self.ENDS}
        self.hellos, self.nonces = {}, {}
        self.links = {name: wire.Link(4096, 32800) for name in self.ENDS}
        self.sealed, self.renewals = set(), 0

    def stream(self, name, data):
        """A frame of the stream; what it says."""
        length, = struct.unpack_from("<H", data)
        require(length == len(data) - 2, "a frame of another length")
        end, other = self.ends[name], self.ends[self.ENDS[name]]
        if end.sending is None:
            return self.clear(name, data[2:])
        body = other.receiving.open(data[2:])
        self.once(other.receiving.key, other.receiving.number)
        require(end.seal_frame(struct.pack("<H", len(body)) + body) == data, "it is not sealed like this")
        require(not other.unconfirmed or body[0] == CONFIRM, "no confirmation under new keys")
        if body[0] == PROOF:
            return self.proof(name, body[1:]) if body[1:] else self.turn(end, other)
        if body[0] == CONFIRM:
            return self.confirmation(end, other, body[1:])
        return list(self.links[name].receive(struct.pack("<H", len(body)) + body))

    def clear(self, name, body):
        if body[0] == HELLO:
            require(name == ("vehicle", "manager")[len(self.hellos)] and body[1:5] == MAGIC, "no hello in its turn")
            self.hellos[name] = body[1:]
            hello = wire.decode_hello(body[1:], MAGIC, SUITES)
            require("identity" in hello, "a hello of other versions")
            self.nonces[name] = hello["nonce"]
            return {"hello": hello}
        require(body[0] == PROOF and len(self.hellos) == 2, "a frame that must be sealed")
        if name == "manager":
            for end in self.ends.values():
                end.begin(*self.hellos.values())
        said = self.proof(name, body[1:])
        if name == "vehicle":
            for end in self.ends.values():
                end.turn()
        return said

    def proof(self, name, message):
        """Either of the two messages: it is what this implementation makes of the same numbers."""
        if self.ends[name].begins:
            require(self.ends[name].propose() == message, "another first message")
            self.first = message
            return "proof 1"
        require(self.ends[name].answer(self.first) == message, "another second message")
        self.ends[self.ENDS[name]].finish(message)
        return "proof 2"

    def turn(self, end, other):
        end.turn_sending()
        other.turn_receiving()
        self.renewals += end.dialed
        return "turn"

    def confirmation(self, end, other, told):
        if not told:
            require(other.dialed, "an acknowledgement of nothing")
            other.adopt()
            return "acknowledgement"
        require(end.confirmation() == told, "another confirmation")
        other.confirmed(told)
        if end.dialed and end.told is not None:
            # So the end that was dialled hears that its own has come.
            other.adopt()
        return {"confirm": told[0]}

    def datagram(self, name, data):
        """A session datagram; what it says."""
        other, header = self.ends[self.ENDS[name]], data[:DATAGRAM_HEADER]
        require(header[:8] + header[14:16] == wire.session_header(0, 0, 0, MAGIC)[:8] + b"\0\0", "another header")
        require(header[16:] == struct.pack("<Q", self.nonces[self.ENDS[name]]), "another nonce")
        return wire.decode_session_body(other.open_datagram(header, data))

    def once(self, key, number):
        require((key, number) not in self.sealed, "a number comes back")
        self.sealed.add((key, number))
