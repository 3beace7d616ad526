// Sends each change as it is made, one after the other, and holds what is not saved yet.

const RETRY_MS = 1000;

export class Saver {
  #state;
  #waiting = []; // places of frames whose label is to be sent
  #sending = false;
  #tell;

  // tell: { saving(), saved(), broken(text), conflict(place, mine, theirs) }
  constructor(state, tell) {
    this.#state = state;
    this.#tell = tell;
    this.broken = false;
    addEventListener("beforeunload", (event) => {
      if (this.#waiting.length) event.preventDefault();
    });
  }

  get idle() {
    return this.#waiting.length === 0;
  }

  get unsaved() {
    return this.#waiting.length;
  }

  save(place) {
    // the newest label of a frame is enough, but one that is on its way stays first
    if (this.#waiting.indexOf(place, this.#sending ? 1 : 0) < 0) this.#waiting.push(place);
    this.#tell.saving();
    if (!this.#sending) this.#send();
  }

  async #send() {
    this.#sending = true;
    while (this.#waiting.length) {
      const place = this.#waiting[0];
      const frame = this.#state.frames[place];
      const label = frame.label;
      let answer;
      try {
        answer = await this.#post(frame, label);
      } catch (error) {
        this.broken = true;
        this.#tell.broken(error.message);
        await new Promise((resolve) => { setTimeout(resolve, RETRY_MS); });
        continue;
      }
      this.broken = false;
      this.#waiting.shift();
      frame.revision = answer.revision;
      if (answer.conflict) {
        this.#waiting = this.#waiting.filter((other) => other !== place);
        const mine = frame.label;
        frame.label = answer.label;
        this.#tell.conflict(place, mine, answer.label);
      } else if (frame.label === label) {
        frame.label = answer.label;
      }
    }
    this.#sending = false;
    this.#tell.saved();
  }

  async #post(frame, label) {
    const sent = label && { state: label.state, u: label.u, v: label.v };
    let response;
    try {
      response = await fetch("label", {
        method: "POST",
        keepalive: true, // a reload does not stop it
        headers: { "content-type": "application/json" },
        body: JSON.stringify({
          recording: this.#state.recording,
          stamp_ns: frame.stamp_ns,
          revision: frame.revision,
          label: sent,
        }),
      });
    } catch {
      throw new Error("The server does not answer.");
    }
    const answer = await response.json().catch(() => ({ error: "no JSON" }));
    if (response.status === 409) return { ...answer, conflict: true };
    if (!response.ok) throw new Error(`Not saved: ${answer.error} (${response.status})`);
    return answer;
  }
}
