// The page's data: arrays that were packed by recon/result/packing.py, and pictures.

'use strict';

/** The bytes of a base64 text. */
function bytesOf(text) {
  const raw = atob(text.trim());
  const bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes;
}

/** The bytes that a zlib stream holds. */
async function inflated(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/**
 * Arrays by name, from the entries that describe them and the bytes that hold them one after the other.
 *
 * An array of more than one byte a value lies in planes: all first bytes, then all second ones.
 */
function arraysOf(entries, bytes) {
  const found = {};
  let at = 0;
  for (const entry of entries) {
    const count = entry.shape.reduce((a, b) => a * b, 1);
    const width = { u8: 1, u16: 2, u32: 4, f32: 4 }[entry.kind];
    const planes = bytes.subarray(at, at + count * width);
    at += count * width;
    const joined = new Uint8Array(count * width);
    for (let b = 0; b < width; b++) for (let i = 0; i < count; i++) joined[i * width + b] = planes[b * count + i];
    const kinds = { u8: Uint8Array, u16: Uint16Array, u32: Uint32Array, f32: Float32Array };
    const view = new kinds[entry.kind](joined.buffer);
    found[entry.name] = entry.low ? measured(view, entry.low, entry.step) : view;
  }
  return found;
}

/** Numbers from steps: low + step * value, with a low and a step for each column. */
function measured(values, low, step) {
  const out = new Float32Array(values.length);
  const columns = low.length;
  for (let i = 0; i < out.length; i++) out[i] = low[i % columns] + step[i % columns] * values[i];
  return out;
}

/** The text of an element of the page. */
const textOf = (id) => document.getElementById(id).textContent;

/** Everything that the page holds: its header and its arrays. */
async function readScene() {
  const about = JSON.parse(textOf('about'));
  return { about, arrays: arraysOf(about.arrays, await inflated(bytesOf(textOf('scene')))) };
}
