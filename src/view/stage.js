// The body in space, drawn on a canvas of two dimensions.
//
// Metres; +y up, and the camera at azimuth 0 stands on the side of +z, which the body faces at yaw 0.

const FIELD = 1.25; // Focal length over the height of the canvas.
const NEAR = 0.05;
const TRAIL_S = 4;
const FLOOR_TRAIL_S = 12;
const MAX_LINES = 60;
// The camera that follows looks at the middle of the way this long before and after.
const FOLLOW_S = 0.7;

function normalizedVector(v) {
  const norm = Math.hypot(...v);
  return v.map((c) => c / norm);
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

class Stage {
  constructor(canvas, colors, redraw) {
    this.canvas = canvas;
    this.colors = colors;
    this.redraw = redraw;
    this.follows = true;
    this.box = [[-1, -1], [1, 1]];
    this.target = [0, 0.9, 0];
    this.view('front');
    this.listen();
  }

  // Takes another motion; the camera stays unless it is told to move.
  show(motion) {
    this.motion = motion;
    const box = motion.floor() ?? [[0, 0], [0, 0]];
    this.box = [box[0].map((c) => c - 1.5), box[1].map((c) => c + 1.5)];
  }

  view(name) {
    const views = { front: [0.5, 0.28, 3.6], side: [Math.PI / 2, 0.15, 3.6], top: [0, 1.5, 6] };
    if (name === 'whole') {
      const [low, high] = this.box;
      this.follows = false;
      this.target = [(low[0] + high[0]) / 2, 0.5, (low[1] + high[1]) / 2];
      [this.azimuth, this.elevation] = [0.5, 0.6];
      this.distance = Math.max(3, 1.1 * Math.hypot(high[0] - low[0], high[1] - low[1]));
      return;
    }
    [this.azimuth, this.elevation, this.distance] = views[name];
  }

  zoom(factor) {
    this.distance = Math.max(0.8, Math.min(500, this.distance * factor));
    this.redraw();
  }

  listen() {
    const { canvas } = this;
    const held = new Map();
    const spread = () => {
      const [a, b] = [...held.values()];
      return Math.hypot(a[0] - b[0], a[1] - b[1]);
    };
    canvas.addEventListener('pointerdown', (event) => {
      canvas.setPointerCapture(event.pointerId);
      held.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener('pointermove', (event) => {
      const before = held.get(event.pointerId);
      if (!before) return;
      const [dx, dy] = [event.clientX - before[0], event.clientY - before[1]];
      const apart = held.size === 2 ? spread() : 0;
      held.set(event.pointerId, [event.clientX, event.clientY]);
      if (held.size === 2) {
        const now = spread();
        if (apart > 0 && now > 0) this.zoom(apart / now);
      } else if (event.shiftKey || event.buttons > 1) {
        const { right, up } = this.axes();
        const metres = this.distance / (FIELD * canvas.clientHeight || 1);
        this.follows = false;
        this.target = this.target.map((c, i) => c + metres * (dy * up[i] - dx * right[i]));
      } else {
        this.azimuth -= dx * 0.008;
        this.elevation = Math.max(-0.1, Math.min(1.55, this.elevation + dy * 0.008));
      }
      this.redraw();
    });
    const release = (event) => held.delete(event.pointerId);
    canvas.addEventListener('pointerup', release);
    canvas.addEventListener('pointercancel', release);
    canvas.addEventListener('contextmenu', (event) => event.preventDefault());
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      this.zoom(Math.exp(Math.max(-1, Math.min(1, event.deltaY / 400))));
    }, { passive: false });
    canvas.addEventListener('dblclick', () => {
      this.follows = true;
      this.view('front');
      this.redraw();
    });
  }

  // The camera's place and its axes.
  axes() {
    const [ca, sa] = [Math.cos(this.azimuth), Math.sin(this.azimuth)];
    const [ce, se] = [Math.cos(this.elevation), Math.sin(this.elevation)];
    const back = [sa * ce, se, ca * ce];
    const right = [ca, 0, -sa];
    const eye = this.target.map((c, i) => c + this.distance * back[i]);
    return { eye, right, up: cross(back, right), forward: back.map((c) => -c) };
  }

  // Draws the moment `time`; `flash` is how near the last beat is, 0 to 1.
  draw(time, flash, beats) {
    const context = fitted(this.canvas);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    context.fillStyle = this.colors.panel;
    context.fillRect(0, 0, width, height);
    if (!this.motion) return;
    const pose = this.motion.pose(time);
    const middle = this.follows && this.middle(time);
    if (middle) this.target = middle;
    const { eye, right, up, forward } = this.axes();
    const seen = (p) => {
      const d = [p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]];
      return [dot(d, right), dot(d, up), dot(d, forward)];
    };
    const onPage = ([x, y, z]) => {
      const scale = (FIELD * height) / z;
      return [width / 2 + scale * x, height / 2 - scale * y];
    };
    this.pen = { context, seen, onPage };
    this.floor();
    this.ways(time, beats);
    if (pose) drawBody(this, pose, flash, eye);
    else this.note('The body is nowhere in this frame: its numbers are not finite.', width, height);
  }

  // Where the body is on average around a moment: what a calm camera looks at; null where unknown.
  middle(time) {
    const { motion } = this;
    const sum = [0, 0, 0];
    let n = 0;
    for (let i = -8; i <= 8; i++) {
      const moment = Math.max(0, Math.min(motion.duration, time + (i * FOLLOW_S) / 8));
      const pose = motion.pose(moment);
      if (!pose) continue;
      pose.position.forEach((c, k) => {
        sum[k] += c;
      });
      n += 1;
    }
    return n > 0 ? [sum[0] / n, 0.9 * (sum[1] / n), sum[2] / n] : null;
  }

  note(text, width, height) {
    const { context } = this.pen;
    context.fillStyle = this.colors.ink;
    context.textAlign = 'center';
    context.fillText(text, width / 2, height / 2);
  }

  // Adds a line in space to the path under the pen, as far as it is before the camera.
  line(a, b) {
    const { context, seen, onPage } = this.pen;
    let [p, q] = [seen(a), seen(b)];
    if (p[2] < NEAR && q[2] < NEAR) return;
    const cut = (behind, before) => {
      const s = (NEAR - behind[2]) / (before[2] - behind[2]);
      return behind.map((c, i) => c + s * (before[i] - c));
    };
    if (p[2] < NEAR) p = cut(p, q);
    if (q[2] < NEAR) q = cut(q, p);
    context.moveTo(...onPage(p));
    context.lineTo(...onPage(q));
  }

  floor() {
    const { context, seen, onPage } = this.pen;
    const [low, high] = this.box;
    const side = Math.max(high[0] - low[0], high[1] - low[1]);
    // Squares of 1, 2, 5, 10, … metres.
    let step = 1;
    for (let i = 0; side / step > MAX_LINES; i++) step *= [2, 2.5, 2][i % 3];
    const ends = (axis) => [Math.floor(low[axis] / step), Math.ceil(high[axis] / step)];
    const [[x0, x1], [z0, z1]] = [ends(0), ends(1)];
    context.lineWidth = 1;
    for (const isAxis of [false, true]) {
      context.strokeStyle = isAxis ? this.colors.axis : this.colors.grid;
      context.beginPath();
      for (let i = x0; i <= x1; i++) {
        if ((i === 0) === isAxis) this.line([i * step, 0, z0 * step], [i * step, 0, z1 * step]);
      }
      for (let i = z0; i <= z1; i++) {
        if ((i === 0) === isAxis) this.line([x0 * step, 0, i * step], [x1 * step, 0, i * step]);
      }
      context.stroke();
    }
    context.fillStyle = this.colors.muted;
    context.font = '11px system-ui, sans-serif';
    context.textAlign = 'center';
    const label = (text, place, next) => {
      const [p, q] = [seen(place), seen(next)];
      if (p[2] < NEAR || q[2] < NEAR) return;
      const [a, b] = [onPage(p), onPage(q)];
      if (Math.hypot(a[0] - b[0], a[1] - b[1]) > 34) context.fillText(text, a[0], a[1] + 12);
    };
    for (let i = x0; i <= x1; i++) {
      const text = i === x1 ? `x ${i * step} m` : `${i * step}`;
      label(text, [i * step, 0, z1 * step], [(i + 1) * step, 0, z1 * step]);
    }
    for (let i = z0; i < z1; i++) {
      const text = i === z0 ? `z ${i * step} m` : `${i * step}`;
      label(text, [x1 * step, 0, i * step], [x1 * step, 0, (i + 1) * step]);
    }
  }

  // Draws where the body came from, in the air and on the floor, fading into the past.
  ways(time, beats) {
    const { motion } = this;
    const { context, seen, onPage } = this.pen;
    if (motion.nFrames === 0) return;
    const last = motion.frameAt(time);
    const columns = motion.columns('position', ['x', 'y', 'z']);
    const place = (frame, onFloor) => {
      const p = motion.read(frame, columns);
      return p.every(Number.isFinite) ? [p[0], onFloor ? 0 : p[1], p[2]] : null;
    };
    const way = (seconds, onFloor, strength, lineWidth) => {
      const n = Math.round(seconds * motion.fps);
      const first = Math.max(0, last - n);
      const parts = 16;
      context.strokeStyle = this.colors.trail;
      context.lineWidth = lineWidth;
      for (let part = 0; part < parts; part++) {
        const from = last - n + Math.round((part * n) / parts);
        const to = last - n + Math.round(((part + 1) * n) / parts);
        if (to <= first) continue;
        context.globalAlpha = strength * ((part + 1) / parts) ** 1.5;
        context.beginPath();
        for (let frame = Math.max(first, from); frame < to; frame++) {
          const [a, b] = [place(frame, onFloor), place(frame + 1, onFloor)];
          if (a && b) this.line(a, b);
        }
        context.stroke();
      }
      context.globalAlpha = 1;
    };
    way(FLOOR_TRAIL_S, true, 0.45, 1);
    way(TRAIL_S, false, 1, 2.5);
    context.fillStyle = this.colors.beat;
    for (const beat of beats) {
      if (beat > time || beat < time - TRAIL_S || beat >= motion.duration) continue;
      const p = place(motion.frameAt(beat), false);
      const q = p && seen(p);
      if (!q || q[2] < NEAR) continue;
      context.globalAlpha = 1 - (time - beat) / TRAIL_S;
      context.beginPath();
      context.arc(...onPage(q), 3.5, 0, 2 * Math.PI);
      context.fill();
    }
    context.globalAlpha = 1;
  }
}

// Returns the pen of a canvas that has as many pixels as the screen shows of it.
function fitted(canvas) {
  const ratio = Math.min(3, window.devicePixelRatio || 1);
  const [width, height] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio].map(Math.round);
  if (canvas.width !== width || canvas.height !== height) {
    [canvas.width, canvas.height] = [width, height];
  }
  const context = canvas.getContext('2d');
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  return context;
}
