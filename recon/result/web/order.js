// Sorting Gaussians by depth, far to near. Used by the page's worker.

'use strict';

const BUCKETS = 65536;

/** Sorts by counting: two passes over the Gaussians, whatever their order. Keeps its memory from call to call. */
class DepthOrder {
  #counts = new Uint32Array(BUCKETS + 1);
  #depths = new Float32Array(0);

  /**
   * Writes the indices of the Gaussians that lie beyond `near`, the farthest first, to `out` from `at` on.
   *
   * @param layers things to sort together: positions in rows of `stride` floats, their `count`, the index of their
   *   `first`, and the depth `near` before which they are not drawn
   * @param axis what gives the depth of a point: [a, b, c, d] in a x + b y + c z + d
   * @returns how many were written
   */
  sort(layers, axis, out, at) {
    const total = layers.reduce((sum, layer) => sum + layer.count, 0);
    if (this.#depths.length < total) this.#depths = new Float32Array(total);
    const depths = this.#depths;
    let [low, high, i] = [Infinity, -Infinity, 0];
    for (const { positions, stride, count, near } of layers) {
      for (let n = 0; n < count; n++, i++) {
        const p = n * stride;
        const z = axis[0] * positions[p] + axis[1] * positions[p + 1] + axis[2] * positions[p + 2] + axis[3];
        depths[i] = z >= near ? z : NaN;
        if (z >= near && z < low) low = z;
        if (z >= near && z > high) high = z;
      }
    }
    if (!(high >= low)) return 0;
    const counts = this.#counts.fill(0);
    const scale = (BUCKETS - 1) / Math.max(high - low, 1e-12);
    // the farthest bucket first, and within a bucket the order of the Gaussians
    for (let n = 0; n < total; n++) if (depths[n] === depths[n]) counts[((high - depths[n]) * scale) | 0]++;
    let sum = at;
    for (let b = 0; b < BUCKETS; b++) {
      const here = counts[b];
      counts[b] = sum;
      sum += here;
    }
    i = 0;
    for (const { count, first } of layers) {
      for (let n = 0; n < count; n++, i++) {
        if (depths[i] === depths[i]) out[counts[((high - depths[i]) * scale) | 0]++] = first + n;
      }
    }
    return sum - at;
  }
}
