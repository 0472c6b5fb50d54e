// The picture: Gaussians, lines over them, and the video and names on a canvas above.

'use strict';

const TRAIL = { before: 0.35, after: 0.05 }; // seconds of a trajectory that are shown around the present moment
const FRAME_SECONDS = 1 / 30; // that a frame may take while something moves
const LEAST_QUALITY = 0.35; // share of the pixels' width that is drawn while a slow computer moves

class Stage {
  constructor(view, overlay, about, arrays) {
    this.canvas = view;
    this.overlay = overlay;
    this.about = about;
    this.quality = 0.5; // until it is known how fast this computer draws
    this.gl = view.getContext('webgl2', { alpha: false, antialias: false, depth: false, preserveDrawingBuffer: true });
    if (!this.gl) {
      const remedy = 'Open the page in a current browser, with hardware acceleration on';
      throw new Error(`this browser offers no WebGL2. ${remedy}`);
    }
    this.splats = new Splats(this.gl, about, arrays);
    const lost = new Error('the graphics card took its memory back. Reload it');
    view.addEventListener('webglcontextlost', () => stop(lost));
    this.lines = new Lines(this.gl);
    this.screens = new Screens(this.gl);
  }

  /** Fits both canvases to the window; `full`: whatever it takes, draw every pixel. Returns [width, height]. */
  fit(full) {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const { clientWidth, clientHeight } = this.canvas;
    const sized = (canvas, scale) => {
      const [width, height] = [clientWidth, clientHeight].map((side) => Math.max(1, Math.round(side * scale)));
      if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    };
    sized(this.canvas, full ? ratio : ratio * this.quality);
    sized(this.overlay, ratio);
    return [this.canvas.width, this.canvas.height];
  }

  /** Lowers the resolution while frames take long, and raises it again. */
  learn(seconds) {
    const factor = clamp(Math.sqrt(FRAME_SECONDS / Math.max(seconds, 1e-3)), 0.3, 1.1);
    if (factor < 0.8 || factor > 1.05) this.quality = clamp(this.quality * factor, LEAST_QUALITY, 1);
  }

  /**
   * Puts the frusta of all cameras: pyramids of `size` world units at the poses that they have now. `tiles[v].picture`
   * is a canvas with what the camera films, and `.shown` tells which picture that is; undefined: none.
   */
  putFrusta(poses, size, tiles) {
    this.about.cameras.forEach((camera, v) => {
      const corners = cornersOf(camera, poses[v], size);
      this.lines.put(`frustum-${v}`, segmentRows(frustum(poses[v].eye, corners), camera.rgb, 0.9));
      if (tiles[v].shown !== undefined) this.screens.put(v, tiles[v], corners);
    });
  }

  /** Puts trajectories: `paths[s]` are positions [M,3] at `seconds[s]`; `colors` [M,3]. */
  putPaths(paths, seconds, colors) {
    const count = colors.length / 3;
    const rows = new Float32Array((paths.length - 1) * count * 2 * LINE_FLOATS);
    let at = 0;
    for (let m = 0; m < count; m++) {
      for (let s = 0; s + 1 < paths.length; s++) {
        for (const k of [s, s + 1]) {
          rows.set(paths[k].subarray(3 * m, 3 * m + 3), at);
          rows.set(colors.subarray(3 * m, 3 * m + 3), at + 3);
          rows[at + 6] = 0.85;
          rows[at + 7] = seconds[k];
          at += LINE_FLOATS;
        }
      }
    }
    this.lines.put('paths', rows);
  }

  /** Puts markers in the cameras' colours: `ghosts[v]` are their positions at the moment that video v shows. */
  putGhosts(ghosts) {
    const rows = new Float32Array(ghosts.reduce((sum, g) => sum + g.length / 3, 0) * LINE_FLOATS);
    let at = 0;
    ghosts.forEach((places, v) => {
      for (let m = 0; m < places.length; m += 3, at += LINE_FLOATS) {
        rows.set([places[m], places[m + 1], places[m + 2], ...this.about.cameras[v].rgb, 0.85, 0], at);
      }
    });
    this.lines.put('ghosts', rows, 'dots');
  }

  /** Learns from the first picture how fast this computer draws. */
  #tryOut(draw) {
    const before = performance.now();
    draw();
    this.gl.readPixels(0, 0, 1, 1, this.gl.RGBA, this.gl.UNSIGNED_BYTE, new Uint8Array(4)); // waits for the picture
    if (this.tried) this.learn((performance.now() - before) / 1000);
    this.tried = (this.tried ?? 0) + 1;
  }

  /** Draws everything. `look`: which layers, the gain and falloff, the seconds that are shown, the camera looked through. */
  draw(shot, look) {
    if ((this.tried ?? 0) < 2) this.#tryOut(() => this.#draw(shot, look)); // shaders are compiled on the first one
    else this.#draw(shot, look);
  }

  #draw(shot, look) {
    const { gl } = this;
    gl.viewport(0, 0, shot.width, shot.height);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    this.splats.draw(shot, look.gain, look.falloff);
    const near = 1e-3 * this.about.radius;
    if (look.paths) this.lines.draw('paths', shot, { trail: [look.seconds, TRAIL.before, TRAIL.after], near });
    if (look.ghosts) this.lines.draw('ghosts', shot, { dot: Math.max(4, shot.height / 110), near });
    if (look.frusta) {
      this.about.cameras.forEach((_, v) => {
        if (v === look.camera) return;
        this.screens.draw(v, shot, near, this.#cover(shot, look.poses[v].eye));
        this.lines.draw(`frustum-${v}`, shot, { near });
      });
    }
  }

  /** How much the picture of a camera at `eye` hides: less before the scene, nothing where one flies through it. */
  #cover(shot, eye) {
    const before = shot.depth(eye) < shot.depth(this.about.focus);
    const away = length(subtract(eye, shot.eye)) / this.about.radius;
    return (before ? 0.45 : 1) * clamp(4 * away - 1, 0, 1);
  }

  /** Draws the video over the rendering, the edge of the camera's image, and the cameras' names. */
  drawOver(shot, look) {
    const { overlay } = this;
    const context = overlay.getContext('2d');
    const scale = overlay.width / shot.width;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, overlay.width, overlay.height);
    if (look.camera >= 0) {
      const [x0, y0, x1, y1] = shot.bounds.map((x) => x * scale);
      context.globalAlpha = look.blend;
      if (look.blend > 0) look.strip?.draw(context, look.own, x0, y0, x1 - x0, y1 - y0);
      context.globalAlpha = 1;
      context.fillStyle = 'rgb(0 0 0 / 62%)'; // beyond the image
      context.fillRect(0, 0, overlay.width, y0);
      context.fillRect(0, y1, overlay.width, overlay.height - y1);
      context.fillRect(0, y0, x0, y1 - y0);
      context.fillRect(x1, y0, overlay.width - x1, y1 - y0);
    }
    this.labels = [];
    if (!look.frusta) return;
    const size = 11 * (window.devicePixelRatio || 1);
    context.font = `600 ${size}px system-ui, sans-serif`;
    context.textAlign = 'center';
    context.textBaseline = 'middle';
    this.about.cameras.forEach((camera, v) => {
      const at = v === look.camera ? null : shot.pixel(look.poses[v].eye);
      if (!at) return;
      const [x, y] = at.map((p) => p * scale);
      if (x < 0 || y < 0 || x > overlay.width || y > overlay.height) return;
      const name = shortened(camera.name, 18);
      const half = context.measureText(name).width / 2 + 0.5 * size;
      context.fillStyle = 'rgb(10 12 16 / 72%)';
      context.fillRect(x - half, y - 0.85 * size, 2 * half, 1.7 * size);
      context.fillStyle = camera.color;
      context.fillRect(x - half, y + 0.7 * size, 2 * half, 0.15 * size);
      context.fillStyle = '#fff';
      context.fillText(name, x, y);
      this.labels.push({ v, x0: x - half, x1: x + half, y0: y - size, y1: y + size });
    });
  }

  /** The camera whose name stands at a point of the page, or -1. */
  labelAt(clientX, clientY) {
    const box = this.overlay.getBoundingClientRect();
    const scale = this.overlay.width / box.width;
    const [x, y] = [(clientX - box.left) * scale, (clientY - box.top) * scale];
    const hit = (this.labels ?? []).find((l) => x >= l.x0 && x <= l.x1 && y >= l.y0 && y <= l.y1);
    return hit ? hit.v : -1;
  }
}

/** Corners of a camera's image, `size` world units before it: upper left, upper right, lower right, lower left. */
function cornersOf(camera, pose, size) {
  const [fx, fy, cx, cy] = camera.lens;
  const [w, h] = [camera.width, camera.height];
  const back = transposed(pose.turn);
  const corners = [[0, 0], [w, 0], [w, h], [0, h]].map(([u, v]) => [(u - cx) / fx, (v - cy) / fy, 1]);
  return corners.map((ray) => add(pose.eye, times(turn(back, ray), size)));
}

/** The edges of a camera's pyramid, with a mark on its upper side. */
function frustum(eye, [a, b, c, d]) {
  const tip = add(mix3(a, b, 0.5), times(subtract(a, d), 0.16));
  const rays = [a, b, c, d].map((end) => [eye, end]);
  return [...rays, [a, b], [b, c], [c, d], [d, a], [mix3(a, b, 0.38), tip], [tip, mix3(a, b, 0.62)]];
}

const shortened = (text, most) => (text.length > most ? `${text.slice(0, most - 1)}…` : text);
