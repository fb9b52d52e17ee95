// Cuts the power before, within and after each flash operation of each start, through both pages of the count of starts and
// back: node starts.mjs UF2… with an image and settings with keys.
//
// A start that goes on to the network has taken a count, which is in flash then. No count is taken twice, and nothing but the
// two pages changes.

import { readFileSync } from 'node:fs';
import { Chip, FLASH_BYTES, PowerCut, SECTOR, flashOf } from './chip.mjs';

const BOOTS = [0x1fc000, 0x1fd000];
const RECORD = 64;
/** Longer than a start takes until it counts. */
const LONG = 1e9;
/** Every count of both pages, and the change back to the first. */
const STARTS = 2 * (SECTOR / RECORD) + 2;

const PHASES = ['before', 'within', 'after'];
const original = flashOf(...process.argv.slice(2).map((file) => readFileSync(file)));

/** The highest count of a sound record. */
function newest(flash) {
  let highest = 0;
  for (let at = BOOTS[0]; at < BOOTS[1] + SECTOR; at += RECORD) {
    const record = Buffer.from(flash.subarray(at, at + RECORD));
    const isSound = record.toString('latin1', 0, 4) === 'CARb' && record.readUInt32LE(RECORD - 4) === crc32(record.subarray(0, RECORD - 4));
    if (isSound) highest = Math.max(highest, Number(record.readBigUInt64LE(4)));
  }
  return highest;
}

/** CRC-32 as in Ethernet. */
function crc32(bytes) {
  let sum = ~0;
  for (const byte of bytes) {
    sum ^= byte;
    for (let bit = 0; bit < 8; bit++) sum = (sum >>> 1) ^ (sum & 1 ? 0xedb88320 : 0);
  }
  return ~sum >>> 0;
}

/** Starts with this flash. `cut` is the operation and the phase at which power goes. The count that was taken, and the operations. */
function started(flash, cut) {
  const operations = [];
  const chip = new Chip(flash);
  chip.onFlash = (kind, offset, length, phase) => {
    if (phase === 'before') operations.push(kind);
    if (cut && operations.length - 1 === cut.operation && phase === cut.phase) throw new PowerCut();
  };
  let reached = false;
  chip.network.onReset = () => {
    reached = true;
  };
  try {
    while (!reached && chip.nanos < LONG) chip.run(chip.nanos + 1e6);
  } catch (error) {
    if (!(error instanceof PowerCut)) throw error;
    return { operations };
  }
  if (!reached) throw new Error('it does not come to the network');
  return { operations, count: newest(flash) };
}

const taken = new Set();
function take({ count }, what) {
  if (!count || taken.has(count)) throw new Error(`${what}: the count ${count} is taken ${count ? 'again' : ''}`);
  taken.add(count);
}

/** Image, settings and keys are as they were. */
function untouched(flash, what) {
  for (const [from, to] of [[0, BOOTS[0]], [BOOTS[1] + SECTOR, FLASH_BYTES]]) {
    if (Buffer.compare(flash.subarray(from, to), original.subarray(from, to))) throw new Error(`${what}: other pages have changed`);
  }
}

const flash = original.slice();
let [cuts, erased] = [0, 0];
for (let start = 0; start < STARTS; start++) {
  const counted = started(flash.slice());
  erased += counted.operations.filter((kind) => kind === 'erase').length;
  for (const operation of counted.operations.keys()) {
    for (const phase of PHASES) {
      const spent = flash.slice();
      const cut = started(spent, { operation, phase });
      const before = newest(spent);
      const next = started(spent);
      cuts++;
      const what = `start ${start}, power cut ${phase} ${cut.operations.at(-1)}`;
      if (next.count <= before || next.count <= Math.max(0, ...taken)) throw new Error(`${what}: ${next.count} follows ${before}`);
      untouched(spent, what);
    }
  }
  take(started(flash), `start ${start}`);
  untouched(flash, `start ${start}`);
}
if (erased < 2) throw new Error(`pages were erased ${erased} times: not each of them`);
console.log(`${STARTS} starts, ${cuts} cuts of power at flash operations, ${erased} pages erased: counts up to ${newest(flash)}`);
