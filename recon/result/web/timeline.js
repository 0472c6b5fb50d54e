// The common clock as a picture: a bar for every video with a tick a frame, seconds below, and the present moment.

'use strict';

const BAR = { height: 14, gap: 4, label: 11 };
const AXIS = { height: 17, apart: 70 }; // below the bars; pixels between two labels at the least
const FRAME_TICKS = 3; // pixels between two frames from which on each has a tick

class Timeline {
  /** @param seek is called with a world second when the picture is clicked or dragged over. */
  constructor(canvas, about, clocks, seek) {
    this.canvas = canvas;
    this.about = about;
    this.clocks = clocks;
    this.range = rangeOf(about, clocks.origin);
    const at = (event) => {
      const box = canvas.getBoundingClientRect();
      seek(mix(this.range[0], this.range[1], clamp((event.clientX - box.left) / box.width, 0, 1)));
    };
    canvas.addEventListener('pointerdown', (event) => {
      canvas.setPointerCapture(event.pointerId);
      at(event);
    });
    canvas.addEventListener('pointermove', (event) => canvas.hasPointerCapture(event.pointerId) && at(event));
    canvas.style.height = `${Math.max(1, about.cameras.length) * (BAR.height + BAR.gap) + BAR.gap + AXIS.height}px`;
  }

  draw(seconds) {
    const { canvas, range } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
    if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
    const context = canvas.getContext('2d');
    const style = getComputedStyle(canvas);
    const place = (t) => ((t - range[0]) / (range[1] - range[0])) * width;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    context.font = `${BAR.label}px system-ui, sans-serif`;
    context.textBaseline = 'middle';
    this.#axis(context, style, place, width, height);
    this.about.cameras.forEach((camera, v) => {
      const y = BAR.gap + v * (BAR.height + BAR.gap);
      const [x0, x1] = [camera.first, camera.last].map((own) => place(this.clocks.at(camera, own)));
      context.fillStyle = camera.color;
      context.globalAlpha = 0.32;
      context.fillRect(x0, y, Math.max(2, x1 - x0), BAR.height);
      context.globalAlpha = 1;
      context.fillRect(x0, y, 3, BAR.height);
      this.#frames(context, camera, place, y);
      context.fillStyle = style.color;
      context.save();
      context.beginPath();
      context.rect(x0, y, Math.max(2, x1 - x0), BAR.height);
      context.clip();
      context.fillText(camera.name, Math.max(x0, 0) + 8, y + BAR.height / 2 + 0.5);
      context.restore();
    });
    context.fillStyle = style.getPropertyValue('--ink');
    context.fillRect(Math.round(place(seconds)) - 1, 0, 2, height);
  }

  /** A tick at the foot of the bar for every frame, where they lie far enough apart to be told apart. */
  #frames(context, camera, place, y) {
    const pixels = (place(1) - place(0)) * (camera.last - camera.first);
    if (pixels < FRAME_TICKS * (frameCount(camera) - 1)) return;
    context.globalAlpha = 0.75;
    for (const own of frameTimes(camera)) context.fillRect(place(this.clocks.at(camera, own)) - 0.5, y + BAR.height - 4, 1, 4);
    context.globalAlpha = 1;
  }

  /** Seconds below the bars, at round numbers. */
  #axis(context, style, place, width, height) {
    const [low, high] = this.range;
    const step = roundStep(((high - low) * AXIS.apart) / Math.max(width, AXIS.apart));
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    context.fillStyle = style.getPropertyValue('--soft');
    context.textAlign = 'center';
    for (let n = Math.ceil(low / step); n * step <= high; n += 1) {
      const x = place(n * step);
      context.fillRect(Math.round(x), height - AXIS.height, 1, 4);
      if (x > 14 && x < width - 18) context.fillText(`${(n * step).toFixed(digits)} s`, x, height - 6);
    }
    context.textAlign = 'start';
  }
}

/** The smallest of 1, 2 and 5 times a power of ten that is at least `least`. */
function roundStep(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return power * [1, 2, 5, 10].find((n) => n * power >= least * (1 - 1e-9));
}

function frameCount({ first, last, shots: { times, step } }) {
  return times ? times.length : Math.round((last - first) / step) + 1;
}

/** Seconds of a video's own clock at which it has a frame. */
function frameTimes(camera) {
  const { first, shots } = camera;
  return shots.times ?? Array.from({ length: frameCount(camera) }, (_, k) => first + k * shots.step);
}

/** World seconds from the first to the last moment of any bar, whichever clocks are chosen. */
function rangeOf(about, origin) {
  let [low, high] = about.span;
  for (const { first, last, rate, offset } of about.cameras) {
    low = Math.min(low, origin, rate * first + offset);
    high = Math.max(high, origin + last - first, rate * last + offset);
  }
  return high > low ? [low, high] : [low, low + 1];
}
