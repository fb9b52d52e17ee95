"""CARA's wire format, version 1, in Python: written from docs/wire.md alone, standard library only.

Each `decode_…` takes bytes and returns plain values, or raises Malformed; each `encode_…` is its inverse. `Link` takes a
stream apart. Nothing here opens a socket.
"""

import struct

MAGIC = b"CARp"
VERSION = 1
PORT = 21970
PRIORITIES = ["emergency", "high", "normal", "low"]
ROLES = ["m_unit", "s_unit"]
TYPES = ["int", "float", "string", "bool", "bytes"]
FIXED = ("int", "float", "bool")
NAME_CHARACTERS = frozenset(b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789_-./")
EMERGENCY_BYTES = 256
MINIMUM_CHUNK = 320
LEAST_MESSAGE = 512
REQUEST_BYTES = 32


class Malformed(Exception):
    """Bytes that the format does not allow."""


class Oversize(Malformed):
    """More than the receiver takes."""


def require(condition):
    if not condition:
        raise Malformed()


# --- varints and the like (section 1)


class Reader:
    def __init__(self, data):
        self.data = data
        self.at = 0

    def take(self, count):
        end = self.at + count
        require(end <= len(self.data))
        piece = self.data[self.at : end]
        self.at = end
        return piece

    def u8(self):
        return self.take(1)[0]

    def fixed(self, form):
        return struct.unpack("<" + form, self.take(struct.calcsize("<" + form)))

    def varint(self, bits):
        number = 0
        for place in range((bits + 6) // 7):
            byte = self.u8()
            number |= (byte & 0x7F) << (7 * place)
            if byte < 0x80:
                require(number >> bits == 0)
                return number
        raise Malformed()

    def boolean(self):
        byte = self.u8()
        require(byte <= 1)
        return byte == 1

    def sized(self):
        return self.take(self.varint(64))

    def text(self, longest):
        data = self.sized()
        require(len(data) <= longest)
        return text_of(data)

    def rest(self):
        return self.take(len(self.data) - self.at)

    def end(self):
        require(self.at == len(self.data))


def text_of(data):
    try:
        return bytes(data).decode("utf-8")
    except UnicodeDecodeError:
        raise Malformed() from None


def varint(number):
    out = bytearray()
    while number >= 0x80:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


def sized(data):
    return varint(len(data)) + data


# Characters that are not seen, which no node's name may have.
UNSEEN = (
    (0x00, 0x1F), (0x7F, 0x9F), (0xAD, 0xAD), (0x61C, 0x61C), (0x200B, 0x200F), (0x2028, 0x202E),
    (0x2060, 0x2064), (0x2066, 0x206F), (0xFEFF, 0xFEFF), (0xE0000, 0xE007F),
)


def is_node_name(name):
    """Not empty, and all of it is seen."""
    return name != "" and not any(first <= ord(c) <= last for c in name for first, last in UNSEEN)


def read_identity(reader):
    identity = {"id": reader.varint(32), "name": reader.text(32)}
    role = reader.varint(32)
    require(role < len(ROLES) and is_node_name(identity["name"]))
    identity["role"] = ROLES[role]
    return identity


def write_identity(identity):
    role = ROLES.index(identity["role"])
    return varint(identity["id"]) + sized(identity["name"].encode()) + varint(role)


def read_manager(reader):
    if not reader.boolean():
        return None
    return {"name": reader.text(32), "id": reader.varint(32)}


def write_manager(manager):
    if manager is None:
        return b"\0"
    return b"\1" + sized(manager["name"].encode()) + varint(manager["id"])


def short_hash(identity):
    data = bytes([ROLES.index(identity["role"])]) + struct.pack("<I", identity["id"]) + identity["name"].encode()
    number = 0x811C9DC5
    for byte in data:
        number = (number ^ byte) * 0x01000193 % 2**32
    return number


# --- the hello (section 7)

HELLO_TAIL = [
    ("epoch", 64), ("nonce", 64), ("term", 32), ("capabilities", 32), ("message_size", 32), ("chunk_size", 16),
    ("calls", 16), ("minimum_interval", 32), ("link", 16), ("udp_port", 16), ("stamp", 64), ("keep_alive", 32),
]


def decode_hello(data):
    reader = Reader(data)
    magic = reader.take(4)
    version = reader.u8()
    require(magic == MAGIC)
    if version != VERSION:
        return {"other_version": version}
    hello = {"fleet": reader.varint(32), "identity": read_identity(reader), "wanted": read_manager(reader)}
    for name, bits in HELLO_TAIL:
        hello[name] = reader.varint(bits)
    reader.end()
    require(is_node_name(hello["identity"]["name"]) and hello["chunk_size"] >= MINIMUM_CHUNK)
    return hello


def encode_hello(hello):
    head = MAGIC + bytes([VERSION]) + varint(hello["fleet"])
    head += write_identity(hello["identity"]) + write_manager(hello["wanted"])
    return head + b"".join(varint(hello[name]) for name, _ in HELLO_TAIL)


# --- datagrams (section 3)


def decode_datagram(data, fleet):
    require(len(data) >= 12)
    reader = Reader(data)
    magic, version, kind, zero, theirs = reader.fixed("4sBBHI")
    require(magic == MAGIC)
    if version != VERSION:
        return {"other_version": version}
    if theirs != fleet:
        return {"other_fleet": theirs}
    require(zero == 0)
    if kind == 1:
        return {"who_has": read_who_has(reader)}
    if kind == 2:
        return {"announce": read_announce(reader)}
    require(kind == 3)
    link, zero, nonce = reader.fixed("HHQ")
    require(zero == 0)
    return {"session": {"link": link, "nonce": nonce, "body": decode_session_body(reader.rest())}}


def encode_datagram(datagram, fleet):
    (name, value), = datagram.items()
    kind = ["who_has", "announce", "session"].index(name) + 1
    head = MAGIC + struct.pack("<BBHI", VERSION, kind, 0, fleet)
    if name == "session":
        return head + struct.pack("<HHQ", value["link"], 0, value["nonce"]) + encode_session_body(value["body"])
    body = write_identity(value["identity"])
    body += varint(value["epoch"]) + varint(value["sequence"]) + varint(value["nonce"])
    if name == "who_has":
        known = b"".join(varint(item) for item in value["known"])
        body += write_manager(value["wanted"]) + varint(value["tcp_port"]) + varint(value["expected"])
        return head + body + varint(len(value["known"])) + known
    return head + body + varint(value["tcp_port"]) + varint(value["room"]) + varint(value["expected"])


def read_who_has(reader):
    search = {"identity": read_identity(reader), "epoch": reader.varint(64), "sequence": reader.varint(32)}
    search.update(nonce=reader.varint(64), wanted=read_manager(reader))
    search.update(tcp_port=reader.varint(16), expected=reader.varint(16))
    count = reader.varint(64)
    require(count <= 64)
    search["known"] = [reader.varint(32) for _ in range(count)]
    reader.end()
    return search


def read_announce(reader):
    answer = {"identity": read_identity(reader), "epoch": reader.varint(64), "sequence": reader.varint(32)}
    answer.update(nonce=reader.varint(64), tcp_port=reader.varint(16))
    answer.update(room=reader.varint(16), expected=reader.varint(16))
    reader.end()
    return answer


# --- messages (section 9)

# code: (name, names of what travels in index, first and second)
ERRORS = {
    1: ("unknown_function", ()), 2: ("stale_function", ()), 3: ("missing_argument", ("index",)),
    4: ("wrong_type", ("index",)), 5: ("wrong_size", ("index", "expected", "found")), 6: ("expired", ()),
    7: ("stale", ()), 8: ("busy", ()), 9: ("malformed", ()), 10: ("not_allowed", ()), 11: ("would_deadlock", ()),
    12: ("too_large", ("limit",)), 13: ("too_soon", ("wait",)), 14: ("result_would_not_fit", ("need", "have")),
    15: ("result_lost", ()),
    20: ("service_failed", ("code",)), 21: ("service_panicked", ()), 22: ("service_not_ready", ()),
    23: ("service_bad_results", ()),
}

# name: fields and their encodings
CONTROLS = [
    ("publish", [("slot", 16), ("generation", 16), ("attributes", "u8[8]"), ("signature", "bytes")]),
    ("withdraw", [("slot", 16)]),
    ("list_end", [("serial", 32)]),
    ("list_ack", [("serial", 32), ("skipped", 16)]),
    ("limits", [("message_size", 32), ("minimum_interval", 32), ("calls", 16)]),
    ("lease_ended", [("call", 32), ("why", "lease_end")]),
]
LEASE_ENDS = ["finished", "expired", "replaced"]


def decode_message(data):
    require(len(data) > 0)
    kind = data[0]
    if kind == 1:
        return {"request": read_request(Reader(data))}
    if kind == 2:
        return {"reply": read_answer(Reader(data))}
    if kind == 3:
        return read_control(Reader(data[1:]))
    require(kind == 4)
    failure = read_answer(Reader(data))
    require("error" in failure)
    return {"failure": failure}


def encode_message(message):
    (name, value), = message.items()
    if name == "request":
        flags = 1 if value["wants_reply"] else 0
        numbers = (value["id"], value["remaining"], value["stamp"], value["since"], 0)
        head = struct.pack("<BBHHHIIQII", 1, flags, value["slot"], value["generation"], 0, *numbers)
        return head + bytes.fromhex(value["block"])
    if name in ("reply", "failure"):
        return write_answer(2 if name == "reply" else 4, value)
    return write_control(name, value)


def read_request(reader):
    form = "BBHHHIIQII"
    _, flags, slot, generation, zero, number, remaining, stamp, since, zero_too = reader.fixed(form)
    require(flags <= 1 and zero == 0 and zero_too == 0)
    return {
        "id": number, "slot": slot, "generation": generation, "wants_reply": flags == 1, "remaining": remaining,
        "stamp": stamp, "since": since, "block": reader.rest().hex(),
    }


def read_answer(reader):
    _, code, index, zero, number, first, second = reader.fixed("BBBBIII")
    require(zero == 0)
    if code == 0:
        return {"id": number, "block": reader.rest().hex()}
    reader.end()
    name, fields = ERRORS.get(code, ("malformed", ()))
    if not fields:
        return {"id": number, "error": name}
    values = {"index": index} if fields[0] == "index" else {}
    values.update(zip([field for field in fields if field != "index"], (first, second)))
    if name == "service_failed":
        values["code"] &= 0xFFFF
    return {"id": number, "error": {name: values}}


def write_answer(kind, value):
    if "block" in value:
        return struct.pack("<BBBBIII", kind, 0, 0, 0, value["id"], 0, 0) + bytes.fromhex(value["block"])
    error = value["error"]
    name, fields = next(iter(error.items())) if isinstance(error, dict) else (error, {})
    code = next(code for code, (known, _) in ERRORS.items() if known == name)
    numbers = [fields[field] for field in ERRORS[code][1] if field != "index"] + [0, 0]
    return struct.pack("<BBBBIII", kind, code, fields.get("index", 0), 0, value["id"], *numbers[:2])


def read_control(reader):
    number = reader.varint(32)
    require(number < len(CONTROLS))
    name, fields = CONTROLS[number]
    value = {}
    for field, encoding in fields:
        if encoding == "u8[8]":
            value[field] = reader.take(8).hex()
        elif encoding == "bytes":
            value[field] = reader.sized().hex()
        elif encoding == "lease_end":
            number = reader.varint(32)
            require(number < len(LEASE_ENDS))
            value[field] = LEASE_ENDS[number]
        else:
            value[field] = reader.varint(encoding)
    reader.end()
    return {name: value}


def write_control(name, value):
    number = [known for known, _ in CONTROLS].index(name)
    out = b"\3" + varint(number)
    for field, encoding in CONTROLS[number][1]:
        if encoding == "u8[8]":
            out += bytes.fromhex(value[field])
        elif encoding == "bytes":
            out += sized(bytes.fromhex(value[field]))
        elif encoding == "lease_end":
            out += varint(LEASE_ENDS.index(value[field]))
        else:
            out += varint(int(value[field]))
    return out


# --- functions and values (section 10)


def decode_signature(data):
    require(len(data) <= 384)
    reader = Reader(data)
    name = read_name(reader, reader.u8())
    arguments = read_variables(reader)
    results = read_variables(reader)
    reader.end()
    known = {variable["name"]: variable for variable in arguments}
    require(all(known.get(variable["name"], variable) == variable for variable in results))
    require(len(known.keys() | {variable["name"] for variable in results}) <= 16)
    return {"name": name, "arguments": arguments, "results": results, "text": text_form(name, arguments, results)}


def encode_signature(signature):
    name = signature["name"].encode()
    out = bytes([len(name)]) + name
    for variables in (signature["arguments"], signature["results"]):
        out += bytes([len(variables)])
        for variable in variables:
            name = variable["name"].encode()
            out += struct.pack("<BBI", TYPES.index(variable["type"]), len(name), variable["size"]) + name
    return out


def read_name(reader, length):
    name = reader.take(length)
    require(1 <= length <= 32 and all(byte in NAME_CHARACTERS for byte in name))
    return bytes(name).decode("ascii")


def read_variables(reader):
    variables = []
    for _ in range(reader.u8()):
        kind, length, size = reader.fixed("BBI")
        require(kind < len(TYPES))
        variables.append({"name": read_name(reader, length), "type": TYPES[kind], "size": size})
    require(len({variable["name"] for variable in variables}) == len(variables))
    return variables


def text_form(name, arguments, results):
    def one(variable):
        short = variable["type"] in FIXED and variable["size"] == 1
        return variable["name"] + ": " + variable["type"] + ("" if short else "[%d]" % variable["size"])

    text = name + "(" + ", ".join(map(one, arguments)) + ")"
    return text + " -> (" + ", ".join(map(one, results)) + ")" if results else text


def decode_attributes(data):
    require(len(data) == 8)
    flags, zeros, lease = struct.unpack("<B3sI", data)
    require(flags < 8 and zeros == b"\0\0\0")
    return {"priority": PRIORITIES[flags & 3], "idempotent": flags & 4 != 0, "lease": lease or None}


def encode_attributes(attributes):
    """Those that are left out have their defaults."""
    flags = PRIORITIES.index(attributes.get("priority", "normal")) | (4 if attributes.get("idempotent") else 0)
    return struct.pack("<B3sI", flags, b"\0\0\0", attributes.get("lease") or 0)


def decode_block(data, variables):
    reader = Reader(data)
    values = {variable["name"]: read_value(reader, variable["type"], variable["size"]) for variable in variables}
    reader.end()
    return values


def read_value(reader, kind, size):
    if kind in FIXED:
        data = reader.take(size * (1 if kind == "bool" else 8))
    else:
        length, = reader.fixed("Q")
        require(length <= size)
        data = reader.take(length)
    require(not any(reader.take(-len(data) % 8)))
    if kind == "int":
        return list(struct.unpack("<%dq" % size, data))
    if kind == "float":
        return ["%016x" % bits for bits in struct.unpack("<%dQ" % size, data)]
    if kind == "bool":
        require(all(byte <= 1 for byte in data))
        return [byte == 1 for byte in data]
    return text_of(data) if kind == "string" else data.hex()


def encode_block(values, variables):
    return b"".join(write_value(values[variable["name"]], variable["type"]) for variable in variables)


def write_value(value, kind):
    head = b""
    if kind == "int":
        data = struct.pack("<%dq" % len(value), *value)
    elif kind == "float":
        data = struct.pack("<%dQ" % len(value), *(int(bits, 16) for bits in value))
    elif kind == "bool":
        data = bytes(value)
    else:
        data = value.encode() if kind == "string" else bytes.fromhex(value)
        head = struct.pack("<Q", len(data))
    return head + data + bytes(-len(data) % 8)


# --- session bodies (section 14)


def decode_session_body(data):
    require(len(data) > 0)
    reader = Reader(data)
    kind = reader.u8()
    if kind == 1:
        stamp, = reader.fixed("Q")
        body = {"keep_alive": {"stamp": stamp}}
    elif kind == 2:
        priority, call, stamp, since = reader.fixed("BIQI")
        require(priority < len(PRIORITIES))
        body = {"renew": {"class": PRIORITIES[priority], "call": call, "stamp": stamp, "since": since}}
    elif kind == 6:
        priority, call = reader.fixed("BI")
        require(priority < len(PRIORITIES))
        body = {"release": {"class": PRIORITIES[priority], "call": call}}
    elif kind == 7:
        slot, call = reader.fixed("HI")
        body = {"release_all": {"slot": slot, "call": call}}
    elif kind in (4, 5):
        body = {"ping" if kind == 4 else "pong": {}}
    else:
        require(kind == 3)
        priority = reader.u8()
        require(priority < len(PRIORITIES))
        body = {"message": {"priority": PRIORITIES[priority], "message": decode_message(reader.rest())}}
    reader.end()
    return body


def encode_session_body(body):
    (name, value), = body.items()
    if name == "keep_alive":
        return struct.pack("<BQ", 1, value["stamp"])
    if name in ("ping", "pong"):
        return bytes([4 if name == "ping" else 5])
    if name == "renew":
        return struct.pack("<BBIQI", 2, PRIORITIES.index(value["class"]), value["call"], value["stamp"], value["since"])
    if name == "release":
        return struct.pack("<BBI", 6, PRIORITIES.index(value["class"]), value["call"])
    if name == "release_all":
        return struct.pack("<BHI", 7, value["slot"], value["call"])
    return bytes([3, PRIORITIES.index(value["priority"])]) + encode_message(value["message"])


# --- frames and chunks (sections 5 and 6)

FRAMES = {"hello": 1, "refuse": 2, "close": 3, "ping": 4, "pong": 5, "session": 6}


def encode_frame(name, payload=b""):
    return struct.pack("<HB", len(payload) + 1, FRAMES[name]) + payload


def encode_chunks(priority, message, limit):
    """A message as the frames that carry it, each with a body of at most `limit` bytes."""
    code = PRIORITIES.index(priority)
    frames, at = [], 0
    while True:
        head = struct.pack("<I", len(message)) if at == 0 else b""
        piece = message[at : at + limit - 2 - len(head)]
        first = 1 if at == 0 else 0
        at += len(piece)
        last = 2 if at == len(message) else 0
        body = bytes([0x10 | first | last, code]) + head + piece
        frames.append(struct.pack("<H", len(body)) + body)
        if last:
            return frames


class Link:
    """One direction of a stream: bytes in, frames and whole messages out, and the limits of who reads."""

    def __init__(self, chunk_limit, message_limit):
        self.chunk_limit = chunk_limit
        self.message_limit = message_limit
        self.buffer = b""
        self.assembly = None

    def receive(self, data):
        """What the bytes complete; raises Malformed or Oversize where the link must end."""
        self.buffer += data
        while len(self.buffer) >= 2:
            length, = struct.unpack_from("<H", self.buffer)
            if length > self.chunk_limit:
                raise Oversize()
            if len(self.buffer) < 2 + length:
                return
            body, self.buffer = self.buffer[2 : 2 + length], self.buffer[2 + length :]
            incoming = self.frame(body)
            if incoming is not None:
                yield incoming

    def frame(self, body):
        require(len(body) > 0)
        kind, payload = body[0], body[1:]
        if kind & ~3 == 0x10:
            return self.chunk(kind, body)
        if kind in (FRAMES["refuse"], FRAMES["close"]):
            require(len(payload) == 1)
            return {"refuse" if kind == FRAMES["refuse"] else "close": payload[0]}
        if kind in (FRAMES["ping"], FRAMES["pong"]):
            require(len(payload) == 0)
            return "ping" if kind == FRAMES["ping"] else "pong"
        if kind == FRAMES["hello"]:
            return {"hello": readable(decode_hello, payload)}
        require(kind == FRAMES["session"])
        return {"session": readable(decode_session_body, payload)}

    def chunk(self, kind, body):
        first, last = kind & 1 != 0, kind & 2 != 0
        reader = Reader(body)
        reader.u8()
        priority = reader.u8()
        require(priority < len(PRIORITIES))
        total = reader.fixed("I")[0] if first else None
        piece = reader.rest()
        require(PRIORITIES[priority] != "emergency" or (first and last))
        require(last or len(body) >= MINIMUM_CHUNK)
        if first and last:
            self.check_total(total)
            require(len(piece) == total)
            return self.message(priority, piece)
        if first:
            require(self.assembly is None)
            self.check_total(total)
            require(len(piece) < total)
            self.assembly = (priority, total, piece)
            return None
        require(self.assembly is not None)
        known, total, before = self.assembly
        whole = before + piece
        require(priority == known and len(whole) <= total and last == (len(whole) == total))
        self.assembly = None if last else (priority, total, whole)
        return self.message(priority, whole) if last else None

    def check_total(self, total):
        if total > self.message_limit:
            raise Oversize()

    @staticmethod
    def message(priority, data):
        return {"priority": PRIORITIES[priority], "message": decode_message(data)}


def readable(decode, data):
    """An unreadable hello is refused, and an unreadable session body dropped: neither is the link's matter."""
    try:
        return decode(data)
    except Malformed:
        return {"unreadable": data.hex()}
