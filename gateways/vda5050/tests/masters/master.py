"""The master control of vda5050-sdk (PyPI), which speaks 2.1 and validates all that it hears: `python master.py PORT VEHICLES [floor]`.

It ends with 0 if all vehicles, at a time, did what they were told: an order, an extension of its base, a pause, and a cancelled order.
On a floor each drives a lap of its ring of cells, and the base of its order ends where another vehicle is. The rings share a column.
"""

import asyncio
import sys

from vda5050.client.master.client import MasterClient
from vda5050.config import MasterConfig
from vda5050.domain.order.builder import OrderBuilder

def place(node):
    """Nodes are letters two metres apart, or cells."""
    return map(float, node.split(",")) if "," in node else (2.0 * (ord(node) - ord("a")), 0.0)


def order(agv, order_id, update, first, way):
    builder = OrderBuilder(
        order_id=order_id, manufacturer="KIT", serial_number=agv.split("/")[1], order_update_id=update, start_sequence_id=first
    )
    for before, word in zip([None, *way], way):
        node, (x, y) = word.rstrip("!"), place(word.rstrip("!"))
        builder.add_node(node, released="!" in word, x=x, y=y, map_id="hall")
        if before:
            builder.add_edge(before.rstrip("!"), node, released="!" in word)
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


def ring(x, y, to_x, to_y):
    """Cells around a rectangle: along its first row, down its far side, and back."""
    step = 1 if to_x > x else -1
    there = [(column, y) for column in range(x, to_x, step)] + [(to_x, row) for row in range(y, to_y)]
    back = [(column, to_y) for column in range(to_x, x, -step)] + [(x, row) for row in range(to_y, y, -1)]
    return [f"{column},{row}" for column, row in there + back]


# Both go down the column 8.
RINGS = [ring(1, 1, 8, 4), list(reversed(ring(8, 1, 16, 4)))]
CELLS = {cell: asyncio.Lock() for cells in RINGS for cell in cells}


async def lap(master, agv, all_are_there):
    async def until(what, is_so):
        assert await master.wait_for(agv, lambda session: session.state and is_so(session.state), timeout=60), what

    await until("a state", lambda state: state.agv_position)
    position = (await master.session(agv)).state.agv_position
    start = f"{round(position.x)},{round(position.y)}"
    cells = next(cells for cells in RINGS if start in cells)
    cells = cells[cells.index(start):] + cells[:cells.index(start) + 1]
    await CELLS[start].acquire()
    await all_are_there.wait()
    for driven, (at, to) in enumerate(zip(cells, cells[1:])):
        await CELLS[to].acquire()
        way = [f"{at}!", f"{to}!", *cells[driven + 2:driven + 3]]
        assert (await master.dispatch(order(agv, "lap", driven, 2 * driven, way), agv)).accepted
        if driven == 2:
            await until("it drives", lambda state: state.driving)
            await master.pause(agv)
            await until("it stands, between two cells", lambda state: state.paused and not state.driving)
            await master.resume(agv)
        await until(f"at {to}", lambda state: state.last_node_sequence_id == 2 * driven + 2)
        CELLS[at].release()
    await until("the end", lambda state: not state.node_states and not state.driving)
    print(agv, "has done its lap", flush=True)


async def main(port, vehicles, floor=None):
    config = MasterConfig(broker_url=f"mqtt://127.0.0.1:{port}", validate_messages=True)
    async with MasterClient(config) as master:
        wrong = []
        master.on_error(lambda event: wrong.append(event))
        all_are_there = asyncio.Barrier(vehicles)
        drive = one if floor is None else lambda master, agv: lap(master, agv, all_are_there)
        await asyncio.gather(*(drive(master, f"KIT/{number:04}") for number in range(1, vehicles + 1)))
        assert not wrong, wrong
        print("done")


asyncio.run(main(*map(int, sys.argv[1:3]), *sys.argv[3:]))
