// Mouse, touch and keys on the scene, and the page's buttons.

'use strict';

const TURN = 0.006; // radians per pixel
const KEY_TURN = 0.09; // radians per key
const SPEEDS = [0.02, 0.1, 0.25, 0.5, 1];

const part = (id) => document.getElementById(id);

/** Drags, pinches, the wheel and the arrow keys move the view. `changed` is called after each. */
function steer(canvas, view, stage, changed, chosen) {
  const fingers = new Map(); // pointer: its last place
  let travelled = 0;

  canvas.addEventListener('pointerdown', (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    travelled = 0;
  });
  canvas.addEventListener('pointermove', (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    travelled += Math.abs(dx) + Math.abs(dy);
    if (travelled < 4) return; // a click trembles
    fingers.set(event.pointerId, now);
    const height = canvas.clientHeight;
    if (fingers.size === 2) {
      const [other] = [...fingers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
      const apart = (place) => Math.max(1, Math.hypot(place[0] - other[0], place[1] - other[1]));
      view.zoom(apart(before) / apart(now));
      view.pan(dx / 2 / height, dy / 2 / height);
    } else if (event.buttons & 6 || event.shiftKey) {
      view.pan(dx / height, dy / height);
    } else {
      view.orbit(dx * TURN, dy * TURN);
    }
    part('hint').classList.add('known'); // whoever has turned the scene needs no hint
    changed();
  });
  const lift = (event) => {
    fingers.delete(event.pointerId);
    if (event.type === 'pointerup' && travelled < 4) {
      const camera = stage.labelAt(event.clientX, event.clientY);
      if (camera >= 0) chosen(camera);
    }
  };
  canvas.addEventListener('pointerup', lift);
  canvas.addEventListener('pointercancel', lift);
  canvas.addEventListener('contextmenu', (event) => event.preventDefault());
  canvas.addEventListener('wheel', (event) => {
    event.preventDefault();
    const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 16 : 1;
    view.zoom(Math.exp(clamp(event.deltaY * lines, -200, 200) * 0.0016));
    changed();
  }, { passive: false });

  const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  canvas.addEventListener('keydown', (event) => {
    if (event.key in arrows) {
      const [x, y] = arrows[event.key];
      if (event.shiftKey) view.pan(-0.04 * x, 0.04 * y);
      else view.orbit(-x * KEY_TURN, y * KEY_TURN);
    } else if (event.key === '+' || event.key === '=') {
      view.zoom(0.9);
    } else if (event.key === '-') {
      view.zoom(1 / 0.9);
    } else {
      return;
    }
    event.preventDefault();
    changed();
  });
}

/** Keys that work wherever the focus is, but where something is typed or chosen. `actions`: by key. */
function listen(actions) {
  window.addEventListener('keydown', (event) => {
    const { target } = event;
    if (event.ctrlKey || event.metaKey || event.altKey || target.closest?.('select, dialog')) return;
    if (event.key === ' ' && target.closest?.('button, label, input[type="checkbox"], input[type="radio"]')) return;
    const action = actions[event.key] ?? actions[event.key.toLowerCase()];
    if (!action) return;
    event.preventDefault();
    action(event);
  });
}

/** A tile for every video: its picture, name, offset and how far it can be trusted. Names are text, never markup. */
function videoTiles(list, { cameras, step }, origin, chosen) {
  return cameras.map((camera, v) => {
    const item = document.createElement('li');
    const button = document.createElement('button');
    const picture = document.createElement('canvas');
    const words = document.createElement('span');
    const name = document.createElement('b');
    const [offset, trust] = [0, 1].map(() => document.createElement('small'));
    button.type = 'button';
    button.title = `Look through ${camera.name}`;
    button.setAttribute('aria-pressed', 'false');
    words.className = 'words';
    words.style.borderTopColor = camera.color;
    name.textContent = camera.name;
    offset.textContent = offsetWords(camera, origin);
    offset.title = `${(lateBy(camera, origin) / step).toFixed(2)} frames of the reference`;
    trust.textContent = camera.trust;
    trust.title = camera.remedy;
    trust.className = camera.doubtful ? 'doubt' : '';
    words.append(name, offset, trust);
    if (camera.strip) {
      Object.assign(picture, { width: camera.strip.width, height: camera.strip.height });
      button.append(picture);
    }
    button.append(words);
    button.addEventListener('click', () => chosen(v));
    item.append(button);
    list.append(item);
    return { button, picture, offset };
  });
}

/** World seconds from where the reference's video begins to where this one does: what the bars show. */
function lateBy({ rate, first, offset }, origin) {
  return rate * first + offset - origin;
}

/** How late a video began, and how sure that is; `origin`: the world second at which the reference's begins. */
function offsetWords(camera, origin) {
  if (camera.reference) return 'the reference';
  const late = lateBy(camera, origin);
  const sure = camera.sigma === null ? '' : ` ± ${(1000 * camera.sigma).toFixed(1)}`;
  return `${(1000 * Math.abs(late)).toFixed(1)}${sure} ms ${late >= 0 ? 'late' : 'early'}`;
}
