// Asks the engine, which runs in a worker; in the page itself where the browser allows no worker.

'use strict';

class Stepper {
  #waiting = new Map(); // id of a question: what to do with its answer
  #next = 0;

  /** A stepper that knows the scene. */
  static async of(about, arrays) {
    const stepper = new Stepper();
    try {
      stepper.#hire();
      await stepper.#ask('begin', { about, arrays });
    } catch {
      stepper.worker = null; // a browser may refuse workers to pages that are opened as files
      stepper.engine = new Engine(about, arrays);
    }
    return stepper;
  }

  /** A worker that knows the engine, from the text that stands in this page. */
  #hire() {
    const url = URL.createObjectURL(new Blob([textOf('engine')], { type: 'text/javascript' }));
    this.worker = new Worker(url);
    this.worker.onmessage = ({ data: { id, answer } }) => {
      const { resolve } = this.#waiting.get(id);
      this.#waiting.delete(id);
      resolve(answer);
    };
    this.worker.onerror = (event) => {
      for (const { reject } of this.#waiting.values()) reject(new Error(event.message || 'its worker ended'));
      this.#waiting.clear();
    };
  }

  #ask(call, ask) {
    if (!this.worker) return Promise.resolve(this.engine[call](ask));
    return new Promise((resolve, reject) => {
      this.#waiting.set(this.#next, { resolve, reject });
      this.worker.postMessage({ id: this.#next++, call, ask });
    });
  }

  /** See Engine.step. */
  step(ask) {
    return this.#ask('step', ask);
  }

  /** See Engine.paths. */
  paths(ask) {
    return this.#ask('paths', ask);
  }
}
