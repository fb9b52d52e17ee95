"""CARA's secured mode in Python: written from docs/wire.md, section 17, standard library only.

X25519, ChaCha20-Poly1305, Noise's NNpsk0, and `Conversation`, which plays both ends of one link with the numbers that
they drew: each message of the handshakes is made again and compared, and everything sealed is opened. It takes no care
against whoever measures how long it takes: for checking only.
"""

import hashlib
import hmac
import struct

import cara_wire as wire

MAGIC = b"CARs"
SUITE = b"Noise_NNpsk0_25519_ChaChaPoly_BLAKE2s"
SUITES = 1
TAG_BYTES = 16
FRAMES_PER_KEY = 1 << 20
HELLO, PROOF, CONFIRM = 1, 7, 8
DATAGRAM_HEADER = 24


class Refused(Exception):
    """Something that is not what it should be."""


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

    def open(self, body):
        if self.number and self.number % FRAMES_PER_KEY == 0:
            self.key = seal(self.key, 2**64 - 1, b"", bytes(32))[:32]
        opened = open_sealed(self.key, self.number, b"", body)
        self.number += 1
        return opened


# --- a link


class Conversation:
    """Both ends of a link: what they sent, in its order. `vehicle` has dialled; `drawn` has, for each end, the 32 bytes of
    each of its proofs."""

    ENDS = {"vehicle": b"dgrI", "manager": b"dgrR"}

    def __init__(self, psk, drawn):
        self.psk = psk
        self.drawn = {end: list(numbers) for end, numbers in drawn.items()}
        self.hellos = []
        self.prologue = None
        self.handshakes = self.fresh = None
        self.directions = dict.fromkeys(self.ENDS)
        self.next = dict.fromkeys(self.ENDS)
        self.datagram_keys = {end: {} for end in self.ENDS}
        self.confirmed = {end: True for end in self.ENDS}
        self.links = {end: wire.Link(4096, 32800) for end in self.ENDS}
        self.nonces = set()
        self.renewals = 0

    def stream(self, end, data):
        """A frame of the stream; what it says."""
        length, = struct.unpack_from("<H", data)
        require(length == len(data) - 2, "a frame of another length")
        direction = self.directions[end]
        if direction is None:
            return self.clear(end, data[2:])
        self.once(direction.key, direction.number)
        body = direction.open(data[2:])
        if not self.confirmed[end]:
            require(body[0] == CONFIRM, "no confirmation under new keys")
        if body[0] == PROOF:
            return self.renewal(end, body[1:])
        if body[0] == CONFIRM:
            return self.confirmation(end, body[1:])
        return list(self.links[end].receive(struct.pack("<H", len(body)) + body))

    def clear(self, end, body):
        if body[0] == HELLO:
            require(end == ("vehicle", "manager")[len(self.hellos)] and body[1:5] == MAGIC, "no hello in its turn")
            self.hellos.append(body[1:])
            hello = wire.decode_hello(body[1:], MAGIC, SUITES)
            require("identity" in hello, "a hello of other versions")
            return {"hello": hello}
        require(body[0] == PROOF and len(self.hellos) == 2, "a frame that must be sealed")
        if self.prologue is None:
            parts = [part for hello in self.hellos for part in (struct.pack("<Q", len(hello)), hello)]
            self.prologue = blake2s(b"CARA prologue 1", *parts)
        return self.proof(end, body[1:])

    def proof(self, end, message):
        """Either of the two messages: it is what this implementation makes of the same numbers."""
        if end == "vehicle":
            require(self.handshakes is None, "a proof within a proof")
            self.fresh = {one: numbers.pop(0) for one, numbers in self.drawn.items()}
            secrets = {one: blake2s(b"ephe", self.prologue, key=fresh) for one, fresh in self.fresh.items()}
            self.handshakes = {one: Handshake(self.prologue, self.psk, secret) for one, secret in secrets.items()}
            require(self.handshakes["vehicle"].write_first() == message, "another first message")
            self.handshakes["manager"].read_first(message)
            return "proof 1"
        require(self.handshakes is not None, "an answer to nothing")
        require(self.handshakes["manager"].write_second() == message, "another second message")
        self.handshakes["vehicle"].read_second(message)
        keys = self.handshakes["vehicle"].split()
        require(keys == self.handshakes["manager"].split(), "two ends with two keys")
        self.binding, self.handshakes = self.handshakes["vehicle"].hash, None
        self.prologue = blake2s(b"CARA renewal 1", self.binding)
        self.next = dict(zip(("vehicle", "manager"), keys))
        if self.directions["vehicle"] is None:
            for one in self.ENDS:
                self.turn(one)
        return "proof 2"

    def renewal(self, end, message):
        if message:
            return self.proof(end, message)
        self.turn(end)
        self.renewals += end == "vehicle"
        return "turn"

    def turn(self, end):
        require(self.next[end] is not None, "a turn without new keys")
        self.directions[end], self.next[end], self.confirmed[end] = Direction(self.next[end]), None, False

    def confirmation(self, end, told):
        if not told:
            require(end == "manager" and all(self.confirmed.values()), "an acknowledgement of nothing")
            return "acknowledgement"
        key = blake2s(self.ENDS[end], self.binding, key=self.fresh[end])
        generation = len(self.datagram_keys[end])
        require(not self.confirmed[end] and told == bytes([generation & 255]) + key, "another confirmation")
        self.datagram_keys[end][generation & 255] = key
        self.confirmed[end] = True
        return {"confirm": generation}

    def datagram(self, end, data):
        """A session datagram; what it says."""
        header, generation, number = data[:DATAGRAM_HEADER], data[24], data[25:33]
        version = bytes([wire.VERSION])
        require(header[:8] == MAGIC + version + b"\3" + version + b"\0" and header[14:16] == b"\0\0", "another header")
        require(generation in self.datagram_keys[end], "a datagram of no known key")
        further = (bytes([len(header), generation]) + number + header).ljust(58, b"\0")
        key, number = self.datagram_keys[end][generation], struct.unpack("<Q", number)[0]
        body = open_sealed(key, number, further, data[33:])
        self.once(key, number)
        return wire.decode_session_body(body)

    def once(self, key, number):
        require((key, number) not in self.nonces, "a number comes back")
        self.nonces.add((key, number))
