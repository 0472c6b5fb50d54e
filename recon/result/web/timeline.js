// The common clock as a picture: a bar for every video, and where the present moment lies.

'use strict';

const BAR = { height: 14, gap: 4, label: 11 };

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
    canvas.style.height = `${Math.max(1, about.cameras.length) * (BAR.height + BAR.gap) + BAR.gap}px`;
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
    this.about.cameras.forEach((camera, v) => {
      const y = BAR.gap + v * (BAR.height + BAR.gap);
      const [x0, x1] = [camera.first, camera.last].map((own) => place(this.clocks.at(camera, own)));
      context.fillStyle = camera.color;
      context.globalAlpha = 0.32;
      context.fillRect(x0, y, Math.max(2, x1 - x0), BAR.height);
      context.globalAlpha = 1;
      context.fillRect(x0, y, 3, BAR.height);
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
