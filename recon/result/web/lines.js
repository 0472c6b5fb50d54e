// Lines and dots over the rendering: frusta, trajectories, and where things are on each video's clock.

'use strict';

/** Where a place of the world is seen, in clip coordinates with w = z; in every shader that draws over Gaussians. */
const PROJECTION = `
uniform mat3 turn;
uniform vec3 shift;
uniform vec4 lens;
uniform vec2 size;
uniform float near;

vec4 projected(vec3 place) {
  vec3 at = turn * place + shift;
  // with w = z what begins behind the camera is cut by the card
  vec2 scaled = 2.0 * (lens.xy * at.xy + lens.zw * at.z) / size - at.z;
  return vec4(scaled.x, -scaled.y, at.z - 2.0 * near, at.z);
}
`;

/** Sets the uniforms of `PROJECTION` to a shot. */
function aim(gl, uniforms, shot, near) {
  gl.uniformMatrix3fv(uniforms.turn, true, shot.turn);
  gl.uniform3fv(uniforms.shift, shot.shift);
  gl.uniform4fv(uniforms.lens, shot.lens);
  gl.uniform2f(uniforms.size, shot.width, shot.height);
  gl.uniform1f(uniforms.near, near);
}

const LINE_VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec3 place;
layout(location = 1) in vec4 paint;
layout(location = 2) in float moment;  // world second that a vertex belongs to
${PROJECTION}
uniform float dot_size;
uniform vec3 trail;  // world second, how long before it a trail begins, how long after it ends; 0: all is drawn alike
out vec4 color;

void main() {
  gl_Position = projected(place);
  gl_PointSize = dot_size;
  float late = moment - trail.x;
  float shown = trail.y + trail.z <= 0.0 ? 1.0 : late <= 0.0 ? 1.0 + late / trail.y : 1.0 - late / max(trail.z, 1e-6);
  color = vec4(paint.rgb, paint.a * clamp(shown, 0.0, 1.0));
}`;

const LINE_FRAGMENT = `#version 300 es
precision mediump float;
in vec4 color;
uniform float round_dots;
out vec4 result;

void main() {
  float alpha = color.a;
  if (round_dots > 0.0) {
    float r = length(gl_PointCoord - 0.5) * 2.0;
    alpha *= 1.0 - smoothstep(0.7, 1.0, r);
  }
  if (alpha <= 0.003) discard;
  result = vec4(color.rgb * alpha, alpha);
}`;

const LINE_FLOATS = 8; // x, y, z; r, g, b, a; world second

/** Lines and dots that are drawn over the Gaussians. */
class Lines {
  constructor(gl) {
    this.gl = gl;
    this.program = program(gl, LINE_VERTEX, LINE_FRAGMENT);
    this.sets = new Map(); // name: { array, buffer, count, mode }
  }

  /** Puts the set `name`: rows of x, y, z, r, g, b, a, world second. `mode`: 'lines' (pairs) or 'dots'. */
  put(name, vertices, mode = 'lines') {
    const { gl } = this;
    if (!this.sets.has(name)) {
      const set = { array: gl.createVertexArray(), buffer: gl.createBuffer() };
      gl.bindVertexArray(set.array);
      gl.bindBuffer(gl.ARRAY_BUFFER, set.buffer);
      for (const [place, width, first] of [[0, 3, 0], [1, 4, 3], [2, 1, 7]]) {
        gl.enableVertexAttribArray(place);
        gl.vertexAttribPointer(place, width, gl.FLOAT, false, 4 * LINE_FLOATS, 4 * first);
      }
      gl.bindVertexArray(null);
      this.sets.set(name, set);
    }
    const set = this.sets.get(name);
    gl.bindBuffer(gl.ARRAY_BUFFER, set.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, vertices, gl.DYNAMIC_DRAW);
    set.count = vertices.length / LINE_FLOATS;
    set.mode = mode === 'dots' ? gl.POINTS : gl.LINES;
  }

  /** Draws one set; `trail`: [world second, seconds before, seconds after], or zeros. `dot`: diameter in pixels. */
  draw(name, shot, { trail = [0, 0, 0], dot = 1, near = 1e-3 } = {}) {
    const set = this.sets.get(name);
    if (!set?.count) return;
    const { gl } = this;
    const { made, uniforms } = this.program;
    gl.useProgram(made);
    aim(gl, uniforms, shot, near);
    gl.uniform1f(uniforms.dot_size, dot);
    gl.uniform1f(uniforms.round_dots, set.mode === gl.POINTS ? 1 : 0);
    gl.uniform3fv(uniforms.trail, trail);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(set.array);
    gl.drawArrays(set.mode, 0, set.count);
    gl.bindVertexArray(null);
  }
}

/** Rows of vertices for segments: `segments` of [[from, to], ...], all of one colour. */
function segmentRows(segments, [r, g, b], alpha = 1) {
  const out = new Float32Array(segments.length * 2 * LINE_FLOATS);
  segments.forEach(([from, to], i) => {
    out.set([...from, r, g, b, alpha, 0], 2 * i * LINE_FLOATS);
    out.set([...to, r, g, b, alpha, 0], (2 * i + 1) * LINE_FLOATS);
  });
  return out;
}
