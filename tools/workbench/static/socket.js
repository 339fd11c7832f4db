// The socket of the fleet: binary frames of columns, and notes as JSON. Events: `frame`, `source`, `alarms`, `problem`, `link`.

const ARRAYS = { f4: Float32Array, u2: Uint16Array, i2: Int16Array, u1: Uint8Array };
const LONGEST_WAIT_MS = 8000;

export class FleetSocket extends EventTarget {
  constructor() {
    super();
    this.names = [];
    this.rows = new Map();
    this.size = 0;
    this.newest = NaN;
    this.source = null;
    this.alarms = { total: 0, list: [] };
    this.problem = "";
    this.isOpen = false;
    this.bytes = 0;
    this._views = {};
    this._format = null;
    this._epoch = null;
    this._wait = 250;
    this._open();
  }

  // Return a value of a car, NaN where it is unknown.
  value(name, row) {
    const column = this._views[name];
    if (!column) return NaN;
    const number = column.view[row];
    return number === column.missing ? NaN : number * column.scale;
  }

  is(flag, row) {
    return (this._views.flags?.view[row] & (this._format?.flags[flag] ?? 0)) !== 0;
  }

  close() {
    this._closed = true;
    clearTimeout(this._timer);
    this._socket?.close();
  }

  _open() {
    this._socket = new WebSocket(`ws://${location.host}/fleet.socket`);
    this._socket.binaryType = "arraybuffer";
    this._socket.onopen = () => {
      this._wait = 250;
      this._epoch = null;
      this._setOpen(true);
    };
    this._socket.onmessage = ({ data }) => (typeof data === "string" ? this._note(JSON.parse(data)) : this._frame(data));
    this._socket.onclose = () => {
      this._setOpen(false);
      if (this._closed) return;
      this._timer = setTimeout(() => this._open(), this._wait);
      this._wait = Math.min(2 * this._wait, LONGEST_WAIT_MS);
    };
  }

  _setOpen(isOpen) {
    this.isOpen = isOpen;
    this.dispatchEvent(new Event("link"));
  }

  _note(note) {
    if (note.frames) this._format = note.frames;
    if (note.cars) {
      if (note.cars.epoch !== this._epoch || note.cars.begin === 0) {
        this._epoch = note.cars.epoch;
        this.names = [];
        this.rows.clear();
      }
      for (const name of note.cars.names) {
        this.rows.set(name, this.names.length);
        this.names.push(name);
      }
    }
    for (const name of ["source", "alarms", "problem"]) {
      if (name in note) {
        this[name] = note[name];
        this.dispatchEvent(new Event(name));
      }
    }
  }

  _frame(buffer) {
    const head = new DataView(buffer);
    const size = head.getUint32(0, true);
    if (!this._format) return;
    if (size === 0) {
      this.names = [];
      this.rows.clear();
    }
    this.size = Math.min(size, this.names.length);
    this.newest = head.getFloat64(16, true);
    this.bytes = buffer.byteLength;
    let at = this._format.head;
    for (const { name, dtype, scale, missing } of this._format.columns) {
      const Type = ARRAYS[dtype];
      this._views[name] = { view: new Type(buffer, at, size), scale, missing };
      at += size * Type.BYTES_PER_ELEMENT;
    }
    this.dispatchEvent(new Event("frame"));
  }
}
