// Groups: several bodies on the stage of one, each in a colour of its own. A page without a group has no
// such part; it comes last, and replaces what is otherwise of one body.

const ALL = -1;
// Space around a group, in metres, and how much further than it is wide the camera stands.
const GROUP_ROOM = 2.4;
const GROUP_DISTANCE = 0.75;
// How far from one of a group it stands, in metres: the others would be in its way.
const MEMBER_DISTANCE = 5;

// A colour #rrggbb on its way to another.
function mixed(color, other, share) {
  const parts = [1, 3, 5].map((i) => {
    const [a, b] = [color, other].map((c) => parseInt(c.slice(i, i + 2), 16));
    return Math.round(a + share * (b - a)).toString(16).padStart(2, '0');
  });
  return `#${parts.join('')}`;
}

samples.forEach((sample, i) => {
  const others = data.samples[i]?.dancers ?? [];
  const decoded = others.map((frames) => new Motion(decodeFloats(frames), channels, fps));
  sample.dancers = [sample.motion, ...decoded];
});

const group = { dancers: samples[0].dancers, followed: ALL, size: 0 };

function colorOf(dancer) {
  return data.colors[dancer % data.colors.length];
}

// The colours of the page with those of a dancer.
function colorsOf(dancer) {
  const body = colorOf(dancer);
  return { ...colors, body, trail: body, front: mixed(body, colors.ink, 0.55) };
}

// The dancers whose place is known at a moment, those further from the camera first.
function dancersAt(time, eye) {
  const known = group.dancers
    .map((motion, dancer) => ({ motion, dancer, pose: motion.pose(time) }))
    .filter(({ pose }) => pose !== null);
  const distance = ({ pose }) => Math.hypot(...pose.position.map((c, i) => c - eye[i]));
  return known.sort((a, b) => distance(b) - distance(a));
}

// The greatest width of the group at any moment.
function widthOf(dancers) {
  let width = 0;
  const n = Math.min(...dancers.map((motion) => motion.nFrames));
  for (let frame = 0; frame < n; frame += 10) {
    const places = dancers
      .map((motion) => motion.pose(frame / motion.fps))
      .filter((pose) => pose !== null)
      .map(({ position }) => [position[0], position[2]]);
    for (const a of places) {
      for (const b of places) width = Math.max(width, Math.hypot(a[0] - b[0], a[1] - b[1]));
    }
  }
  return width;
}

const solo = { show: stage.show, view: stage.view, draw: stage.draw, ways: stage.ways,
  middle: stage.middle };

stage.show = function show(motion) {
  solo.show.call(this, motion);
  const boxes = group.dancers.map((dancer) => dancer.floor()).filter((box) => box !== null);
  if (boxes.length === 0) return;
  const end = (i, of) => [0, 1].map((axis) => of(...boxes.map((box) => box[i][axis])));
  this.box = [end(0, Math.min).map((c) => c - 1.5), end(1, Math.max).map((c) => c + 1.5)];
};

stage.view = function view(name) {
  solo.view.call(this, name);
  if (name === 'whole' || group.dancers.length < 2) return;
  const room = group.followed === ALL ? GROUP_ROOM + GROUP_DISTANCE * group.size : MEMBER_DISTANCE;
  this.distance = Math.max(this.distance, room);
};

// Where the camera that follows looks: at one dancer, or at the middle of all.
stage.middle = function middle(time) {
  const followed = group.followed === ALL ? group.dancers : [group.dancers[group.followed]];
  const { motion } = this;
  const middles = followed.map((dancer) => {
    this.motion = dancer;
    return solo.middle.call(this, time);
  }).filter((place) => place !== null);
  this.motion = motion;
  if (middles.length === 0) return null;
  return [0, 1, 2].map((i) => middles.reduce((sum, m) => sum + m[i], 0) / middles.length);
};

// What is drawn of one body is drawn of the nearest, after all others.
stage.draw = function draw(time, flash, beats) {
  const middle = this.follows && this.middle(time);
  if (middle) this.target = middle;
  this.order = dancersAt(time, this.axes().eye);
  this.flash = flash;
  const nearest = this.order[this.order.length - 1];
  this.motion = nearest?.motion ?? group.dancers[0];
  this.colors = colorsOf(nearest?.dancer ?? 0);
  solo.draw.call(this, time, flash, beats);
  this.colors = colors;
};

stage.ways = function ways(time, beats) {
  const { motion, colors: own } = this;
  const { eye } = this.axes();
  group.dancers.forEach((dancer, i) => {
    this.motion = dancer;
    this.colors = colorsOf(i);
    // Beats are marked where the eye is: on the way of who is followed.
    solo.ways.call(this, time, i === group.followed ? beats : []);
  });
  for (const { dancer, pose } of this.order.slice(0, -1)) {
    this.colors = colorsOf(dancer);
    drawBody(this, pose, this.flash, eye);
  }
  [this.motion, this.colors] = [motion, own];
};

const dancerChoice = element('select', { id: 'dancer' });
at('camera').append(element('label', {}, ['Dancer ', dancerChoice]));

function fillDancers() {
  const options = group.dancers.map((_, i) => element('option', { value: i, textContent: i }));
  dancerChoice.replaceChildren(element('option', { value: ALL, textContent: 'all' }), ...options);
  dancerChoice.value = group.followed;
}

function nameDancers() {
  const names = group.dancers.map((_, i) => {
    const swatch = element('span', { textContent: '■ ' });
    swatch.style.color = colorOf(i);
    const name = element('span', {}, [swatch, `${i}  `]);
    name.style.whiteSpace = 'pre';
    name.style.display = 'inline-block'; // a line may end between two names
    return name;
  });
  const shown = Math.max(0, group.followed);
  at('facts').append(
    element('dt', { textContent: 'dancers' }), element('dd', {}, names),
    element('dt', { textContent: 'curves' }), element('dd', { textContent: `of dancer ${shown}` }),
  );
}

// Follows one dancer, from 0, or all of them (-1): curves and bar are those of the dancer.
function follow(dancer) {
  group.followed = dancer >= 0 && dancer < group.dancers.length ? dancer : ALL;
  samples[state.sample].motion = group.dancers[Math.max(0, group.followed)];
  stage.follows = true;
  stage.view('front');
  choose(state.sample);
}
dancerChoice.addEventListener('change', () => follow(Number(dancerChoice.value)));
window.motiongen.follow = follow;

const chooseSolo = choose;
choose = (index) => {
  group.dancers = samples[index].dancers;
  if (group.followed >= group.dancers.length) group.followed = ALL;
  samples[index].motion = group.dancers[Math.max(0, group.followed)];
  group.size = widthOf(group.dancers);
  chooseSolo(index);
  dancerChoice.parentElement.hidden = group.dancers.length < 2;
  if (group.dancers.length < 2) return;
  fillDancers();
  nameDancers();
};

choose(0);
stage.view('front');
draw();
