// The master control of vda-5050-lib (npm): an order with an update, instant actions and a cancelled order.
//
// node master.js PORT VEHICLES, all at a time; prints what it is told, and ends with 0 if all of it came.

const {BlockingType, MasterController} = require("vda-5050-lib");

const header = {orderUpdateId: 0};
const place = node => ({x: 2 * (node.charCodeAt(0) - 97), y: 0, theta: 0, mapId: "hall"});

function order(orderId, orderUpdateId, first, way) {
    const words = way.split(" ");
    const nodes = words.map((word, index) => ({
        nodeId: word[0], sequenceId: first + 2 * index, released: word.endsWith("!"), nodePosition: place(word[0]), actions: [],
    }));
    const edges = nodes.slice(1).map((node, index) => ({
        edgeId: nodes[index].nodeId + node.nodeId, sequenceId: node.sequenceId - 1, released: node.released,
        startNodeId: nodes[index].nodeId, endNodeId: node.nodeId, actions: [],
    }));
    return {...header, orderId, orderUpdateId, nodes, edges};
}

const action = (actionType, actionId) => ({actionType, actionId, blockingType: BlockingType.None, actionParameters: []});

async function main(port, vehicles) {
    const master = new MasterController(
        {interfaceName: "uagv", transport: {brokerUrl: `mqtt://127.0.0.1:${port}`}, vdaVersion: "2.0.0", topicFormat: "%interfaceName%/v2/%manufacturer%/%serialNumber%/%topic%"},
        {});
    await master.start();
    await Promise.all(Array.from({length: vehicles}, (_, index) => one(master, String(index + 1).padStart(4, "0"))));
    await master.stop();
    console.log("done");
}

async function one(master, serialNumber) {
    const agv = {manufacturer: "KIT", serialNumber};
    const drive = (what, onTraversed) => new Promise((resolve, reject) => master.assignOrder(agv, what, {
        onNodeTraversed: node => {
            console.log("traversed", node.nodeId, node.sequenceId);
            if (onTraversed) onTraversed(node);
        },
        onOrderProcessed: (error, byCancelation, active) => {
            console.log("processed", what.orderId, what.orderUpdateId, !!error, byCancelation, active);
            error ? reject(new Error(JSON.stringify(error))) : resolve(byCancelation);
        },
    }).catch(reject));
    const at_once = (...actions) => new Promise((resolve, reject) => master.initiateInstantActions(agv, {instantActions: actions}, {
        onActionStateChanged: state => {
            console.log("action", state.actionId, state.actionStatus);
            if (["FINISHED", "FAILED"].includes(state.actionStatus)) resolve(state.actionStatus);
        },
        onActionError: error => reject(new Error(JSON.stringify(error))),
    }).catch(reject));

    const first = order("m1", 0, 0, "a! b! c! d");
    first.nodes[1].actions.push({...action("beep", "m1-beep"), blockingType: BlockingType.Hard});
    const updated = drive(first);
    await new Promise(resolve => setTimeout(resolve, 500));
    const update = drive(order("m1", 1, 4, "c! d! e!"));
    await Promise.race([updated, update]);
    console.log("pause", await at_once(action("startPause", "m-pause")));
    console.log("resume", await at_once(action("stopPause", "m-resume")));
    await update;
    const cancelled = drive(order("m2", 0, 0, "e! a!"));
    await new Promise(resolve => setTimeout(resolve, 700));
    console.log("cancel", await at_once(action("cancelOrder", "m-cancel")));
    if (await cancelled !== true) throw new Error("it was not cancelled");
}

main(Number(process.argv[2]), Number(process.argv[3])).then(() => process.exit(0), error => {
    console.error(error);
    process.exit(1);
});
