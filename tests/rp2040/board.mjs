// A board that runs beside other programs: node board.mjs SOCKET FLASH [UF2…] [--events] [--cut=PHASE:NUMBER]
//
// SOCKET takes Ethernet frames as QEMU's `-netdev stream` does, each behind its length in four bytes. FLASH is a file with the
// flash, made of the UF2 files if it is absent. Standard output has the log as defmt encodes it; with `--events`, standard error has what
// happens, each with the chip's own time in µs: `pin NUMBER LEVEL`, `flash KIND OFFSET`, and `from` and `to` with the payload's bytes for
// TCP and UDP. The signal USR2 presses the button. Power goes when the other end closes SOCKET, or `before`, `within` or `after` the flash
// operation of that number, from 1.
//
// The chip's clock follows this computer's, and stands still where this computer is too slow or busy for it.

import { existsSync, openSync, readFileSync, writeFileSync, writeSync } from 'node:fs';
import { createConnection } from 'node:net';
import { BUTTON, Chip, LED, MOTORS, flashOf } from './chip.mjs';

/** How far the chip may be behind, and most that it runs before frames are looked for, in ns. */
const [BEHIND, TURN] = [20e6, 2e6];

/** How long the button is pressed, in ns. */
const PRESSED = 200e6;

const isOption = (word) => word.startsWith('--');
const words = process.argv.slice(2);
const showsEvents = words.includes('--events');
const cut = words.find((word) => word.startsWith('--cut='))?.slice('--cut='.length);
const [socketPath, flashPath, ...images] = words.filter((word) => !isOption(word));
if (!existsSync(flashPath)) writeFileSync(flashPath, flashOf(...images.map((image) => readFileSync(image))));
const chip = new Chip(new Uint8Array(readFileSync(flashPath)));
const flash = openSync(flashPath, 'r+');
const happens = (...what) => {
  if (showsEvents) console.error(Math.floor(chip.nanos / 1e3), ...what);
};

for (const pin of [MOTORS, LED]) {
  chip.rp.gpio[pin].addListener((state) => happens('pin', pin, Number(state === 1)));
}
chip.onReset = () => {
  console.error('the watchdog resets the chip');
  process.exit(1);
};
let operations = 0;
chip.onFlash = (kind, offset, length, phase) => {
  if (phase === 'before') operations++;
  writeSync(flash, chip.flash, offset, length, offset);
  if (cut === `${phase}:${operations}`) process.exit(0);
  if (phase === 'after') happens('flash', kind, offset);
};

const button = chip.rp.gpio[BUTTON];
const released = chip.rp.clock.createAlarm(() => button.setInputValue(true));
process.on('SIGUSR2', () => {
  button.setInputValue(false);
  released.schedule(PRESSED);
});

const cable = createConnection(socketPath);
chip.network.onFrame = (frame) => {
  note('from', frame);
  const length = Buffer.alloc(4);
  length.writeUInt32BE(frame.length);
  cable.write(Buffer.concat([length, frame]));
};
let arrived = Buffer.alloc(0);
cable.on('data', (bytes) => {
  arrived = Buffer.concat([arrived, bytes]);
  while (arrived.length >= 4 && arrived.length >= 4 + arrived.readUInt32BE()) {
    const end = 4 + arrived.readUInt32BE();
    const frame = arrived.subarray(4, end);
    arrived = arrived.subarray(end);
    turn();
    if (chip.network.receive(frame)) note('to', frame);
  }
  turn();
});
cable.on('close', () => process.exit(0));

/** Says how many bytes of TCP or UDP a frame has. */
function note(way, frame) {
  if (frame.readUInt16BE(12) !== 0x0800) return;
  const [header, total, protocol] = [(frame[14] & 15) * 4, frame.readUInt16BE(16), frame[23]];
  const name = { 6: 'tcp', 17: 'udp' }[protocol];
  if (name) happens(way, name, total - header - (name === 'tcp' ? (frame[14 + header + 12] >> 4) * 4 : 8));
}

const now = () => Number(process.hrtime.bigint());
let start = now();
let timer;

/** Lets the chip come to the present. */
function turn() {
  clearTimeout(timer);
  clearImmediate(timer);
  const behind = now() - start - chip.nanos;
  if (behind > BEHIND) start += behind - BEHIND;
  const goal = Math.min(now() - start, chip.nanos + TURN);
  if (goal > chip.nanos) chip.run(goal);
  const logged = chip.logged();
  if (logged.length) writeSync(1, logged);
  timer = now() - start - chip.nanos > TURN ? setImmediate(turn) : setTimeout(turn, 1);
}
turn();
