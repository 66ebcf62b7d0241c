// Curves over time with a cursor, and the line of beats.

const LEFT = 46;
const RIGHT = 10;
const TOP = 5;
const FOOT = 17;
const FONT = '11px system-ui, sans-serif';
// Beats closer than this would be a veil.
const MIN_BEAT_GAP = 4;

// Multiples of 1, 2 or 5 times a power of ten from low to high, at most `most` of them.
function ticks(low, high, most) {
  const span = high - low;
  if (!(span > 0) || !Number.isFinite(span)) return [low];
  let step = 10 ** (Math.floor(Math.log10(span / most)) - 1);
  for (let i = 0; span / step > most; i++) step *= [2, 2.5, 2][i % 3];
  const found = [];
  const first = Math.ceil(low / step - 1e-6);
  for (let i = first; i * step <= high + 1e-6 * step; i++) found.push(i * step);
  return found;
}

// Three significant figures, without idle zeros.
function short(value) {
  if (!Number.isFinite(value)) return '–';
  const text = Math.abs(value) >= 1e5 || (value !== 0 && Math.abs(value) < 1e-3)
    ? value.toExponential(1)
    : String(Number(value.toPrecision(3)));
  return text.replace('-', '−');
}

function element(name, properties = {}, children = []) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

// One line of values, at a place on the page: [column, least, greatest] of each pixel, or each frame.
function* columnsOf(values, first, last, width) {
  const nFrames = last - first + 1;
  const nColumns = Math.max(1, Math.min(nFrames, Math.floor(width)));
  for (let column = 0; column < nColumns; column++) {
    const from = first + Math.floor((column * nFrames) / nColumns);
    const to = first + Math.floor(((column + 1) * nFrames) / nColumns);
    let [least, greatest] = [Infinity, -Infinity];
    for (let frame = from; frame < to; frame++) {
      const value = values[frame];
      if (!Number.isFinite(value)) continue;
      least = Math.min(least, value);
      greatest = Math.max(greatest, value);
    }
    yield [(from + to - 1) / 2, least, greatest];
  }
}

class Chart {
  constructor(curve, colors, seek) {
    Object.assign(this, { curve, colors });
    this.canvas = element('canvas');
    this.canvas.setAttribute('role', 'img');
    this.canvas.setAttribute('aria-label', `${curve.name} over time; a click moves to that time`);
    this.caption = element('figcaption');
    this.element = element('figure', {}, [this.caption, this.canvas]);
    this.sheet = document.createElement('canvas');
    const to = (event) => {
      const x = event.clientX - this.canvas.getBoundingClientRect().left;
      seek(this.timeAt(x));
    };
    this.canvas.addEventListener('pointerdown', (event) => {
      this.canvas.setPointerCapture(event.pointerId);
      to(event);
    });
    this.canvas.addEventListener('pointermove', (event) => {
      if (event.buttons & 1) to(event);
    });
  }

  // Takes another motion, whose curves are computed when they are first drawn.
  show(motion) {
    this.motion = motion;
    this.lines = null;
  }

  prepare() {
    const names = ['first', 'second', 'third', 'fourth'];
    this.lines = this.curve.lines(this.motion).map(([label, values], i) => {
      return { label, values, color: names[i % names.length] };
    });
    let [low, high] = this.curve.range ?? [Infinity, -Infinity];
    for (const { values } of this.lines) {
      for (const value of values) {
        if (!Number.isFinite(value)) continue;
        low = Math.min(low, value);
        high = Math.max(high, value);
      }
    }
    if (!(low < high)) [low, high] = Number.isFinite(low) ? [low - 0.5, low + 0.5] : [0, 1];
    const pad = 0.04 * (high - low);
    this.ends = [low - pad, high + pad];
    const unit = this.curve.unit && ` ${this.curve.unit}`;
    this.readings = this.lines.map(({ label, color }) => {
      const reading = element('span');
      const value = element('span', { className: 'value' }, [
        element('span', { textContent: `${label} ` }), reading, element('span', { textContent: unit }),
      ]);
      value.style.color = `var(--${color})`;
      return { reading, value };
    });
    this.caption.replaceChildren(
      element('strong', { textContent: this.curve.name }),
      ...this.readings.map(({ value }) => value),
    );
    this.read = -1;
  }

  timeAt(x) {
    const [from, to] = this.shown;
    const width = this.canvas.clientWidth - LEFT - RIGHT;
    return from + (Math.max(0, Math.min(1, (x - LEFT) / width)) * (to - from));
  }

  // Draws what does not move: axes, beats and curves from one time to another.
  draft(shown, beats) {
    if (!this.lines) this.prepare();
    this.shown = shown;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    fitted(this.canvas);
    [this.sheet.width, this.sheet.height] = [this.canvas.width, this.canvas.height];
    const pen = this.sheet.getContext('2d');
    const ratio = width > 0 ? this.canvas.width / width : 1;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    const [low, high] = this.ends;
    const [from, to] = shown;
    const x = (time) => LEFT + ((time - from) / (to - from)) * (width - LEFT - RIGHT);
    const y = (value) => TOP + ((high - value) / (high - low)) * (height - TOP - FOOT);
    this.x = x;
    this.axes(pen, x, y, width, height);
    pen.strokeStyle = this.colors.beat;
    const inside = beats.filter((beat) => beat >= from && beat <= to);
    if (inside.length * MIN_BEAT_GAP <= width - LEFT - RIGHT) {
      pen.globalAlpha = 0.35;
      pen.beginPath();
      for (const beat of inside) {
        pen.moveTo(x(beat), TOP);
        pen.lineTo(x(beat), height - FOOT);
      }
      pen.stroke();
      pen.globalAlpha = 1;
    }
    pen.save();
    pen.beginPath();
    pen.rect(LEFT, 0, width - LEFT - RIGHT, height);
    pen.clip();
    for (const { values, color } of this.lines) this.trace(pen, values, this.colors[color], x, y);
    pen.restore();
  }

  axes(pen, x, y, width, height) {
    const [from, to] = this.shown;
    pen.font = FONT;
    pen.fillStyle = this.colors.muted;
    pen.strokeStyle = this.colors.grid;
    pen.lineWidth = 1;
    pen.beginPath();
    pen.textAlign = 'right';
    pen.textBaseline = 'middle';
    for (const value of ticks(...this.ends, Math.max(2, Math.floor((height - TOP - FOOT) / 24)))) {
      pen.moveTo(LEFT, y(value));
      pen.lineTo(width - RIGHT, y(value));
      pen.fillText(short(value), LEFT - 6, y(value));
    }
    pen.textAlign = 'center';
    pen.textBaseline = 'alphabetic';
    for (const time of ticks(from, to, Math.max(2, Math.floor((width - LEFT - RIGHT) / 70)))) {
      pen.moveTo(x(time), TOP);
      pen.lineTo(x(time), height - FOOT);
      // A label at the right edge ends there instead of being cut.
      const label = `${short(time)} s`;
      const half = pen.measureText(label).width / 2;
      pen.fillText(label, Math.min(x(time), width - half), height - 4);
    }
    pen.stroke();
  }

  trace(pen, values, color, x, y) {
    const { fps, nFrames } = this.motion;
    if (nFrames === 0) return;
    const [from, to] = this.shown;
    const first = Math.max(0, Math.floor(from * fps) - 1);
    const last = Math.min(nFrames - 1, Math.ceil(to * fps) + 1);
    if (last < first) return;
    const jump = this.curve.wraps ? this.curve.wraps / 2 : Infinity;
    pen.strokeStyle = color;
    pen.lineWidth = 1.5;
    pen.lineJoin = 'round';
    pen.beginPath();
    let before = null;
    for (const [frame, least, greatest] of columnsOf(values, first, last, x(to) - x(from))) {
      if (least > greatest) {
        before = null;
        continue;
      }
      const at = x(frame / fps);
      if (before === null || Math.abs(least - before) > jump) pen.moveTo(at, y(least));
      else pen.lineTo(at, y(least));
      // A frame alone is a dot.
      if (before === null) pen.lineTo(at + 0.5, y(least));
      if (greatest - least <= jump) {
        if (greatest > least) pen.lineTo(at, y(greatest));
        before = greatest;
      } else {
        pen.moveTo(at, y(greatest));
        before = greatest;
      }
    }
    pen.stroke();
  }

  draw(time) {
    const pen = fitted(this.canvas);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    pen.clearRect(0, 0, width, height);
    if (this.sheet.width > 0 && this.sheet.height > 0) pen.drawImage(this.sheet, 0, 0, width, height);
    const x = this.x(time);
    pen.strokeStyle = this.colors.ink;
    pen.lineWidth = 1;
    pen.beginPath();
    pen.moveTo(x, TOP);
    pen.lineTo(x, height - FOOT);
    pen.stroke();
    const frame = this.motion.frameAt(time);
    if (frame === this.read) return;
    this.read = frame;
    this.lines.forEach(({ values }, i) => {
      this.readings[i].reading.textContent = short(values[frame] ?? NaN);
    });
  }
}

// The line of beats over the scrubber: longer at the begin of a bar.
function drawBeats(canvas, colors, motion, beats, time, duration) {
  const pen = fitted(canvas);
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  pen.clearRect(0, 0, width, height);
  // The thumb of a scrubber is about 16 px wide and stays inside.
  const x = (at) => 8 + (at / duration) * (width - 16);
  pen.fillStyle = colors.floor;
  pen.fillRect(8, 0, width - 16, height);
  pen.fillStyle = colors.grid;
  pen.fillRect(8, 0, Math.max(0, x(time) - 8), height);
  if (beats.length * MIN_BEAT_GAP > width) return;
  for (const beat of beats) {
    if (beat > duration) continue;
    const phase = motion.phase(Math.min(beat, motion.duration));
    const isDownbeat = Math.min(phase, 1 - phase) < 0.06;
    const isPast = beat <= time && time - beat < 0.12;
    pen.fillStyle = isPast ? colors.ink : colors.beat;
    const length = isDownbeat ? height : 0.55 * height;
    pen.fillRect(x(beat) - (isPast ? 1.5 : 0.75), height - length, isPast ? 3 : 1.5, length);
  }
}

// The dial: one turn is a bar, and the downbeat is at the top.
function drawDial(canvas, colors, phase, flash) {
  const pen = fitted(canvas);
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  pen.clearRect(0, 0, width, height);
  const [x, y, radius] = [width / 2, height / 2, Math.min(width, height) / 2 - 6];
  if (!(radius > 0)) return;
  pen.lineWidth = 5;
  pen.strokeStyle = colors.grid;
  pen.beginPath();
  pen.arc(x, y, radius, 0, 2 * Math.PI);
  pen.stroke();
  pen.textAlign = 'center';
  pen.textBaseline = 'middle';
  pen.fillStyle = colors.muted;
  pen.font = FONT;
  pen.fillText('bar', x, y + 12);
  pen.fillStyle = colors.ink;
  pen.font = '16px system-ui, sans-serif';
  // Rounded down: a bar that is not over is not 1.00.
  pen.fillText(Number.isFinite(phase) ? (Math.floor(phase * 100) / 100).toFixed(2) : '–', x, y - 5);
  if (Number.isFinite(phase)) {
    const angle = 2 * Math.PI * phase - Math.PI / 2;
    pen.strokeStyle = colors.trail;
    pen.beginPath();
    pen.arc(x, y, radius, -Math.PI / 2, angle);
    pen.stroke();
    pen.fillStyle = colors.trail;
    pen.beginPath();
    pen.arc(x + radius * Math.cos(angle), y + radius * Math.sin(angle), 5, 0, 2 * Math.PI);
    pen.fill();
  }
  pen.globalAlpha = flash;
  pen.fillStyle = colors.beat;
  pen.beginPath();
  pen.arc(x, y - radius, 6, 0, 2 * Math.PI);
  pen.fill();
  pen.globalAlpha = 1;
}
