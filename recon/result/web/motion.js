// How Gaussians move: nodes on splines that carry them, a spline for each, or not at all.
// The same mathematics as recon/motion/warp.py and its compiled kernels. Used by the page's worker.

'use strict';

const SLOTS = 8; // nodes that carry a Gaussian
const ROW = 16; // floats of a relative motion: rotation 9, shift 3, quaternion 4; or two quaternions, for dual ones
const PLACE = 8; // floats of a placed Gaussian: x, y, z, 0, quaternion wxyz

/** @returns the motion that the header names, with `carry(seconds, out)` and `markers(seconds)`. */
function motionOf(about, arrays) {
  const kinds = { scaffold: ScaffoldMotion, 'per-gaussian': OwnMotion, static: NoMotion };
  return new kinds[about.motion.kind](about.motion, arrays);
}

/** Every k-th of `count` things, so that there are at most `most`. */
function someOf(count, most) {
  const step = Math.max(1, Math.ceil(count / most));
  return Uint32Array.from({ length: Math.ceil(count / step) }, (_, i) => i * step);
}

/** Nodes on splines carry the Gaussians that are bound to them. */
class ScaffoldMotion {
  constructor(about, arrays) {
    this.about = about;
    this.knots = arrays.knots; // [P,M,3]
    this.knotQuats = arrays.knot_quats; // [P,M,4]
    this.nodes = about.nodes;
    this.means = arrays.dynamic_means;
    this.quats = arrays.dynamic_quats;
    this.groupOf = arrays.group_of; // [N] which row of `groups` a Gaussian has
    this.weights = normalised(arrays.weights, SLOTS); // [N,8]
    this.positions = new Float32Array(3 * this.nodes);
    this.turns = new Float32Array(4 * this.nodes);
    this.#pairUp(arrays);
  }

  /** Lists the (rest, node) pairs in use: each needs one relative motion, and there are far fewer than slots. */
  #pairUp(arrays) {
    const { groups } = arrays; // [U,9] rest, then eight nodes
    const seen = new Map();
    this.pairs = []; // node and rest of every pair
    this.slots = new Uint32Array((groups.length / 9) * SLOTS);
    for (let u = 0; u < groups.length / 9; u++) {
      for (let k = 0; k < SLOTS; k++) {
        const [rest, node] = [groups[9 * u], groups[9 * u + 1 + k]];
        const key = rest * this.nodes + node;
        if (!seen.has(key)) {
          seen.set(key, this.pairs.length);
          this.pairs.push({ node, at: key });
        }
        this.slots[SLOTS * u + k] = seen.get(key);
      }
    }
    this.restPositions = arrays.rest_positions; // [R,M,3]
    this.restQuats = arrays.rest_quats; // [R,M,4]
    this.rows = new Float32Array(this.pairs.length * ROW);
  }

  /** Where all nodes are at world second `seconds`: fills `positions` and `turns`. */
  place(seconds) {
    const { path, clocks } = this.about;
    const windows = clocks.map((clock) => knotWeights(path, (seconds - clock.offset) / clock.rate));
    const [P, Q] = [3 * this.nodes, 4 * this.nodes];
    for (let m = 0; m < this.nodes; m++) {
      const { first, weights } = windows[this.about.clock_of ? this.about.clock_of[m] : 0];
      for (let c = 0; c < 3; c++) this.positions[3 * m + c] = along(this.knots, first * P + 3 * m + c, P, weights);
      let norm = 0;
      for (let c = 0; c < 4; c++) {
        const x = along(this.knotQuats, first * Q + 4 * m + c, Q, weights);
        this.turns[4 * m + c] = x;
        norm += x * x;
      }
      norm = 1 / Math.max(Math.sqrt(norm), 1e-12);
      for (let c = 0; c < 4; c++) this.turns[4 * m + c] *= norm;
    }
  }

  /** The relative motion of every pair since its rest. */
  #relate() {
    const { rows, restPositions: p0, restQuats: q0, positions: p, turns: q } = this;
    for (let j = 0; j < this.pairs.length; j++) {
      const { node, at } = this.pairs[j];
      const [a, b, c, d] = [q[4 * node], q[4 * node + 1], q[4 * node + 2], q[4 * node + 3]];
      const [e, f, g, h] = [q0[4 * at], -q0[4 * at + 1], -q0[4 * at + 2], -q0[4 * at + 3]];
      const w = a * e - b * f - c * g - d * h;
      const x = a * f + b * e + c * h - d * g;
      const y = a * g - b * h + c * e + d * f;
      const z = a * h + b * g - c * f + d * e;
      const R = rotationOf([w, x, y, z]);
      const [rx, ry, rz] = turn(R, [p0[3 * at], p0[3 * at + 1], p0[3 * at + 2]]);
      const [sx, sy, sz] = [p[3 * node] - rx, p[3 * node + 1] - ry, p[3 * node + 2] - rz];
      const r = j * ROW;
      if (this.about.blend === 'dual-quaternion') {
        rows.set([w, x, y, z], r);
        rows.set([
          -sx * x - sy * y - sz * z, sx * w + sy * z - sz * y, sy * w + sz * x - sx * z, sz * w + sx * y - sy * x,
        ], r + 4);
      } else {
        rows.set(R, r);
        rows[r + 9] = sx;
        rows[r + 10] = sy;
        rows[r + 11] = sz;
        rows[r + 12] = w;
        rows[r + 13] = x;
        rows[r + 14] = y;
        rows[r + 15] = z;
      }
    }
  }

  /** Places all Gaussians at world second `seconds` into `out` [N,8]. */
  carry(seconds, out) {
    this.place(seconds);
    this.#relate();
    const dual = this.about.blend === 'dual-quaternion';
    const sum = new Float64Array(ROW);
    const { rows, slots, weights, means, quats, groupOf } = this;
    const quatAt = dual ? 0 : 12;
    for (let n = 0; n < groupOf.length; n++) {
      sum.fill(0);
      const first = slots[SLOTS * groupOf[n]] * ROW + quatAt;
      for (let k = 0; k < SLOTS; k++) {
        const w = weights[SLOTS * n + k];
        if (w === 0) continue;
        const r = slots[SLOTS * groupOf[n] + k] * ROW;
        const q = r + quatAt;
        // q and -q are one rotation: the sign that agrees with the nearest node's
        const agrees = rows[first] * rows[q] + rows[first + 1] * rows[q + 1]
          + rows[first + 2] * rows[q + 2] + rows[first + 3] * rows[q + 3];
        const s = agrees >= 0 ? w : -w;
        if (dual) {
          for (let c = 0; c < 8; c++) sum[c] += s * rows[r + c];
        } else {
          for (let c = 0; c < 12; c++) sum[c] += w * rows[r + c];
          for (let c = 12; c < 16; c++) sum[c] += s * rows[r + c];
        }
      }
      const x = means[3 * n];
      const y = means[3 * n + 1];
      const z = means[3 * n + 2];
      let [w, i, j, k] = [sum[quatAt], sum[quatAt + 1], sum[quatAt + 2], sum[quatAt + 3]];
      const norm = 1 / Math.max(Math.sqrt(w * w + i * i + j * j + k * k), 1e-12);
      if (dual) unrolled(sum, norm * norm);
      const o = PLACE * n;
      out[o] = sum[0] * x + sum[1] * y + sum[2] * z + sum[9];
      out[o + 1] = sum[3] * x + sum[4] * y + sum[5] * z + sum[10];
      out[o + 2] = sum[6] * x + sum[7] * y + sum[8] * z + sum[11];
      w *= norm;
      i *= norm;
      j *= norm;
      k *= norm;
      putProduct(out, o + 4, w, i, j, k, quats, 4 * n);
    }
  }

  /** Positions [K,3] of some of the nodes at world second `seconds`. */
  markers(seconds) {
    this.shown ??= someOf(this.nodes, 500);
    this.place(seconds);
    return picked(this.positions, this.shown, 3);
  }
}

/** Replaces a blended dual quaternion by its rotation (first nine floats) and shift (three more). */
function unrolled(sum, perSquare) {
  const [a, b, c, d, e, f, g, h] = sum;
  const shift = [
    (-e * b + f * a - g * d + h * c) * perSquare,
    (-e * c + f * d + g * a - h * b) * perSquare,
    (-e * d - f * c + g * b + h * a) * perSquare,
  ];
  const norm = Math.sqrt(perSquare);
  sum.set(rotationOf([a * norm, b * norm, c * norm, d * norm]), 0);
  sum.set(shift, 9);
}

/** Every Gaussian on a spline of its own. */
class OwnMotion {
  constructor(about, arrays) {
    this.about = about;
    this.knots = arrays.own_knots; // [P,N,3] displacements
    this.turns = arrays.own_quats; // [P,N,4], or undefined where nothing turns
    this.means = arrays.dynamic_means;
    this.quats = arrays.dynamic_quats;
    this.places = new Float32Array((this.means.length / 3) * PLACE);
  }

  carry(seconds, out) {
    const { first, weights } = knotWeights(this.about.path, seconds);
    const N = this.means.length / 3;
    for (let n = 0; n < N; n++) {
      const o = PLACE * n;
      for (let c = 0; c < 3; c++) {
        out[o + c] = this.means[3 * n + c] + along(this.knots, 3 * (first * N + n) + c, 3 * N, weights);
      }
      if (!this.turns) {
        for (let c = 0; c < 4; c++) out[o + 4 + c] = this.quats[4 * n + c];
        continue;
      }
      const q = [0, 1, 2, 3].map((c) => along(this.turns, 4 * (first * N + n) + c, 4 * N, weights));
      const norm = 1 / Math.max(Math.hypot(...q), 1e-12);
      putProduct(out, o + 4, q[0] * norm, q[1] * norm, q[2] * norm, q[3] * norm, this.quats, 4 * n);
    }
  }

  markers(seconds) {
    this.shown ??= someOf(this.means.length / 3, 500);
    this.carry(seconds, this.places);
    return picked(this.places, this.shown, PLACE);
  }
}

/** Nothing moves. */
class NoMotion {
  constructor(about, arrays) {
    this.means = arrays.dynamic_means;
    this.quats = arrays.dynamic_quats;
  }

  carry(seconds, out) {
    for (let n = 0; n < this.means.length / 3; n++) {
      out.set(this.means.subarray(3 * n, 3 * n + 3), PLACE * n);
      out.set(this.quats.subarray(4 * n, 4 * n + 4), PLACE * n + 4);
    }
  }

  markers() {
    return new Float32Array(0);
  }
}

/** The weighted sum of four knots, `stride` floats apart. */
function along(knots, at, stride, weights) {
  return (
    weights[0] * knots[at] +
    weights[1] * knots[at + stride] +
    weights[2] * knots[at + 2 * stride] +
    weights[3] * knots[at + 3 * stride]
  );
}

/** Writes the product of a quaternion and the one at `quats[q]` to `out[o]`. */
function putProduct(out, o, a, b, c, d, quats, q) {
  const e = quats[q];
  const f = quats[q + 1];
  const g = quats[q + 2];
  const h = quats[q + 3];
  out[o] = a * e - b * f - c * g - d * h;
  out[o + 1] = a * f + b * e + c * h - d * g;
  out[o + 2] = a * g - b * h + c * e + d * f;
  out[o + 3] = a * h + b * g - c * f + d * e;
}

function normalised(weights, width) {
  const out = Float32Array.from(weights);
  for (let n = 0; n < out.length; n += width) {
    let sum = 0;
    for (let k = 0; k < width; k++) sum += out[n + k];
    for (let k = 0; k < width; k++) out[n + k] /= sum || 1;
  }
  return out;
}

/** The first three floats of the rows that `which` names. */
function picked(rows, which, width) {
  const out = new Float32Array(3 * which.length);
  which.forEach((row, i) => out.set(rows.subarray(width * row, width * row + 3), 3 * i));
  return out;
}
