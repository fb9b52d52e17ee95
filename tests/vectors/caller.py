#!/usr/bin/env python3
"""An m_unit in Python, standard library only, written from docs/wire.md: it answers the who-has of an s_unit that looks for
it, takes its link, with the keys of its file or in plain mode, serves `call_mechanic`, and calls what the s_unit has published.
Each line of standard input is a command:

    NAME NUMBER...  calls that function; the numbers are its arguments, 0 for what is missing. What has a lease is renewed from
                    then on
    release         releases all that is held
    lapse           renews nothing any more, and does not say so

Each thing that happens is a line on standard output. It ends with the link, or with its standard input.

It leaves out what makes an m_unit fit for a fleet: more than one link, the challenge of an identity that comes again, links
with other m_units, who-has of its own and the one that looks for a twin; and what cara_unit.py does.
"""

import os
import select
import socket
import sys
import time

sys.dont_write_bytecode = True

from cara_unit import Ended, Function, Unit, chance, options_of, say  # noqa: E402

FAULT = [{"name": "fault", "type": "string", "size": 64}, {"name": "minutes", "type": "int", "size": 1}]
CALL_MECHANIC = {"name": "call_mechanic", "arguments": FAULT, "results": FAULT}


class MUnit(Unit):
    def __init__(self, options):
        super().__init__(options, "m_unit", [Function(CALL_MECHANIC, lambda arguments: {**arguments, "minutes": [5]})])
        self.itself = {"name": options.name, "id": options.id}
        self.input = b""

    # --- being found (section 4)

    def listen(self):
        """Answers until an s_unit has dialled and is taken."""
        shared = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        shared.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        shared.bind((self.options.broadcast, self.port))
        with shared, socket.create_server((self.options.address, 0)) as listener:
            say("listens")
            while True:
                ready, _, _ = select.select([shared, listener], [], [])
                if shared in ready:
                    self.answer_who_has(*shared.recvfrom(2048), listener.getsockname()[1])
                if listener in ready:
                    try:
                        self.open_link(listener.accept()[0], dialed=False)
                        return
                    except Ended as ended:
                        say("not joined:", ended)
                        self.tcp.close()

    def answer_who_has(self, data, source, port):
        who_has = self.heard_discovery(data, "who_has")
        if who_has and self.belongs(who_has) and (self.ring is None or self.ring.pair_keys(who_has["identity"])):
            time.sleep(chance(0.02))
            answer = {"nonce": who_has["nonce"], "tcp_port": port, "room": 1, "expected": 1}
            self.udp.sendto(self.discovery("announce", who_has["identity"], **answer), source)

    def belongs(self, told):
        return told["identity"]["role"] == "s_unit" and told["wanted"] == self.itself

    # --- calling

    def live(self):
        super().live()
        self.readers[sys.stdin] = self.commands

    def list_ended(self):
        say("functions", ", ".join(each["signature"]["text"] for each in self.theirs.values()))

    def commands(self):
        data = os.read(sys.stdin.fileno(), 4096)
        if not data:
            self.close(1, "stopped")
        *lines, self.input = (self.input + data).split(b"\n")
        for line in lines:
            if line.strip():
                self.command(*line.decode().split())

    def command(self, name, *numbers):
        if name == "release":
            for number in list(self.held):
                self.release(number)
        elif name == "lapse":
            for held in self.held.values():
                held["next"] = float("inf")
        elif name not in self.theirs:
            say("unknown:", name)
        else:
            given = iter(map(int, numbers))
            arguments = self.theirs[name]["signature"]["arguments"]
            self.call(name, {each["name"]: [next(given, 0) for _ in range(each["size"])] for each in arguments})


def main():
    unit = MUnit(options_of("An m_unit that calls one s_unit.", "AGV_manager", 1).parse_args())
    unit.listen()
    try:
        unit.run()
    except Ended as ended:
        say("ended", ended)


if __name__ == "__main__":
    main()
