// Draws Gaussians with WebGL2, as recon/raster does: EWA splatting, blended far to near.

'use strict';

const ROW_TEXELS = ORDER_ROW; // of all textures; where they hold Gaussians, two texels each
const PER_ROW = ROW_TEXELS / 2;

const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

uniform usampler2D order;  // what to draw, far to near
uniform sampler2D places;  // x, y, z, 0; quaternion wxyz
uniform sampler2D looks;   // standard deviations along three axes, opacity; colour
uniform mat3 turn;         // world to camera
uniform vec3 shift;
uniform vec4 lens;         // fx, fy, cx, cy in pixels
uniform vec2 size;         // of the canvas, pixels
uniform vec4 bounds;       // of the image, pixels: left, top, right, bottom
uniform float blur;        // variance in square pixels added to every splat
uniform vec3 gain;         // of the colours
uniform sampler2D bands;   // spherical harmonics beyond the constant, one texel each
uniform int degree;        // of the spherical harmonics; 0: colours do not depend on the view
out vec2 across;           // standard deviations from the middle
out vec2 from_axis;        // from the principal point, in half diagonals of the image
flat out vec4 paint;
flat out float reach2;

const float LEAST_ALPHA = 1.0 / 255.0;
const float MARGIN = 0.15;  // of the image's size: how far outside the Jacobian still follows x / z

mat3 rotation(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

vec3 band(int index, int harmonic) {
  int count = (degree + 1) * (degree + 1) - 1;
  int texel = index * count + harmonic - 1;
  return texelFetch(bands, ivec2(texel % ${ROW_TEXELS}, texel / ${ROW_TEXELS}), 0).rgb;
}

// What the harmonics beyond the constant add to the colour in a direction: recon/raster/sh.py.
vec3 shade(int index, vec3 direction) {
  vec3 sum = vec3(0.0);
  float cosine = 1.0, sine = 0.0;       // of m * azimuth, times sin(polar)^m
  float edge = 1.0;                     // Legendre polynomial l = m
  for (int m = 0; m <= degree; m++) {
    float before = 0.0, here = edge;    // those of l - 1 and l
    float ratio = 1.0;                  // (l - m)! / (l + m)!
    for (int k = 1; k <= 2 * m; k++) ratio /= float(k);
    for (int l = m; l <= degree; l++) {
      float norm = sqrt(float(2 * l + 1) / 6.283185307179586 * ratio);
      if (m > 0) {
        norm *= (m & 1) == 1 ? -1.0 : 1.0;
        sum += norm * here * (cosine * band(index, l * l + l + m) + sine * band(index, l * l + l - m));
      } else if (l > 0) {
        sum += norm * 0.7071067811865476 * here * band(index, l * l + l);
      }
      float next = (float(2 * l + 1) * direction.z * here - float(l + m) * before) / float(l - m + 1);
      before = here;
      here = next;
      ratio *= float(l + 1 - m) / float(l + 1 + m);
    }
    float turned = direction.x * cosine - direction.y * sine;
    sine = direction.x * sine + direction.y * cosine;
    cosine = turned;
    edge *= float(2 * m + 1);
  }
  return sum;
}

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // beyond the canvas: not drawn
  int splat = gl_VertexID >> 2;
  int index = int(texelFetch(order, ivec2(splat % ${ROW_TEXELS}, splat / ${ROW_TEXELS}), 0).r);
  ivec2 at = ivec2((index % ${PER_ROW}) * 2, index / ${PER_ROW});
  vec4 look = texelFetch(looks, at, 0);
  if (look.w < LEAST_ALPHA) return;
  vec3 place = texelFetch(places, at, 0).xyz;
  vec3 mean = turn * place + shift;
  float z = mean.z;
  if (z <= 0.0) return;
  mat3 axes = turn * rotation(normalize(texelFetch(places, at + ivec2(1, 0), 0)));
  axes[0] *= look.x;
  axes[1] *= look.y;
  axes[2] *= look.z;

  // u, v: how far a standard deviation along each axis moves the splat in x and y
  vec2 tangent = mean.xy / z;
  vec2 low = (bounds.xy - lens.zw - MARGIN * (bounds.zw - bounds.xy)) / lens.xy;
  vec2 high = (bounds.zw - lens.zw + MARGIN * (bounds.zw - bounds.xy)) / lens.xy;
  vec2 held = clamp(tangent, low, high);
  mat3 rows = transpose(axes);
  vec3 u = lens.x / z * (rows[0] - held.x * rows[2]);
  vec3 v = lens.y / z * (rows[1] - held.y * rows[2]);

  // the covariance's own axes; its determinant is a sum of squares, so that needles keep their width
  float uu = dot(u, u), vv = dot(v, v), uv = dot(u, v);
  vec3 area = cross(u, v);
  float det = dot(area, area) + blur * (uu + vv) + blur * blur;
  float half_sum = 0.5 * (uu + vv) + blur;
  float half_gap = 0.5 * (uu - vv);
  float larger = half_sum + sqrt(half_gap * half_gap + uv * uv);
  float smaller = det / larger;
  vec2 along = abs(uv) > 1e-9 * larger ? normalize(vec2(uv, larger - uu - blur)) : (uu >= vv ? vec2(1, 0) : vec2(0, 1));

  reach2 = 2.0 * log(look.w / LEAST_ALPHA);
  vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
  across = corner * sqrt(reach2);
  vec2 middle = lens.xy * tangent + lens.zw;
  vec2 pixel = middle + across.x * sqrt(larger) * along + across.y * sqrt(smaller) * vec2(-along.y, along.x);
  vec3 tint = texelFetch(looks, at + ivec2(1, 0), 0).rgb;
  if (degree > 0) tint = max(tint + shade(index, normalize(place + transpose(turn) * shift)), 0.0);
  paint = vec4(tint * gain, look.w);
  from_axis = (pixel - lens.zw) / (0.5 * length(bounds.zw - bounds.xy));
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
in vec2 across;
in vec2 from_axis;
flat in vec4 paint;
flat in float reach2;
uniform vec2 falloff;      // of the colours: log V = falloff.x * r^2 + falloff.y * r^4
out vec4 color;

void main() {
  float distance2 = dot(across, across);
  if (distance2 > reach2) discard;
  float alpha = min(0.999, paint.a * exp(-0.5 * distance2));
  float r2 = dot(from_axis, from_axis);
  color = vec4(paint.rgb * exp(r2 * (falloff.x + r2 * falloff.y)) * alpha, alpha);
}`;

/** A compiled program with the places of its uniforms. Errors name the stage that does not compile. */
function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = gl.getAttachedShaders(made).map((shader) => gl.getShaderInfoLog(shader));
    throw new Error(`shaders do not compile: ${[...logs, gl.getProgramInfoLog(made)].filter(Boolean).join('; ')}`);
  }
  const uniforms = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(made, i);
    uniforms[name] = gl.getUniformLocation(made, name);
  }
  return { made, uniforms };
}

/** The Gaussians on the graphics card. */
class Splats {
  /** @param about the page's header. @param arrays as decode.js gives them. */
  constructor(gl, about, arrays) {
    this.gl = gl;
    this.program = program(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.count = 0;
    this.rows = { moving: about.row_start / PER_ROW, all: Math.ceil((about.row_start + about.still) / PER_ROW) || 1 };
    this.places = this.#texture(this.#stillPlaces(about, arrays));
    this.looks = this.#texture(this.#looksOf(about, arrays));
    this.degree = about.degree;
    this.bands = this.#texture(this.#bandsOf(about, arrays));
    this.order = gl.createTexture();
    this.array = this.#corners(about.row_start + about.still);
  }

  /** Two triangles for each of `count` splats, in one draw: tiny instances are slow, and on a CPU very slow. */
  #corners(count) {
    const { gl } = this;
    const indices = new Uint32Array(6 * count);
    for (let n = 0; n < count; n++) indices.set([4 * n, 4 * n + 1, 4 * n + 2, 4 * n + 2, 4 * n + 1, 4 * n + 3], 6 * n);
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return array;
  }

  /** A texture of whole rows of four floats a texel. */
  #texture(values) {
    const { gl } = this;
    const texture = gl.createTexture();
    const rows = values.length / (4 * ROW_TEXELS);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, ROW_TEXELS, rows, 0, gl.RGBA, gl.FLOAT, values);
    this.#unfiltered();
    return texture;
  }

  #unfiltered() {
    const { gl } = this;
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
      gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    }
  }

  /** Places of what is static; those of what moves follow with every instant. */
  #stillPlaces(about, arrays) {
    const values = new Float32Array(this.rows.all * ROW_TEXELS * 4);
    for (let n = 0; n < about.still; n++) {
      const o = 8 * (about.row_start + n);
      values.set(arrays.static_means.subarray(3 * n, 3 * n + 3), o);
      values.set(arrays.static_quats.subarray(4 * n, 4 * n + 4), o + 4);
    }
    return values;
  }

  #looksOf(about, arrays) {
    const values = new Float32Array(this.rows.all * ROW_TEXELS * 4);
    for (const [part, count, first] of [['dynamic', about.moving, 0], ['static', about.still, about.row_start]]) {
      const names = ['log_scales', 'opacities', 'colors'];
      const [scales, opacities, colors] = names.map((name) => arrays[`${part}_${name}`]);
      for (let n = 0; n < count; n++) {
        const o = 8 * (first + n);
        for (let c = 0; c < 3; c++) {
          values[o + c] = Math.exp(scales[3 * n + c]);
          values[o + 4 + c] = colors[3 * n + c];
        }
        values[o + 3] = opacities[n];
      }
    }
    return values;
  }

  /** Spherical harmonics beyond the constant: as many texels a Gaussian. */
  #bandsOf(about, arrays) {
    const count = (about.degree + 1) ** 2 - 1;
    const rows = Math.max(1, Math.ceil(((about.row_start + about.still) * count) / ROW_TEXELS));
    const values = new Float32Array(rows * ROW_TEXELS * 4);
    for (const [part, first] of [['dynamic', 0], ['static', about.row_start]]) {
      const bands = arrays[`${part}_bands`]; // [N, harmonics, 3]; a part may have fewer than the other
      if (!bands) continue;
      const own = (about.degrees[part] + 1) ** 2 - 1;
      for (let i = 0; i < bands.length / 3; i++) {
        const texel = (first + Math.floor(i / own)) * count + (i % own);
        values.set(bands.subarray(3 * i, 3 * i + 3), 4 * texel);
      }
    }
    return values;
  }

  /** Takes what the engine computed for an instant and a view. */
  take({ places, order, drawn }) {
    const { gl } = this;
    if (places?.length) {
      gl.bindTexture(gl.TEXTURE_2D, this.places);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW_TEXELS, this.rows.moving, gl.RGBA, gl.FLOAT, places);
    }
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    const rows = order.length / ROW_TEXELS;
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32UI, ROW_TEXELS, rows, 0, gl.RED_INTEGER, gl.UNSIGNED_INT, order);
    this.#unfiltered();
    this.count = drawn;
  }

  /**
   * Draws into the present framebuffer; `shot` is a Shot of view.js, `gain` three factors, `falloff` the coefficients of
   * the lens's vignetting.
   */
  draw(shot, gain, falloff) {
    const { gl } = this;
    const { made, uniforms } = this.program;
    gl.useProgram(made);
    gl.uniform1i(uniforms.places, 0);
    gl.uniform1i(uniforms.looks, 1);
    gl.uniformMatrix3fv(uniforms.turn, true, shot.turn);
    gl.uniform3fv(uniforms.shift, shot.shift);
    gl.uniform4fv(uniforms.lens, shot.lens);
    gl.uniform2f(uniforms.size, shot.width, shot.height);
    gl.uniform4fv(uniforms.bounds, shot.bounds);
    gl.uniform1f(uniforms.blur, shot.blur);
    gl.uniform3fv(uniforms.gain, gain);
    gl.uniform2fv(uniforms.falloff, falloff);
    gl.uniform1i(uniforms.degree, this.degree);
    gl.uniform1i(uniforms.bands, 2);
    gl.uniform1i(uniforms.order, 3);
    [this.places, this.looks, this.bands, this.order].forEach((texture, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    gl.activeTexture(gl.TEXTURE0);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.array);
    gl.drawElements(gl.TRIANGLES, 6 * this.count, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(null);
  }
}
