// The page: puts together scene, view, clocks, videos and controls, and draws when something changes.

'use strict';

// Okabe and Ito's colours, which the colour-blind tell apart; names stand beside them everywhere
const COLORS = ['#e69f00', '#56b4e9', '#009e73', '#f0e442', '#0072b2', '#d55e00', '#cc79a7', '#b8bec9'];
const REST_SECONDS = 0.25; // without change, before the picture is drawn with every pixel
const FRUSTUM = 0.13; // depth of a camera's pyramid, as a share of the cameras' distance
const PATH_SAMPLES = 72; // instants of a trajectory
const DENSE = 1500; // Gaussians whose trajectories are shown
const NODE_COLOR = [1, 0.93, 0.55];

class Page {
  constructor({ about, arrays }, stepper) {
    this.about = about;
    this.arrays = arrays;
    this.strips = about.cameras.map(() => null);
    this.clocks = new Clocks(about);
    this.view = new View(about);
    this.stage = new Stage(part('view'), part('overlay'), about, arrays);
    this.stepper = stepper;
    this.seconds = openingMoment(about);
    this.speed = Number(part('speed').value);
    this.playing = false;
    this.answer = null; // what the engine said last
    this.asked = ''; // what it was asked
    this.working = 0; // questions that the engine has not answered
    this.changedAt = 0;
    this.calm = matchMedia('(prefers-reduced-motion: reduce)').matches;
    this.#bind();
    this.#readHash();
  }

  /** Something changed: draw. */
  change() {
    document.documentElement.dataset.state = 'moving';
    this.changedAt = performance.now();
    this.dirty = true;
    this.full = false;
    if (!this.frame) {
      this.before = performance.now();
      this.frame = requestAnimationFrame((now) => this.#tick(now));
    }
  }

  get layers() {
    const chosen = Object.fromEntries(['still', 'frusta', 'ghosts'].map((id) => [id, part(id).checked]));
    return { ...chosen, paths: part('paths').value !== 'none' };
  }

  #tick(now) {
    this.frame = 0;
    const passed = clamp((now - this.before) / 1000, 0, 0.25);
    this.before = now;
    if (this.playing) this.#play(passed);
    const sliding = this.clocks.advance(passed);
    const flying = this.view.moving;
    this.view.advance(passed, (camera) => this.clocks.own(camera, this.seconds));
    const active = this.playing || sliding || flying;
    if (active) {
      this.changedAt = now;
      this.dirty = true;
      this.stage.learn(passed);
    }
    const resting = !active && now - this.changedAt > 1000 * REST_SECONDS;
    const [width, height] = this.stage.fit(resting);
    const shot = this.view.shot(width, height);
    this.#ask(shot);
    const upToDate = this.working === 0;
    if (this.answer && (this.dirty || (resting && upToDate && !this.full))) {
      this.#draw(shot);
      this.dirty = false;
      this.full = resting && upToDate;
    }
    if (this.full) {
      document.documentElement.dataset.state = 'still';
    } else {
      this.frame = requestAnimationFrame((later) => this.#tick(later));
    }
  }

  #play(passed) {
    const [first, last] = this.about.span;
    this.seconds += passed * this.speed;
    if (this.seconds > last) this.seconds = first + ((this.seconds - first) % Math.max(last - first, 1e-6));
  }

  /** Asks the engine for the present instant and view, unless it knows them or is at work. */
  #ask(shot) {
    if (this.working > 0) return;
    const { still, ghosts } = this.layers;
    const times_ = ghosts ? this.about.cameras.map((camera) => this.clocks.shown(camera, this.seconds)) : [];
    const ask = { time: this.seconds, axis: shot.axis, still, near: this.view.near, ghosts: times_ };
    const key = JSON.stringify(ask);
    if (key === this.asked) return;
    this.asked = key;
    this.working++;
    this.stepper.step(ask).then((answer) => {
      this.working--;
      this.answer = answer;
      this.stage.splats.take(answer);
      if (ghosts) this.stage.putGhosts(answer.ghosts);
      this.dirty = true;
      if (!this.frame) this.change();
    }, stop);
  }

  #draw(shot) {
    const { view, about } = this;
    const camera = view.mode === 'camera' && !view.way ? view.camera : -1;
    const filming = camera >= 0 ? about.cameras[camera] : null;
    const own = filming ? this.clocks.own(filming, this.seconds) : 0;
    const poses = about.cameras.map((each) => poseOf(each, this.clocks.own(each, this.seconds)));
    const look = {
      ...this.layers,
      seconds: this.seconds,
      gain: filming ? filming.gain : [1, 1, 1],
      falloff: filming ? filming.falloff : [0, 0],
      camera,
      poses,
      own,
      blend: Number(part('blend').value),
      strip: filming ? this.strips[camera] : null,
    };
    this.#tell();
    if (look.frusta) this.stage.putFrusta(poses, FRUSTUM * about.radius, this.tiles);
    this.stage.draw(shot, look);
    this.stage.drawOver(shot, look);
  }

  /** Everything around the picture that shows the present moment. */
  #tell() {
    const { about, seconds } = this;
    part('time').value = seconds;
    const frame = (seconds - about.start) / about.step;
    part('time').setAttribute('aria-valuetext', `${seconds.toFixed(3)} seconds`);
    part('now').textContent = `${seconds.toFixed(3)} s · frame ${frame.toFixed(2)} of the reference`;
    part('between').textContent = filmedWords(about.cameras, this.clocks, seconds);
    this.timeline.draw(seconds);
    about.cameras.forEach((camera, v) => {
      this.tiles[v].button.setAttribute('aria-pressed', String(this.view.camera === v));
      const { synchronised, origin } = this.clocks;
      this.tiles[v].offset.textContent = synchronised ? offsetWords(camera, origin) : 'offset not applied';
      this.#showTile(v, this.clocks.own(camera, seconds));
    });
    part('tour').setAttribute('aria-pressed', String(this.view.mode === 'tour'));
    part('camera').value = String(this.view.camera);
    part('play').setAttribute('aria-pressed', String(this.playing));
    part('play').setAttribute('aria-label', this.playing ? 'Pause' : 'Play');
    part('blend').disabled = this.view.camera < 0 || !this.strips[this.view.camera];
    part('blend-note').hidden = !part('blend').disabled;
  }

  /** Draws a video's picture of a second of its own clock, unless it is the one that its tile shows. */
  #showTile(v, own) {
    const [tile, strip, camera] = [this.tiles[v], this.strips[v], this.about.cameras[v]];
    if (!strip) return;
    const found = strip.nearest(own);
    const shown = found >= 0 ? found : own < camera.first ? 'not yet filming' : 'stopped filming';
    if (shown === tile.shown) return;
    tile.shown = shown;
    const context = tile.picture.getContext('2d');
    if (found < 0) blank(context, shown);
    else strip.draw(context, own, 0, 0, tile.picture.width, tile.picture.height);
  }

  seek(seconds) {
    this.seconds = clamp(seconds, ...this.about.span);
    this.change();
  }

  setPlaying(playing) {
    this.playing = playing;
    this.change();
  }

  lookThrough(camera) {
    if (camera < 0) this.view.free(this.view.pose);
    else if (camera < this.about.cameras.length) this.view.through(camera, this.calm);
    this.change();
  }

  chooseClocks(synchronised) {
    part('clocks').querySelector(`[value="${synchronised ? 'synchronised' : 'filmed'}"]`).checked = true;
    this.clocks.choose(synchronised, this.calm);
    this.change();
  }

  toggleTour() {
    if (this.view.mode === 'tour') this.view.free(this.view.pose);
    else if (this.about.cameras.length > 1) this.view.startTour();
    this.change();
  }

  /** Shows trajectories of the nodes, or of many Gaussians in their own colours. */
  async showPaths() {
    const kind = part('paths').value;
    if (kind !== 'none' && kind !== this.pathsPut) {
      this.pathsPut = kind;
      const [first, last] = this.about.span;
      const seconds = Array.from({ length: PATH_SAMPLES }, (_, i) => mix(first, last, i / (PATH_SAMPLES - 1)));
      const which = kind === 'dense' ? someOf(this.about.moving, DENSE) : null;
      this.working++;
      this.change();
      const paths = await this.stepper.paths({ seconds, which });
      this.working--;
      const nodes = () => Float32Array.from({ length: paths[0].length }, (_, i) => NODE_COLOR[i % 3]);
      this.stage.putPaths(paths, seconds, which ? picked(this.arrays.dynamic_colors, which, 3) : nodes());
      this.asked = ''; // the engine was elsewhere in time
    }
    this.change();
  }

  #bind() {
    const { about } = this;
    const changed = () => this.change();
    const select = part('camera');
    select.append(new Option('free', '-1'), ...about.cameras.map((camera, v) => new Option(camera.name, String(v))));
    select.addEventListener('change', () => this.lookThrough(Number(select.value)));
    this.tiles = videoTiles(part('videos'), about, this.clocks.origin, (v) => this.lookThrough(v));
    this.timeline = new Timeline(part('timeline'), about, this.clocks, (t) => this.seek(t));
    [part('time').min, part('time').max] = this.timeline.range;
    part('time').addEventListener('input', () => this.seek(Number(part('time').value)));
    part('play').addEventListener('click', () => this.setPlaying(!this.playing));
    part('speed').addEventListener('change', () => (this.speed = Number(part('speed').value)));
    part('clocks').addEventListener('change', (event) => this.chooseClocks(event.target.value === 'synchronised'));
    part('tour').addEventListener('click', () => this.toggleTour());
    part('home').addEventListener('click', () => (this.view.home(), this.change()));
    for (const id of ['still', 'frusta', 'ghosts']) part(id).addEventListener('change', changed);
    part('paths').addEventListener('change', () => this.showPaths());
    part('blend').addEventListener('input', changed);
    new ResizeObserver(changed).observe(part('view'));
    steer(part('view'), this.view, this.stage, changed, (v) => this.lookThrough(v));
    this.#bindKeys();
    part('facts').textContent = factsOf(about);
    if (!about.still) part('still').closest('label').hidden = true;
  }

  #bindKeys() {
    const toggle = (id) => () => part(id).click();
    const frames = (count) => (event) => {
      this.playing = false;
      this.seek(this.seconds + count * this.about.step * (event.shiftKey ? 0.1 : 1));
    };
    const faster = (by) => () => {
      const next = clamp(SPEEDS.indexOf(this.speed) + by, 0, SPEEDS.length - 1);
      this.speed = SPEEDS[next];
      part('speed').value = String(this.speed);
    };
    const cameras = Object.fromEntries([...'123456789'].map((digit, v) => [digit, () => this.lookThrough(v)]));
    listen({
      ...cameras,
      0: () => this.lookThrough(-1),
      Escape: () => this.lookThrough(-1),
      ' ': () => this.setPlaying(!this.playing),
      ',': frames(-1),
      '<': frames(-1),
      '.': frames(1),
      '>': frames(1),
      '[': faster(-1),
      ']': faster(1),
      c: () => this.chooseClocks(!this.clocks.synchronised),
      f: () => this.toggleTour(),
      h: () => (this.view.home(), this.change()),
      t: () => {
        part('paths').selectedIndex = (part('paths').selectedIndex + 1) % 3;
        this.showPaths();
      },
      g: toggle('ghosts'),
      v: toggle('frusta'),
      b: toggle('still'),
      '?': () => part('help').showModal(),
    });
    // a range that takes any value steps by hundredths of its length: step by frames
    part('time').addEventListener('keydown', (event) => {
      const by = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
      if (!by) return;
      event.preventDefault();
      frames(by)(event);
    });
  }

  /** What the address asks for: #bare&time=1.25&camera=cam0&clocks=filmed&play. */
  #readHash() {
    const asked = new URLSearchParams(location.hash.slice(1));
    document.documentElement.classList.toggle('bare', asked.has('bare'));
    if (asked.has('bare')) part('frusta').checked = false;
    if (Number.isFinite(parseFloat(asked.get('time')))) this.seek(parseFloat(asked.get('time')));
    const camera = this.about.cameras.findIndex(({ name }) => name === asked.get('camera'));
    if (camera >= 0) this.view.through(camera, true);
    if (asked.get('clocks') === 'filmed') {
      this.clocks.share = 0;
      this.chooseClocks(false);
    }
    if (asked.has('play')) this.setPlaying(true);
  }
}

/** Adds to the header's cameras what is computed from it: poses, colours. */
function prepareCameras(about, arrays) {
  about.cameras.forEach((camera, v) => {
    const rows = arrays[`poses-${v}`]; // [T,3,4] world to camera
    camera.poses = [];
    for (let p = 0; p < rows.length; p += 12) {
      const turn_ = [0, 1, 2, 4, 5, 6, 8, 9, 10].map((k) => rows[p + k]);
      const shift = [3, 7, 11].map((k) => rows[p + k]);
      camera.poses.push({ turn: turn_, eye: times(turn(transposed(turn_), shift), -1) });
    }
    camera.times = arrays[`times-${v}`];
    camera.color = COLORS[v % COLORS.length];
    camera.rgb = [1, 3, 5].map((k) => parseInt(camera.color.slice(k, k + 2), 16) / 255);
    camera.reference = v === about.reference;
  });
  if (about.motion.kind === 'scaffold') about.motion.clock_of = arrays.clock_of;
}

const CANDIDATES = 40; // moments that are tried

/** Soon after the first moment that all videos show, as far from any frame as can be; the middle where there is none. */
function openingMoment(about) {
  const [first, last] = about.span;
  const starts = about.cameras.map(({ offset, rate, first: own }) => rate * own + offset);
  const ends = about.cameras.map(({ offset, rate, last: own }) => rate * own + offset);
  const [start, end] = [Math.max(first, ...starts), Math.min(last, ...ends)];
  if (!about.cameras.length || start >= end) return (first + last) / 2;
  const beside = (t) => Math.min(...about.cameras.map((c) => c.rate * besideFrame(c, (t - c.offset) / c.rate)));
  const moments = Array.from({ length: CANDIDATES }, (_, i) => start + (2 * about.step * i) / CANDIDATES);
  return moments.filter((t) => t < end).reduce((best, t) => (beside(t) > beside(best) ? t : best), start);
}

/** Says in a tile why it shows no picture. */
function blank(context, words) {
  const { width, height } = context.canvas;
  context.fillStyle = '#000';
  context.fillRect(0, 0, width, height);
  context.fillStyle = '#a3abba';
  context.font = `${Math.round(width / 12)}px system-ui, sans-serif`;
  context.textAlign = 'center';
  context.textBaseline = 'middle';
  context.fillText(words, width / 2, height / 2);
}

function factsOf(about) {
  const count = (n) => n.toLocaleString('en');
  const videos = `${about.cameras.length} ${about.cameras.length === 1 ? 'camera' : 'cameras'}`;
  const gaussians = `${count(about.moving)} moving blobs of colour` + (about.still ? `, ${count(about.still)} that stand still` : '');
  const seconds = `${(about.span[1] - about.span[0]).toFixed(2)} s`;
  return [videos, gaussians, seconds, about.quality].filter(Boolean).join(' · ');
}

/** Says what went wrong in place of the scene. */
function stop(error) {
  part('message').textContent = `The scene cannot be shown: ${error.message}.`;
  document.documentElement.dataset.state = 'failed';
  console.error(error);
}

async function begin() {
  const scene = await readScene();
  prepareCameras(scene.about, scene.arrays);
  const page = new Page(scene, await Stepper.of(scene.about, scene.arrays));
  part('message').textContent = '';
  page.change();
  page.strips = await readStrips(page.about.cameras);
  page.change();
  document.documentElement.dataset.ready = 'yes';
}

begin().catch(stop);
