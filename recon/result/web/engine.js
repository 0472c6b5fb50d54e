// The engine: where every Gaussian is at a time, and in which order a camera draws them. It runs in a worker; where a
// browser allows none, in the page itself.

'use strict';

const ORDER_ROW = 2048; // indices in a row of the texture that holds the order

/** Everything that is computed per instant and per view. */
class Engine {
  constructor(about, arrays) {
    this.about = about;
    this.motion = motionOf(about, arrays);
    this.order = new DepthOrder();
    this.still = arrays.static_means ?? new Float32Array(0);
    this.count = about.moving;
    this.placed = new Float32Array(about.row_start * PLACE); // whole rows of the texture
    this.time = NaN;
  }

  /**
   * @param ask `time`: world second. `axis`: gives depth, see DepthOrder. `still`: whether what is static is drawn, and
   *   `near`: the depth before which it is not. `ghosts`: world seconds at which to place markers.
   * @returns `places` [N,8], or null where the time is that of the last step; `order`: what to draw, far to
   *   near, the first `drawn` of whole rows of a texture; `ghosts`: positions of the markers at each time.
   */
  step(ask) {
    const moved = ask.time !== this.time;
    if (moved) this.motion.carry(ask.time, this.placed);
    this.time = ask.time;
    const moving = { positions: this.placed, stride: PLACE, count: this.count, first: 0, near: this.about.moving_near };
    const still = {
      positions: this.still, stride: 3, count: this.still.length / 3, first: this.about.row_start, near: ask.near,
    };
    const layers = ask.still ? [still] : [];
    const order = new Uint32Array(Math.max(1, Math.ceil((this.count + still.count) / ORDER_ROW)) * ORDER_ROW);
    let drawn = 0;
    if (this.about.layered) {
      // what moves is drawn over what is static, as in the fit
      drawn = this.order.sort(layers, ask.axis, order, 0);
      drawn += this.order.sort([moving], ask.axis, order, drawn);
    } else {
      drawn = this.order.sort([moving, ...layers], ask.axis, order, 0);
    }
    return {
      time: ask.time,
      places: moved ? this.placed.slice() : null,
      order,
      drawn,
      ghosts: (ask.ghosts ?? []).map((seconds) => this.motion.markers(seconds)),
    };
  }

  /**
   * Trajectories: positions at `seconds[i]`, one array each. `which`: indices of Gaussians to follow; without it, the
   * markers.
   */
  paths({ seconds, which }) {
    if (!which) return seconds.map((t) => this.motion.markers(t));
    this.time = NaN; // `placed` no longer is the last step's
    return seconds.map((t) => {
      this.motion.carry(t, this.placed);
      return picked(this.placed, which, PLACE);
    });
  }
}

if (typeof document === 'undefined') {
  let engine = null;
  self.onmessage = ({ data: { id, call, ask } }) => {
    if (call === 'begin') engine = new Engine(ask.about, ask.arrays);
    const answer = call === 'begin' ? null : engine[call](ask);
    // given away, not copied
    const given = [answer?.places, answer?.order].filter(Boolean).map((array) => array.buffer);
    self.postMessage({ id, answer }, given);
  };
}
