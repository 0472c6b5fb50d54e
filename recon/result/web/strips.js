// What the cameras filmed: a strip of small pictures of every video.

'use strict';

/** The pictures of one video. */
class Strip {
  /** @param about times (s on the video's own clock), columns, width and height of a picture. */
  constructor(about, sheet) {
    this.about = about;
    this.sheet = sheet; // all pictures, row by row
  }

  static async of(about, text) {
    return new Strip(about, await createImageBitmap(new Blob([bytesOf(text)], { type: 'image/webp' })));
  }

  /** Index of the picture nearest to a second of the own clock; -1 where the video was not running. */
  nearest(own) {
    const { times: all } = this.about;
    const gap = all.length > 1 ? (all[all.length - 1] - all[0]) / (all.length - 1) : 0.1;
    if (own < all[0] - gap || own > all[all.length - 1] + gap) return -1;
    let best = 0;
    for (let k = 1; k < all.length; k++) if (Math.abs(all[k] - own) < Math.abs(all[best] - own)) best = k;
    return best;
  }

  /** Draws the picture at `own` into a rectangle of a 2D canvas; whether there is one. */
  draw(context, own, x, y, width, height) {
    const k = this.nearest(own);
    if (k < 0) return false;
    const { columns, width: w, height: h } = this.about;
    context.imageSmoothingQuality = 'high';
    context.drawImage(this.sheet, (k % columns) * w, Math.floor(k / columns) * h, w, h, x, y, width, height);
    return true;
  }
}

/** The strips of all cameras; null for a camera without one. */
function readStrips(cameras) {
  const read = async (camera, v) => {
    if (!camera.strip) return null;
    try {
      return await Strip.of(camera.strip, textOf(`strip-${v}`));
    } catch {
      return null; // a browser without WebP shows the scene all the same
    }
  };
  return Promise.all(cameras.map(read));
}
