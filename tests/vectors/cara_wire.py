"""CARA's wire format, version 2, in Python: written from docs/wire.md alone, standard library only.

Each `decode_…` takes bytes and returns plain values, or raises Malformed; each `encode_…` is its inverse. `Link` takes a
stream apart. Nothing here opens a socket.
"""

import struct

MAGIC = b"CARp"
# That of every link, and what this end speaks.
VERSION = 2
VERSIONS = [VERSION, VERSION]
PORT = 21970
PRIORITIES = ["emergency", "high", "normal", "low"]
ROLES = ["m_unit", "s_unit"]
TYPES = ["int", "float", "string", "bool", "bytes", "list", "record"]
DEPTH = 8
FIXED = ("int", "float", "bool")
NAME_CHARACTERS = frozenset(b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789_-./")
EMERGENCY_BYTES = 256
MINIMUM_CHUNK = 320
LEAST_MESSAGE = 512
REQUEST_BYTES = 32
LONGEST_HEADER = 64
REPLY_BYTES = 16
SAMPLE_BYTES = 16
MUST_UNDERSTAND = 0x8000


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


# --- items (section 1)


def items_of(data):
    """The items of a list: (kind, body) of each."""
    reader, items = Reader(data), []
    while reader.at < len(data):
        kind, length = reader.fixed("HH")
        body = reader.take(length)
        reader.take(-length % 4)
        if kind != 0:
            items.append((kind, body))
    return items


def item(kind, body):
    return struct.pack("<HH", kind, len(body)) + body + bytes(-len(body) % 4)


CLAIM = [("term", 64), ("claimant", 64), ("tag", "tag"), ("since", 32)]
# kind: (name, fields and their encodings)
ITEMS = {
    1: ("unit", [("id", 32), ("name", "name"), ("role", "role"), ("epoch", 64)]),
    2: ("wanted", [("name", "name"), ("id", 32)]),
    3: ("link", [("nonce", 64), ("link", 16), ("udp_port", 16), ("stamp", 64), ("keep_alive", 32)]),
    4: ("limits", [("message_size", 32), ("chunk_size", 16), ("calls", 16), ("minimum_interval", 32)]),
    5: ("search", [("sequence", 32), ("nonce", 64), ("tcp_port", 16), ("expected", 16)]),
    6: ("known", None),
    7: ("answer", [("sequence", 32), ("nonce", 64), ("tcp_port", 16), ("room", 16), ("expected", 16)]),
    8: ("claim", CLAIM),
    9: ("obeyed", CLAIM),
    10: ("standby", []),
}
HELLO_ITEMS = ("unit", "wanted", "link", "limits", "claim", "obeyed")
WHO_HAS_ITEMS = ("unit", "wanted", "search", "known", "standby")
ANNOUNCE_ITEMS = ("unit", "answer", "claim", "obeyed")


def read_fields(reader, fields):
    """What follows them is of a later version."""
    value = {}
    for name, encoding in fields:
        if encoding == "name":
            value[name] = reader.text(32)
        elif encoding == "role":
            value[name] = one_of(ROLES, reader.u8())
        elif encoding == "lease_end":
            why = reader.varint(32)
            value[name] = LEASE_ENDS[why] if why < len(LEASE_ENDS) else "expired"
        elif encoding == "refusal":
            refusal = reader.varint(32)
            value[name] = REFUSALS[refusal] if refusal < len(REFUSALS) else "unknown"
        elif encoding == "stays":
            value[name] = min(reader.varint(32), 6)
        elif encoding == "latch":
            reason, by = reader.varint(32), reader.varint(32)
            value[name] = {"by": by, "reason": min(reason - 1, 0xFFFF)} if reason else None
        elif encoding == "order":
            how, holder, link, call = (reader.varint(32) for _ in range(4))
            end = None if how < 2 else LEASE_ENDS[how - 2] if how - 2 < len(LEASE_ENDS) else "expired"
            order = {"holder": holder, "link": link, "call": call, "claim": [reader.varint(64), reader.varint(64)], "end": end}
            value[name] = order if how else None
        elif encoding == "tag":
            value[name] = reader.fixed("16s")[0].hex()
        elif encoding == "bytes":
            value[name] = reader.sized().hex()
        else:
            value[name] = reader.varint(encoding)
    return value


def write_fields(value, fields):
    out = b""
    for name, encoding in fields:
        if encoding == "name":
            out += sized(value[name].encode())
        elif encoding == "role":
            out += bytes([ROLES.index(value[name])])
        elif encoding == "lease_end":
            out += varint(LEASE_ENDS.index(value[name]))
        elif encoding == "refusal":
            out += varint(REFUSALS.index(value[name]))
        elif encoding == "latch":
            latch = value[name] or {"by": 0, "reason": -1}
            out += varint(latch["reason"] + 1) + varint(latch["by"])
        elif encoding == "order":
            order = value[name] or {"holder": 0, "link": 0, "call": 0, "claim": [0, 0], "end": None}
            how = LEASE_ENDS.index(order["end"]) + 2 if order["end"] else int(value[name] is not None)
            out += b"".join(varint(number) for number in (how, order["holder"], order["link"], order["call"], *order["claim"]))
        elif encoding == "tag":
            out += bytes.fromhex(value[name])
        elif encoding == "bytes":
            out += sized(bytes.fromhex(value[name]))
        else:
            out += varint(int(value[name]))
    return out


def one_of(names, number):
    require(number < len(names))
    return names[number]


def passed_over(kind):
    """An unknown kind may be passed over, unless it must be understood."""
    require(kind & MUST_UNDERSTAND == 0)
    return 1


def read_items(data, wanted, needed):
    """The items of these names, the last one of each, and how many others there were."""
    found, skipped = {"skipped": 0}, 0
    for kind, body in items_of(data):
        name, fields = ITEMS.get(kind, (None, None))
        if name not in wanted:
            skipped += passed_over(kind)
        elif name == "known":
            require(len(body) % 4 == 0)
            found[name] = list(struct.unpack("<%dI" % (len(body) // 4), body))[:64]
        else:
            found[name] = read_fields(Reader(body), fields)
    require(all(name in found for name in needed))
    require(is_node_name(found["unit"]["name"]))
    found["skipped"] = skipped
    found["claims"] = {name: found.get(name) for name in ("claim", "obeyed")}
    found["identity"] = {name: found["unit"][name] for name in ("id", "name", "role")}
    return found


def write_items(value, names):
    """The items of a value in which all fields stand side by side."""
    out = b""
    for kind, (name, fields) in ITEMS.items():
        if name not in names:
            continue
        if name == "unit":
            out += item(kind, write_fields({**value, **value["identity"]}, fields))
        elif name in ("claim", "obeyed", "wanted"):
            out += item(kind, write_fields(value[name], fields)) if value.get(name) else b""
        elif name == "standby":
            out += item(kind, b"") if value.get(name) else b""
        elif name == "known":
            out += item(kind, struct.pack("<%dI" % len(value[name]), *value[name])) if value[name] else b""
        else:
            out += item(kind, write_fields(value, fields))
    return out


# --- versions (section 1)


def versions_of(first, last):
    return [first, first if first <= 1 or last < first else last]


def in_common(theirs):
    """The highest version that both speak, None without one."""
    last = min(theirs[1], VERSIONS[1])
    return last if last >= max(theirs[0], VERSIONS[0]) else None


def short_hash(identity):
    data = bytes([ROLES.index(identity["role"])]) + struct.pack("<I", identity["id"]) + identity["name"].encode()
    number = 0x811C9DC5
    for byte in data:
        number = (number ^ byte) * 0x01000193 % 2**32
    return number


def rank(claim):
    """By which claims are compared; below all others without one."""
    return (claim["term"], claim["claimant"]) if claim else (0, 0)


# --- the hello (section 7)


def decode_hello(data, magic=MAGIC, suites=0):
    """A hello of this mode, by default the plain one; `suites` are those of which one must be in it."""
    reader = Reader(data)
    theirs, first, last, their_suites, fleet, capabilities = reader.fixed("4sBBHIQ")
    require(theirs == magic)
    versions = versions_of(first, last)
    if in_common(versions) is None:
        return {"other_versions": versions}
    require(suites == 0 or their_suites & suites != 0)
    found = read_items(reader.rest(), HELLO_ITEMS, ("unit", "link", "limits"))
    require(found["limits"]["chunk_size"] >= MINIMUM_CHUNK)
    return {
        "versions": versions, "capabilities": capabilities, "fleet": fleet, "identity": found["identity"],
        "wanted": found.get("wanted"), "epoch": found["unit"]["epoch"], **found["claims"],
        **found["link"], **found["limits"],
        "skipped": found["skipped"],
    }


def encode_hello(hello, magic=MAGIC, suites=0):
    first, last = hello["versions"]
    head = struct.pack("<4sBBHIQ", magic, first, last, suites, hello["fleet"], hello["capabilities"])
    return head + write_items(hello, HELLO_ITEMS)


# --- datagrams (section 3)


def decode_datagram(data, fleet, magic=MAGIC, codes=0):
    """A datagram of this mode, by default the plain one, without the codes behind it; `codes` is how many these were."""
    require(len(data) >= 12)
    reader = Reader(data)
    their_magic, first, kind, last, their_codes, theirs = reader.fixed("4sBBBBI")
    require(their_magic == magic)
    versions = versions_of(first, last)
    if in_common(versions) is None:
        return {"other_versions": versions}
    if theirs != fleet:
        return {"other_fleet": theirs}
    if kind == 3:
        link, _, nonce = reader.fixed("HHQ")
        return {"session": {"link": link, "nonce": nonce, "body": decode_session_body(reader.rest())}}
    require(their_codes == codes)
    if kind == 1:
        return {"who_has": read_datagram(reader.rest(), WHO_HAS_ITEMS, "search")}
    require(kind == 2)
    return {"announce": read_datagram(reader.rest(), ANNOUNCE_ITEMS, "answer")}


def read_datagram(data, items, own):
    found = read_items(data, items, ("unit", own))
    value = {"identity": found["identity"], "epoch": found["unit"]["epoch"], **found[own], "skipped": found["skipped"]}
    if own == "search":
        value.update(wanted=found.get("wanted"), known=found.get("known", []), standby="standby" in found)
    else:
        value.update(found["claims"])
    return value


def encode_datagram(datagram, fleet, magic=MAGIC, codes=0):
    (name, value), = datagram.items()
    if name == "session":
        return session_header(value["link"], value["nonce"], fleet, magic) + encode_session_body(value["body"])
    kind, items = (1, WHO_HAS_ITEMS) if name == "who_has" else (2, ANNOUNCE_ITEMS)
    return struct.pack("<4sBBBBI", magic, VERSIONS[0], kind, VERSIONS[1], codes, fleet) + write_items(value, items)


def session_header(link, nonce, fleet, magic=MAGIC):
    return struct.pack("<4sBBBBIHHQ", magic, VERSION, 3, VERSION, 0, fleet, link, 0, nonce)


# --- messages (section 9)


class Window:
    """The newest number, and which of the 64 up to it have come: each counts once (sections 12 and 17)."""

    def __init__(self):
        self.newest, self.seen = 0, set()

    def is_behind(self, number):
        return number + 64 <= self.newest

    def note(self, number):
        self.newest = max(self.newest, number)
        self.seen = {each for each in self.seen | {number} if not self.is_behind(each)}


# code: (name, names of what travels in index, first and second)
ERRORS = {
    1: ("unknown_function", ()), 2: ("stale_function", ()), 3: ("missing_argument", ("index",)),
    4: ("wrong_type", ("index",)), 5: ("wrong_size", ("index", "expected", "found")), 6: ("expired", ()),
    7: ("stale", ()), 8: ("busy", ()), 9: ("malformed", ()), 10: ("not_allowed", ()), 11: ("would_deadlock", ()),
    12: ("too_large", ("limit",)), 13: ("too_soon", ("wait",)), 14: ("result_would_not_fit", ("need", "have")),
    15: ("result_lost", ()), 16: ("unsupported", ()), 17: ("held", ("by", "operator")), 18: ("inhibited", ("by", "reason")), 19: ("replaced", ()),
    20: ("service_failed", ("code",)), 21: ("service_panicked", ()), 22: ("service_not_ready", ()),
    23: ("service_bad_results", ()),
}

# kind of the item: (name, fields and their encodings)
CONTROLS = {
    1: ("publish", [("slot", 16), ("generation", 16), ("attributes", "bytes"), ("signature", "bytes")]),
    2: ("withdraw", [("slot", 16)]),
    3: ("list_end", [("serial", 32)]),
    4: ("list_ack", [("serial", 32), ("skipped", 16)]),
    5: ("limits", [("message_size", 32), ("minimum_interval", 32), ("calls", 16)]),
    6: ("lease_ended", [("call", 32), ("why", "lease_end")]),
    7: ("actuator", [("slot", 16), ("latch", "latch"), ("last", "order")]),
    8: ("subscribe", [("slot", 16), ("generation", 16), ("interval", 32)]),
    9: ("subscribed", [("slot", 16), ("generation", 16), ("interval", 32), ("bytes", 32), ("refusal", "refusal")]),
    10: ("claimed", CLAIM),
    11: ("hand_over", [("name", "bytes"), ("id", 32)]),
    12: ("handed_over", [("refusal", "stays")]),
}
# Behind one of these nothing follows in a message.
LAST_ITEMS = ("list_end", "list_ack", "lease_ended", "actuator", "subscribed", "handed_over")
REFUSALS = ["none", "unknown", "not_allowed", "full"]
LEASE_ENDS = ["finished", "expired", "replaced", "stopped", "released"]


def decode_message(data):
    require(len(data) > 0)
    kind = data[0]
    if kind == 1:
        return {"request": read_request(Reader(data))}
    if kind == 2:
        return {"reply": read_answer(Reader(data))}
    if kind == 3:
        require(len(data) >= 4)
        return {"control": [read_control(*each) for each in items_of(data[4:])]}
    if kind == 5:
        _, _, _, words, number = Reader(data[:8]).fixed("BBBBI")
        require(words >= 2)
        reader = Reader(data)
        reader.take(4 * words)
        return {"progress": {"id": number, "block": reader.rest().hex()}}
    if kind == 6:
        return {"sample": read_sample(Reader(data))}
    require(kind == 4)
    failure = read_answer(Reader(data))
    require("error" in failure)
    return {"failure": failure}


def encode_message(message):
    (name, value), = message.items()
    if name == "request":
        flags = value["unknown"] | (1 if value["wants_reply"] else 0) | (16 if value.get("takes_over") else 0)
        flags |= (2 if value.get("wants_progress") else 0) | (4 if value.get("operator") else 0)
        numbers = (value["id"], value["remaining"], value["stamp"], value["since"], value["number"])
        place = (value["slot"], value["generation"], REQUEST_BYTES // 4, 0)
        return struct.pack("<BBHHBBIIQII", 1, flags, *place, *numbers) + bytes.fromhex(value["block"])
    if name in ("reply", "failure"):
        return write_answer(2 if name == "reply" else 4, value)
    if name == "progress":
        return struct.pack("<BBBBI", 5, 0, 0, 2, value["id"]) + bytes.fromhex(value["block"])
    if name == "sample":
        head = struct.pack("<BBHHBBq", 6, 0, value["slot"], value["generation"], SAMPLE_BYTES // 4, 0, value["made"])
        return head + bytes.fromhex(value["block"])
    return bytes([3, 0, 0, 0]) + b"".join(write_control(*told) for each in value for told in each.items())


def behind_header(reader, words, least):
    """The block, behind a header that says its length in words."""
    require(4 * words >= least)
    reader.take(4 * words - least)
    return reader.rest().hex()


def read_request(reader):
    form = "BBHHBBIIQII"
    _, flags, slot, generation, words, _, number, remaining, stamp, since, made = reader.fixed(form)
    return {
        "id": number, "slot": slot, "generation": generation, "wants_reply": flags & 1 == 1,
        "wants_progress": flags & 2 != 0,
        "takes_over": flags & 0x10 != 0, "operator": flags & 4 != 0, "unknown": flags & 0xE0,
        "remaining": remaining, "stamp": stamp, "since": since, "number": made,
        "block": behind_header(reader, words, REQUEST_BYTES),
    }


def read_sample(reader):
    _, _, slot, generation, words, _, made = reader.fixed("BBHHBBq")
    block = behind_header(reader, words, SAMPLE_BYTES)
    return {"slot": slot, "generation": generation, "made": made, "block": block}


def read_answer(reader):
    kind, code, index, words, number, first, second = reader.fixed("BBBBIII")
    block = behind_header(reader, words, REPLY_BYTES) if kind == 2 else ""
    if kind == 4 and 4 * words >= REPLY_BYTES:
        block = reader.rest()[4 * words - REPLY_BYTES:].hex()
    if code == 0:
        return {"id": number, "block": block}
    name, fields = ERRORS.get(code, ("malformed", ()))
    if not fields:
        return {"id": number, "error": name}
    values = {"index": index} if fields[0] == "index" else {}
    values.update(zip([field for field in fields if field != "index"], (first, second)))
    for short in ("code", "reason"):
        if short in values:
            values[short] &= 0xFFFF
    if "operator" in values:
        values["operator"] = values["operator"] & 1 == 1
    answer = {"id": number, "error": {name: values}}
    details = read_details(bytes.fromhex(block)) if code == 20 else None
    return {**answer, "details": details} if details else answer


def read_details(data):
    """Text and values of a service that failed; none where they cannot be read."""
    length = int.from_bytes(data[:8], "little")
    end = 8 + (length + 7) // 8 * 8
    if len(data) < 8 or len(data) < end:
        return None
    try:
        return {"text": data[8:8 + length].decode(), "values": data[end:].hex()}
    except UnicodeDecodeError:
        return None


def write_details(details):
    text = details["text"].encode()
    return struct.pack("<Q", len(text)) + text + bytes(-len(text) % 8) + bytes.fromhex(details["values"])


def write_answer(kind, value):
    if "block" in value:
        return struct.pack("<BBBBIII", kind, 0, 0, REPLY_BYTES // 4, value["id"], 0, 0) + bytes.fromhex(value["block"])
    error = value["error"]
    name, fields = next(iter(error.items())) if isinstance(error, dict) else (error, {})
    code = next(code for code, (known, _) in ERRORS.items() if known == name)
    numbers = [fields[field] for field in ERRORS[code][1] if field != "index"] + [0, 0]
    return struct.pack("<BBBBIII", kind, code, fields.get("index", 0), REPLY_BYTES // 4, value["id"], *numbers[:2]) + (
        write_details(value["details"]) if "details" in value else b"")


def read_control(kind, body):
    if kind not in CONTROLS:
        passed_over(kind)
        return {"unknown": {"kind": kind, "body": body.hex()}}
    name, fields = CONTROLS[kind]
    return {name: read_fields(Reader(body), fields)}


def write_control(name, value):
    if name == "unknown":
        return item(value["kind"], bytes.fromhex(value["body"]))
    (kind, fields), = [(kind, fields) for kind, (known, fields) in CONTROLS.items() if known == name]
    return item(kind, write_fields(value, fields))


# --- functions and values (section 10)


# Behind the results: the name of each, and the word in the text form.
SECTIONS = {1: ("progress", "progress"), 2: ("failure", "fails")}
# Lines for people: number 0 is what the function does, 1 the name of a variable, a blank and its unit.
HELP = 3


def decode_signature(data):
    reader = Reader(data)
    name = read_name(reader, reader.u8())
    arguments = read_variables(reader)
    results = read_variables(reader)
    sections, people, last, end, whole = {}, [], 0, len(data), len(data)
    while reader.at < len(data):
        section = reader.u8()
        require(section > last)
        if section >= HELP > last:
            end = reader.at - 1
        if section > HELP >= last:
            whole = reader.at - 1
        last = section
        if section in SECTIONS:
            sections[SECTIONS[section][0]] = read_variables(reader)
            require(sections[SECTIONS[section][0]])
        else:
            lines = skip_variables(reader)
            people = lines if section == HELP else people
    known = {variable["name"]: variable for variable in arguments}
    require(all(known.get(variable["name"], variable) == variable for variable in results))
    require(len(known.keys() | {variable["name"] for variable in results}) <= 16)
    text = text_form(name, arguments, results, sections)
    require(end <= 1024)
    # Too long with its help, it is kept without.
    people = people if whole <= 1024 else []
    said = {"help": cut(next((text for number, text in people if number == 0), ""), 160)}
    units = [text.split(" ", 1) for number, text in people if number == 1 and " " in text]
    said["units"] = [[variable, cut(unit, 16)] for variable, unit in units]
    said = {key: value for key, value in said.items() if value}
    return {"name": name, "arguments": arguments, "results": results, **sections, **said, "text": text}


def cut(text, most):
    """As much of it as so many bytes of UTF-8 hold."""
    return text.encode()[:most].decode(errors="ignore")


def encode_signature(signature):
    name = signature["name"].encode()
    out = bytes([len(name)]) + name
    lists = [(b"", signature["arguments"]), (b"", signature["results"])]
    lists += [(bytes([number]), signature[key]) for number, (key, _) in SECTIONS.items() if key in signature]
    for before, variables in lists:
        out += before + bytes([len(variables)])
        for variable in variables:
            out += write_variable(variable)
    lines = [(0, signature["help"])] if "help" in signature else []
    lines += [(1, " ".join(unit)) for unit in signature.get("units", [])]
    if lines:
        out += bytes([HELP, len(lines)])
    for number, text in lines:
        text = text.encode()
        out += struct.pack("<BBI", TYPES.index("string"), len(text), number) + text
    return out


def write_variable(variable):
    name = variable["name"].encode()
    return struct.pack("<BBI", TYPES.index(variable["type"]), len(name), variable["size"]) + name + write_inner(variable)


def write_inner(variable):
    """What a list or record is made of."""
    if variable["type"] == "record":
        return b"".join(map(write_variable, variable["fields"]))
    if variable["type"] != "list":
        return b""
    element = variable["element"]
    return struct.pack("<BI", TYPES.index(element["type"]), element["size"]) + write_inner(element)


def read_name(reader, length):
    name = reader.take(length)
    require(1 <= length <= 32 and all(byte in NAME_CHARACTERS for byte in name))
    return bytes(name).decode("ascii")


def read_variables(reader):
    return read_some_variables(reader, reader.u8(), 0)


def read_some_variables(reader, count, depth):
    variables = []
    for _ in range(count):
        kind, length, size = reader.fixed("BBI")
        name = read_name(reader, length)
        variables.append({"name": name, **read_type(reader, kind, size, depth)})
    require(len({variable["name"] for variable in variables}) == len(variables))
    return variables


def skip_variables(reader):
    """The sizes and names of those of a section, of which no more is looked at than how long they are."""
    count, lines = reader.u8(), []
    require(count > 0)
    for _ in range(count):
        kind, length, size = reader.fixed("BBI")
        lines.append((size, text_of(reader.take(length))))
        skip_type(reader, kind, size)
    return lines


def skip_type(reader, kind, size):
    require(kind < len(TYPES))
    if TYPES[kind] == "list":
        skip_type(reader, *reader.fixed("BI"))
    elif TYPES[kind] == "record":
        for _ in range(size):
            field, length, inner = reader.fixed("BBI")
            reader.take(length)
            skip_type(reader, field, inner)


def read_type(reader, kind, size, depth):
    """A type, and what a list or record is made of."""
    require(kind < len(TYPES))
    variable = {"type": TYPES[kind], "size": size}
    if variable["type"] in ("list", "record"):
        require(depth < DEPTH)
    if variable["type"] == "list":
        variable["element"] = read_type(reader, *reader.fixed("BI"), depth + 1)
        require(least(variable["element"]) > 0)
    elif variable["type"] == "record":
        require(1 <= size <= 255)
        variable["fields"] = read_some_variables(reader, size, depth + 1)
    return variable


def least(variable):
    """Bytes of the shortest value in a block."""
    kind, size = variable["type"], variable["size"]
    if kind == "record":
        return sum(map(least, variable["fields"]))
    return -(-size * (1 if kind == "bool" else 8) // 8) * 8 if kind in FIXED else 8


def type_text(variable):
    if variable["type"] == "list":
        return type_text(variable["element"]) + ("?" if variable["size"] == 1 else "[..%d]" % variable["size"])
    if variable["type"] == "record":
        return "{" + ", ".join(field["name"] + ": " + type_text(field) for field in variable["fields"]) + "}"
    short = variable["type"] in FIXED and variable["size"] == 1
    return variable["type"] + ("" if short else "[%d]" % variable["size"])


def text_form(name, arguments, results, sections):
    def one(variable):
        return variable["name"] + ": " + type_text(variable)

    def listed(variables):
        return "(" + ", ".join(map(one, variables)) + ")"

    text = name + listed(arguments) + (" -> " + listed(results) if results else "")
    declared = [(word, sections[key]) for key, word in SECTIONS.values() if key in sections]
    return text + "".join(" " + word + " " + listed(variables) for word, variables in declared)


# Attributes without a value, and their bits.
FLAGS = {"idempotent": 4, "stop": 8, "reset": 16}


def decode_attributes(data):
    flags, actuator, least, lease = Reader(data).fixed("BBHI")
    return {
        "priority": PRIORITIES[flags & 3], "lease": lease or None, "actuator": actuator,
        "stream": least if flags & 32 else None,
        **{name: flags & bit != 0 for name, bit in FLAGS.items()},
    }


def encode_attributes(attributes):
    """Those that are left out have their defaults."""
    flags = PRIORITIES.index(attributes.get("priority", "normal"))
    for name, bit in FLAGS.items():
        flags |= bit if attributes.get(name) else 0
    stream = attributes.get("stream")
    flags |= 0 if stream is None else 32
    return struct.pack("<BBHI", flags, attributes.get("actuator", 0), stream or 0, attributes.get("lease") or 0)


def decode_block(data, variables):
    reader = Reader(data)
    values = read_values(reader, variables)
    reader.end()
    return values


def read_values(reader, variables):
    return {variable["name"]: read_value(reader, variable) for variable in variables}


def read_value(reader, variable):
    kind, size = variable["type"], variable["size"]
    if kind == "record":
        return read_values(reader, variable["fields"])
    if kind == "list":
        count, body = reader.fixed("II")
        require(count <= size and body % 8 == 0 and count * least(variable["element"]) <= body)
        elements = Reader(reader.take(body))
        values = [read_value(elements, variable["element"]) for _ in range(count)]
        elements.end()
        return values
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
    return b"".join(write_value(values[variable["name"]], variable) for variable in variables)


def write_value(value, variable):
    kind, head = variable["type"], b""
    if kind == "record":
        return encode_block(value, variable["fields"])
    if kind == "list":
        body = b"".join(write_value(element, variable["element"]) for element in value)
        return struct.pack("<II", len(value), len(body)) + body
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
        body = {"keep_alive": {"stamp": stamp, **decode_report(reader)}}
    elif kind == 2:
        priority, call, stamp, since, age = reader.fixed("BIQII")
        require(priority < len(PRIORITIES))
        body = {"renew": {"class": PRIORITIES[priority], "call": call, "stamp": stamp, "since": since, "age": age}}
    elif kind == 8:
        call, = reader.fixed("I")
        body = {"renewed": {"call": call}}
    elif kind == 6:
        priority, call = reader.fixed("BI")
        require(priority < len(PRIORITIES))
        body = {"release": {"class": PRIORITIES[priority], "call": call}}
    elif kind == 9:
        priority, call = reader.fixed("BI")
        require(priority < len(PRIORITIES))
        body = {"cancel": {"class": PRIORITIES[priority], "call": call}}
    elif kind == 7:
        slot, call = reader.fixed("HI")
        body = {"release_all": {"slot": slot, "call": call}}
    elif kind == 4:
        body = {"ping": {}}
    elif kind == 5:
        body = {"pong": decode_report(reader)}
    elif kind == 10:
        body = {"close": {"code": reader.u8()}}
    else:
        require(kind == 3)
        priority = reader.u8()
        require(priority < len(PRIORITIES))
        body = {"message": {"priority": PRIORITIES[priority], "message": decode_message(reader.rest())}}
    return body


def decode_report(reader):
    received, flags = reader.fixed("IB")
    return {"received": received, "hears": bool(flags & 1), "holds": bool(flags & 2), "misses": bool(flags & 4)}


def encode_report(value):
    flags = value["hears"] | value["holds"] << 1 | value["misses"] << 2
    return struct.pack("<IB", value["received"], flags)


def encode_session_body(body):
    (name, value), = body.items()
    if name == "keep_alive":
        return struct.pack("<BQ", 1, value["stamp"]) + encode_report(value)
    if name == "ping":
        return bytes([4])
    if name == "pong":
        return bytes([5]) + encode_report(value)
    if name == "close":
        return bytes([10, value["code"]])
    if name == "renew":
        numbers = value["call"], value["stamp"], value["since"], value["age"]
        return struct.pack("<BBIQII", 2, PRIORITIES.index(value["class"]), *numbers)
    if name == "renewed":
        return struct.pack("<BI", 8, value["call"])
    if name == "release":
        return struct.pack("<BBI", 6, PRIORITIES.index(value["class"]), value["call"])
    if name == "cancel":
        return struct.pack("<BBI", 9, PRIORITIES.index(value["class"]), value["call"])
    if name == "release_all":
        return struct.pack("<BHI", 7, value["slot"], value["call"])
    return bytes([3, PRIORITIES.index(value["priority"])]) + encode_message(value["message"])


# --- frames and chunks (sections 5 and 6)

FRAMES = {"hello": 1, "refuse": 2, "close": 3, "ping": 4, "pong": 5, "session": 6, "proof": 7, "confirm": 8}


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

    magic, suites = MAGIC, 0

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
            require(len(payload) >= 1)
            return {"refuse" if kind == FRAMES["refuse"] else "close": payload[0]}
        if kind in (FRAMES["ping"], FRAMES["pong"]):
            require(len(payload) == 0)
            return "ping" if kind == FRAMES["ping"] else "pong"
        if kind == FRAMES["hello"]:
            self.hello = payload
            return {"hello": readable(decode_hello, payload, self.magic, self.suites)}
        if 0x40 <= kind <= 0x7F:
            return "skipped"
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


def readable(decode, data, *mode):
    """An unreadable hello is refused, and an unreadable session body dropped: neither is the link's matter."""
    try:
        return decode(data, *mode)
    except Malformed:
        return {"unreadable": data.hex()}
