// The page: its parts, its clock and its controls.

const FLASH_S = 0.12;
const ZOOM = 1.2;
// A scrubber that jumps back this little is the clock of the audio running unevenly.
const UNEVEN_S = 0.25;

const at = (id) => document.getElementById(id);
const data = JSON.parse(at('data').textContent);
const { fps, channels, beats } = data;
const samples = data.samples.map(({ name, facts, frames }) => {
  return { name, facts, motion: new Motion(decodeFloats(frames), channels, fps) };
});
if (samples.length === 0) {
  samples.push({ name: '', facts: [], motion: new Motion(new Float32Array(0), channels, fps) });
}

const colors = {};
function readColors() {
  const style = getComputedStyle(document.documentElement);
  const names = ['paper', 'panel', 'ink', 'muted', 'grid', 'axis', 'floor', 'body', 'front', 'trail',
    'beat', 'first', 'second', 'third', 'fourth'];
  for (const name of names) colors[name] = style.getPropertyValue(`--${name}`).trim() || '#808080';
}
readColors();

const isCalm = window.matchMedia('(prefers-reduced-motion: reduce)').matches;
const audio = at('audio');
const stage = new Stage(at('stage'), colors, () => draw());
const charts = CURVES.map((curve) => new Chart(curve, colors, (time) => seek(time)));
const state = { sample: 0, time: 0, isPlaying: false, hasSound: audio !== null, rate: 1 };
let motion = samples[0].motion;

function audioDuration() {
  return audio && Number.isFinite(audio.duration) ? audio.duration : 0;
}

// How long there is anything to see or hear, in seconds.
function duration() {
  return Math.max(motion.duration, audioDuration(), 1 / fps);
}

// The clock. While there is sound it is the audio's, smoothed between its steps; else the page's own.
// `heardAt` is when the audio last moved to `heard`: never, as long as it is still starting.
const clock = { wall: 0, heard: 0, heardAt: Infinity };

function isHeard() {
  return state.hasSound && !audio.paused && !audio.ended && state.time < audioDuration();
}

function tick(now) {
  const passed = Math.max(0, Math.min(0.25, (now - clock.wall) / 1000));
  clock.wall = now;
  if (!state.isPlaying) return;
  if (isHeard()) {
    if (audio.currentTime !== clock.heard) {
      [clock.heard, clock.heardAt] = [audio.currentTime, now];
    }
    const since = Math.max(0, Math.min(UNEVEN_S, (now - clock.heardAt) / 1000)) * state.rate;
    const time = clock.heard + since;
    // Never a step back for the unevenness of the audio's clock.
    const isStep = time < state.time && state.time - time < UNEVEN_S;
    state.time = isStep ? state.time : time;
  } else {
    state.time += passed * state.rate;
  }
  if (state.time < duration() - 1e-6) return;
  if (at('loop').checked) {
    seek(0);
  } else {
    state.time = duration();
    pause();
  }
}

function play() {
  if (state.time >= duration() - 0.5 / fps) seek(0);
  state.isPlaying = true;
  state.hasSound = audio !== null;
  sound();
  label();
}

function pause() {
  state.isPlaying = false;
  audio?.pause();
  label();
}

// Starts the audio where the clock is; a browser that refuses leaves the clock to run alone.
function sound() {
  if (!state.hasSound || !state.isPlaying || state.time >= audioDuration()) return;
  if (Math.abs(audio.currentTime - state.time) > 0.03) audio.currentTime = state.time;
  [clock.heard, clock.heardAt] = [audio.currentTime, Infinity];
  audio.play()?.catch(() => {
    state.hasSound = false;
  });
}

function seek(time) {
  state.time = Math.max(0, Math.min(duration(), Number(time) || 0));
  if (audio && audioDuration() > 0) {
    audio.currentTime = Math.min(state.time, audioDuration());
    [clock.heard, clock.heardAt] = [audio.currentTime, Infinity];
    if (state.isPlaying && audio.paused) sound();
  }
  draw();
}

function label() {
  const button = at('play');
  button.textContent = state.isPlaying ? '❚❚' : '▶';
  button.setAttribute('aria-label', state.isPlaying ? 'Pause' : 'Play');
}

// How near the last beat is: 1 on it, then falling.
function flashAt(time) {
  let [low, high] = [0, beats.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (beats[middle] <= time + 1e-6) low = middle + 1;
    else high = middle;
  }
  if (low === 0 || isCalm) return 0;
  return Math.exp(-(time - beats[low - 1]) / FLASH_S);
}

// The part of the time that charts show: all of it, or the page of it that the clock is on.
function shown() {
  const span = Number(at('span').value);
  const whole = duration();
  if (!span || span >= whole) return [0, whole];
  const from = Math.floor(Math.min(state.time, whole - 1e-6) / span) * span;
  return [from, from + span];
}

let drafted = '';
function draftCharts() {
  const open = charts.filter((chart) => chart.isOpen);
  const [from, to] = shown();
  const widths = open.map((chart) => chart.canvas.clientWidth).join();
  const key = [from, to, state.sample, widths, colors.paper, window.devicePixelRatio].join('|');
  if (key === drafted) return open;
  drafted = key;
  open.forEach((chart) => chart.draft([from, to], beats));
  return open;
}

function draw() {
  const { time } = state;
  const flash = flashAt(time);
  stage.draw(time, flash, beats);
  at('follow').checked = stage.follows;
  drawDial(at('dial'), colors, motion.phase(time), flash);
  drawBeats(at('beats'), colors, motion, beats, time, duration());
  draftCharts().forEach((chart) => chart.draw(time));
  at('time').textContent = `${time.toFixed(2)} / ${duration().toFixed(2)} s`;
  const scrub = at('scrub');
  scrub.max = duration();
  if (document.activeElement !== scrub || Math.abs(scrub.value - time) > 0.5 / fps) scrub.value = time;
  scrub.setAttribute('aria-valuetext', `${time.toFixed(2)} seconds, frame ${motion.frameAt(time)}`);
}

function choose(index) {
  state.sample = index;
  const { facts } = samples[index];
  ({ motion } = samples[index]);
  const own = [['frames', `${motion.nFrames} at ${fps} per second`]];
  if (beats.length > 0) own.push(['beats', `${beats.length}`]);
  at('facts').replaceChildren(...[...facts, ...own].flatMap(([name, value]) => [
    element('dt', { textContent: name }), element('dd', { textContent: value }),
  ]));
  stage.show(motion);
  charts.forEach((chart) => chart.show(motion));
  drafted = '';
  seek(state.time);
}

function listen() {
  at('play').addEventListener('click', () => (state.isPlaying ? pause() : play()));
  at('scrub').addEventListener('input', (event) => seek(event.target.value));
  at('beats').addEventListener('pointerdown', (event) => {
    const box = at('beats').getBoundingClientRect();
    seek(((event.clientX - box.left - 8) / (box.width - 16)) * duration());
  });
  at('rate').addEventListener('change', (event) => {
    state.rate = Number(event.target.value);
    if (audio) audio.playbackRate = state.rate;
  });
  at('span').addEventListener('change', draw);
  at('follow').addEventListener('change', (event) => {
    stage.follows = event.target.checked;
    draw();
  });
  at('camera').addEventListener('click', (event) => {
    const { view } = event.target.dataset;
    if (!view) return;
    stage.follows = true;
    stage.view(view);
    draw();
  });
  document.addEventListener('keydown', keys);
  window.addEventListener('resize', draw);
  window.matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => {
    readColors();
    draw();
  });
}

function keys(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const { tagName, type, id } = event.target;
  // What has keys of its own keeps them.
  if (tagName === 'SELECT' || id === 'volume') return;
  const isPressed = event.key === ' ' || event.key === 'Enter';
  if (isPressed && (tagName === 'BUTTON' || type === 'checkbox')) return;
  const moves = {
    ArrowLeft: () => seek(state.time - 1),
    ArrowRight: () => seek(state.time + 1),
    ',': () => seek((motion.frameAt(state.time) - 1) / fps),
    '.': () => seek((motion.frameAt(state.time) + 1) / fps),
    Home: () => seek(0),
    End: () => seek(duration()),
    '+': () => stage.zoom(1 / ZOOM),
    '=': () => stage.zoom(1 / ZOOM),
    '-': () => stage.zoom(ZOOM),
    ' ': () => (state.isPlaying ? pause() : play()),
  };
  const move = moves[event.key];
  if (!move) return;
  event.preventDefault();
  move();
}

function fill() {
  const select = at('sample');
  select.append(...samples.map(({ name }, i) => element('option', { value: i, textContent: name })));
  select.addEventListener('change', () => choose(Number(select.value)));
  at('sample-choice').hidden = samples.length < 2;
  for (const chart of charts) {
    chart.isOpen = chart.curve.shown;
    const box = element('input', { type: 'checkbox', checked: chart.isOpen });
    box.addEventListener('change', () => {
      chart.isOpen = box.checked;
      chart.element.hidden = !box.checked;
      drafted = '';
      draw();
    });
    at('channels').append(element('label', {}, [box, ` ${chart.curve.name}`]));
    chart.element.hidden = !chart.isOpen;
    at('charts').append(chart.element);
  }
}

function listenToAudio() {
  at('volume-choice').hidden = false;
  at('volume').addEventListener('input', (event) => {
    audio.volume = Number(event.target.value);
  });
  audio.addEventListener('loadedmetadata', () => {
    sound();
    draw();
  });
}

function missAudio() {
  state.hasSound = false;
  at('problem').textContent = 'This browser cannot play the audio; the motion plays without it.';
  at('problem').hidden = false;
}

// Returns the file that the audio element has as an address, and takes it from there: what the browser
// reads of an address it holds beside the file.
function takeAudio() {
  const [head, base64] = audio.getAttribute('src').split(';base64,');
  audio.removeAttribute('src');
  audio.load();
  return decodeBlob(base64, head.slice('data:'.length));
}

// Audio as an address is not to be sought through in every browser; as a file in memory it is. Until it
// is one, the motion plays by its own clock.
async function bringAudio() {
  const file = await takeAudio();
  audio.addEventListener('error', () => {
    audio.addEventListener('error', missAudio);
    const reader = new FileReader();
    reader.onload = () => {
      audio.src = reader.result;
    };
    reader.onerror = missAudio;
    reader.readAsDataURL(file);
  }, { once: true });
  audio.src = URL.createObjectURL(file);
}

function run(now) {
  tick(now);
  if (state.isPlaying) draw();
  requestAnimationFrame(run);
}

window.motiongen = {
  frame: () => motion.frameAt(state.time),
  time: () => state.time,
  duration,
  isPlaying: () => state.isPlaying,
  choose: (index) => {
    at('sample').value = index;
    choose(index);
  },
  seek,
  play,
  pause,
};

fill();
listen();
if (audio) listenToAudio();
choose(0);
requestAnimationFrame((now) => {
  clock.wall = now;
  draw();
  window.motiongenReady = true;
  run(now);
  // After the first picture: a long recording takes seconds.
  if (audio) setTimeout(() => bringAudio().catch(missAudio));
});
