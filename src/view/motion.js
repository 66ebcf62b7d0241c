// A motion as it was embedded, and what follows from it. Nothing here knows of the page.

// Returns the bytes behind a base64 text. No list of characters: a list takes 16 times the memory.
function decodeBytes(base64) {
  const binary = atob(base64);
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

// Signs of base64 that are decoded at once: whole groups of four, and some hundredths of a second.
const PART_SIGNS = 1 << 22;

// Returns a file in memory with the bytes behind a base64 text of any length. The page lives on between
// the parts, and no part is held twice.
async function decodeBlob(base64, type) {
  const parts = [];
  for (let from = 0; from < base64.length; from += PART_SIGNS) {
    parts.push(new Blob([decodeBytes(base64.slice(from, from + PART_SIGNS))]));
    await new Promise((resolve) => setTimeout(resolve));
  }
  return new Blob(parts, { type });
}

// Returns the numbers behind a base64 text of little-endian 32-bit floats.
function decodeFloats(base64) {
  const bytes = decodeBytes(base64);
  const view = new DataView(bytes.buffer);
  const values = new Float32Array(Math.floor(bytes.length / 4));
  for (let i = 0; i < values.length; i++) values[i] = view.getFloat32(4 * i, true);
  return values;
}

// The vector v turned by the unit quaternion q = (w, x, y, z).
function rotate(q, v) {
  const [w, x, y, z] = q;
  const tx = 2 * (y * v[2] - z * v[1]);
  const ty = 2 * (z * v[0] - x * v[2]);
  const tz = 2 * (x * v[1] - y * v[0]);
  return [
    v[0] + w * tx + y * tz - z * ty,
    v[1] + w * ty + z * tx - x * tz,
    v[2] + w * tz + x * ty - y * tx,
  ];
}

function normalized(q) {
  const norm = Math.hypot(...q);
  return norm > 1e-9 ? q.map((c) => c / norm) : [1, 0, 0, 0];
}

function degrees(radians) {
  return (radians * 180) / Math.PI;
}

// An angle in degrees brought to (-180, 180].
function wrapped(angle) {
  return angle - 360 * Math.ceil((angle - 180) / 360);
}

class Motion {
  constructor(values, names, fps) {
    this.values = values;
    this.names = names;
    this.width = names.length;
    this.fps = fps;
    this.nFrames = Math.floor(values.length / this.width);
    this.duration = this.nFrames / fps;
    this.index = new Map(names.map((name, i) => [name, i]));
  }

  // The columns of a group, such as position_x to position_z.
  columns(group, parts) {
    return parts.map((part) => this.index.get(part === '' ? group : `${group}_${part}`));
  }

  read(frame, columns) {
    const start = frame * this.width;
    return columns.map((column) => this.values[start + column]);
  }

  // The number of the frame at a time in seconds.
  frameAt(time) {
    // Times that were made of frames must lead back to them.
    return Math.max(0, Math.min(this.nFrames - 1, Math.floor(time * this.fps + 1e-6)));
  }

  // Where the body is at a time, between two frames: null where it is not known.
  pose(time) {
    if (this.nFrames === 0) return null;
    const frame = this.frameAt(time);
    const next = Math.min(frame + 1, this.nFrames - 1);
    const share = Math.max(0, Math.min(1, time * this.fps - frame));
    const positions = this.columns('position', ['x', 'y', 'z']);
    const quaternions = this.columns('quaternion', ['w', 'x', 'y', 'z']);
    const [p0, p1] = [this.read(frame, positions), this.read(next, positions)];
    const [q0, q1] = [this.read(frame, quaternions), this.read(next, quaternions)];
    const known = (values) => values.every(Number.isFinite);
    if (!known(p0) || !known(q0)) return null;
    const s = known(p1) && known(q1) ? share : 0;
    const mix = (a, b) => (s > 0 ? a + s * (b - a) : a);
    const sign = q0.reduce((sum, c, i) => sum + c * q1[i], 0) < 0 ? -1 : 1;
    return {
      position: p0.map((c, i) => mix(c, p1[i])),
      quaternion: normalized(q0.map((c, i) => mix(c, sign * q1[i]))),
    };
  }

  // The phase of the bar at a time, from 0 to 1; NaN where it is not known.
  phase(time) {
    if (this.nFrames === 0) return NaN;
    const [column] = this.columns('phase', ['']);
    const frame = this.frameAt(time);
    const [from] = this.read(frame, [column]);
    let [to] = this.read(Math.min(frame + 1, this.nFrames - 1), [column]);
    if (to < from - 0.5) to += 1;
    const share = Math.max(0, Math.min(1, time * this.fps - frame));
    const phase = from + (Number.isFinite(to) ? share * (to - from) : 0);
    return phase - Math.floor(phase);
  }

  // One value per frame.
  each(value) {
    const values = new Float32Array(this.nFrames);
    for (let frame = 0; frame < this.nFrames; frame++) values[frame] = value(frame);
    return values;
  }

  column(index) {
    return this.each((frame) => this.values[frame * this.width + index]);
  }

  norm(group, factor = 1) {
    const columns = this.columns(group, ['x', 'y', 'z']);
    return this.each((frame) => factor * Math.hypot(...this.read(frame, columns)));
  }

  // The speed of the position: |p[t+1] - p[t]| fps, and at the last frame the one before.
  speed() {
    const columns = this.columns('position', ['x', 'y', 'z']);
    return this.each((frame) => {
      const t = Math.max(0, Math.min(frame, this.nFrames - 2));
      if (t + 1 >= this.nFrames) return 0;
      const [from, to] = [this.read(t, columns), this.read(t + 1, columns)];
      return this.fps * Math.hypot(...to.map((c, i) => c - from[i]));
    });
  }

  // The turn about the vertical in degrees, 0 towards +Z and 90 towards +X.
  yaw() {
    const [w, y] = this.columns('quaternion', ['w', 'y']);
    return this.each((frame) => {
      const [qw, qy] = this.read(frame, [w, y]);
      return wrapped(degrees(2 * Math.atan2(qy, qw)));
    });
  }

  // The angle in degrees between the body and the vertical.
  tilt() {
    const columns = this.columns('quaternion', ['w', 'x', 'y', 'z']);
    return this.each((frame) => {
      const q = this.read(frame, columns);
      if (!q.every(Number.isFinite)) return NaN;
      const up = rotate(normalized(q), [0, 1, 0])[1];
      return degrees(Math.acos(Math.max(-1, Math.min(1, up))));
    });
  }

  // The least box around the path on the floor: [x, z] of two corners, or null.
  floor() {
    const columns = this.columns('position', ['x', 'z']);
    let box = null;
    for (let frame = 0; frame < this.nFrames; frame++) {
      const [x, z] = this.read(frame, columns);
      if (!Number.isFinite(x) || !Number.isFinite(z)) continue;
      box ??= [[x, z], [x, z]];
      box[0] = [Math.min(box[0][0], x), Math.min(box[0][1], z)];
      box[1] = [Math.max(box[1][0], x), Math.max(box[1][1], z)];
    }
    return box;
  }
}

// What can be drawn over time: names, units and curves. A range is shown whole even where values keep
// within it; a jump beyond half of `wraps` is no line.
const CURVES = [
  {
    name: 'position', unit: 'm', shown: true,
    lines: (m) => ['x', 'y', 'z'].map((part) => [part, m.column(m.index.get(`position_${part}`))]),
  },
  {
    name: 'speed', unit: 'm/s', shown: true, range: [0, 0],
    lines: (m) => [['of the position', m.speed()], ['as the velocity says', m.norm('velocity')]],
  },
  {
    name: 'acceleration', unit: 'm/s²', shown: true, range: [0, 0],
    lines: (m) => [['length', m.norm('acceleration')]],
  },
  {
    name: 'yaw', unit: '°', shown: true, range: [-180, 180], wraps: 360,
    lines: (m) => [['0 faces +z', m.yaw()]],
  },
  {
    name: 'tilt', unit: '°', shown: false, range: [0, 0],
    lines: (m) => [['from upright', m.tilt()]],
  },
  {
    name: 'turn rate', unit: '°/s', shown: false, range: [0, 0],
    lines: (m) => [['length', m.norm('angular_velocity', 180 / Math.PI)]],
  },
  {
    name: 'phase', unit: 'bar', shown: true, range: [0, 1], wraps: 1,
    lines: (m) => [['0 on the downbeat', m.column(m.index.get('phase'))]],
  },
  {
    name: 'style', unit: '', shown: false, range: [-1, 1],
    lines: (m) => m.names
      .filter((name) => name.startsWith('style_'))
      .map((name) => [name.slice('style_'.length), m.column(m.index.get(name))]),
  },
];
