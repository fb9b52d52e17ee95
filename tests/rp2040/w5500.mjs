// A W5500 (data sheet 1.1.0) as far as a driver in MACRAW mode uses it: registers, buffers of socket 0, interrupt pin.
// The other seven sockets have registers and do nothing: the chip has MACRAW in socket 0 only.

const COMMON = { MODE: 0x00, MAC: 0x09, SIR: 0x17, SIMR: 0x18, PHY: 0x2e, VERSION: 0x39 };
const SOCKET = {
  MODE: 0x00, COMMAND: 0x01, INTERRUPT: 0x02, STATUS: 0x03, RX_KIB: 0x1e, TX_KIB: 0x1f, TX_FREE: 0x20, TX_READ: 0x22,
  TX_WRITE: 0x24, RX_SIZE: 0x26, RX_READ: 0x28, RX_WRITE: 0x2a, MASK: 0x2c,
};
const READ_ONLY = [SOCKET.STATUS, ...[SOCKET.TX_FREE, SOCKET.TX_READ, SOCKET.RX_SIZE, SOCKET.RX_WRITE].flatMap((at) => [at, at + 1])];
const [OPEN, CLOSE, SEND, RECEIVE] = [0x01, 0x10, 0x20, 0x40];
const [MACRAW, FILTER] = [0x04, 0x80];
const [RECEIVED, SENT] = [0x04, 0x10];
const SOCKETS = 8;
const SHORTEST = 60;

export class W5500 {
  /** `interrupt` gets whether the pin is low. */
  constructor(interrupt) {
    this.interrupt = interrupt;
    /** Called with each frame that the board sends. */
    this.onFrame = () => {};
    /** Called when the board resets it. */
    this.onReset = () => {};
    /** Whether the cable's ends have agreed. */
    this.link = false;
    this.powerOn();
  }

  powerOn() {
    this.common = new Uint8Array(0x40);
    this.common[COMMON.VERSION] = 4;
    this.sockets = Array.from({ length: SOCKETS }, () => new Uint8Array(0x30));
    for (const socket of this.sockets) {
      socket[SOCKET.RX_KIB] = socket[SOCKET.TX_KIB] = 2;
      socket[SOCKET.MASK] = 0xff;
    }
    this.rx = new Uint8Array(0x4000);
    this.tx = new Uint8Array(0x4000);
    /** Where the chip has read up to: the register's value counts from the next RECV on. */
    this.taken = 0;
    this.header = [];
    this.update();
  }

  /** The reset pin. */
  reset(low) {
    this.isReset = low;
    if (!low) return;
    this.powerOn();
    this.link = false;
    this.onReset();
  }

  /** The cable's ends have agreed. */
  connect() {
    this.link = true;
    this.update();
  }

  /** The select pin: a transaction begins. */
  select(low) {
    this.isSelected = low;
    this.header = [];
  }

  /** One byte on the bus. */
  exchange(byte) {
    if (!this.isSelected || this.isReset) return 0xff;
    if (this.header.length < 3) {
      this.header.push(byte);
      if (this.header.length === 3) this.address = (this.header[0] << 8) | this.header[1];
      return 0;
    }
    const control = this.header[2];
    const [block, at] = [control >> 3, this.address++ & 0xffff];
    if (!(control & 4)) return this.read(block, at);
    this.write(block, at, byte);
    return 0;
  }

  read(block, at) {
    const socket = this.sockets[block >> 2];
    if (block === 0) return this.common[at] ?? 0;
    if ((block & 3) === 1) return socket[at] ?? 0;
    if (block === 3) return this.rx[at % this.size(SOCKET.RX_KIB)];
    return 0;
  }

  write(block, at, byte) {
    if (block === 0) {
      if (at === COMMON.MODE && byte & 0x80) this.powerOn();
      else if (![COMMON.SIR, COMMON.PHY, COMMON.VERSION].includes(at)) this.common[at] = byte;
    } else if ((block & 3) === 1) this.writeSocket(this.sockets[block >> 2], at, byte);
    else if (block === 2) this.tx[at % this.size(SOCKET.TX_KIB)] = byte;
    this.update();
  }

  writeSocket(socket, at, byte) {
    if (at === SOCKET.INTERRUPT) socket[at] &= ~byte;
    else if (at === SOCKET.COMMAND) this.command(socket, byte);
    else if (!READ_ONLY.includes(at)) socket[at] = byte;
  }

  command(socket, command) {
    if (socket !== this.sockets[0]) return;
    if (command === OPEN) {
      socket[SOCKET.STATUS] = (socket[SOCKET.MODE] & 0x0f) === MACRAW ? 0x42 : 0;
      this.taken = 0;
      [SOCKET.TX_READ, SOCKET.TX_WRITE, SOCKET.RX_READ, SOCKET.RX_WRITE].forEach((pointer) => this.set(pointer, 0));
    } else if (command === CLOSE) socket[SOCKET.STATUS] = 0;
    else if (command === SEND) this.send();
    else if (command === RECEIVE) {
      this.taken = this.get(SOCKET.RX_READ);
      // What is left is reported again.
      if (this.waiting()) socket[SOCKET.INTERRUPT] |= RECEIVED;
    }
  }

  send() {
    const [from, to] = [this.get(SOCKET.TX_READ), this.get(SOCKET.TX_WRITE)];
    const length = (to - from) & 0xffff;
    const frame = Buffer.alloc(Math.max(length, SHORTEST));
    for (let index = 0; index < length; index++) frame[index] = this.tx[(from + index) % this.size(SOCKET.TX_KIB)];
    this.set(SOCKET.TX_READ, to);
    this.sockets[0][SOCKET.INTERRUPT] |= SENT;
    if (this.link) this.onFrame(frame);
  }

  /** A frame comes in by the cable; whether it was taken. */
  receive(frame) {
    const [socket] = this.sockets;
    if (this.isReset || !this.link || socket[SOCKET.STATUS] !== 0x42 || !this.isForUs(frame)) return false;
    const length = Math.max(frame.length, SHORTEST) + 2;
    if (this.waiting() + length > this.size(SOCKET.RX_KIB)) return false;
    let at = this.get(SOCKET.RX_WRITE);
    const put = (byte) => {
      this.rx[at++ % this.size(SOCKET.RX_KIB)] = byte;
    };
    put(length >> 8);
    put(length & 0xff);
    for (let index = 0; index < length - 2; index++) put(frame[index] ?? 0);
    this.set(SOCKET.RX_WRITE, at);
    socket[SOCKET.INTERRUPT] |= RECEIVED;
    this.update();
    return true;
  }

  isForUs(frame) {
    const own = this.common.subarray(COMMON.MAC, COMMON.MAC + 6);
    return !(this.sockets[0][SOCKET.MODE] & FILTER) || frame[0] & 1 || own.every((byte, index) => frame[index] === byte);
  }

  /** Bytes that wait to be read. */
  waiting() {
    return (this.get(SOCKET.RX_WRITE) - this.taken) & 0xffff;
  }

  /** What registers and pin tell of the rest. */
  update() {
    const [socket] = this.sockets;
    this.set(SOCKET.RX_SIZE, this.waiting());
    this.set(SOCKET.TX_FREE, this.size(SOCKET.TX_KIB) - ((this.get(SOCKET.TX_WRITE) - this.get(SOCKET.TX_READ)) & 0xffff));
    this.common[COMMON.PHY] = this.link ? 0xbf : 0xb8;
    this.common[COMMON.SIR] = socket[SOCKET.INTERRUPT] & socket[SOCKET.MASK] ? 1 : 0;
    this.interrupt((this.common[COMMON.SIR] & this.common[COMMON.SIMR]) !== 0);
  }

  size(register) {
    return this.sockets[0][register] * 1024;
  }

  get(register) {
    return (this.sockets[0][register] << 8) | this.sockets[0][register + 1];
  }

  set(register, value) {
    this.sockets[0].set([(value >> 8) & 0xff, value & 0xff], register);
  }
}
