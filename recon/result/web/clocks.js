// The videos' clocks: as filmed (all begin together), synchronised, and on the way from one to the other.

'use strict';

const SLIDE_SECONDS = 0.7; // that the bars take to slide from one to the other

class Clocks {
  /**
   * @param about the header: of each camera `offset` and `rate`, t_world = rate * t_own + offset, and `first` second.
   */
  constructor({ cameras, reference }) {
    this.cameras = cameras;
    const first = cameras[reference];
    this.origin = first ? first.rate * first.first + first.offset : 0; // where all begin, as filmed
    this.share = 1; // 0: as filmed. 1: synchronised.
    this.aim = 1;
  }

  get synchronised() {
    return this.aim === 1;
  }

  /** Chooses the clocks to slide to; at once where motion is not wanted. */
  choose(synchronised, atOnce) {
    this.aim = synchronised ? 1 : 0;
    if (atOnce) this.share = this.aim;
  }

  /** Slides on by `seconds`; whether anything changed. */
  advance(seconds) {
    if (this.share === this.aim) return false;
    const step = seconds / SLIDE_SECONDS;
    this.share = this.aim > this.share ? Math.min(this.aim, this.share + step) : Math.max(this.aim, this.share - step);
    return true;
  }

  /** On the present clocks a video's own second is slope * t + start. */
  #line({ first, offset, rate }) {
    const s = this.share * this.share * (3 - 2 * this.share); // slow at both ends
    return { slope: mix(1, 1 / rate, s), start: mix(first - this.origin, -offset / rate, s) };
  }

  /** The second of a video's own clock that stands at `t` on the present clocks. */
  own(camera, t) {
    const { slope, start } = this.#line(camera);
    return slope * t + start;
  }

  /** Where a second of a video's own clock stands on the present clocks: the inverse of `own`. */
  at(camera, own) {
    const { slope, start } = this.#line(camera);
    return (own - start) / slope;
  }

  /** The world second that a video shows at `t`: `t` itself once the clocks are synchronised. */
  shown(camera, t) {
    return camera.rate * this.own(camera, t) + camera.offset;
  }
}

const FILMED = 0.0005; // seconds beside a frame within which the instant is that frame's

/** Seconds between a second of a video's own clock and its nearest frame; none where it does not film. */
function besideFrame({ first, last, shots }, own) {
  const apart = ({ times, step }) => {
    if (!times) return Math.abs(own - first - Math.round((own - first) / step) * step);
    return times.reduce((least, t) => Math.min(least, Math.abs(own - t)), Infinity);
  };
  return own < first - FILMED || own > last + FILMED ? Infinity : apart(shots);
}

/** In words, whether any video filmed this instant: what is shown is rendered, on frames and between them alike. */
function filmedWords(cameras, clocks, seconds) {
  if (!cameras.length) return '';
  if (!clocks.synchronised) return 'rendered; videos as if all had begun together';
  const beside = cameras.map((camera) => camera.rate * besideFrame(camera, clocks.own(camera, seconds)));
  const nearest = beside.indexOf(Math.min(...beside));
  if (beside[nearest] === Infinity) return 'rendered; no video filmed then';
  if (beside[nearest] <= FILMED) return `rendered; video ${cameras[nearest].name} has a frame of this instant`;
  const away = `${(1000 * beside[nearest]).toFixed(1)} ms away`;
  return `rendered between frames; the nearest is ${away}, in video ${cameras[nearest].name}`;
}
