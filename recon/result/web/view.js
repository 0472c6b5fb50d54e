// Where the scene is looked at from: a free view, the filming cameras, and the ways between them.
// Cameras look along z, x points right and y down (OpenCV). A pose is { eye, turn }: turn is world to camera.

'use strict';

const FLY_SECONDS = 1.1; // from one view to another
const HOME = { right: 0.3, up: 0.2, zoom: 1.5 }; // from the reference's camera to the view that the page opens with
const LEG_SECONDS = 3; // from camera to camera on the tour

/** One image to draw: pose, lens and size in pixels of the canvas. */
class Shot {
  constructor(pose, lens, width, height) {
    this.turn = pose.turn;
    this.eye = pose.eye;
    this.shift = times(turn(pose.turn, pose.eye), -1);
    this.width = width;
    this.height = height;
    Object.assign(this, lens);
  }

  /** Gives the depth of a point, as the engine asks for it. */
  get axis() {
    return [...this.turn.slice(6), this.shift[2]];
  }

  /** Depth of a point: how far before the camera it lies. */
  depth(point) {
    return dot(this.turn.slice(6), point) + this.shift[2];
  }

  /** Pixels [x, y] of a point, or null behind the camera. */
  pixel(point) {
    const at = add(turn(this.turn, point), this.shift);
    if (at[2] <= 1e-6) return null;
    return [(this.lens[0] * at[0]) / at[2] + this.lens[2], (this.lens[1] * at[1]) / at[2] + this.lens[3]];
  }
}

/**
 * The lens with which a camera's whole image fits into a canvas: lens (fx, fy, cx, cy), bounds of the image, and the
 * blur of the splats, which grows with the image so that they look as they did when they were fitted.
 */
function fittedLens({ width: w, height: h, lens: [fx, fy, cx, cy] }, width, height, blur) {
  const scale = Math.min(width / w, height / h);
  const [x, y] = [(width - w * scale) / 2, (height - h * scale) / 2];
  return {
    lens: [fx * scale, fy * scale, cx * scale + x, cy * scale + y],
    bounds: [x, y, x + w * scale, y + h * scale],
    blur: blur * Math.max(1, scale) ** 2,
    scale,
  };
}

/** The same lens for a free view: the image has no bounds but the canvas. */
function freeLens(camera, width, height, blur) {
  return { ...fittedLens(camera, width, height, blur), bounds: [0, 0, width, height] };
}

/** Pose of a filming camera at a second of its own clock; between the frames of a moving one, in between. */
function poseOf(camera, own) {
  const poses = camera.poses;
  if (poses.length === 1) return poses[0];
  const times_ = camera.times;
  let k = 0;
  while (k < poses.length - 2 && times_[k + 1] <= own) k++;
  const s = clamp((own - times_[k]) / (times_[k + 1] - times_[k]), 0, 1);
  const q = slerp(quaternionOf(poses[k].turn), quaternionOf(poses[k + 1].turn), s);
  return { eye: mix3(poses[k].eye, poses[k + 1].eye, s), turn: rotationOf(q) };
}

/** A pose that looks from `eye` at `focus`, its rows along the horizon. */
function lookAt(eye, focus, up) {
  const z = unit(subtract(focus, eye));
  const across = cross(z, up);
  const x = unit(length(across) > 1e-6 ? across : cross(z, [up[1], up[2], up[0]]));
  return { eye, turn: [...x, ...cross(z, x), ...z] };
}

/** Coordinates about the scene: azimuth, height along `up`, and distance from the axis through the focus. */
class Around {
  constructor(focus, up) {
    this.focus = focus;
    this.up = unit(up);
    const helper = Math.abs(this.up[0]) < 0.8 ? [1, 0, 0] : [0, 1, 0];
    this.ahead = unit(cross(this.up, helper));
    this.side = cross(this.up, this.ahead);
  }

  of(point) {
    const d = subtract(point, this.focus);
    const [x, y] = [dot(d, this.ahead), dot(d, this.side)];
    return { azimuth: Math.atan2(y, x), radius: Math.hypot(x, y), height: dot(d, this.up) };
  }

  point({ azimuth, radius, height }) {
    const flat = add(times(this.ahead, radius * Math.cos(azimuth)), times(this.side, radius * Math.sin(azimuth)));
    return add(this.focus, add(flat, times(this.up, height)));
  }

  /** The pose on the way from a to b, in an arc about the scene. */
  between(a, b, s) {
    const [p, q] = [this.of(a.eye), this.of(b.eye)];
    const gap = Math.atan2(Math.sin(q.azimuth - p.azimuth), Math.cos(q.azimuth - p.azimuth));
    const eye = this.point({
      azimuth: p.azimuth + s * gap,
      radius: mix(p.radius, q.radius, s),
      height: mix(p.height, q.height, s),
    });
    return { eye, turn: rotationOf(slerp(quaternionOf(a.turn), quaternionOf(b.turn), s)) };
  }
}

const eased = (s) => s * s * (3 - 2 * s);

/** The present view: free, a filming camera's, or on tour along all of them. */
class View {
  constructor(about) {
    this.about = about;
    this.around = new Around(about.focus, about.up);
    this.lensOf = about.cameras[about.reference] ?? about.lens;
    this.mode = 'free'; // 'free', 'camera' or 'tour'
    this.camera = -1; // index of the camera that is looked through
    this.progress = 0; // of the tour, in cameras
    this.way = null; // { from, seconds }: on the way to a new view
    this.home();
    this.tour = this.#tourOrder();
  }

  /** Cameras by azimuth, and back again where they do not stand all around. */
  #tourOrder() {
    const { cameras } = this.about;
    const azimuths = cameras.map((camera) => this.around.of(camera.poses[0].eye).azimuth);
    const order = cameras.map((_, i) => i).sort((a, b) => azimuths[a] - azimuths[b]);
    const next = (k) => azimuths[order[(k + 1) % order.length]];
    const gaps = order.map((i, k) => (next(k) - azimuths[i] + 2 * Math.PI) % (2 * Math.PI));
    const widest = gaps.indexOf(Math.max(...gaps));
    if (order.length < 3 || gaps[widest] < (120 * Math.PI) / 180) return order;
    const row = [...order.slice(widest + 1), ...order.slice(0, widest + 1)];
    return [...row, ...row.slice(1, -1).reverse()];
  }

  /**
   * Back to the view that the page opens with: from behind the reference's camera, which is seen with the others, and
   * on the side where these stand: what lies on the other side nobody may have filmed.
   */
  home() {
    const { cameras, reference } = this.about;
    const camera = cameras[reference];
    this.free(camera ? camera.poses[0] : lookAt(this.about.eye, this.about.focus, this.about.up));
    if (!camera) return;
    const start = { pose: this.pose, focus: this.focus };
    const among = times(cameras.reduce((sum, { poses }) => add(sum, poses[0].eye), [0, 0, 0]), 1 / cameras.length);
    const beside = [1, -1].map((side) => {
      Object.assign(this, start);
      this.orbit(side * HOME.right, HOME.up);
      return { pose: this.pose, focus: this.focus };
    });
    const [right, left] = beside.map(({ pose }) => length(subtract(pose.eye, among)));
    Object.assign(this, beside[left < right ? 1 : 0]);
    this.zoom(HOME.zoom);
  }

  /** A free view from a pose, with the focus straight ahead at the depth of the scene. */
  free(pose) {
    this.mode = 'free';
    this.camera = -1;
    this.pose = pose;
    const z = pose.turn.slice(6);
    const depth = Math.max(dot(subtract(this.about.focus, pose.eye), z), 0.1 * this.about.radius);
    this.focus = add(pose.eye, times(z, depth));
  }

  /** Looks through camera `index`, flying there unless `atOnce`. */
  through(index, atOnce) {
    this.way = atOnce ? null : { from: this.pose, seconds: 0 };
    this.mode = 'camera';
    this.camera = index;
  }

  startTour() {
    this.way = { from: this.pose, seconds: 0 };
    this.mode = 'tour';
    this.camera = -1;
    this.progress = 0;
  }

  get moving() {
    return this.way !== null || this.mode === 'tour';
  }

  /** Moves on by `seconds`. `own(camera)`: the second that a camera's own clock shows. */
  advance(seconds, own) {
    let aim = this.pose;
    if (this.mode === 'camera') {
      const camera = this.about.cameras[this.camera];
      aim = poseOf(camera, own(camera));
    } else if (this.mode === 'tour') {
      if (!this.way) this.progress += seconds / LEG_SECONDS;
      const leg = Math.floor(this.progress);
      const [a, b] = [0, 1].map((k) => this.about.cameras[this.tour[(leg + k) % this.tour.length]]);
      aim = this.around.between(poseOf(a, own(a)), poseOf(b, own(b)), eased(this.progress - leg));
    }
    if (this.way) {
      this.way.seconds += seconds;
      const s = Math.min(1, this.way.seconds / FLY_SECONDS);
      this.pose = this.around.between(this.way.from, aim, eased(s));
      if (s === 1) this.way = null;
    } else {
      this.pose = aim;
    }
  }

  /** Lets go of a camera or the tour, and stays where it is. */
  #release() {
    this.way = null;
    if (this.mode !== 'free') this.free(this.pose);
  }

  /** Turns about the focus by radians to the right and up. */
  orbit(right, up) {
    this.#release();
    const around = aboutAxis(this.around.up, -right);
    const elevation = Math.asin(clamp(dot(unit(subtract(this.pose.eye, this.focus)), this.around.up), -1, 1));
    const most = (88 * Math.PI) / 180;
    const tilt = aboutAxis(this.pose.turn.slice(0, 3), elevation - clamp(elevation + up, -most, most));
    const both = matrixProduct(around, tilt);
    this.pose = {
      eye: add(this.focus, turn(both, subtract(this.pose.eye, this.focus))),
      turn: matrixProduct(this.pose.turn, transposed(both)),
    };
  }

  /** Moves sideways and up by shares of what the canvas's height shows at the focus. */
  pan(right, up) {
    this.#release();
    const distance = length(subtract(this.pose.eye, this.focus));
    const reach = (distance * this.lensOf.height) / this.lensOf.lens[1];
    const x = this.pose.turn.slice(0, 3);
    const y = this.pose.turn.slice(3, 6);
    const by = add(times(x, -right * reach), times(y, up * reach));
    this.pose = { ...this.pose, eye: add(this.pose.eye, by) };
    this.focus = add(this.focus, by);
  }

  /** Comes closer (factor < 1) or goes away. */
  zoom(factor) {
    this.#release();
    const away = subtract(this.pose.eye, this.focus);
    const distance = clamp(length(away) * factor, 0.02 * this.about.radius, 20 * this.about.radius);
    this.pose = { ...this.pose, eye: add(this.focus, times(unit(away), distance)) };
  }

  /** The depth before which nothing static is drawn: seen from behind the cameras, a wall would hide the scene. */
  get near() {
    if (this.mode === 'camera' && !this.way) return this.about.near;
    const beyond = length(subtract(this.pose.eye, this.about.focus)) - this.about.radius;
    return this.about.near + Math.max(0, beyond);
  }

  /** What to draw on a canvas of this size. */
  shot(width, height) {
    const locked = this.mode === 'camera' && !this.way;
    const camera = this.mode === 'camera' ? this.about.cameras[this.camera] : this.lensOf;
    const lens = (locked ? fittedLens : freeLens)(camera, width, height, this.about.blur);
    return new Shot(this.pose, lens, width, height);
  }
}
