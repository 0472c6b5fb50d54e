// Vectors, rotations and quaternions as plain arrays. Rotations are 3 x 3, row by row; quaternions are wxyz.
// Used by the page and by its worker.

'use strict';

const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const times = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const length = (a) => Math.hypot(a[0], a[1], a[2]);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => times(a, 1 / Math.max(length(a), 1e-12));
const mix = (a, b, s) => a + (b - a) * s;
const mix3 = (a, b, s) => [mix(a[0], b[0], s), mix(a[1], b[1], s), mix(a[2], b[2], s)];
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

/** M v for a 3 x 3 matrix. */
const turn = (M, v) => [
  M[0] * v[0] + M[1] * v[1] + M[2] * v[2],
  M[3] * v[0] + M[4] * v[1] + M[5] * v[2],
  M[6] * v[0] + M[7] * v[1] + M[8] * v[2],
];

/** A B for 3 x 3 matrices. */
function matrixProduct(A, B) {
  const out = new Array(9);
  for (let i = 0; i < 3; i++) {
    for (let j = 0; j < 3; j++) {
      out[3 * i + j] = A[3 * i] * B[j] + A[3 * i + 1] * B[3 + j] + A[3 * i + 2] * B[6 + j];
    }
  }
  return out;
}

const transposed = (M) => [M[0], M[3], M[6], M[1], M[4], M[7], M[2], M[5], M[8]];

/** The rotation by `angle` radians about the unit vector `axis`. */
function aboutAxis(axis, angle) {
  const s = Math.sin(angle / 2);
  return rotationOf([Math.cos(angle / 2), axis[0] * s, axis[1] * s, axis[2] * s]);
}

/** The rotation of a unit quaternion. */
function rotationOf([w, x, y, z]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

/** A unit quaternion of a rotation. */
function quaternionOf(M) {
  const candidates = [
    [1 + M[0] + M[4] + M[8], M[7] - M[5], M[2] - M[6], M[3] - M[1]],
    [M[7] - M[5], 1 + M[0] - M[4] - M[8], M[1] + M[3], M[2] + M[6]],
    [M[2] - M[6], M[1] + M[3], 1 - M[0] + M[4] - M[8], M[5] + M[7]],
    [M[3] - M[1], M[2] + M[6], M[5] + M[7], 1 - M[0] - M[4] + M[8]],
  ];
  let best = 0; // the one whose own component is the largest loses no digits
  for (let k = 1; k < 4; k++) if (candidates[k][k] > candidates[best][best]) best = k;
  const q = candidates[best];
  const norm = Math.hypot(q[0], q[1], q[2], q[3]);
  return q.map((x) => x / norm);
}

/** From unit quaternion p to q along the shorter arc, s in 0..1. */
function slerp(p, q, s) {
  let cosine = p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3];
  const sign = cosine < 0 ? -1 : 1;
  cosine = Math.min(1, cosine * sign);
  const angle = Math.acos(cosine);
  const share = (part) => (angle < 1e-4 ? part : Math.sin(part * angle) / Math.sin(angle));
  const [a, b] = [share(1 - s), share(s)];
  const out = p.map((x, k) => a * x + b * sign * q[k]);
  const norm = Math.hypot(out[0], out[1], out[2], out[3]);
  return out.map((x) => x / norm);
}
