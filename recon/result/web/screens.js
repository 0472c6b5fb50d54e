// The videos in space: each camera's picture of the moment on the far side of its pyramid.

'use strict';

const SCREEN_VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec3 place;
layout(location = 1) in vec2 at;
${PROJECTION}
out vec2 texel;

void main() {
  gl_Position = projected(place);
  texel = at;
}`;

const SCREEN_FRAGMENT = `#version 300 es
precision mediump float;
in vec2 texel;
uniform sampler2D picture;
uniform float cover;
out vec4 color;

void main() {
  color = vec4(texture(picture, texel).rgb, 1.0) * cover;
}`;

class Screens {
  constructor(gl) {
    this.gl = gl;
    this.program = program(gl, SCREEN_VERTEX, SCREEN_FRAGMENT);
    this.screens = new Map(); // camera: { texture, array, buffer }
  }

  #made(v) {
    const { gl } = this;
    const screen = { texture: gl.createTexture(), array: gl.createVertexArray(), buffer: gl.createBuffer() };
    gl.bindVertexArray(screen.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, screen.buffer);
    for (const [place, width, first] of [[0, 3, 0], [1, 2, 3]]) {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, width, gl.FLOAT, false, 20, 4 * first);
    }
    gl.bindVertexArray(null);
    this.screens.set(v, screen);
    return screen;
  }

  /** Puts the picture of camera `v` between four corners: upper left, upper right, lower right, lower left. */
  put(v, { picture, shown }, [a, b, c, d]) {
    const { gl } = this;
    const screen = this.screens.get(v) ?? this.#made(v);
    gl.bindBuffer(gl.ARRAY_BUFFER, screen.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([...a, 0, 0, ...b, 1, 0, ...d, 0, 1, ...c, 1, 1]), gl.DYNAMIC_DRAW);
    if (screen.shown === shown) return;
    screen.shown = shown;
    gl.bindTexture(gl.TEXTURE_2D, screen.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture);
    for (const [name, value] of [
      [gl.TEXTURE_MIN_FILTER, gl.LINEAR],
      [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
      [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE],
      [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
    ]) gl.texParameteri(gl.TEXTURE_2D, name, value);
  }

  /** Draws the picture of camera `v`; `cover`: 0..1, how much of what lies behind it is hidden. */
  draw(v, shot, near, cover) {
    const screen = this.screens.get(v);
    if (!screen) return;
    const { gl } = this;
    const { made, uniforms } = this.program;
    gl.useProgram(made);
    aim(gl, uniforms, shot, near);
    gl.uniform1i(uniforms.picture, 0);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, screen.texture);
    gl.uniform1f(uniforms.cover, cover);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(screen.array);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    gl.bindVertexArray(null);
  }
}
