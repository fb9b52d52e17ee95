// An RP2040 with its flash chip and a W5500 on SPI0: rp2040js, and what the image needs that rp2040js lacks.
//
// The boot ROM is this file's own: rp2040js has none, and the maker's is not part of the project. It checks and starts boot2,
// and has the functions that the image asks for by name. Each of them is a breakpoint, and done here.

import { BasePeripheral, RP2040 } from 'rp2040js';
import { W5500 } from './w5500.mjs';

export const FLASH = 0x10000000;
export const FLASH_BYTES = 2 * 1024 * 1024;
export const SECTOR = 4096;
const PAGE = 256;
const RAM = 0x20000000;
const BOOT2_BYTES = 256;
/** Where the ROM puts boot2: below the end of RAM. */
const BOOT2 = 0x20041f00;
const CYCLE = 8; // ns

/** Typical times of a W25Q16JV, in ns. */
const ERASE = 45e6;
const PROGRAM = 0.4e6;

/** How long the ends of a cable need to agree: until just after the driver has asked for that, so that frames pass long before it knows. */
const NEGOTIATION = 1.62e9;

/** Pins, as examples/firmware/rp/src/board/w5500.rs has them. */
const [BUTTON, MOTORS, SELECT, RESET, INTERRUPT, LED] = [14, 15, 17, 20, 21, 25];
export { BUTTON, LED, MOTORS };

/** Thrown out of a flash operation by whoever wants the power to end there. */
export class PowerCut extends Error {}

/** The bytes of UF2 files for this chip, in flash that is erased elsewhere. */
export function flashOf(...files) {
  const flash = new Uint8Array(FLASH_BYTES).fill(0xff);
  for (const file of files) {
    for (let at = 0; at + 512 <= file.length; at += 512) {
      const word = (offset) => file.readUInt32LE(at + offset);
      if (word(0) !== 0x0a324655 || word(4) !== 0x9e5d5157 || word(28) !== 0xe48bff56) throw new Error('this is no UF2 for an RP2040');
      flash.set(file.subarray(at + 32, at + 32 + word(16)), word(12) - FLASH);
    }
  }
  return flash;
}

/** Registers that remember what is written, but for those that `read` answers. */
class Registers extends BasePeripheral {
  constructor(chip, name, read) {
    super(chip, name);
    this.values = new Map();
    this.read = read;
  }
  readUint32(offset) {
    return this.read(offset) ?? this.values.get(offset) ?? 0;
  }
  writeUint32(offset, value) {
    this.values.set(offset, value);
  }
}

export class Chip {
  /** Puts power on a board with this flash, which stays the caller's. */
  constructor(flash) {
    this.rp = new RP2040();
    this.flash = flash;
    this.rp.flash.set(flash);
    this.rp.logger = this.logger();
    /** Called as (kind, offset, length, phase) before, within and after each erase and program. */
    this.onFlash = () => {};
    /** Called when the watchdog resets the chip, by time or because the program says so. */
    this.onReset = () => {};
    this.complete();
    this.network = this.wire();
    this.boot();
  }

  get nanos() {
    return this.rp.clock.nanos;
  }

  /** Lets the clock come to `nanos`. */
  run(nanos) {
    const { clock, core } = this.rp;
    while (clock.nanos < nanos) {
      // What pends while the core sleeps does not wake it by itself.
      if (core.waiting && core.interruptsUpdated && core.checkForInterrupts()) core.waiting = false;
      if (core.waiting) clock.tick(Math.min(clock.nextAlarm ? clock.nanosToNextAlarm : Infinity, nanos - clock.nanos));
      else clock.tick(core.executeInstruction() * CYCLE);
    }
  }

  /** What the image has logged since the last time, as defmt encodes it. */
  logged() {
    this.log ??= this.find('SEGGER RTT');
    if (this.log === undefined) return Buffer.alloc(0);
    const memory = this.rp.sramView;
    const word = (index) => memory.getUint32(this.log + 24 + 4 * index, true);
    const [buffer, size, write, read] = [word(1) - RAM, word(2), word(3), word(4)];
    memory.setUint32(this.log + 24 + 16, write, true);
    const span = (from, to) => this.rp.sram.slice(buffer + from, buffer + to);
    return Buffer.concat(write < read ? [span(read, size), span(0, write)] : [span(read, write)]);
  }

  find(text) {
    const at = Buffer.from(this.rp.sram.buffer).indexOf(text);
    return at < 0 ? undefined : at;
  }

  logger() {
    return {
      debug() {},
      // rp2040js only logs that another core or WFE should be woken.
      info: (_, message) => {
        if (message === 'SEV') this.rp.core.eventRegistered = true;
      },
      warn(name, message) {
        if (process.env.RP2040_WARNINGS) console.error(`warning ${name}: ${message}`);
      },
      error(name, message) {
        throw new Error(`${name}: ${message}`);
      },
    };
  }

  /** What rp2040js lacks, or has as a stub. */
  complete() {
    const { rp } = this;
    // The ring oscillator, whose random bits do not repeat.
    rp.peripherals[0x40060] = new Registers(rp, 'ROSC', (offset) => ({ 0x18: 0x80001000, 0x1c: Number(Math.random() < 0.5) })[offset]);
    // Power came.
    rp.peripherals[0x40064] = new Registers(rp, 'VREG_AND_CHIP_RESET', (offset) => ({ 8: 1 << 8 })[offset]);
    // Streaming from flash never runs.
    rp.peripherals[0x14000] = new Registers(rp, 'XIP_CTRL', () => 0);
    // A channel that is to stop has stopped, which rp2040js answers with all ones: the image would stop the others as well.
    const [ABORT, read] = [0x444, rp.dma.readUint32.bind(rp.dma)];
    rp.dma.readUint32 = (offset) => (offset === ABORT ? 0 : read(offset));
    rp.peripherals[0x40058].onWatchdogTrigger = () => this.onReset();
    this.serial();
    this.rom();
  }

  /** The flash chip as seen through SSI in direct mode: status, and its number. */
  serial() {
    const ssi = this.rp.peripherals[0x18000];
    const [read, write] = [ssi.readUint32.bind(ssi), ssi.writeUint32.bind(ssi)];
    const [ENABLE, DATA] = [0x08, 0x60];
    let [command, answered] = [undefined, 0];
    ssi.writeUint32 = (offset, value) => {
      if (offset === ENABLE) [command, answered] = [undefined, 0];
      if (offset === DATA) command ??= value & 0xff;
      write(offset, value);
    };
    ssi.readUint32 = (offset) => {
      if (offset !== DATA) return read(offset);
      const number = [0, 0, 0, 0, 0xe6, 0x61, 0x64, 0x08, 0x43, 0x2c, 0x9d, 0x21];
      const answers = { 0x05: () => 0, 0x35: () => 2, 0x4b: () => number[answered++] };
      return answers[command]?.() ?? 0xff;
    };
  }

  rom() {
    const rom = new Uint16Array(this.rp.bootrom.buffer);
    const [LOOKUP, TABLE, BX_LR] = [0x40, 0x60, 0x4770];
    const functions = {
      IF: () => {},
      EX: () => {},
      FC: () => {},
      CX: () => {},
      RE: ([offset, length]) => this.erase(offset, length),
      RP: ([offset, from, length]) => this.program(offset, from, length),
      C4: ([to, from, length]) => {
        for (let at = 0; at < length; at += 4) this.rp.writeUint32(to + at, this.rp.readUint32(from + at));
      },
    };
    const names = Object.keys(functions);
    const address = (index) => LOOKUP + 4 * (index + 1);
    rom.set([0x754d, 0x0201, TABLE, TABLE, LOOKUP | 1], 0x10 / 2);
    [-1, ...names.keys()].forEach((index) => rom.set([0xbe00 | (index + 1), BX_LR], address(index) / 2));
    this.rp.onBreak = (code) => {
      const { core } = this.rp;
      // Elsewhere a breakpoint is a fault.
      if (core.PC >= TABLE) throw new Error(`breakpoint ${code} at ${core.PC.toString(16)}`);
      if (code === 0) {
        const index = names.findIndex((name) => Buffer.from(name).readUInt16LE() === core.registers[1]);
        if (index < 0) throw new Error(`the ROM has no function ${String.fromCharCode(core.registers[1] & 0xff, core.registers[1] >> 8)}`);
        core.registers[0] = address(index) | 1;
        return;
      }
      const name = names[code - 1];
      // While the ROM has the flash chip, nothing can be read from it: no caller can be there.
      if (name !== 'C4' && core.LR < RAM) throw new Error(`${name} is called from flash`);
      functions[name](core.registers);
    };
  }

  erase(offset, length) {
    this.change('erase', offset, length, SECTOR, ERASE, new Uint8Array(length).fill(0xff), (_, to) => to);
  }

  program(offset, from, length) {
    const bytes = Uint8Array.from({ length }, (_, index) => this.rp.readUint8(from + index));
    this.change('program', offset, length, PAGE, PROGRAM, bytes, (was, to) => was & to);
  }

  /** Changes one byte after the other; `within` is when half of those that differ are changed. */
  change(kind, offset, length, unit, nanos, bytes, becomes) {
    if (offset % unit || length % unit || offset + length > FLASH_BYTES) throw new Error(`${kind} of ${length} bytes at ${offset}`);
    const changes = [];
    bytes.forEach((byte, index) => {
      const [at, was] = [offset + index, this.flash[offset + index]];
      if (becomes(was, byte) !== was) changes.push([at, becomes(was, byte)]);
    });
    const change = ([at, byte]) => {
      this.flash[at] = byte;
    };
    const half = changes.length >> 1;
    this.onFlash(kind, offset, length, 'before');
    changes.slice(0, half).forEach(change);
    this.onFlash(kind, offset, length, 'within');
    changes.slice(half).forEach(change);
    this.rp.flash.set(this.flash.subarray(offset, offset + length), offset);
    this.rp.clock.tick((nanos * length) / unit);
    this.onFlash(kind, offset, length, 'after');
  }

  /** The network controller, and what else is at the pins. */
  wire() {
    const { gpio, spi, clock } = this.rp;
    const network = new W5500((low) => gpio[INTERRUPT].setInputValue(!low));
    const agreed = clock.createAlarm(() => network.connect());
    network.onReset = () => agreed.schedule(NEGOTIATION);
    const [bus] = spi;
    let answer = 0;
    const done = clock.createAlarm(() => bus.completeTransmit(answer));
    bus.onTransmit = (byte) => {
      answer = network.exchange(byte);
      done.schedule(8e9 / bus.clockFrequency);
    };
    const follow = (pin, act) => {
      gpio[pin].addListener((state) => act(state === 1));
    };
    follow(SELECT, (high) => network.select(!high));
    follow(RESET, (high) => network.reset(!high));
    [BUTTON, INTERRUPT].forEach((pin) => gpio[pin].setInputValue(true));
    return network;
  }

  boot() {
    const { rp } = this;
    const boot2 = this.flash.subarray(0, BOOT2_BYTES);
    const sum = new DataView(boot2.buffer, boot2.byteOffset).getUint32(BOOT2_BYTES - 4, true);
    if (crc32(boot2.subarray(0, BOOT2_BYTES - 4)) !== sum) throw new Error('boot2 has a wrong check sum: the ROM would start USB');
    rp.sram.set(boot2, BOOT2 - RAM);
    Object.assign(rp.core, { PC: BOOT2, SP: BOOT2, LR: 0 });
  }
}

/** As the ROM computes it: CRC-32/MPEG-2. */
function crc32(bytes) {
  let sum = 0xffffffff;
  for (const byte of bytes) {
    sum ^= byte << 24;
    for (let bit = 0; bit < 8; bit++) sum = sum & 0x80000000 ? (sum << 1) ^ 0x04c11db7 : sum << 1;
  }
  return sum >>> 0;
}
