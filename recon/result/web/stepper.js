// Asks the engine, which runs in a worker; in the page itself where the browser allows no worker.

'use strict';

class Stepper {
  #waiting = new Map(); // id of a question: what to do with its answer
  #next = 0;

  constructor(about, arrays) {
    this.worker = this.#hired();
    this.engine = this.worker ? null : new Engine(about, arrays);
    if (this.worker) this.#ask('begin', { about, arrays });
  }

  /** A worker that knows the engine, from the text that stands in this page. */
  #hired() {
    try {
      const url = URL.createObjectURL(new Blob([textOf('engine')], { type: 'text/javascript' }));
      const worker = new Worker(url);
      worker.onmessage = ({ data: { id, answer } }) => {
        const { resolve } = this.#waiting.get(id);
        this.#waiting.delete(id);
        resolve(answer);
      };
      worker.onerror = (event) => {
        for (const { reject } of this.#waiting.values()) reject(new Error(event.message || 'the worker ended'));
        this.#waiting.clear();
      };
      return worker;
    } catch {
      return null;
    }
  }

  #ask(call, ask) {
    if (this.engine) return Promise.resolve(this.engine[call](ask));
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
