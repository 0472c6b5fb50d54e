// Curves in time: at any time a weighted sum of four consecutive knots, as recon/motion/paths.py defines them.
// Used by the page's worker.

'use strict';

const WINDOW = 4;

/**
 * First knot and weights of the four knots that make up the curve at `seconds`.
 *
 * @param {{kind: 'BSpline' | 'HermiteSpline' | 'Sampled', start: number, spacing: number, count: number}} path
 * @returns {{first: number, weights: number[]}}
 */
function knotWeights(path, seconds) {
  const s = (seconds - path.start) / path.spacing;
  if (path.kind === 'Sampled') return nearestKnot(s, path.count);
  return path.kind === 'BSpline' ? bsplineWeights(s, path.count) : hermiteWeights(s, path.count);
}

function nearestKnot(s, count) {
  const nearest = clamp(Math.floor(s + 0.5), 0, count - 1);
  const first = clamp(nearest - 1, 0, count - WINDOW);
  const weights = [0, 0, 0, 0];
  weights[nearest - first] = 1;
  return { first, weights };
}

/** Uniform cubic B-spline whose ends go on straight: a knot beyond an end lies on the line through the last two. */
function bsplineWeights(s, count) {
  const last = count - 1;
  const interval = clamp(Math.floor(s), 0, last - 1);
  const first = clamp(interval - 1, 0, count - WINDOW);
  const weights = [0, 0, 0, 0];
  const put = (knot, weight) => {
    if (knot >= 0 && knot <= last) {
      weights[knot - first] += weight;
      return;
    }
    const [end, inside] = knot < 0 ? [0, 1] : [last, last - 1];
    weights[end - first] += 2 * weight;
    weights[inside - first] -= weight;
  };
  const u = clamp(s - interval, 0, 1);
  const [u2, u3, v] = [u * u, u * u * u, 1 - u];
  put(interval - 1, (v * v * v) / 6);
  put(interval, (4 - 6 * u2 + 3 * u3) / 6);
  put(interval + 1, (1 + 3 * u + 3 * u2 - 3 * u3) / 6);
  put(interval + 2, u3 / 6);
  const beyond = s - interval - u; // of the straight line
  if (beyond) {
    const [from, to] = s < 0 ? [0, 1] : [last - 1, last];
    weights[from - first] -= beyond;
    weights[to - first] += beyond;
  }
  return { first, weights };
}

/** Cubic Hermite with central differences as tangents, one-sided at the ends; a straight line beyond them. */
function hermiteWeights(s, count) {
  const last = count - 1;
  const interval = clamp(Math.floor(s), 0, last - 1);
  const first = clamp(interval - 1, 0, count - WINDOW);
  const weights = [0, 0, 0, 0];
  const put = (knot, weight) => (weights[knot - first] += weight);
  /** Adds the tangent at a knot, in knots per interval. */
  const slope = (knot, weight) => {
    const [before, after] = [Math.max(knot - 1, 0), Math.min(knot + 1, last)];
    put(after, weight / (after - before));
    put(before, -weight / (after - before));
  };
  if (s < 0 || s > last) {
    const end = s < 0 ? 0 : last;
    put(end, 1);
    slope(end, s - end);
    return { first, weights };
  }
  const u = s - interval;
  const [u2, u3] = [u * u, u * u * u];
  put(interval, 1 - 3 * u2 + 2 * u3);
  put(interval + 1, 3 * u2 - 2 * u3);
  slope(interval, u - 2 * u2 + u3);
  slope(interval + 1, u3 - u2);
  return { first, weights };
}
