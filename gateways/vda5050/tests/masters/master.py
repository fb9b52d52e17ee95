"""The master control of vda5050-sdk (PyPI), which speaks 2.1 and validates all that it hears: `python master.py PORT VEHICLES`.

It ends with 0 if all vehicles, at a time, did what they were told: an order, an extension of its base, a pause, and a cancelled order.
"""

import asyncio
import sys

from vda5050.client.master.client import MasterClient
from vda5050.config import MasterConfig
from vda5050.domain.order.builder import OrderBuilder

def order(agv, order_id, update, first, way):
    builder = OrderBuilder(
        order_id=order_id, manufacturer="KIT", serial_number=agv.split("/")[1], order_update_id=update, start_sequence_id=first
    )
    for before, word in zip([None, *way], way):
        builder.add_node(word[0], released="!" in word, x=2.0 * (ord(word[0]) - ord("a")), y=0.0, map_id="hall")
        if before:
            builder.add_edge(before[0], word[0], released="!" in word)
    return builder.build()


async def one(master, agv):
    async def until(what, is_so):
        assert await master.wait_for(agv, lambda session: session.state and is_so(session.state), timeout=20), what
        print(agv, what, flush=True)

    async def sent(*of_order):
        assert (await master.dispatch(order(agv, *of_order), agv)).accepted

    await until("a state", lambda state: True)
    await sent("p1", 0, 0, ["a!", "b!", "c"])
    await until("at b", lambda state: state.last_node_id == "b" and not state.driving)
    await sent("p1", 1, 2, ["b!", "c!", "d!"])
    for stop in range(2):
        await until("it drives", lambda state: state.driving)
        await master.pause(agv)
        await until("it is paused", lambda state: state.paused and not state.driving)
        await master.resume(agv)
    await until("at d", lambda state: state.last_node_id == "d" and not state.node_states)
    await sent("p2", 0, 0, ["d!", "a!"])
    await until("it drives", lambda state: state.driving)
    await master.cancel_order(agv)
    await until("it is cancelled", lambda state: not state.node_states and not state.driving)
    assert await master.wait_for_action(agv, "cancel-order", timeout=10)


async def main(port, vehicles):
    config = MasterConfig(broker_url=f"mqtt://127.0.0.1:{port}", validate_messages=True)
    async with MasterClient(config) as master:
        wrong = []
        master.on_error(lambda event: wrong.append(event))
        await asyncio.gather(*(one(master, f"KIT/{number:04}") for number in range(1, vehicles + 1)))
        assert not wrong, wrong
        print("done")


asyncio.run(main(*map(int, sys.argv[1:])))
