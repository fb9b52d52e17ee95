#!/usr/bin/env python3
"""An s_unit in Python, standard library only, written from docs/wire.md: it finds its manager by broadcast, joins it, with
the keys of its file or in plain mode, publishes `pos_info` and `go_to`, serves them, and calls `call_mechanic` once the
manager has published it. Each thing that happens is a line on standard output. It ends when the manager does.

It leaves out what an s_unit may leave out, hearing broadcasts of others, and what cara_unit.py does.
"""

import secrets
import socket
import sys
import time

sys.dont_write_bytecode = True

from cara_unit import KEYS_LIVE, Ended, Function, Unit, chance, options_of, say  # noqa: E402

POSITION = [{"name": "position", "type": "int", "size": 2}]
POS_INFO = {"name": "pos_info", "arguments": [], "results": POSITION}
GO_TO = {"name": "go_to", "arguments": POSITION, "results": []}
LEASE_MILLIS = 1000


class SUnit(Unit):
    def __init__(self, options):
        functions = [Function(POS_INFO, self.pos_info), Function(GO_TO, self.go_to, lease=LEASE_MILLIS)]
        super().__init__(options, "s_unit", functions)
        manager, number = options.manager.rsplit("/", 1)
        self.wanted = {"name": manager, "id": int(number)}
        self.position = [3, -4]

    def pos_info(self, _):
        return {"position": self.position}

    def go_to(self, arguments):
        self.position = arguments["position"]
        return {}

    # --- finding the manager (section 4)

    def find(self):
        """The address at which the manager can be dialled."""
        pause, nonce = 0.25, secrets.randbits(63) + 1
        time.sleep(chance(0.4))
        while True:
            data = self.discovery("who_has", nonce=nonce, wanted=self.wanted, tcp_port=0, expected=1, known=[])
            self.udp.sendto(data, (self.options.broadcast, self.port))
            found = self.await_announce(nonce, time.monotonic() + pause + chance(pause))
            if found:
                return found
            pause = min(2 * pause, 8)

    def await_announce(self, nonce, until):
        while time.monotonic() < until:
            self.udp.settimeout(max(until - time.monotonic(), 0.001))
            try:
                data, source = self.udp.recvfrom(2048)
            except socket.timeout:
                continue
            announce = self.heard_discovery(data, "announce")
            if announce and self.is_manager(announce) and announce["nonce"] == nonce and announce["tcp_port"]:
                return source[0], announce["tcp_port"]
        return None

    def is_manager(self, told):
        return told["identity"] == {**self.wanted, "role": "m_unit"}

    belongs = is_manager

    # --- calling the manager

    def list_ended(self):
        """Calls the manager's function, once; every argument at its smallest."""
        if "call_mechanic" not in self.theirs or self.next_id > 1:
            return
        least = {"int": lambda size: [7] * size, "string": lambda size: "flat tyre"[:size]}
        arguments = self.theirs["call_mechanic"]["signature"]["arguments"]
        self.call("call_mechanic", {each["name"]: least[each["type"]](each["size"]) for each in arguments})


def main():
    parser = options_of("An s_unit that offers pos_info and go_to.", "agv_in_python", 77)
    parser.add_argument("--manager", default="AGV_manager/1", help="NAME/ID")
    parser.add_argument("--renew", type=float, default=KEYS_LIVE, help="seconds until a link's keys are made anew")
    unit = SUnit(parser.parse_args())
    try:
        unit.open_link(socket.create_connection(unit.find(), timeout=2), dialed=True)
        unit.run()
    except Ended as ended:
        say("ended", ended)
        return 0 if ended.by_peer else 1


if __name__ == "__main__":
    sys.exit(main())
