// The videos' clocks: as filmed (all begin together), synchronised, and on the way from one to the other.

'use strict';

const SLIDE_SECONDS = 0.7; // that the bars take to slide from one to the other

class Clocks {
  /** @param cameras the header's list: `offset` (s) and `rate` of each: t_world = rate * t_own + offset. */
  constructor(cameras) {
    this.cameras = cameras;
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

  /** 0..1, slow at both ends. */
  get #eased() {
    return this.share * this.share * (3 - 2 * this.share);
  }

  /** The second of a video's own clock that stands at `t` on the present clocks. */
  own(camera, t) {
    return mix(t, (t - camera.offset) / camera.rate, this.#eased);
  }

  /** Where a second of a video's own clock stands on the present clocks: the inverse of `own`. */
  at(camera, own) {
    const slope = mix(1, 1 / camera.rate, this.#eased);
    return (own + (this.#eased * camera.offset) / camera.rate) / slope;
  }

  /** The world second that a video shows at `t`: `t` itself once the clocks are synchronised. */
  shown(camera, t) {
    return camera.rate * this.own(camera, t) + camera.offset;
  }
}
